"""The mean of all training light, as cameras saw it: what to answer to a photograph without looking at it."""

from __future__ import annotations

from pathlib import Path
from typing import Final

import torch

from ...geometry import rotate_latlong
from ...imageio import write_exr
from ...shapes import Latlong
from ..panoramas import reduce_panorama
from .scene_sampler import SceneSampler

__all__ = ["MEAN_FILE", "mean_light", "write_mean_light"]

MEAN_FILE: Final = "mean_light.exr"

ROWS: Final = 32
CEILING: Final = 32.0
"""Radiance above it counts as this much: no bracket to EV -5 tells it apart, and one sun would outweigh all scenes."""


def mean_light(sampler: SceneSampler, pictures: int) -> Latlong:
    """Mean light around the first pictures of a sampler, (1, 32, 64, 3), on the scale of their photographs' EV 0."""
    total = torch.zeros(1, ROWS, 2 * ROWS, 3)
    for index in range(pictures):
        light, rotation = sampler.light(index)
        # Reduced before it is turned: a mean has no detail to lose, and turning costs by the pixel.
        total += rotate_latlong(reduce_panorama(light.clamp(max=CEILING), ROWS), rotation)
    return total / pictures


def write_mean_light(folder: Path, light: Latlong, pictures: int) -> Path:
    """Write it beside a model's files.

    Raises:
        OutputError: the folder cannot be written.
    """
    return write_exr(folder / MEAN_FILE, light[0], metadata={"pictures": str(pictures)})
