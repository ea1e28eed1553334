"""Lights of whole balls given back to a median, which has lost them.

Balls of one photograph agree where the scene is bright and differ in where its lights are. A pixelwise median keeps
what at least half of the balls show at a pixel: a lamp that every ball has, each in another place, is in no median. So
the brightest tenth of a median is too dark, whatever the number of balls, and balls that stop early (`Rounds.until`)
are soft on top of that. Its order is right all the same: where it is brightest a light is likeliest.

A few balls painted to the end know how bright lights are. Pixels of the brightest tenth are raised to the luminance
that pixels of the same rank have in these balls; each keeps its place, its colour and its rank.

Sources: Gonzalez and Woods, Digital Image Processing, Sec. 3.3 (histogram specification), here of the brightest ranks;
for medians that lose what balls show in different places, DiffusionLight, Sec. 4.1.
"""

from __future__ import annotations

from typing import Final

import torch
from jaxtyping import Float
from torch import Tensor

from .ball import inscribed_disc
from .errors import ImageError
from .exposure import luminance

__all__ = ["RESTORED_SHARE", "restore_lights"]

RESTORED_SHARE: Final = 0.1
"""Share of the ball's pixels, the brightest, that are raised: in full at the very top, not at all at the other end."""


def restore_lights(
    ball_hdr: Float[Tensor, "b rows columns 3"],
    whole_hdr: Float[Tensor, "m h w 3"],
    share: float = RESTORED_SHARE,
) -> Float[Tensor, "b rows columns 3"]:
    """Raise the brightest pixels of a ball to the luminances of the same ranks in other balls.

    With r the rank of a pixel's luminance among the disc's, from 0 to 1, L(r) the ball's own luminance there and T(r)
    the median over the other balls of theirs, the pixel is multiplied by max(1, T / L)^w, where w rises from 0 at
    r = 1 - share to 1 at r = 1. Pixels of a ball image have equal solid angles, so ranks are shares of the sphere.

    Args:
        ball_hdr: (1, D, D, 3) linear radiance, 0 or more.
        whole_hdr: (M, D, D, 3) linear radiance of balls of the same scene that were painted to the end.
        share: of the disc's pixels that may be raised, above 0, up to 1.

    Returns:
        (1, D, D, 3) linear radiance; nowhere darker than it was, hues as they were, and the ball itself, bit for bit,
        when the other balls are no brighter at any rank. Pixels of equal luminance stay equal.

    Raises:
        ImageError: more than one ball, one that is not square, or other balls of another size or none.
    """
    if len(ball_hdr) != 1 or ball_hdr.shape[1] != ball_hdr.shape[2]:
        raise ImageError("ball", f"has shape {tuple(ball_hdr.shape)}; one square ball crop is accepted")
    if len(whole_hdr) < 1 or whole_hdr.shape[1:] != ball_hdr.shape[1:]:
        raise ImageError("light balls", f"have shape {tuple(whole_hdr.shape)}; the ball has {tuple(ball_hdr.shape)}")
    on_ball = (inscribed_disc(ball_hdr.shape[1]) > 0).to(ball_hdr.device)
    own = luminance(ball_hdr[0, on_ball])[:, 0]
    order = own.argsort(stable=True)
    # A median over M balls of each rank: one ball with a light that no other has decides nothing.
    whole = luminance(whole_hdr[:, on_ball].to(own))[..., 0].sort(dim=1).values
    targets = torch.quantile(whole, 0.5, dim=0)
    ordered = own[order]
    ranks = (torch.arange(len(ordered)).to(own) + 0.5) / len(ordered)
    weights = ((ranks - (1 - share)) / share).clamp(min=0)
    lit = ordered > 0
    gains = torch.where(lit, (targets / torch.where(lit, ordered, 1.0)).clamp(min=1) ** weights, 1.0)
    raised = torch.empty_like(own)
    raised[order] = _shared_by_equals(ordered, gains)
    restored = ball_hdr.clone()
    restored[0, on_ball] = ball_hdr[0, on_ball] * raised[:, None]
    return restored


def _shared_by_equals(ordered: Float[Tensor, "n"], gains: Float[Tensor, "n"]) -> Float[Tensor, "n"]:
    """The mean gain of pixels of one luminance, whose order among themselves is an accident; their energy stays."""
    _, group, counts = torch.unique_consecutive(ordered, return_inverse=True, return_counts=True)
    totals = torch.zeros(len(counts)).to(gains).index_add(0, group, gains)
    return (totals / counts)[group]
