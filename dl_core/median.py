"""The pixelwise median of N balls, and how much they disagree.

Source: DiffusionLight, Sec. 4.1 and Algorithm 1, line 11.
"""

from __future__ import annotations

from typing import Final

import torch
from jaxtyping import Float
from torch import Tensor

from .errors import OptionError
from .shapes import BallImage

__all__ = ["pixelwise_median", "pixelwise_spread"]

BAND: Final = 16
"""Rows sorted at once: sorting takes three times what is sorted, so that N balls as a whole would need four of it."""


def _require_balls(balls: BallImage) -> None:
    if balls.ndim != 4 or balls.shape[0] < 1:
        raise OptionError("balls", tuple(balls.shape), "shape (N, side, side, channels) with N of at least 1")


def pixelwise_median(balls: BallImage) -> Float[Tensor, "1 d d c"]:
    """Median of N balls, per pixel and channel; the mean of the two middle values where N is even.

    Args:
        balls: (N, D, D, C), display-encoded.

    Raises:
        OptionError: no balls.
    """
    _require_balls(balls)
    return torch.cat([_median(band) for band in balls.split(BAND, dim=1)], dim=1)


def pixelwise_spread(balls: BallImage) -> Float[Tensor, "1 d d c"]:
    """Median absolute deviation of N balls from their median; zero for a single ball.

    Args:
        balls: (N, D, D, C), display-encoded.

    Raises:
        OptionError: no balls.
    """
    _require_balls(balls)
    return torch.cat([_median((band - _median(band)).abs()) for band in balls.split(BAND, dim=1)], dim=1)


def _median(band: Float[Tensor, "n h w c"]) -> Float[Tensor, "1 h w c"]:
    ordered = band.sort(dim=0).values
    count = band.shape[0]
    return (ordered[(count - 1) // 2 : (count - 1) // 2 + 1] + ordered[count // 2 : count // 2 + 1]) / 2
