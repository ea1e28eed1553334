"""Where a painted ball is: radius and centre fitted to true balls that are not where they were asked for.

A photograph is taken straight ahead into a panorama, and the true ball of another radius and centre is set in it, with
what a painter gets wrong. The direction error is that of a light 20 degrees from the rim's direction, straight ahead,
the worst over azimuth: how far off the unwrap with the nominal or the fitted circle puts it.
"""

from __future__ import annotations

import argparse
import math
import random
import time
from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path
from statistics import median
from typing import Final

import torch
import torch.nn.functional as F
from jaxtyping import Float
from torch import Tensor

from ..ball import Ball, place_ball
from ..ball_fit import BallFit, fit_ball
from ..exposure import auto_exposure, expose, quantize
from ..footprints import coverage
from ..geometry import latlong_to_ball, latlong_to_perspective
from ..imageio import read_envmap
from ..projection import ORTHOGRAPHIC, disc_coordinates, disc_directions
from ..shapes import Latlong
from .journal import Journal
from .report import Column, Report, Row, add_output, add_panoramas, panorama_files, prepare_output, publish

__all__ = ["FAULTS", "Circle", "add_arguments", "bench_fit", "composite", "direction_error", "run", "summarize"]

CANVAS: Final = 1024
DIAMETER: Final = 256
FOV: Final = 60.0
MARGIN: Final = 16
BAR_DEG: Final = 0.5

PROTOCOL: Final[Row] = {
    "canvas_px": CANVAS,
    "ball_px": DIAMETER,
    "fov_deg": FOV,
    "offsets": "radius, x and y each drawn evenly from -1 to 1 px",
    "direction_deg": "error of a light 20 degrees from straight ahead, worst over azimuth",
}


@dataclass(frozen=True)
class Circle:
    """A circle on the canvas: radius and centre (x, y), pixels."""

    radius: float
    x: float
    y: float


Fault = Callable[[Tensor, Tensor, torch.Generator], Tensor]


def _blurred(picture: Tensor) -> Tensor:
    kernel = torch.exp(-torch.linspace(-2, 2, 5).square() / (2 * 0.6**2))
    kernel = (kernel / kernel.sum()).expand(3, 1, 5)
    planes = F.pad(picture.permute(0, 3, 1, 2), (2, 2, 2, 2), mode="replicate")
    planes = F.conv2d(F.conv2d(planes, kernel[:, :, None], groups=3), kernel[..., None], groups=3)
    return planes.permute(0, 2, 3, 1)


FAULTS: Final[dict[str, Fault]] = {
    "none": lambda picture, covered, generator: picture,
    "noise": lambda picture, covered, generator: picture + 0.02 * torch.randn(picture.shape, generator=generator),
    "blur": lambda picture, covered, generator: _blurred(picture),
    "tint": lambda picture, covered, generator: picture * (1 - covered * torch.tensor([0.05, 0.1, 0.15])),
    "halo": lambda picture, covered, generator: picture * (1 - 0.08 * (1 - covered)),
    "matte": lambda picture, covered, generator: torch.lerp(picture, picture.mean(dim=(1, 2), keepdim=True), covered),
    "mirrored": lambda picture, covered, generator: torch.where(covered > 0.5, picture.flip(2), picture),
}
"""What a painter gets wrong, by name: (picture around the ball, share of each pixel that is ball, random) -> picture.

matte and mirrored are no mirror balls: a clear fit of them would be wrong, whatever it says.
"""


def add_arguments(parser: argparse.ArgumentParser) -> None:
    """Declare the options."""
    add_panoramas(parser)
    add_output(parser)
    add = parser.add_argument
    add("--faults", nargs="+", choices=FAULTS, default=list(FAULTS), help="of the painter (default: all)")
    add("--seed", type=int, default=0, help="of offsets and noise (default: 0)")
    add("--without-photograph", action="store_true", help="fit to the painted picture alone, as it is outside the disc")


