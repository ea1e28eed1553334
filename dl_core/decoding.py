"""Decode the ball and not the canvas, where the decoder sees no further than its convolutions reach."""

from __future__ import annotations

from collections.abc import Callable
from typing import Final

from jaxtyping import Float
from torch import Tensor, nn

from .ball import Ball, crop_ball
from .shapes import BallImage, Image

__all__ = ["PLAIN_MARGIN", "decode_ball", "decode_margin"]

PLAIN_MARGIN: Final = 4
"""Latent cells decoded around the ball where the decoder has convolutions alone: on latents of white noise, which have
more fine detail than any painting, it changes no value by more than a third of an 8-bit code with the mini model's
autoencoder."""


def decode_margin(autoencoder: nn.Module) -> int | None:
    """Latent cells to decode around a ball with an autoencoder; None for the whole canvas.

    A decoder with group normalization, as SDXL's, is not cut: its statistics and its attention are those of all it
    sees, so that no margin is exact, and what else the photograph holds decides what a cut ball looks like. With random
    weights 16 cells lose 2.4 codes of 8 bits on average (tests/test_decoding.py); `lightprobe bench early --section
    decoding` measures it with any weights.
    """
    normalizes = any(isinstance(layer, nn.GroupNorm) for layer in autoencoder.modules())
    return None if normalizes else PLAIN_MARGIN


def decode_ball(
    decode: Callable[[Tensor], Image], latents: Float[Tensor, "n k rows columns"], ball: Ball, margin: int | None
) -> BallImage:
    """Decode the ball's neighbourhood and cut the ball out.

    Args:
        decode: (n, k, h, w) latents of any size -> (n, H, W, 3), display-encoded, each cell as many pixels wide as the
            canvas has for one of `latents`.
        latents: of the canvas.
        ball: where it sits on the canvas.
        margin: cells decoded around it, see `decode_margin`.

    Returns:
        (n, D, D, 3) in [0, 1].
    """
    cells = latents.shape[-1]
    cell = ball.canvas // cells

    def neighbourhood(start: int) -> slice:
        if margin is None:
            return slice(0, cells)
        end = -(-(start + ball.diameter) // cell)
        return slice(max(0, start // cell - margin), min(cells, end + margin))

    rows, columns = neighbourhood(ball.top), neighbourhood(ball.left)
    window = Ball(ball.left - columns.start * cell, ball.top - rows.start * cell, ball.diameter, 0, 0)
    return crop_ball(decode(latents[:, :, rows, columns]), window).clamp(0, 1)
