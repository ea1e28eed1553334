"""`lightprobe estimate PHOTO -o OUT.exr`: a photograph in; a light probe, the ball and a sheet of spheres out.

Only the options are here, so that help comes without loading torch; names are checked against their tables by the
run, and this text against the tables by the tests.
"""

from __future__ import annotations

import argparse

__all__ = ["add_arguments", "run"]


def add_arguments(parser: argparse.ArgumentParser) -> None:
    """Declare the options of `estimate`."""
    add = parser.add_argument
    add("photo", metavar="PHOTO", help="photograph: JPEG, PNG, TIFF, WebP ...")
    add("-o", "--output", metavar="OUT.exr", required=True, help="map to write: .exr, or .hdr")
    add("--preset", help="draft, fast, balanced, best, turbo or paper (default: balanced)")
    add(
        "--budget",
        type=float,
        metavar="SECONDS",
        help="in place of a preset: the best one whose painting is done in time, by a short calibration",
    )
    add("--seed", type=int, default=0, help="of the first ball (default: 0)")
    add("--evs", metavar="0,-2.5,-5", help="exposures, descending from 0 (default: the preset's)")
    add(
        "--bracket",
        default="fixed",
        help="fixed: every exposure; scene: the next darker one only while the last one clips, on to --darkest "
        "(default: fixed)",
    )
    add(
        "--darkest",
        metavar="EV",
        type=float,
        help="with --bracket scene, where exposures end (default: what the model was trained to, -5; further down it "
        "paints what it never saw)",
    )
    add(
        "--tolerance",
        type=float,
        help="error a median may have, in display values, such as 0.02: a round ends once its median is within, and "
        "leaves out balls unlike the others; the preset's balls are the most it paints (default: it paints them all)",
    )
    add("--min-balls", type=int, default=6, help="with --tolerance, the fewest balls of a round (default: 6)")
    add(
        "--reject",
        action="store_true",
        help="leave balls unlike the others out, and replace them",
    )
    add(
        "--light-balls",
        type=int,
        default=0,
        help="balls to paint to the end besides, whose lights are given back to a median, which loses them; with "
        "draft, fast, balanced and best; 5 are enough (default: 0, none)",
    )
    add("--merge", default="robust", help="robust, channel or paper: how exposures become radiance (default: robust)")
    add("--height", type=int, default=256, help="rows of the map, half its width (default: 256)")
    add(
        "--depth",
        metavar="FILE|FOLDER",
        help="depth of the photograph as a picture, near is bright; or the folder of a depth model of transformers', "
        "which then estimates depth anew for every round (default: all far)",
    )
    add("--diameter", type=int, help="of the ball in canvas pixels (default: the model's)")
    add("--x", type=float, help="column of the ball's centre on the canvas (default: the middle)")
    add("--y", type=float, help="row of the ball's centre on the canvas (default: the middle)")
    add(
        "--depth-disc",
        metavar="NAME",
        help="what the depth map shows of the ball: ball, or authors, their code's one pixel more (default: the "
        "preset's, authors with paper and turbo)",
    )
    add(
        "--white-balance",
        default="none",
        help="take the photograph's cast out before painting, and give it back to the light: none, grey-world or "
        "shades-of-grey (default: none)",
    )
    add(
        "--front-fill",
        action="store_true",
        help="fill the directions that the photograph shows with the photograph; its field of view is that of --fov, "
        "or of its EXIF data",
    )
    add("--fov", type=float, metavar="DEG", help="with --front-fill, field of view across the longer side, 5 to 170")
    add("--pitch", type=float, metavar="DEG", help="that the camera looked up; the map's horizon is levelled by it")
    add("--roll", type=float, metavar="DEG", help="that the camera was turned clockwise; likewise")
    add(
        "--impute",
        default="initial",
        help="noise put on the photograph outside the ball: initial, as the authors' code, or predicted, as the "
        "paper's Algorithm 0 (default: initial)",
    )
    add(
        "--backend", default="mini", help="mini: the model that comes along, a preview; diffusers: SDXL (default: mini)"
    )
    add("--model", metavar="PATH", help="diffusers: SDXL checkpoint; mini: another folder than its own")
    add("--controlnet", metavar="PATH", help="diffusers: depth ControlNet for SDXL")
    add("--lora", metavar="PATH", help="diffusers: exposure LoRA")
    add("--turbo-lora", metavar="PATH", help="diffusers: Turbo LoRA for the first timesteps, with --preset turbo")
    add(
        "--precision",
        metavar="TYPE",
        help="what the networks compute in: float32, bfloat16, or float16 on a GPU (default there; else float32)",
    )
    add("--json", action="store_true", help="print the report as JSON")


def run(args: argparse.Namespace) -> None:
    """Estimate, write, report (see `estimating.run`)."""
    from .estimating import run as estimate_and_write

    estimate_and_write(args)
