"""What the geometry loses: energy and detail of panoramas that go latlong -> ball -> latlong."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path
from statistics import median
from typing import Any

from ..exposure import auto_exposure, expose
from ..geometry import ball_coverage, ball_solid_angle, ball_to_latlong, latlong_energy, latlong_to_ball
from ..imageio import read_envmap
from ..metrics import energy_kept, irradiance, si_rmse, spread_directions
from ..shapes import BallImage

__all__ = ["ball_energy", "bench_geometry", "summarize"]


def ball_energy(ball_hdr: BallImage) -> float:
    """Radiance integrated over the sphere as a ball that fills its crop shows it, channels summed."""
    size = ball_hdr.shape[1]
    covered = ball_hdr * ball_coverage(size)[None, :, :, None]
    return float(covered.double().sum()) * ball_solid_angle(size / 2)


def bench_geometry(panoramas: list[Path], balls: Sequence[int]) -> list[dict[str, Any]]:
    """Round trips of every panorama through balls of several diameters.

    Args:
        panoramas: files of linear radiance.
        balls: diameters in pixels.

    Returns:
        One record a panorama and diameter: energy of the ball and of the map that comes back, as shares of the
        panorama's; si-RMSE of irradiance over 400 normals; RMSE of the display-encoded map, clipped at EV 0.
    """
    normals = spread_directions(400)
    records: list[dict[str, Any]] = []
    for path in panoramas:
        latlong = read_envmap(path)
        latlong = latlong * auto_exposure(latlong)
        energy = float(latlong_energy(latlong).sum())
        for size in balls:
            ball = latlong_to_ball(latlong, size)
            again = ball_to_latlong(ball, latlong.shape[1])
            shown = expose(again, 0.0) - expose(latlong, 0.0)
            records.append(
                {
                    "panorama": path.stem,
                    "ball": size,
                    "ball_energy": ball_energy(ball) / energy,
                    "map_energy": energy_kept(again, latlong),
                    "si_rmse": si_rmse(irradiance(again, normals), irradiance(latlong, normals)),
                    "display_rmse": float(shown.square().mean().sqrt()),
                }
            )
    return records


def summarize(records: list[dict[str, Any]]) -> list[dict[str, Any]]:
    """Median and worst over the panoramas, a record for each diameter."""
    summaries = []
    for size in sorted({record["ball"] for record in records}):
        of_size = [record for record in records if record["ball"] == size]
        summary: dict[str, Any] = {"ball": size, "panoramas": len(of_size)}
        for metric in ("ball_energy", "map_energy"):
            values = [record[metric] for record in of_size]
            summary[metric] = {"median": median(values), "worst": max(values, key=lambda share: abs(share - 1))}
        for metric in ("si_rmse", "display_rmse"):
            values = [record[metric] for record in of_size]
            summary[metric] = {"median": median(values), "worst": max(values)}
        summaries.append(summary)
    return summaries
