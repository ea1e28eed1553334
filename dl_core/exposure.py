"""Exposure: display encoding, EV scaling, and merging a bracket of balls into radiance.

Display-encoded values are radiance^(1/γ) clipped to [0, 1], γ = 2.4. An EV scales radiance by 2^EV before encoding.

Sources: DiffusionLight, Sec. 4.2 (γ-2.4, 99th percentile to 0.9) and Algorithm 2 (merge); Wang et al., StyleLight
(ECCV 2022) for the tone mapping it follows; luminance weights of sRGB as the paper prints them.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from itertools import pairwise
from typing import Final

import torch
from jaxtyping import Float
from torch import Tensor

from .errors import ImageError, OptionError

__all__ = [
    "GAMMA",
    "LUMINANCE",
    "MERGES",
    "auto_exposure",
    "check_evs",
    "check_merge",
    "decode_display",
    "encode_display",
    "expose",
    "luminance",
    "merge_bracket",
    "merge_channel",
    "merge_paper",
    "quantize",
]

GAMMA: Final = 2.4
LUMINANCE: Final = (0.21267, 0.71516, 0.07217)
CLIP_THRESHOLD: Final = 0.9
"""Linear value from which an exposure counts as clipped; the next darker one takes over between it and 1."""


def encode_display(radiance: Tensor, gamma: float = GAMMA) -> Tensor:
    """Radiance -> display values in [0, 1]; what lies outside [0, 1] clips."""
    return radiance.clamp(0, 1) ** (1 / gamma)


def decode_display(display: Tensor, gamma: float = GAMMA) -> Tensor:
    """Display values in [0, 1] -> radiance in [0, 1]."""
    return display.clamp(0, 1) ** gamma


def expose(radiance: Tensor, ev: float, gamma: float = GAMMA) -> Tensor:
    """What a display-encoded picture shows of radiance at an exposure value: encode(2^ev · radiance)."""
    return encode_display(radiance * 2.0**ev, gamma)


def quantize(display: Tensor) -> Tensor:
    """Round display values to 8 bits, as the authors' code stores them between its stages."""
    return (display.clamp(0, 1) * 255).round() / 255


def luminance(rgb: Float[Tensor, "*n 3"]) -> Float[Tensor, "*n 1"]:
    """Luminance of linear RGB (Rec.709 primaries, weights as printed in Algorithm 2)."""
    return (rgb * rgb.new_tensor(LUMINANCE)).sum(dim=-1, keepdim=True)


def auto_exposure(
    radiance: Float[Tensor, "*n 3"], *, percentile: float = 99.0, target: float = 0.9, gamma: float = GAMMA
) -> float:
    """Scale that maps a percentile of intensity to a display value: the paper's EV 0.

    Args:
        radiance: linear RGB of the picture the photographer would have taken.
        percentile: of all channel values, 0 to 100.
        target: display value it lands on, in (0, 1].
        gamma: of the display encoding.

    Returns:
        The factor for the radiance; 1 for a picture without light.

    Source: DiffusionLight, Sec. 4.2.
    """
    values = radiance.reshape(-1).double()
    rank = min(len(values), max(1, round(len(values) * percentile / 100)))
    level = float(torch.kthvalue(values, rank).values)
    return target**gamma / level if level > 0 else 1.0


def check_evs(evs: Sequence[float]) -> tuple[float, ...]:
    """The EVs of a bracket, checked: they start at 0 and descend strictly.

    Raises:
        OptionError: none, unsorted, repeated, or without 0.
    """
    values = tuple(float(ev) for ev in evs)
    accepted = "strictly descending EVs that start at 0, such as 0, -2.5, -5"
    if not values or values[0] != 0 or not all(a > b for a, b in pairwise(values)):
        raise OptionError("evs", tuple(evs), accepted)
    if not all(ev >= -40 for ev in values):
        raise OptionError("evs", tuple(evs), accepted + ", none below -40")
    return values