def run(args: argparse.Namespace) -> None:
    """Measure, write and print.

    Raises:
        ProbeError: a folder without maps, a map that cannot be read, or a report that cannot be written.
    """
    started = time.perf_counter()
    files = panorama_files(args.panoramas)
    prepare_output(args)
    journal = Journal(args.out, _identity(args, files), len(args.faults))
    given = not args.without_photograph
    rows = bench_fit(files, args.faults, args.seed, with_photograph=given, journal=journal)
    report = Report("fit", PROTOCOL, rows, summarize(rows), time.perf_counter() - started, seeds=(args.seed,))
    publish(report, args, rows=_ROWS, summary=_SUMMARY)


def _identity(args: argparse.Namespace, files: list[Path]) -> Row:
    """What has to be the same for a stopped run to go on; names of the maps, whose folder may be elsewhere by then."""
    return {
        "bench": "fit",
        "panoramas": [path.stem for path in files],
        "faults": list(args.faults),
        "seed": args.seed,
        "photograph": not args.without_photograph,
    }


def bench_fit(
    panoramas: list[Path],
    faults: list[str],
    seed: int = 0,
    *,
    with_photograph: bool = True,
    journal: Journal | None = None,
) -> list[Row]:
    """Fit a true ball of every panorama with every fault; one row each.

    Args:
        panoramas: maps.
        faults: names in `FAULTS`.
        seed: of offsets and noise.
        with_photograph: whether the fit is given the canvas before painting.
        journal: holds the panoramas that are measured already, and keeps the others.
    """
    journal = journal or Journal(None, {}, len(faults))
    nominal = place_ball(CANVAS, DIAMETER)
    for path in panoramas:
        if journal.has(path.stem):
            continue
        latlong = read_envmap(path)
        photo = latlong_to_perspective(latlong, CANVAS, CANVAS, fov=FOV, samples=1)
        scale = auto_exposure(photo)
        draw = random.Random(f"{seed}/{path.stem}")
        dr, dx, dy = (draw.uniform(-1, 1) for _ in range(3))
        true = Circle(DIAMETER / 2 + dr, nominal.centre[0] + dx, nominal.centre[1] + dy)
        picture, covered = composite(latlong * scale, photo * scale, true)
        rows: list[Row] = []
        for fault in faults:
            generator = torch.Generator().manual_seed(seed)
            painted = _with_fault(picture, covered, nominal, FAULTS[fault], generator)
            given = quantize(expose(photo * scale, 0.0)) if with_photograph else None
            fit = fit_ball(painted, nominal, fov=FOV, photograph_ldr=given)
            rows.append({"panorama": path.stem, "fault": fault, **_row(fit, nominal, true)})
        journal.add(rows)
    return journal.rows


def composite(
    latlong_hdr: Latlong, photo_hdr: Float[Tensor, "b y x c"], circle: Circle
) -> tuple[Float[Tensor, "b y x c"], Float[Tensor, "b y x 1"]]:
    """A photograph with a true orthographic ball in it, display-encoded, and the ball's share of each pixel."""
    side = 2 * math.ceil(circle.radius) + 2 * MARGIN
    left, top = round(circle.x) - side // 2, round(circle.y) - side // 2
    centre = (circle.x - left, circle.y - top)
    ball = latlong_to_ball(latlong_hdr, side, radius=circle.radius, centre=centre)
    lens = ORTHOGRAPHIC.lens(circle.radius, centre, side)
    share = coverage(side, circle.radius, centre, lens)[None, ..., None]
    light, covered = photo_hdr.clone(), torch.zeros_like(photo_hdr[..., :1])
    window = light[:, top : top + side, left : left + side]
    window.copy_(torch.lerp(window, ball, share))
    covered[:, top : top + side, left : left + side] = share
    return expose(light, 0.0), covered


def _with_fault(picture: Tensor, covered: Tensor, ball: Ball, fault: Fault, generator: torch.Generator) -> Tensor:
    """The picture as painted: with the fault inside the inpaint disc's square, in 8 bits."""
    first, side = ball.left - ball.dilation, ball.diameter + 2 * ball.dilation
    here = (slice(None), slice(ball.top - ball.dilation, ball.top - ball.dilation + side), slice(first, first + side))
    painted = picture.clone()
    painted[here] = fault(picture[here], covered[here], generator)
    return quantize(painted.clamp(0, 1))


