"""What unwrap and merge lose when the painter makes no mistake.

A true orthographic mirror ball of a known panorama, exposed at the bracket's EVs and rounded to 8 bits, goes through
each combination of unwrap and merge; irradiance over well-spread normals is compared with the panorama's own.
"""

from __future__ import annotations

import argparse
import time
from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path
from typing import Final

from torch import Tensor

from ..exposure import auto_exposure, expose, merge_channel, merge_paper, quantize
from ..geometry import ball_to_latlong, latlong_to_ball, latlong_to_perspective
from ..imageio import read_envmap
from ..metrics import angular_error, energy_kept, irradiance, si_rmse, spread_directions
from ..presets import PAPER_EVS
from ..shapes import BallImage, Latlong
from .reference import reference_merge, reference_unwrap
from .report import (
    Column,
    Report,
    Row,
    add_output,
    add_panoramas,
    median_and_worst,
    panorama_files,
    prepare_output,
    publish,
)

__all__ = ["EXPOSURES", "WAYS", "Way", "add_arguments", "bench_merge", "perfect_bracket", "run", "summarize"]

BALL: Final = 256
NORMALS: Final = 400
LONG_EVS: Final = (*PAPER_EVS, -7.5, -10.0)


def perfect_bracket(ball_hdr: BallImage, evs: tuple[float, ...]) -> list[BallImage]:
    """The 8-bit pictures a painter without error would paint of a ball."""
    return [quantize(expose(ball_hdr, ev)) for ev in evs]


@dataclass(frozen=True)
class Way:
    """One way from a perfect painter's ball to a map.

    Attributes:
        label: for the table.
        recover: (ball in linear radiance, rows of the map) -> map; what it may see of the ball is its own affair.
    """

    label: str
    recover: Callable[[BallImage, int], Latlong]


def _channel(ball: BallImage, evs: tuple[float, ...]) -> BallImage:
    return merge_channel(perfect_bracket(ball, evs), evs)


def _unwrap(ball_hdr: BallImage, height: int) -> Latlong:
    """As `estimate` unwraps: what a painter leaves beside the ball is not looked at."""
    return ball_to_latlong(ball_hdr, height, painted=True)


WAYS: Final[dict[str, Way]] = {
    "reference": Way(
        "reference: unwrap 8-bit maps, luminance merge",
        lambda ball, height: reference_merge(perfect_bracket(ball, PAPER_EVS), PAPER_EVS, height),
    ),
    "channel-reference": Way(
        "channel merge on the ball, reference unwrap",
        lambda ball, height: reference_unwrap(_channel(ball, PAPER_EVS), height),
    ),
    "channel-long-reference": Way(
        "the same, bracket to EV -10",
        lambda ball, height: reference_unwrap(_channel(ball, LONG_EVS), height),
    ),
    "hdr-reference": Way("true HDR ball, reference unwrap", reference_unwrap),
    "paper": Way(
        "paper merge on the ball, our unwrap",
        lambda ball, height: _unwrap(merge_paper(perfect_bracket(ball, PAPER_EVS), PAPER_EVS), height),
    ),
    "channel": Way(
        "channel merge on the ball, our unwrap",
        lambda ball, height: _unwrap(_channel(ball, PAPER_EVS), height),
    ),
    "channel-long": Way(
        "the same, bracket to EV -10",
        lambda ball, height: _unwrap(_channel(ball, LONG_EVS), height),
    ),
    "ceiling": Way(
        "true HDR ball clipped at the short bracket's ceiling",
        lambda ball, height: _unwrap(ball.clamp(max=2.0 ** -PAPER_EVS[-1]), height),
    ),
    "hdr": Way("true HDR ball, our unwrap of a rendered ball", lambda ball, height: ball_to_latlong(ball, height)),
}
"""What is compared, in the order of the table."""

EXPOSURES: Final[dict[str, Callable[[Latlong], Tensor]]] = {
    "map": lambda latlong: latlong,
    # The paper's own input: 256 x 192 pixels, 60 degrees high, that is 75.2 degrees wide.
    "crop": lambda latlong: latlong_to_perspective(latlong, 192, 256, fov=75.18),
}
"""What the exposure is set on: the picture whose 99th percentile of intensity becomes 0.9 on display."""


FIGURES: Final = (
    Column("energy kept", "energy_kept", ".3f"),
    Column("irradiance si-RMSE", "irradiance_si_rmse", ".4f"),
    Column("irradiance angle (deg)", "irradiance_angular_error_deg", ".2f"),
)

PROTOCOL: Final[Row] = {
    "ball_px": BALL,
    "normals": NORMALS,
    "evs": PAPER_EVS,
    "long_evs": LONG_EVS,
    "bits": 8,
    "gamma": 2.4,
    "exposure": "99th percentile of all channel values to 0.9 on display",
    "irradiance_si_rmse": "one scale for all normals and channels, mean over both, relative to the mean irradiance",
    "irradiance_angular_error_deg": "mean over normals of the angle between RGB irradiances",
}


def add_arguments(parser: argparse.ArgumentParser) -> None:
    """Declare the options."""
    add_panoramas(parser)
    add_output(parser)
    parser.add_argument(
        "--exposure",
        choices=tuple(EXPOSURES),
        default="map",
        help="what EV 0 is set on: the whole map, or the paper's 60 degree crop straight ahead (default: map)",
    )


def run(args: argparse.Namespace) -> None:
    """Measure, write and print.

    Raises:
        ProbeError: a folder without maps, a map that cannot be read, or a report that cannot be written.
    """
    started = time.perf_counter()
    files = panorama_files(args.panoramas)
    prepare_output(args)
    rows = bench_merge(files, args.exposure)
    report = Report("merge", PROTOCOL, rows, summarize(rows), time.perf_counter() - started)
    details = (Column("panorama", "panorama"), Column("way", "way"), *FIGURES)
    publish(report, args, rows=details, summary=(Column("way to the map", "label"), *FIGURES))


def bench_merge(panoramas: list[Path], exposure: str = "map") -> list[Row]:
    """Measure every row of `WAYS` on every panorama.

    Args:
        panoramas: files of linear radiance.
        exposure: key of `EXPOSURES`.

    Returns:
        One row a panorama and way: panorama, way, energy kept, irradiance si-RMSE (relative to the mean) and
        irradiance angular error in degrees.
    """
    normals = spread_directions(NORMALS)
    rows: list[Row] = []
    for path in panoramas:
        latlong = read_envmap(path)
        latlong = latlong * auto_exposure(EXPOSURES[exposure](latlong))
        truth = irradiance(latlong, normals)
        ball = latlong_to_ball(latlong, BALL)
        for name, way in WAYS.items():
            found = way.recover(ball, latlong.shape[1])
            lit = irradiance(found, normals)
            rows.append(
                {
                    "panorama": path.stem,
                    "way": name,
                    "energy_kept": energy_kept(found, latlong),
                    "irradiance_si_rmse": si_rmse(lit, truth),
                    "irradiance_angular_error_deg": angular_error(lit, truth),
                }
            )
    return rows


def summarize(rows: list[Row]) -> list[Row]:
    """Median and worst over the panoramas, a row for each way: the worst energy is the one furthest from 1."""
    summary = []
    for name, way in WAYS.items():
        of_way = [row for row in rows if row["way"] == name]
        line: Row = {"way": name, "label": way.label, "panoramas": len(of_way)}
        line |= median_and_worst(of_way, "energy_kept", ideal=1.0)
        line |= median_and_worst(of_way, "irradiance_si_rmse")
        line |= median_and_worst(of_way, "irradiance_angular_error_deg")
        summary.append(line)
    return summary
