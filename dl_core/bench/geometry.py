"""What the geometry loses: panoramas that go latlong -> ball -> latlong, by way of unwrapping and space of values.

Unwrapping interpolates and averages values of the ball, and in which space those are decides what is lost: linear
radiance keeps energy; display-encoded values, of which a light is a smaller part, keep what a display shows; split
radiance is encoded up to white and linear above.
"""

from __future__ import annotations

import argparse
import time
from collections.abc import Callable, Iterator, Sequence
from itertools import product
from pathlib import Path
from typing import Final

from ..exposure import GAMMA, auto_exposure, expose
from ..geometry import (
    ball_coverage,
    ball_solid_angle,
    ball_to_latlong,
    latlong_energy,
    latlong_to_ball,
)
from ..imageio import read_envmap
from ..metrics import energy_kept, irradiance, si_rmse, spread_directions
from ..shapes import BallImage, Latlong
from .reference import reference_unwrap
from .report import (
    Column,
    Report,
    Row,
    add_output,
    add_panoramas,
    panorama_files,
    prepare_output,
    publish,
    summarize_groups,
)

__all__ = ["SPACES", "UNWRAPS", "add_arguments", "ball_energy", "bench_geometry", "run", "summarize"]

NORMALS: Final = 400
PSNR_CEILING: Final = 120.0
"""Of a map without any error, dB."""

Unwrap = Callable[[BallImage, int], Latlong]

UNWRAPS: Final[dict[str, Unwrap]] = {"footprint": ball_to_latlong, "reference": reference_unwrap}
"""Ways from a ball to a map, the package's own first."""


def _encoded(unwrap: Unwrap, ball_hdr: BallImage, height: int) -> Latlong:
    return unwrap(ball_hdr.clamp(min=0) ** (1 / GAMMA), height) ** GAMMA


def _split(unwrap: Unwrap, ball_hdr: BallImage, height: int) -> Latlong:
    shown, excess = _encoded(unwrap, ball_hdr.clamp(max=1), height), (ball_hdr - 1).clamp(min=0)
    return shown + unwrap(excess, height)


SPACES: Final[dict[str, Callable[[Unwrap, BallImage, int], Latlong]]] = {
    "linear": lambda unwrap, ball_hdr, height: unwrap(ball_hdr, height),
    "encoded": _encoded,
    "split": _split,
}
"""Spaces of values to interpolate in, the package's own first."""

PROTOCOL: Final[Row] = {
    "normals": NORMALS,
    "gamma": GAMMA,
    "highlight_energy": "radiance above white at EV 0, integrated, as a share of the panorama's; null without any",
    "irradiance_si_rmse": "one scale for all normals and channels, relative to the mean irradiance",
    "ldr_rmse": "of the map, gamma 2.4, clipped at EV 0",
    "ldr_psnr_db": "of the same",
    "unwrap_seconds": "of one ball; the worst is the first one, for which footprints are computed",
}

IDEALS: Final = {
    "ball_energy": 1.0,
    "energy_kept": 1.0,
    "highlight_energy": 1.0,
    "irradiance_si_rmse": 0.0,
    "ldr_rmse": 0.0,
    "ldr_psnr_db": PSNR_CEILING,
    "unwrap_seconds": 0.0,
}

FIGURES: Final = (
    Column("ball (px)", "ball_px", "d"),
    Column("unwrap", "unwrap"),
    Column("space", "space"),
    Column("energy of the ball", "ball_energy", ".4f"),
    Column("energy kept", "energy_kept", ".4f"),
    Column("highlight energy", "highlight_energy", ".4f"),
    Column("irradiance si-RMSE", "irradiance_si_rmse", ".4f"),
    Column("LDR RMSE", "ldr_rmse", ".4f"),
    Column("LDR PSNR (dB)", "ldr_psnr_db", ".2f"),
    Column("seconds", "unwrap_seconds", ".4f"),
)


def add_arguments(parser: argparse.ArgumentParser) -> None:
    """Declare the options."""
    add_panoramas(parser)
    add_output(parser)
    parser.add_argument(
        "--balls", nargs="+", type=int, default=[256, 1024], metavar="PX", help="diameters (default: 256 1024)"
    )
    parser.add_argument(
        "--unwrap", nargs="+", choices=tuple(UNWRAPS), default=["footprint"], help="unwraps (default: footprint)"
    )
    parser.add_argument(
        "--space", nargs="+", choices=tuple(SPACES), default=["linear"], help="spaces of values (default: linear)"
    )


