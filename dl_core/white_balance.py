"""White balance: neutralize a photograph's cast before it is painted in, and give it back to the light.

A model has seen more neutral photographs than coloured ones. The photograph is scaled to a neutral mean in linear
light, channel by channel; the radiance that is estimated in it is divided by the same gains.

What it gains is measured by `lightprobe bench mend --options white-balance`. Colours come closer where there is a cast;
where there is none, grey world takes the scene's own colour for one, and the mean of order 6 does so less.

Sources: Buchsbaum, A spatial processor model for object colour perception (J. Franklin Institute, 1980), for grey
world; Finlayson and Trezzi, Shades of gray and colour constancy (CIC 2004), for Minkowski means of order 6.
"""

from __future__ import annotations

from typing import Final

import torch
from jaxtyping import Float
from torch import Tensor

from .errors import OptionError
from .exposure import GAMMA, decode_display, luminance
from .shapes import Image

__all__ = ["WHITE_BALANCES", "balance", "cast_gains", "check_white_balance"]

WHITE_BALANCES: Final[dict[str, int | None]] = {"none": None, "grey-world": 1, "shades-of-grey": 6}
"""Order of the Minkowski mean that is taken for grey, by name; None leaves a photograph as it is."""

LARGEST_GAIN: Final = 4.0
"""Times, or its inverse, that a channel is scaled against green at most: a picture all in red is no white one."""


def check_white_balance(name: str) -> str:
    """The name of a white balance, checked.

    Raises:
        OptionError: an unknown one.
    """
    if name not in WHITE_BALANCES:
        raise OptionError("white_balance", name, ", ".join(WHITE_BALANCES))
    return name


def cast_gains(photo_ldr: Float[Tensor, "1 h w 3"], method: str) -> Float[Tensor, "3"]:
    """Factors in linear light that make a photograph neutral, and keep the luminance of its mean.

    Args:
        photo_ldr: display-encoded in [0, 1].
        method: key of `WHITE_BALANCES`.

    Returns:
        One factor a channel; exactly 1 for a photograph whose channels have the same mean, and for `none`. A channel
        without light has that of green.

    Raises:
        OptionError: an unknown method.
    """
    order = WHITE_BALANCES[check_white_balance(method)]
    if order is None:
        return torch.ones(3)
    linear = decode_display(photo_ldr).double().flatten(0, 2)
    mean = (linear**order).mean(dim=0) ** (1 / order)
    green = mean[1].expand(3)
    gains = torch.where((mean > 0) & (green > 0), green / mean, torch.ones(()).double())
    gains = gains.clamp(1 / LARGEST_GAIN, LARGEST_GAIN)
    level = luminance(gains * mean)
    return (gains * (luminance(mean) / level if float(level) > 0 else 1.0)).float()


def balance(image_ldr: Image, gains: Float[Tensor, "3"]) -> Image:
    """Scale a display-encoded picture in linear light: decode, multiply, encode; what passes white clips.

    By gains of 1 a picture stays as it is, bit for bit.
    """
    return (image_ldr * gains.to(image_ldr) ** (1 / GAMMA)).clamp(0, 1)
