"""What unwrap and merge lose when the painter makes no mistake.

A true orthographic mirror ball of a known panorama, exposed at the bracket's EVs and rounded to 8 bits, goes through
each combination of unwrap and merge; irradiance over well-spread normals is compared with the panorama's own.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path
from statistics import median
from typing import Any, Final

from torch import Tensor

from ..exposure import auto_exposure, expose, merge_channel, merge_paper, quantize
from ..geometry import ball_to_latlong, latlong_to_ball, latlong_to_perspective
from ..imageio import read_envmap
from ..metrics import angular_error, energy_kept, irradiance, si_rmse, spread_directions
from ..presets import PAPER_EVS
from ..shapes import BallImage, Latlong
from .reference import reference_merge, reference_unwrap

__all__ = ["EXPOSURES", "ROWS", "Row", "bench_merge", "perfect_bracket", "summarize"]

BALL: Final = 256
NORMALS: Final = 400
LONG_EVS: Final = (*PAPER_EVS, -7.5, -10.0)


def perfect_bracket(ball_hdr: BallImage, evs: tuple[float, ...]) -> list[BallImage]:
    """The 8-bit pictures a painter without error would paint of a ball."""
    return [quantize(expose(ball_hdr, ev)) for ev in evs]


@dataclass(frozen=True)
class Row:
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


ROWS: Final[dict[str, Row]] = {
    "reference": Row(
        "reference: unwrap 8-bit maps, luminance merge",
        lambda ball, height: reference_merge(perfect_bracket(ball, PAPER_EVS), PAPER_EVS, height),
    ),
    "channel-reference": Row(
        "channel merge on the ball, reference unwrap",
        lambda ball, height: reference_unwrap(_channel(ball, PAPER_EVS), height),
    ),
    "channel-long-reference": Row(
        "the same, bracket to EV -10",
        lambda ball, height: reference_unwrap(_channel(ball, LONG_EVS), height),
    ),
    "hdr-reference": Row("true HDR ball, reference unwrap", reference_unwrap),
    "paper": Row(
        "paper merge on the ball, our unwrap",
        lambda ball, height: _unwrap(merge_paper(perfect_bracket(ball, PAPER_EVS), PAPER_EVS), height),
    ),
    "channel": Row(
        "channel merge on the ball, our unwrap",
        lambda ball, height: _unwrap(_channel(ball, PAPER_EVS), height),
    ),
    "channel-long": Row(
        "the same, bracket to EV -10",
        lambda ball, height: _unwrap(_channel(ball, LONG_EVS), height),
    ),
    "ceiling": Row(
        "true HDR ball clipped at the short bracket's ceiling",
        lambda ball, height: _unwrap(ball.clamp(max=2.0 ** -PAPER_EVS[-1]), height),
    ),
    "hdr": Row("true HDR ball, our unwrap of a rendered ball", lambda ball, height: ball_to_latlong(ball, height)),
}
"""What is compared, in the order of the table."""

EXPOSURES: Final[dict[str, Callable[[Latlong], Tensor]]] = {
    "map": lambda latlong: latlong,
    # The paper's own input: 256 x 192 pixels, 60 degrees high, that is 75.2 degrees wide.
    "crop": lambda latlong: latlong_to_perspective(latlong, 192, 256, fov=75.18),
}
"""What the exposure is set on: the picture whose 99th percentile of intensity becomes 0.9 on display."""


def bench_merge(panoramas: list[Path], exposure: str = "map") -> list[dict[str, Any]]:
    """Measure every row of `ROWS` on every panorama.

    Args:
        panoramas: files of linear radiance.
        exposure: key of `EXPOSURES`.

    Returns:
        One record a panorama and row: panorama, row, energy kept, irradiance si-RMSE (relative to the mean) and
        irradiance angular error in degrees.
    """
    normals = spread_directions(NORMALS)
    records: list[dict[str, Any]] = []
    for path in panoramas:
        latlong = read_envmap(path)
        latlong = latlong * auto_exposure(EXPOSURES[exposure](latlong))
        truth = irradiance(latlong, normals)
        ball = latlong_to_ball(latlong, BALL)
        for name, row in ROWS.items():
            found = row.recover(ball, latlong.shape[1])
            lit = irradiance(found, normals)
            records.append(
                {
                    "panorama": path.stem,
                    "row": name,
                    "energy_kept": energy_kept(found, latlong),
                    "si_rmse": si_rmse(lit, truth),
                    "angular_error": angular_error(lit, truth),
                }
            )
    return records


def summarize(records: list[dict[str, Any]]) -> list[dict[str, Any]]:
    """Median and worst over the panoramas, a record for each row: the worst energy is the one furthest from 1."""
    summaries = []
    for name, row in ROWS.items():
        of_row = [record for record in records if record["row"] == name]
        energies = [record["energy_kept"] for record in of_row]
        summary: dict[str, Any] = {"row": name, "label": row.label, "panoramas": len(of_row)}
        summary["energy_kept"] = {"median": median(energies), "worst": max(energies, key=lambda kept: abs(kept - 1))}
        for metric in ("si_rmse", "angular_error"):
            values = [record[metric] for record in of_row]
            summary[metric] = {"median": median(values), "worst": max(values)}
        summaries.append(summary)
    return summaries