def direction_error(used: Circle, true: Circle, angle: float = 20.0) -> float:
    """Degrees by which an orthographic unwrap with a circle misplaces a light `angle` degrees from straight ahead."""
    azimuth = torch.arange(72, dtype=torch.float64) * (math.pi / 36)
    polar = math.radians(angle)
    sides = torch.stack((azimuth.cos(), azimuth.sin()), dim=-1) * math.sin(polar)
    light = torch.cat((sides, torch.full((72, 1), -math.cos(polar), dtype=torch.float64)), dim=-1)
    shift = torch.tensor([true.x - used.x, used.y - true.y], dtype=torch.float64)
    seen = disc_directions((disc_coordinates(light) * true.radius + shift) / used.radius)
    return math.degrees(float(torch.acos((seen * light).sum(dim=-1).clamp(-1, 1)).max()))


def _row(fit: BallFit, nominal: Ball, true: Circle) -> Row:
    asked = Circle(nominal.diameter / 2, *nominal.centre)
    errors = (fit.radius - true.radius, fit.centre[0] - true.x, fit.centre[1] - true.y)
    worst = max(abs(error) for error in errors)
    sigmas = max(abs(error) / sigma for error, sigma in zip(errors, fit.sigma, strict=True))
    return {
        "clear": fit.clear,
        "radius_error_before_px": asked.radius - true.radius,
        "x_error_before_px": asked.x - true.x,
        "y_error_before_px": asked.y - true.y,
        "radius_error_px": errors[0],
        "x_error_px": errors[1],
        "y_error_px": errors[2],
        "sigma_px": max(fit.sigma) if fit.clear else None,
        "largest_error_sigmas": sigmas if fit.clear else None,
        "wrong": fit.clear and (sigmas > 3 or worst > 0.2),
        "direction_before_deg": direction_error(asked, true),
        "direction_deg": direction_error(Circle(fit.radius, *fit.centre), true),
        "explained": fit.explained,
        "reason": fit.reason,
    }


def summarize(rows: list[Row]) -> list[Row]:
    """A row for each fault: how many fits are clear, how many of these wrong, and their errors."""
    summary = []
    for fault in dict.fromkeys(row["fault"] for row in rows):
        own = [row for row in rows if row["fault"] == fault]
        clear = [row for row in own if row["clear"]]
        after = [row["direction_deg"] for row in clear]
        summary.append(
            {
                "fault": fault,
                "balls": len(own),
                "clear": len(clear),
                "wrong": sum(row["wrong"] for row in clear),
                "within_half_degree": sum(angle <= BAR_DEG for angle in after),
                "direction_before_deg_worst": max(row["direction_before_deg"] for row in own),
                "direction_deg_median": median(after) if after else None,
                "direction_deg_worst": max(after) if after else None,
            }
        )
    return summary


_ROWS: Final = (
    Column("panorama", "panorama"),
    Column("fault", "fault"),
    Column("clear", "clear"),
    Column("r before", "radius_error_before_px", "+.2f"),
    Column("x", "x_error_before_px", "+.2f"),
    Column("y", "y_error_before_px", "+.2f"),
    Column("r after (px)", "radius_error_px", "+.3f"),
    Column("x", "x_error_px", "+.3f"),
    Column("y", "y_error_px", "+.3f"),
    Column("sigma", "sigma_px", ".3f"),
    Column("light before (deg)", "direction_before_deg", ".2f"),
    Column("after", "direction_deg", ".2f"),
    Column("reason", "reason"),
)
_SUMMARY: Final = (
    Column("fault", "fault"),
    Column("balls", "balls"),
    Column("clear", "clear"),
    Column("clear but wrong", "wrong"),
    Column("within 0.5 deg", "within_half_degree"),
    Column("worst before (deg)", "direction_before_deg_worst", ".2f"),
    Column("median after", "direction_deg_median", ".2f"),
    Column("worst after", "direction_deg_worst", ".2f"),
)
