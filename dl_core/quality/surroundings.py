"""Checks of what a ball came from and stands in: the photograph, the rim, the horizon, the bracket.

What is usual was measured on good balls in photographs of panoramas (`judge.Range`); the limit for exposures is half a
stop, the most by which a model's exposures should be off.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from itertools import pairwise
from typing import Final

import torch
import torch.nn.functional as F
from jaxtyping import Float
from torch import Tensor

from ..ball import Ball, crop_disc, disc_mask, require_canvas
from ..errors import OptionError
from ..exposure import decode_display, exposure_ratio, luminance
from ..shapes import BallImage, Image
from .features import DARKEST, BallFeatures
from .judge import Check, Judge, Range, verdict

__all__ = [
    "contrast_of",
    "cue_check",
    "exposures_check",
    "horizon_check",
    "rim_check",
    "rim_difference",
]

COARSE: Final = 32
"""Pixels along the longer side at which a photograph's contrast is taken: light, not texture."""
EMPTY: Final = (0.02, 0.98)
"""Display values at and beyond which a photograph holds nothing."""
RING: Final = 0.12
"""Width of the rings inside and outside the rim, in radii."""
SECTORS: Final = 8
AGREEMENT: Final = Range(typical=0.1, limit=0.5)
"""Stops by which exposures disagree."""


def contrast_of(photo_ldr: Image) -> float:
    """Standard deviation of a photograph's luminance, stops, at 32 pixels along its longer side."""
    light = luminance(decode_display(photo_ldr.float())).permute(0, 3, 1, 2)
    height, width = light.shape[2:]
    scale = COARSE / max(height, width)
    small = F.interpolate(light, (max(1, round(height * scale)), max(1, round(width * scale))), mode="area")
    return float((small + DARKEST).log2().std(correction=0))


def cue_check(photo_ldr: Image, judge: Judge) -> Check:
    """Whether a photograph shows enough to tell its light by.

    Args:
        photo_ldr: (1, H, W, 3) display-encoded in [0, 1].
        judge: knows what contrast is usual.
    """
    low, high = EMPTY
    white, black = (float(part.all(dim=-1).float().mean()) for part in (photo_ldr >= high, photo_ldr <= low))
    score = judge.ranges["contrast"].score(contrast_of(photo_ldr)) * (1 - max(white, black))
    bad = "the photograph is flat: nothing in it tells where light comes from"
    if max(white, black) > 0.5:
        bad = f"{max(white, black):.0%} of the photograph is {'white' if white > black else 'black'}, without a cue"
    return verdict(
        "cue",
        score,
        "the photograph has contrast to tell its light by",
        bad,
        "Use a wider photograph of the place, or one with a shaded object in it; take the map for a guess.",
    )


def rim_difference(canvas_ldr: Image, ball: Ball) -> float:
    """Stops between the light just inside the rim and just outside, the mean over sectors and channels.

    At its rim a mirror ball shows what lies straight behind it, so the two go on into each other.

    Args:
        canvas_ldr: (1, S, S, 3) display-encoded, with the ball.
        ball: where it is.

    Raises:
        ImageError: a canvas of another size.
    """
    canvas = decode_display(require_canvas(canvas_ldr, ball).float())[0]
    reach = max(1.0, RING * ball.diameter / 2)
    discs = [disc_mask(ball, grow=grow)[0].to(canvas) for grow in (-reach, 0.0, reach)]
    inside, outside = (discs[1] - discs[0]).clamp(min=0), (discs[2] - discs[1]).clamp(min=0)
    place = torch.arange(ball.canvas) + 0.5
    x, y = ball.centre
    turn = torch.atan2((place - y)[:, None], (place - x)[None, :]) / (2 * math.pi) + 0.5
    sector = (turn * SECTORS).long().clamp(max=SECTORS - 1).flatten()
    levels = [_by_sector(canvas, ring, sector) for ring in (inside, outside)]
    return float(((levels[0] + DARKEST) / (levels[1] + DARKEST)).log2().abs().nanmean())


def _by_sector(canvas: Float[Tensor, "s s 3"], ring: Float[Tensor, "s s"], sector: Tensor) -> Float[Tensor, "k 3"]:
    """Mean light of a ring in each sector; NaN where the canvas ends before it."""
    weighted = torch.cat((canvas * ring[..., None], ring[..., None]), dim=-1).flatten(0, 1)
    sums = torch.zeros(SECTORS, 4).index_add(0, sector, weighted)
    return sums[:, :3] / torch.where(sums[:, 3:] > 0, sums[:, 3:], torch.nan)


def rim_check(canvas_ldr: Image, ball: Ball, judge: Judge) -> Check:
    """Whether the rim continues the picture around it. Args, Raises: as `rim_difference`."""
    stops = rim_difference(canvas_ldr, ball)
    return verdict(
        "rim",
        judge.ranges["rim"].score(stops),
        f"its rim goes on into the picture around it ({stops:.1f} stops apart)",
        f"its rim is {stops:.1f} stops from the picture around it, as if pasted from elsewhere",
        "Paint with more balls or another seed; a refined median (final) follows the picture better.",
    )


def horizon_check(features: BallFeatures, judge: Judge) -> Check:
    """Whether up is where most light is, as in most places. Of a level camera only."""
    stops = features.upright
    return verdict(
        "horizon",
        judge.ranges["upright"].score(stops),
        "light comes from where it does in most places",
        f"its lower half is {-stops:.1f} stops brighter than its upper one: rare for a level camera",
        "If the camera looked steeply up or down, turn the map level; if not, paint with other seeds.",
    )


def exposures_check(balls_ldr: Sequence[BallImage], evs: Sequence[float]) -> Check:
    """Whether the exposures of a bracket show the same light, scaled.

    Args:
        balls_ldr: (1, D, D, 3) display-encoded for each EV.
        evs: exposure values, descending from 0.

    Raises:
        OptionError: fewer than two exposures, or not one ball for each.
    """
    if len(balls_ldr) != len(evs) or len(evs) < 2:
        raise OptionError("balls", len(balls_ldr), "one ball for each of two EVs or more")
    side = balls_ldr[0].shape[1]
    disc = crop_disc(Ball(0, 0, side, side, 0)) > 0.5
    found = []
    for (brighter, darker), (high, low) in zip(pairwise(balls_ldr), pairwise(evs), strict=True):
        compared = exposure_ratio(decode_display(brighter[0][disc]), decode_display(darker[0][disc]), high - low)
        if compared is not None:
            found.append(abs(compared[0]) + compared[1])
    if not found:
        return Check("exposures", 1.0, "too dark or too bright to compare the exposures")
    worst = max(found)
    return verdict(
        "exposures",
        AGREEMENT.score(worst),
        f"the exposures agree within {worst:.2f} stops",
        f"the exposures disagree by {worst:.2f} stops",
        "Check the exposure LoRA and its scale; merge robust undoes errors of up to two stops.",
    )
