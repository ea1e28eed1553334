"""How much of a map's light is likely to be in the wrong place: one number for a whole estimate.

The share of light misplaced is ∫ |E - T| dω / ∫ T dω of luminances of estimate and truth: 0 is right, 1 is what a black
map has. An estimate cannot know it, but it goes with what an estimate can see of itself. Photographs are exposed so
that they look alike: where the estimate comes out dark beside its photograph, a light is behind the camera that nobody
saw; and the more the light is gathered in few places, the more of it can be in others. How much each counts is measured
(`confidence.Calibration`), on maps whose truth is known.

Source: own; the share is the L1 distance of measures that optimal transport bounds (Villani, Topics in Optimal
Transportation, 2003, Sec. 7.1).
"""

from __future__ import annotations

from typing import Final

import torch
from jaxtyping import Float
from torch import Tensor

from .exposure import luminance
from .geometry import latlong_solid_angles
from .resize import resize_latlong
from .shapes import Latlong

__all__ = ["OVERALL", "ROWS", "light_misplaced", "overall_evidence"]

ROWS: Final = 16
"""Of the maps that are looked at: 11 degrees."""
OVERALL: Final = ("constant", "level", "peak", "contrast", "spread", "clipped")
"""What the share is predicted from, in the order of `overall_evidence`."""
DARKEST: Final = 1e-4
"""Luminance, white at EV 0 being 1, that stands for anything darker."""


def light_misplaced(estimate_hdr: Latlong, truth_hdr: Float[Tensor, "b k l c"]) -> float:
    """Share of the true light that an estimate has in another place, or not at all, or too much of.

    Args:
        estimate_hdr: (1, H, 2H, 3) linear radiance.
        truth_hdr: (1, K, 2K, 3) on the same scale, of any size.
    """
    estimate, truth = (luminance(resize_latlong(light, ROWS))[0, ..., 0] for light in (estimate_hdr, truth_hdr))
    shares = _shares(estimate)
    return float(((estimate - truth).abs() * shares).sum() / (truth * shares).sum().clamp(min=DARKEST))


def overall_evidence(latlong_hdr: Latlong, spread_stops: Float[Tensor, "..."], clipped: float) -> Float[Tensor, "k"]:
    """What the share of light misplaced is predicted from.

    Args:
        latlong_hdr: (1, H, 2H, 3) linear radiance, white at EV 0 being 1.
        spread_stops: standard deviation of the balls at every pixel, stops.
        clipped: share of the ball that EV 0 clips.

    Returns:
        (6,) in the order of `OVERALL`: 1; log2 of the mean luminance; log2 of the highest over the mean; the share of
        light that is not spread evenly; the mean spread; the share that clips.
    """
    level = luminance(resize_latlong(latlong_hdr, ROWS))[0, ..., 0].clamp(min=DARKEST)
    shares = _shares(level)
    mean = (level * shares).sum()
    uneven = ((level - mean).abs() * shares).sum() / (2 * mean)
    return torch.stack(
        (
            torch.ones_like(mean),
            mean.log2(),
            (level.max() / mean).log2(),
            uneven,
            spread_stops.mean().to(mean),
            torch.full_like(mean, clipped),
        )
    )


def _shares(level: Float[Tensor, "h w"]) -> Float[Tensor, "h w"]:
    angles = latlong_solid_angles(ROWS).to(level).expand_as(level)
    return angles / angles.sum()
