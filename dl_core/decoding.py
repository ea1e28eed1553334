"""Decode the ball and not the canvas: an autoencoder's decoder sees only as far as its convolutions reach."""

from __future__ import annotations

from collections.abc import Callable
from typing import Final

from jaxtyping import Float
from torch import Tensor, nn

from .ball import Ball, crop_ball
from .shapes import BallImage, Image

__all__ = ["NORMALIZING_MARGIN", "PLAIN_MARGIN", "decode_ball", "decode_margin"]

PLAIN_MARGIN: Final = 4
"""Latent cells decoded around the ball: 4 change it by 0.002 of an 8-bit code with the mini model's autoencoder."""
NORMALIZING_MARGIN: Final = 16
"""The same for decoders with group normalization, whose statistics are those of all they see."""


def decode_margin(autoencoder: nn.Module) -> int:
    """Latent cells to decode around a ball with an autoencoder, by whether it normalizes what it sees."""
    normalizes = any(isinstance(layer, nn.GroupNorm) for layer in autoencoder.modules())
    return NORMALIZING_MARGIN if normalizes else PLAIN_MARGIN


def decode_ball(
    decode: Callable[[Tensor], Image], latents: Float[Tensor, "n k rows columns"], ball: Ball, margin: int
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
        end = -(-(start + ball.diameter) // cell)
        return slice(max(0, start // cell - margin), min(cells, end + margin))

    rows, columns = neighbourhood(ball.top), neighbourhood(ball.left)
    window = Ball(ball.left - columns.start * cell, ball.top - rows.start * cell, ball.diameter, 0, 0)
    return crop_ball(decode(latents[:, :, rows, columns]), window).clamp(0, 1)
