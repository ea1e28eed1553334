"""How well exposures follow the EV asked for, and whether the ball stays the same ball.

Balls are painted in photographs taken inside panoramas, at EVs spread over the bracket, as the method paints them. A
ball's luminance should fall by 2^EV wherever EV 0 is not clipped, and lights should stay where they are.

Source: DiffusionLight, Sec. 4.2 (Eq. 3: the exposure LoRA's aim).
"""

from __future__ import annotations

import argparse
import math
import time
from collections.abc import Sequence
from dataclasses import replace
from itertools import pairwise
from pathlib import Path
from statistics import median
from typing import Final

import torch
import torch.nn.functional as F
from jaxtyping import Float
from torch import Tensor

from ..backends.loading import ModelFiles
from ..ball import fit_canvas, paint_depth, place_ball
from ..errors import OptionError
from ..exposure import decode_display, luminance, parse_evs
from ..imageio import read_envmap
from ..iterative import Rounds, iterative_inpaint
from ..painter import PaintRequest
from ..presets import preset
from ..shapes import BallImage
from .cameras import Camera, take
from .journal import Journal
from .painters import PAINTERS, Studio, add_files, identity, open_studio
from .paintings import VARIANTS
from .report import Column, Report, Row, add_output, add_panoramas, panorama_files, prepare_output, publish

__all__ = ["UNCLIPPED", "add_arguments", "bench_steering", "run", "steering", "structure", "summarize"]

UNCLIPPED: Final = 0.95
"""Display value up to which a channel of the EV 0 ball counts as not clipped."""

BLOCK: Final = 4
"""Pixels along the blocks whose luminance makes edges."""

DARKEST: Final = 1e-6
"""Luminance below which nothing is told apart: that of a code of 8 bits."""

STEERED: Final = "both"
"""The row of the ablation whose exposures are steered."""


def add_arguments(parser: argparse.ArgumentParser) -> None:
    """Declare the options."""
    add_panoramas(parser)
    add = parser.add_argument
    add("--painter", default="mini", help=f"{', '.join(PAINTERS)} (default: mini)")
    add("--evs", default="0,-1,-2,-2.5,-3,-4,-5", help="EVs to ask for (default: 0,-1,-2,-2.5,-3,-4,-5)")
    add("--structure-ev", type=float, default=-2.5, help="EV whose edges are compared with EV 0's (default: -2.5)")
    add("--preset", default="draft", help="schedule of each exposure (default: draft)")
    add("--seed", type=int, default=0, help="of the first ball (default: 0)")
    add_files(parser)
    add_output(parser)


def run(args: argparse.Namespace) -> None:
    """Measure, write and print.

    Raises:
        ProbeError: a folder without maps, EVs that are none, files of the painter that do not serve, or a report that
            cannot be written.
    """
    started = time.perf_counter()
    files, evs = panorama_files(args.panoramas), parse_evs(args.evs)
    if args.structure_ev not in evs:
        raise OptionError("--structure-ev", args.structure_ev, "one of --evs")
    rounds = preset(args.preset).rounds
    prepare_output(args)
    models = ModelFiles.of(args)
    run_identity = {
        "bench": "steering",
        "panoramas": [path.stem for path in files],
        "evs": list(evs),
        "preset": args.preset,
        "seed": args.seed,
        "structure_ev": args.structure_ev,
        "painter": identity(args.painter, models),
    }
    studio = open_studio(args.painter, models)
    journal = Journal(args.out, run_identity, len(evs))
    rows = bench_steering(files, studio, evs, rounds, args.structure_ev, seed=args.seed, journal=journal)
    protocol = {
        "painter": args.painter,
        "preset": args.preset,
        "unclipped": f"all channels of the EV 0 ball at most {UNCLIPPED} display-encoded",
        "stops": "log2 of the mean luminance there over that at EV 0",
        "structure": f"correlation of luminance edges there between EV 0 and EV {args.structure_ev:g}",
    }
    report = Report(
        "steering",
        protocol,
        rows,
        summarize(rows),
        time.perf_counter() - started,
        seeds=(args.seed,),
        evaluations=sum(row["evaluations"] for row in rows),
    )
    publish(report, args, rows=_ROWS, summary=_SUMMARY)