def _bracket(balls: Sequence[Tensor], evs: Sequence[float]) -> tuple[list[Tensor], tuple[float, ...]]:
    values = check_evs(evs)
    if len(balls) != len(values):
        raise OptionError("balls", len(balls), f"one ball image per EV, that is {len(values)}")
    for ball, ev in zip(balls, values, strict=True):
        if ball.shape != balls[0].shape:
            raise ImageError(f"ball at EV {ev:g}", f"has shape {tuple(ball.shape)}, EV 0 has {tuple(balls[0].shape)}")
        if not torch.isfinite(ball).all():
            raise ImageError(f"ball at EV {ev:g}", "holds NaN or infinite values")
        if ball.min() < 0:
            raise ImageError(f"ball at EV {ev:g}", f"holds negative values (lowest {float(ball.min()):g})")
    return list(balls), values


def _takeover(exposed: Tensor, brighter: Tensor, darker: Tensor) -> Tensor:
    """Weight of the darker exposure: rises from 0 to 1 as the brighter one, `exposed`, goes from 0.9 to clipped.

    It takes over only where it reports more light (Algorithm 2, line 7).
    """
    ramp = ((exposed - CLIP_THRESHOLD) / (1 - CLIP_THRESHOLD)).clamp(0, 1)
    return ramp * (darker > brighter).to(ramp)


def merge_paper(balls: Sequence[Tensor], evs: Sequence[float], gamma: float = GAMMA) -> Tensor:
    """Merge luminances and keep the chroma of EV 0.

    Args:
        balls: one (..., 3) display-encoded image in [0, 1] per EV, all of one shape.
        evs: exposure values, strictly descending from 0.
        gamma: of the display encoding.

    Returns:
        (..., 3) linear radiance; its ceiling is 2^(-last EV).

    Raises:
        OptionError: EVs as `check_evs` rejects them, or not one ball per EV.
        ImageError: shapes that differ, NaN, or negative values.

    Warnings:
        A light with one clipped channel is never replaced, and clipped lights turn neutral: the chroma is that of a
        clipped picture. That is how the paper avoids ghosts where painted exposures do not align.

    Source: DiffusionLight, Algorithm 2.
    """
    balls, evs = _bracket(balls, evs)
    linear = [decode_display(ball, gamma) for ball in balls]
    scaled = [luminance(image) * 2.0**-ev for image, ev in zip(linear, evs, strict=True)]
    merged = scaled[-1]
    for i in range(len(balls) - 2, -1, -1):
        weight = _takeover(scaled[i] * 2.0 ** evs[i], scaled[i], merged)
        merged = (1 - weight) * scaled[i] + weight * merged
    # Where EV 0 is black its chroma is undefined, and so is the ratio: the merge keeps the black.
    return linear[0] * (merged / scaled[0].clamp(min=1e-10))


def merge_channel(balls: Sequence[Tensor], evs: Sequence[float], gamma: float = GAMMA) -> Tensor:
    """Merge each colour channel by itself: the paper's rule applied to radiance per channel.

    Exact on brackets that align; ghosts in colour where they do not.

    Args, Returns, Raises: as `merge_paper`.

    Source: Algorithm 2 of DiffusionLight with luminance replaced by each channel.
    """
    balls, evs = _bracket(balls, evs)
    linear = [decode_display(ball, gamma) for ball in balls]
    merged = linear[-1] * 2.0 ** -evs[-1]
    for i in range(len(balls) - 2, -1, -1):
        scaled = linear[i] * 2.0 ** -evs[i]
        weight = _takeover(linear[i], scaled, merged)
        merged = (1 - weight) * scaled + weight * merged
    return merged


MERGES: Final[dict[str, Callable[..., Tensor]]] = {"channel": merge_channel, "paper": merge_paper}
"""Merge methods by name, the default first."""


def check_merge(method: str) -> str:
    """The name of a merge method, checked before anything is painted for it.

    Raises:
        OptionError: an unknown method.
    """
    if method not in MERGES:
        raise OptionError("merge", method, ", ".join(MERGES))
    return method


def merge_bracket(
    balls: Sequence[Tensor], evs: Sequence[float], method: str = "channel", gamma: float = GAMMA
) -> Tensor:
    """Merge a bracket by the method of a given name (see `MERGES`).

    Raises:
        OptionError: an unknown method, and what the method raises.
    """
    return MERGES[check_merge(method)](balls, evs, gamma)
