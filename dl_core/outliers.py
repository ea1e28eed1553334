"""Balls that are not like the others: disco balls, matte balls, balls of another scene.

Two things are looked at. A ball whose low-pass lies far from the others' shows other light; a ball whose fine detail is
much stronger or much weaker than the others' has facets, or is no mirror. Both are compared with the median over the
balls, which half of them cannot move.

Sources: Iglewicz and Hoaglin, How to detect and handle outliers (ASQC 1993), for distances from the median in units of
their median and the limit of 3.5; DiffusionLight, Sec. 4.1 and Fig. 4, for what bad balls look like.
"""

from __future__ import annotations

from typing import Final

import torch
from jaxtyping import Bool, Float
from torch import Tensor

from .settling import low_pass
from .shapes import BallImage

__all__ = ["find_outliers"]

LIMIT: Final = 3.5
"""Robust standard deviations from the others from which a ball counts as an outlier."""
NORMAL_MAD: Final = 0.6745
"""Median absolute deviation of a normal law, in standard deviations."""
LEAST_RATIO: Final = 2.0
"""No ball nearer than this many times the median distance is an outlier, however alike the distances are."""
LEAST_DETAIL: Final = 0.1
"""Least standard deviation of the logarithm of detail: mirrors of one scene differ by so much without being worse."""
ROUNDING: Final = 0.5 / 255
"""Half a code of 8 bits: balls so near each other are equal."""


def find_outliers(balls: BallImage, weight: Float[Tensor, "d d"]) -> Bool[Tensor, "n"]:
    """Which balls are not like the others.

    Args:
        balls: (N, D, D, 3) display-encoded.
        weight: (D, D) 1 on the disc, 0 outside.

    Returns:
        (N,) true for an outlier; never for half of the balls or more, and for none of fewer than four.
    """
    count = len(balls)
    if count < 4:
        return torch.zeros(count, dtype=torch.bool, device=balls.device)
    scores = torch.maximum(_strangeness(balls, weight), _detail_difference(balls, weight))
    most = (count - 1) // 2
    cut = max(LIMIT, float(scores.sort(descending=True).values[most]))
    return scores > cut


def _strangeness(balls: BallImage, weight: Float[Tensor, "d d"]) -> Float[Tensor, "n"]:
    """Distances of the balls' low-pass from its median over the balls, in robust standard deviations."""
    means, shares = low_pass(balls, weight)
    away = means - means.median(dim=0, keepdim=True).values
    distances = (away.square().mean(dim=-1) * shares).sum(dim=-1).sqrt()
    middle = distances.median().clamp(min=ROUNDING)
    scale = (distances - middle).abs().median() / NORMAL_MAD
    return (distances - middle) / scale.clamp(min=(LEAST_RATIO - 1) * float(middle) / LIMIT)


def _detail_difference(balls: BallImage, weight: Float[Tensor, "d d"]) -> Float[Tensor, "n"]:
    """How the logarithms of the balls' detail differ from their median, in robust standard deviations."""
    detail = (_detail(balls, weight) + ROUNDING).log()
    difference = (detail - detail.median()).abs()
    return difference / (difference.median() / NORMAL_MAD).clamp(min=LEAST_DETAIL)


def _detail(balls: BallImage, weight: Float[Tensor, "d d"]) -> Float[Tensor, "n"]:
    """RMS difference of neighbouring pixels, rows and columns alike, both of which have weight."""
    weight = weight.to(balls)
    total, size = torch.zeros(()).to(balls), torch.zeros(()).to(balls)
    for axis in (1, 2):
        both = weight.narrow(axis - 1, 1, weight.shape[axis - 1] - 1) * weight.narrow(
            axis - 1, 0, weight.shape[axis - 1] - 1
        )
        total = total + (balls.diff(dim=axis).square().mean(dim=-1) * both).sum(dim=(1, 2))
        size = size + both.sum()
    return (total / size).sqrt()