def bench_steering(
    panoramas: Sequence[Path],
    studio: Studio,
    evs: tuple[float, ...],
    rounds: Rounds,
    structure_ev: float,
    *,
    seed: int = 0,
    journal: Journal | None = None,
) -> list[Row]:
    """Paint every panorama's ball at every EV; one row each.

    Args:
        panoramas: maps.
        studio: gives the painter, the canvas and the ball.
        evs: descending from 0.
        rounds: schedule of each exposure.
        structure_ev: of `evs`, whose edges are compared with EV 0's.
        seed: of the first ball.
        journal: holds the panoramas that are measured already, and keeps the others.
    """
    journal = journal or Journal(None, {}, len(evs))
    ball = place_ball(studio.canvas, studio.diameter)
    for path in panoramas:
        if journal.has(path.stem):
            continue
        shot = take(read_envmap(path), Camera())
        painter = studio.painter_of(VARIANTS[STEERED], shot)
        request = PaintRequest(fit_canvas(shot.photo_ldr, ball.canvas), paint_depth(None, ball), ball, 0.0, (seed,))
        results = [iterative_inpaint(painter, replace(request, ev=ev), rounds) for ev in evs]
        brightest = results[0].ball
        rows: list[Row] = []
        for ev, result in zip(evs, results, strict=True):
            stops = steering(brightest, result.ball)
            rows.append(
                {
                    "panorama": path.stem,
                    "ev": ev,
                    "stops": stops,
                    "error_stops": stops - ev,
                    "structure": structure(brightest, result.ball) if ev == structure_ev else None,
                    "evaluations": result.evaluations,
                }
            )
        journal.add(rows)
    return journal.rows


def _clear(brightest: BallImage) -> Float[Tensor, "d d"]:
    """1 on the pixels inside the ball that EV 0 does not clip."""
    size = brightest.shape[1]
    positions = (torch.arange(size) + 0.5) * (2 / size) - 1
    inside = positions[:, None] ** 2 + positions[None, :] ** 2 < (1 - 2 / size) ** 2
    return (inside & (brightest[0].amax(dim=-1) <= UNCLIPPED)).float()


def steering(brightest: BallImage, exposed: BallImage) -> float:
    """Stops by which an exposure is darker (negative) than EV 0 where that is not clipped.

    Args:
        brightest: (1, D, D, 3) the ball at EV 0, display-encoded.
        exposed: (1, D, D, 3) the ball at another EV, display-encoded.

    Returns:
        log2 of the ratio of mean luminances; minus infinity for a black ball, NaN where all of EV 0 is clipped.
    """
    clear = _clear(brightest)
    means = [float((luminance(decode_display(ball))[0, ..., 0] * clear).sum()) for ball in (exposed, brightest)]
    if means[1] == 0:
        return math.nan
    return math.log2(means[0] / means[1]) if means[0] > 0 else -math.inf


def structure(brightest: BallImage, exposed: BallImage) -> float:
    """Correlation of the edges of two exposures: differences of neighbouring blocks' logarithmic luminance.

    Blocks are `BLOCK` pixels wide and not clipped anywhere, so that codes of 8 bits and noise count little.

    Args, Returns: as `steering`; 1 for balls that differ in exposure alone, NaN for one without edges.
    """
    clear = -F.max_pool2d(-_clear(brightest)[None], BLOCK)[0]
    across, down = clear[:, 1:] * clear[:, :-1] > 0, clear[1:] * clear[:-1] > 0
    edges = []
    for ball in (brightest, exposed):
        level = F.avg_pool2d(luminance(decode_display(ball))[..., 0], BLOCK)[0].clamp(min=DARKEST).log2()
        edges.append(torch.cat((level.diff(dim=1)[across], level.diff(dim=0)[down])))
    return float(torch.corrcoef(torch.stack(edges))[0, 1])


def summarize(rows: Sequence[Row]) -> list[Row]:
    """A record for each EV over the maps, and whether luminance fell from EV to EV on all of them."""
    monotone = {
        name: all(a > b for a, b in pairwise(stops))
        for name in dict.fromkeys(row["panorama"] for row in rows)
        for stops in [[row["stops"] for row in rows if row["panorama"] == name]]
    }
    summary = []
    for ev in dict.fromkeys(row["ev"] for row in rows):
        own = [row for row in rows if row["ev"] == ev]
        errors = [row["error_stops"] for row in own]
        structures = [row["structure"] for row in own if row["structure"] is not None]
        summary.append(
            {
                "ev": ev,
                "maps": len(own),
                "stops_median": median(row["stops"] for row in own),
                "error_stops_median": median(errors),
                "error_stops_worst": max(errors, key=abs),
                "within_half_a_stop": sum(abs(error) <= 0.5 for error in errors) / len(errors),
                "structure_median": median(structures) if structures else None,
                "structure_worst": min(structures) if structures else None,
                "monotone": sum(monotone.values()) / len(monotone),
            }
        )
    return summary


_ROWS: Final = (
    Column("panorama", "panorama"),
    Column("EV", "ev", "g"),
    Column("stops", "stops", ".2f"),
    Column("error (stops)", "error_stops", "+.2f"),
    Column("structure", "structure", ".2f"),
)
_SUMMARY: Final = (
    Column("EV", "ev", "g"),
    Column("maps", "maps"),
    Column("stops", "stops_median", ".2f"),
    Column("error", "error_stops_median", "+.2f"),
    Column("worst", "error_stops_worst", "+.2f"),
    Column("within 0.5", "within_half_a_stop", ".0%"),
    Column("structure", "structure_median", ".2f"),
    Column("worst", "structure_worst", ".2f"),
    Column("monotone", "monotone", ".0%"),
)
