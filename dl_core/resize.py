"""Latlong maps of another size, exactly: every pixel of the result is the mean over its own part of the sphere."""

from __future__ import annotations

import math
from functools import lru_cache

import torch
from jaxtyping import Float
from torch import Tensor

from .errors import OptionError
from .shapes import Latlong

__all__ = ["resize_latlong"]


@lru_cache(maxsize=16)
@torch.inference_mode(mode=False)  # a cached inference tensor could never take part in a gradient
def _shares(source: int, target: int, *, solid_angle: bool) -> Float[Tensor, "target source"]:
    """How much of each target row (or column) each source row makes up; every line sums to 1."""
    edges = [torch.linspace(0, math.pi, count + 1, dtype=torch.float64) for count in (source, target)]
    low, high = (-torch.cos(edge) if solid_angle else edge for edge in edges)
    overlap = torch.minimum(low[None, 1:], high[1:, None]) - torch.maximum(low[None, :-1], high[:-1, None])
    return (overlap.clamp(min=0) / high.diff()[:, None]).float()


def resize_latlong(latlong: Latlong, height: int, *, solid_angle: bool = True) -> Float[Tensor, "b rows columns c"]:
    """A map of another size, whatever the two sizes are. Differentiable.

    Pixels of the source count as areas of one value, so a larger map shows them as blocks and keeps their energy.

    Args:
        latlong: (B, H, 2H, C).
        height: rows of the result; its width is twice that.
        solid_angle: weigh by solid angle, which keeps the energy of radiance to the rounding of its type; otherwise by
            area of the picture, as tools for pictures do.

    Raises:
        OptionError: a map that is not 2:1, or a height below 1.
    """
    if latlong.ndim != 4 or latlong.shape[2] != 2 * latlong.shape[1]:
        raise OptionError("latlong", tuple(latlong.shape), "shape (batch, height, 2 x height, channels)")
    if height < 1:
        raise OptionError("height", height, "1 or more rows")
    rows = _shares(latlong.shape[1], height, solid_angle=solid_angle).to(latlong)
    columns = _shares(latlong.shape[2], 2 * height, solid_angle=False).to(latlong)
    # One axis after the other: both at once would be a matrix of all pixels by all pixels.
    return torch.einsum("sj,brjc->brsc", columns, torch.einsum("ri,bijc->brjc", rows, latlong))
