"""What the geometry loses: energy and detail of panoramas that go latlong -> ball -> latlong."""

from __future__ import annotations

import argparse
import time
from collections.abc import Sequence
from pathlib import Path
from typing import Final

from ..exposure import auto_exposure, expose
from ..geometry import ball_coverage, ball_solid_angle, ball_to_latlong, latlong_energy, latlong_to_ball
from ..imageio import read_envmap
from ..metrics import energy_kept, irradiance, si_rmse, spread_directions
from ..shapes import BallImage
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

__all__ = ["add_arguments", "ball_energy", "bench_geometry", "run", "summarize"]

NORMALS: Final = 400

PROTOCOL: Final[Row] = {
    "normals": NORMALS,
    "irradiance_si_rmse": "one scale for all normals and channels, relative to the mean irradiance",
    "ldr_rmse": "of the map, gamma 2.4, clipped at EV 0",
}

FIGURES: Final = (
    Column("ball (px)", "ball_px", "d"),
    Column("energy of the ball", "ball_energy", ".4f"),
    Column("energy kept", "energy_kept", ".4f"),
    Column("irradiance si-RMSE", "irradiance_si_rmse", ".4f"),
    Column("LDR RMSE", "ldr_rmse", ".4f"),
)


def add_arguments(parser: argparse.ArgumentParser) -> None:
    """Declare the options."""
    add_panoramas(parser)
    add_output(parser)
    parser.add_argument(
        "--balls", nargs="+", type=int, default=[256, 1024], metavar="PX", help="diameters (default: 256 1024)"
    )


def run(args: argparse.Namespace) -> None:
    """Measure, write and print.

    Raises:
        ProbeError: a folder without maps, a map that cannot be read, or a report that cannot be written.
    """
    started = time.perf_counter()
    files = panorama_files(args.panoramas)
    prepare_output(args)
    rows = bench_geometry(files, args.balls)
    report = Report("geometry", PROTOCOL, rows, summarize(rows), time.perf_counter() - started)
    publish(report, args, rows=(Column("panorama", "panorama"), *FIGURES), summary=FIGURES)


def ball_energy(ball_hdr: BallImage) -> float:
    """Radiance integrated over the sphere as a ball that fills its crop shows it, channels summed."""
    size = ball_hdr.shape[1]
    covered = ball_hdr * ball_coverage(size)[None, :, :, None]
    return float(covered.double().sum()) * ball_solid_angle(size / 2)


def bench_geometry(panoramas: list[Path], balls: Sequence[int]) -> list[Row]:
    """Round trips of every panorama through balls of several diameters.

    Args:
        panoramas: files of linear radiance.
        balls: diameters in pixels.

    Returns:
        One row a panorama and diameter: energy of the ball and of the map that comes back, as shares of the
        panorama's; si-RMSE of irradiance over 400 normals; RMSE of the display-encoded map, clipped at EV 0.
    """
    normals = spread_directions(NORMALS)
    rows: list[Row] = []
    for path in panoramas:
        latlong = read_envmap(path)
        latlong = latlong * auto_exposure(latlong)
        energy = float(latlong_energy(latlong).sum())
        for size in balls:
            ball = latlong_to_ball(latlong, size)
            again = ball_to_latlong(ball, latlong.shape[1])
            shown = expose(again, 0.0) - expose(latlong, 0.0)
            rows.append(
                {
                    "panorama": path.stem,
                    "ball_px": size,
                    "ball_energy": ball_energy(ball) / energy,
                    "energy_kept": energy_kept(again, latlong),
                    "irradiance_si_rmse": si_rmse(irradiance(again, normals), irradiance(latlong, normals)),
                    "ldr_rmse": float(shown.square().mean().sqrt()),
                }
            )
    return rows


def summarize(rows: list[Row]) -> list[Row]:
    """Median and worst over the panoramas, a row for each diameter."""
    summary = []
    for size in sorted({row["ball_px"] for row in rows}):
        of_size = [row for row in rows if row["ball_px"] == size]
        line: Row = {"ball_px": size, "panoramas": len(of_size)}
        for key, ideal in (("ball_energy", 1.0), ("energy_kept", 1.0), ("irradiance_si_rmse", 0.0), ("ldr_rmse", 0.0)):
            line |= median_and_worst(of_size, key, ideal=ideal)
        summary.append(line)
    return summary
