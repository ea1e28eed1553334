"""The maps of the Blender references: generated ones, and the shipped panoramas at 128 rows.

Without torch or anything else of this package, so that the environment that holds Blender can import it.
"""

from __future__ import annotations

import math
from collections.abc import Callable
from pathlib import Path
from typing import Final

import numpy as np
import OpenEXR

__all__ = ["DIRECTION_MAP_HEIGHT", "direction_map", "environment"]

DIRECTION_MAP_HEIGHT: Final = 128
_SHIPPED: Final = Path(__file__).parents[1] / "data" / "hdri"

Pixels = np.ndarray
"""(rows, columns, channels) float32, row 0 up."""


def direction_map(height: int = DIRECTION_MAP_HEIGHT) -> Pixels:
    """A map whose RGB is the direction: 1 + (x, y, z) / 2 in our axes, 0.5 to 1.5. Linear in direction, so that a
    mean of colours is the mean of directions.
    """
    polar = (np.arange(height)[:, None] + 0.5) * (math.pi / height)
    azimuth = ((np.arange(2 * height)[None, :] + 0.5) / height - 1) * math.pi
    parts = (np.sin(polar) * np.sin(azimuth), np.cos(polar) * np.ones_like(azimuth), -np.sin(polar) * np.cos(azimuth))
    return (1 + np.stack(parts, axis=-1) / 2).astype(np.float32)


def _uniform_map(height: int) -> Pixels:
    return np.ones((height, 2 * height, 3), np.float32)


def _sun_map(height: int) -> Pixels:
    """A sun, exp(-(angle / 2 degrees)²) of radiance 1000, right above the camera's shoulder in a plain blue sky."""
    towards = 2 * (direction_map(height).astype(np.float64) - 1)
    sun = np.array([0.6, 0.48, 0.64])
    angle = np.arccos(np.clip(towards @ sun / np.linalg.norm(towards, axis=-1), -1, 1))
    glow = 1000 * np.exp(-((angle / math.radians(2)) ** 2))[..., None] * np.array([1.0, 0.9, 0.75])
    sky = (1.2 + towards[..., 1:2]) * np.array([0.1, 0.14, 0.22])
    return (glow + sky).astype(np.float32)


def _halved(pixels: Pixels) -> Pixels:
    """Mean of 2 x 2 pixels, weighted by the solid angle of their rows."""
    height = pixels.shape[0]
    edges = np.cos(np.arange(height + 1) * (math.pi / height))
    weights = (edges[:-1] - edges[1:]).reshape(-1, 2, 1, 1, 1)
    blocks = pixels.reshape(height // 2, 2, height, 2, -1)
    return ((blocks * weights).sum(axis=(1, 3)) / (2 * weights.sum(axis=1)[..., 0])).astype(np.float32)


def _shipped_map(name: str, height: int) -> Pixels:
    channels = OpenEXR.File(str(_SHIPPED / f"{name}.exr"), separate_channels=True).channels()
    pixels = np.stack([channels[channel].pixels.astype(np.float32) for channel in "RGB"], axis=-1)
    while pixels.shape[0] > height:
        pixels = _halved(pixels)
    return pixels


def environment(name: str, height: int) -> Pixels:
    """The map of a name: a generated one, or a panorama shipped in data/hdri, halved down to a height."""
    return _GENERATED[name](height) if name in _GENERATED else _shipped_map(name, height)


_GENERATED: Final[dict[str, Callable[[int], Pixels]]] = {
    "directions": direction_map,
    "sun": _sun_map,
    "uniform": _uniform_map,
}
