"""What the nodes share: the category, the BALL socket, and the conversions between ComfyUI's layouts and ours.

ComfyUI's IMAGE is (B, H, W, C) floats, display-encoded by convention though never checked; its MASK is (B, H, W) or
(H, W). Both are the library's `Image` and `Mask`, so that most values pass through unchanged.
"""

from __future__ import annotations

from typing import Any, Final

import torch
from comfy_api.latest import io

from ..dl_core.errors import ImageError, OptionError

__all__ = [
    "CATEGORY",
    "BallFitSocket",
    "BallSocket",
    "DepthModelSocket",
    "as_finite_rgb",
    "as_rgb",
    "named_output",
    "parse_evs",
    "parse_numbers",
]

CATEGORY: Final = "LightProbe"

BallSocket = io.Custom("BALL")
"""A `dl_core.ball.Ball`: where the ball sits on the canvas."""

BallFitSocket = io.Custom("BALL_FIT")
"""A `dl_core.ball_fit.BallFit`: radius and centre of a painted ball, as real numbers."""

DepthModelSocket = io.Custom("DEPTH_MODEL")
"""What estimates depth, near bright, when called with an IMAGE: a `dl_core.depth.DepthModel`."""


def named_output(kind: Any, name: str, tooltip: str, *, is_list: bool = False) -> Any:
    """An output that is shown by its name: ComfyUI shows the type by default, and wants ids no input has."""
    return kind.Output(f"{name}_out", display_name=name, tooltip=tooltip, is_output_list=is_list)


def as_rgb(image: torch.Tensor, socket: str) -> torch.Tensor:
    """An IMAGE of one, three or four channels as (B, H, W, 3): grey is repeated, alpha dropped.

    Raises:
        ImageError: another layout; `socket` is named.
    """
    if image.ndim != 4 or image.shape[-1] not in (1, 3, 4):
        raise ImageError(socket, f"has shape {tuple(image.shape)}; (batch, height, width, 1, 3 or 4) is accepted")
    return image.expand(-1, -1, -1, 3) if image.shape[-1] == 1 else image[..., :3]


def as_finite_rgb(image: torch.Tensor, socket: str) -> torch.Tensor:
    """As `as_rgb`, of pictures without NaN and infinity.

    Raises:
        ImageError: another layout, or values that are not finite; `socket` is named.
    """
    picture = as_rgb(image, socket)
    if not torch.isfinite(picture).all():
        raise ImageError(socket, "holds NaN or infinite values")
    return picture


def parse_evs(text: str) -> tuple[float, ...]:
    """EVs written as text, "0, -2.5, -5".

    Raises:
        OptionError: something that is not a number.
    """
    return parse_numbers(text, "evs", "0, -2.5, -5")


def parse_numbers(text: str, name: str, example: str) -> tuple[float, ...]:
    """Numbers written as text, between commas or semicolons.

    Raises:
        OptionError: something that is not a number; `name` and `example` say what was wanted.
    """
    try:
        return tuple(float(part) for part in text.replace(";", ",").split(",") if part.strip())
    except ValueError as error:
        raise OptionError(name, text, f"numbers between commas, such as {example}") from error
