"""How far a picture is from the true one: RMSE, si-RMSE, angular error and normalized RMSE, under a convention.

A convention says what is averaged over what, and what is done to the light before spheres are lit by it. Figures of
different conventions cannot be compared; every report names the one it used.

- `published`: as the public evaluation code counts. Squared errors are summed over the three channels and divided by
  pixels (√3 more than a mean over channels), angles are averaged over the mask with black pixels as 0, and the range
  of the normalized RMSE is that of the whole frame, background included. Spheres are lit by maps that were reduced to
  128 x 256 and gamma-compressed. That code takes its mask from the prediction's alpha; the masks of two renders of
  one scene are the same.
- `published-array`: as the same authors count their array of spheres: means over pixels and channels, and pixels that
  have no angle left out.
- `radiance`: linear maps, means over pixels and channels, black pixels left out of the angle, and
  the range of the normalized RMSE taken on the mask.

Sources: Grosse et al., Ground truth dataset and baseline evaluations for intrinsic image algorithms (ICCV 2009), Sec.
4, for si-RMSE; LeGendre et al., DeepLight (CVPR 2019), Sec. 5, for the angular error; Marnerides et al., ExpandNet
(2018), for the range of the normalized RMSE; DiffusionLight, Sec. 5, and the public evaluation code of DiffusionLight
and StyleLight, for `published`.
"""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import Final

import numpy as np
import torch
from jaxtyping import Bool, Float
from torch import Tensor

from .errors import ImageError, OptionError
from .metrics import angular_error, least_squares_scale, rgb_angles

__all__ = ["CONVENTIONS", "Convention", "PictureErrors", "check_convention", "picture_errors"]


@dataclass(frozen=True)
class Convention:
    """A way to count.

    Attributes:
        summary: one line for people.
        channels_averaged: squared errors are divided by the channels too, not by the pixels alone.
        black_counts: a pixel without an angle, because one of the two is black, counts as 0 degrees; otherwise it is
            left out.
        range_on_mask: the percentiles of the normalized RMSE are those of the mask, not of the frame.
        compressed: maps are reduced to 128 x 256 and gamma-compressed before spheres are lit by them.
    """

    summary: str
    channels_averaged: bool
    black_counts: bool
    range_on_mask: bool
    compressed: bool


CONVENTIONS: Final[dict[str, Convention]] = {
    "published": Convention(
        "as the public evaluation of three spheres counts: gamma-compressed maps, channels summed, range of the frame",
        channels_averaged=False,
        black_counts=True,
        range_on_mask=False,
        compressed=True,
    ),
    "published-array": Convention(
        "as the public evaluation of the array of spheres counts: linear maps, means over channels",
        channels_averaged=True,
        black_counts=False,
        range_on_mask=False,
        compressed=False,
    ),
    "radiance": Convention(
        "linear maps, means over channels, range of the ball",
        channels_averaged=True,
        black_counts=False,
        range_on_mask=True,
        compressed=False,
    ),
}
"""Conventions by name."""

RANGE: Final = (0.01, 99.9)
"""Percentiles that the normalized RMSE maps to 0 and 1, as in the public code; the paper prints 0.1 and 99.9."""


@dataclass(frozen=True)
class PictureErrors:
    """Errors of a picture against the true one.

    Attributes:
        rmse: root mean square error, radiance units.
        si_rmse: the same after the one scale that makes it least.
        angular_error_deg: mean angle between RGB vectors, degrees.
        normalized_rmse: the same as `rmse` after both pictures' percentiles are mapped to 0 and 1.
    """

    rmse: float
    si_rmse: float
    angular_error_deg: float
    normalized_rmse: float


def check_convention(name: str) -> Convention:
    """The convention of a name.

    Raises:
        OptionError: an unknown one.
    """
    if name not in CONVENTIONS:
        raise OptionError("convention", name, ", ".join(CONVENTIONS))
    return CONVENTIONS[name]


