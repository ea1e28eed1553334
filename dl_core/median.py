"""The pixelwise median of N balls, and how much they disagree.

Source: DiffusionLight, Sec. 4.1 and Algorithm 1, line 11.
"""

from __future__ import annotations

from jaxtyping import Float
from torch import Tensor

from .errors import OptionError
from .shapes import BallImage

__all__ = ["pixelwise_median", "pixelwise_spread"]


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
    ordered = balls.sort(dim=0).values
    count = balls.shape[0]
    return (ordered[(count - 1) // 2 : (count - 1) // 2 + 1] + ordered[count // 2 : count // 2 + 1]) / 2


def pixelwise_spread(balls: BallImage) -> Float[Tensor, "1 d d c"]:
    """Median absolute deviation of N balls from their median; zero for a single ball.

    Args:
        balls: (N, D, D, C), display-encoded.
    """
    return pixelwise_median((balls - pixelwise_median(balls)).abs())