def run(args: argparse.Namespace) -> None:
    """Measure, write and print.

    Raises:
        ProbeError: a folder without maps, a map that cannot be read, or a report that cannot be written.
    """
    started = time.perf_counter()
    files = panorama_files(args.panoramas)
    prepare_output(args)
    rows = bench_geometry(files, args.balls, unwraps=args.unwrap, spaces=args.space)
    report = Report("geometry", PROTOCOL, rows, summarize(rows), time.perf_counter() - started)
    publish(report, args, rows=(Column("panorama", "panorama"), *FIGURES), summary=FIGURES)


def ball_energy(ball_hdr: BallImage) -> float:
    """Radiance integrated over the sphere as a ball that fills its crop shows it, channels summed."""
    size = ball_hdr.shape[1]
    covered = ball_hdr * ball_coverage(size)[None, :, :, None]
    return float(covered.double().sum()) * ball_solid_angle(size / 2)


def bench_geometry(
    panoramas: list[Path],
    balls: Sequence[int],
    *,
    unwraps: Sequence[str] = ("footprint",),
    spaces: Sequence[str] = ("linear",),
) -> list[Row]:
    """Round trips of every panorama through balls of several diameters.

    Args:
        panoramas: files of linear radiance.
        balls: diameters in pixels.
        unwraps: keys of `UNWRAPS`.
        spaces: keys of `SPACES`.

    Returns:
        One row a panorama, diameter, unwrap and space: energy of the ball and of the map that comes back, as shares
        of the panorama's; and the figures of `PROTOCOL`.
    """
    normals = spread_directions(NORMALS)
    rows: list[Row] = []
    for path in panoramas:
        latlong = read_envmap(path)
        latlong = latlong * auto_exposure(latlong)
        energy, truth = float(latlong_energy(latlong).sum()), irradiance(latlong, normals)
        for size in balls:
            ball = latlong_to_ball(latlong, size)
            kept = ball_energy(ball) / energy
            for labels, again, seconds in _unwrapped(ball, latlong.shape[1], unwraps, spaces):
                rows.append(
                    {
                        "panorama": path.stem,
                        "ball_px": size,
                        **labels,
                        "ball_energy": kept,
                        "energy_kept": energy_kept(again, latlong),
                        "highlight_energy": _highlight_energy(again, latlong),
                        "irradiance_si_rmse": si_rmse(irradiance(again, normals), truth),
                        **_shown_error(again, latlong),
                        "unwrap_seconds": seconds,
                    }
                )
    return rows


def _unwrapped(
    ball_hdr: BallImage, height: int, unwraps: Sequence[str], spaces: Sequence[str]
) -> Iterator[tuple[Row, Latlong, float]]:
    """Every way's name, its map, and the seconds it took."""
    for unwrap, space in product(unwraps, spaces):
        started = time.perf_counter()
        again = SPACES[space](UNWRAPS[unwrap], ball_hdr, height)
        yield {"unwrap": unwrap, "space": space}, again, time.perf_counter() - started


def _highlight_energy(again_hdr: Latlong, truth_hdr: Latlong) -> float | None:
    excess, true_excess = ((latlong - 1).clamp(min=0) for latlong in (again_hdr, truth_hdr))
    return energy_kept(excess, true_excess) if true_excess.any() else None


def _shown_error(again_hdr: Latlong, truth_hdr: Latlong) -> Row:
    squared = (
        (expose(again_hdr, 0.0) - expose(truth_hdr, 0.0)).double().square().mean().clamp(min=10 ** (-PSNR_CEILING / 10))
    )
    return {"ldr_rmse": float(squared.sqrt()), "ldr_psnr_db": float(-10 * squared.log10())}


def summarize(rows: list[Row]) -> list[Row]:
    """Median and worst over the panoramas, a row for each diameter, unwrap and space."""
    return summarize_groups(rows, ("ball_px", "unwrap", "space"), IDEALS)