def picture_errors(
    estimate: Float[Tensor, "rows columns 3"],
    truth: Float[Tensor, "h w 3"],
    mask: Bool[Tensor, "h w"] | None = None,
    convention: str = "radiance",
) -> PictureErrors:
    """Compare two pictures where a mask holds. All sums are in float64.

    Args:
        estimate: (H, W, 3) linear values, finite.
        truth: (H, W, 3) linear values, finite.
        mask: (H, W), True where pixels count; everywhere when not given.
        convention: key of `CONVENTIONS`.

    Returns:
        The four errors. A black estimate cannot be scaled to the truth: its si-RMSE is its RMSE.

    Raises:
        OptionError: an unknown convention.
        ImageError: pictures of different sizes, NaN or infinite values, or a mask that holds nowhere.
    """
    counted = check_convention(convention)
    mask = torch.ones(truth.shape[:2], dtype=torch.bool, device=truth.device) if mask is None else mask
    _require_comparable(estimate, truth, mask)
    e, t = estimate[mask].double(), truth[mask].double()
    frames = (e, t) if counted.range_on_mask else (estimate, truth)
    normalized = [_normalize(values, frame) for values, frame in zip((e, t), frames, strict=True)]
    return PictureErrors(
        rmse=_root_mean_square(e - t, counted),
        si_rmse=_root_mean_square(least_squares_scale(e, t) * e - t, counted),
        angular_error_deg=_angle(e, t, counted),
        normalized_rmse=_root_mean_square(normalized[0] - normalized[1], counted),
    )


def _require_comparable(estimate: Tensor, truth: Tensor, mask: Tensor) -> None:
    if estimate.shape != truth.shape or mask.shape != truth.shape[:2]:
        sizes = " and ".join(f"{picture.shape[1]} x {picture.shape[0]}" for picture in (estimate, truth))
        raise ImageError("estimate", f"and truth are {sizes} pixels; two pictures of one size are compared")
    for name, picture in (("estimate", estimate), ("truth", truth)):
        if not all(math.isfinite(end) for end in torch.aminmax(picture)):
            raise ImageError(name, "holds NaN or infinite values")
    if not bool(mask.any()):
        raise ImageError("mask", "holds nowhere; nothing is left to compare")


def _root_mean_square(difference: Float[Tensor, "n 3"], counted: Convention) -> float:
    count = difference.numel() if counted.channels_averaged else len(difference)
    return math.sqrt(float(difference.square().sum()) / count)


def _angle(estimate: Float[Tensor, "n 3"], truth: Float[Tensor, "n 3"], counted: Convention) -> float:
    if not counted.black_counts:
        return angular_error(estimate, truth)
    return float(torch.rad2deg(rgb_angles(estimate, truth)).mean())


def _normalize(values: Float[Tensor, "n 3"], frame: Float[Tensor, "*n 3"]) -> Float[Tensor, "n 3"]:
    """Values with the percentiles of a frame, all channels together, at 0 and 1.

    A frame of one value, up to float32's rounding, has no range: it becomes 0 everywhere.
    """
    low, high = _percentiles(frame.cpu().numpy().ravel(), RANGE)
    if high - low <= 1e-6 * max(abs(low), abs(high)):
        return torch.zeros_like(values)
    return (values - low) / (high - low)


def _percentiles(values: np.ndarray, ranks: tuple[float, float]) -> list[float]:
    """Percentiles, linear between order statistics, which are all that is put in order: a whole frame has millions."""
    places = [(len(values) - 1) * rank / 100 for rank in ranks]
    around = [(math.floor(place), math.ceil(place)) for place in places]
    ordered = np.partition(values, sorted({whole for pair in around for whole in pair}))
    below, above = ordered[[pair[0] for pair in around]], ordered[[pair[1] for pair in around]]
    return [
        float(low) + (float(high) - float(low)) * (place % 1)
        for low, high, place in zip(below, above, places, strict=True)
    ]
