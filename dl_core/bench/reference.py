"""The authors' unwrap and merge, written anew from their description: the baseline of every merge table.

What it does, and where it differs from `dl_core`:

- Each exposure is unwrapped as an 8-bit display-encoded picture, and merged afterwards, map by map.
- The map's grid holds both end points of 0..2π and 0..π: the first and last column are one direction, each pole is a
  whole row, and pixels are 1/(W - 1) of the turn apart.
- Four times more point samples along each side, bilinear, at a ball radius half a pixel short, then a resize.
- Luminance replaces luminance, and the chroma is that of EV 0 (`dl_core.exposure.merge_paper`).

The resize is a triangle filter here, close in width to the Gaussian of the scripts' library.

Source: the authors' public scripts as described in the package's notes; DiffusionLight, Sec. 4 and Algorithm 2.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from functools import lru_cache
from typing import Final

import torch
import torch.nn.functional as F
from jaxtyping import Float
from torch import Tensor

from ..exposure import merge_paper, quantize
from ..projection import disc_coordinates
from ..shapes import BallImage, Latlong

__all__ = ["reference_merge", "reference_unwrap"]

SUPERSAMPLING: Final = 4
RADIUS_SHORT: Final = 0.5
"""Pixels by which the scripts' ball is smaller than half its crop."""


def _closed_grid(height: int) -> Float[Tensor, "h w 3"]:
    """Directions of a map that holds both end points of both angles."""
    polar = torch.linspace(0, math.pi, height)[:, None]
    azimuth = torch.linspace(-math.pi, math.pi, 2 * height)[None, :]
    ring = torch.sin(polar)
    up = torch.cos(polar).expand(-1, 2 * height)
    return torch.stack((ring * torch.sin(azimuth), up, -ring * torch.cos(azimuth)), dim=-1)


def reference_unwrap(ball: BallImage, height: int) -> Latlong:
    """Unwrap a ball that fills its crop as the authors' script does.

    Args:
        ball: (B, D, D, C), display-encoded in the scripts; linear values pass as well.
        height: rows of the map; its width is twice that.
    """
    grid = _sample_grid(ball.shape[1], height).expand(ball.shape[0], -1, -1, -1)
    planes = ball.permute(0, 3, 1, 2)
    fine = F.grid_sample(planes, grid, mode="bilinear", padding_mode="border", align_corners=False)
    return F.interpolate(fine, size=(height, 2 * height), mode="bilinear", antialias=True).permute(0, 2, 3, 1)


@lru_cache(maxsize=2)
def _sample_grid(size: int, height: int) -> Float[Tensor, "h w 2"]:
    """Where on a ball's crop each sample of a supersampled map lies, -1 to 1."""
    disc = disc_coordinates(_closed_grid(height * SUPERSAMPLING)) * (1 - 2 * RADIUS_SHORT / size)
    return torch.stack((disc[..., 0], -disc[..., 1]), dim=-1)


def reference_merge(balls_ldr: Sequence[BallImage], evs: Sequence[float], height: int) -> Latlong:
    """Radiance map from a bracket of 8-bit balls as the authors' scripts make it: unwrap, round, merge.

    Args:
        balls_ldr: one (B, D, D, 3) display-encoded ball per EV.
        evs: exposure values, descending from 0.
        height: rows of the map.
    """
    return merge_paper([quantize(reference_unwrap(quantize(ball), height)) for ball in balls_ldr], evs)
