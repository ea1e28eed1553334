"""What tells a mirror ball from other balls, as numbers.

A mirror ball squeezes the world near its rim. With the disc's radius as 1, a step outwards at ρ turns the reflected
direction by 2 / sqrt(1 - ρ²), a step around by 2 sqrt(1 - ρ²): of detail that runs every way in the world, differences
across the rim's direction are A = 1 / (1 - ρ²) times those along it. The angle ψ of a gradient from the outward
direction then has the density

    p(ψ) = 1 / (π A (cos²ψ / A² + sin²ψ)),

whatever the detail's strength. Facets, paint and a photograph without a ball do not know of the rim, and a ball beside
its place squeezes towards another centre. The logarithm of this density over that of gradients that run every way
(1 / π), averaged over the disc, says how well a ball of a certain place explains a picture: the one that should be
there, others, and each quarter of the rim by itself.

Everything is a ratio or an angle, so that neither exposure nor contrast counts, and is taken over the disc alone.

Source: Tyler, Statistical analysis for the angular central Gaussian distribution on the sphere (Biometrika 74, 1987),
for the density of angles.
"""

from __future__ import annotations

import math
from dataclasses import asdict, dataclass
from functools import lru_cache
from typing import Final

import torch
import torch.nn.functional as F
from jaxtyping import Float
from torch import Tensor

from ..errors import ImageError
from ..exposure import decode_display, luminance
from ..shapes import BallImage, Image

__all__ = ["DARKEST", "SIDE", "SMALLEST", "BallFeatures", "ball_features"]

SIDE: Final = 64
"""Pixels that balls are reduced to: what is told apart here is coarse, and a ball takes milliseconds."""
SMALLEST: Final = 16
SECTORS: Final = 12
WINDOW: Final = 3
"""Sectors that are judged together: a quarter of the rim."""
RING: Final = 0.6
"""Radius from which a sector is judged: squeezing is a factor of 1.6 there."""
RIM: Final = 0.95
"""Radius up to which gradients count: the last pixels of a painted ball are a mixture."""
ELSEWHERE: Final = (0.15, 0.3, 0.5)
"""Distances, in radii, of other centres that are tried, in eight directions each."""
CUTS: Final = (0.0, 0.2, 0.4, 0.6)
"""Distances from the centre, in radii, of straight cuts that are tried."""
CLEAR: Final = 0.02
"""Gradient, in display values over two pixels, that counts by half: below it is noise."""
NOISE: Final = 1e-3
"""Display values that detail is not told apart below: a quarter of a code of 8 bits."""
DARKEST: Final = 0.01
"""Linear value below which lights are not told apart: 6.6 stops below white."""


@dataclass(frozen=True)
class BallFeatures:
    """Numbers of a ball.

    Attributes:
        squeeze: how well a mirror ball in its place explains the gradients, nats; 0 for gradients that run every way.
        elsewhere: how much better the best of other places explains them, nats.
        weakest: as `squeeze`, in the quarter of the rim that fits worst.
        cut: how much better gradients beyond the best straight cut are explained by no ball, nats.
        detail: log2 of the RMS of detail a 16th of the ball wide over that of half of it: paint has none.
        edges: log2 of the RMS of detail a 32nd of the ball wide over that of an eighth: facets have edges, paint none.
        grain: log2 of the RMS of the finest detail over that of a 16th.
        busy: log2 of the share of the disc that has gradients to judge by.
        colour: degrees between the ball's mean colour and grey.
        upright: stops by which the upper half is brighter than the lower.
    """

    squeeze: float
    elsewhere: float
    weakest: float
    cut: float
    detail: float
    edges: float
    grain: float
    busy: float
    colour: float
    upright: float

    def values(self) -> dict[str, float]:
        """The numbers by name."""
        return asdict(self)


@dataclass(frozen=True)
class _Disc:
    """The geometry of a disc that fills its square."""

    x: Float[Tensor, "d d"]
    y: Float[Tensor, "d d"]
    inside: Float[Tensor, "d d"]
    sector: Tensor


@lru_cache(maxsize=1)
def _disc() -> _Disc:
    place = (torch.arange(SIDE) + 0.5) * (2 / SIDE) - 1
    y, x = torch.meshgrid(place, place, indexing="ij")
    inside = ((x.square() + y.square()).sqrt() < 1 - 2 / SIDE).float()
    sector = ((torch.atan2(y, x) / (2 * math.pi) + 0.5) * SECTORS).long().clamp(max=SECTORS - 1)
    return _Disc(x, y, inside, sector)


def ball_features(ball_ldr: Image) -> BallFeatures:
    """Measure a ball.

    Args:
        ball_ldr: (1, D, D, 3) display-encoded in [0, 1], the disc filling the square.

    Raises:
        ImageError: another shape, fewer than 16 pixels, NaN, or values outside [0, 1].
    """
    if ball_ldr.ndim != 4 or ball_ldr.shape[0] != 1 or ball_ldr.shape[3] != 3 or ball_ldr.shape[1] != ball_ldr.shape[2]:
        raise ImageError("ball", f"has shape {tuple(ball_ldr.shape)}, (1, side, side, 3) is accepted")
    if ball_ldr.shape[1] < SMALLEST:
        raise ImageError("ball", f"is {ball_ldr.shape[1]} pixels wide; {SMALLEST} or more are accepted")
    if not torch.isfinite(ball_ldr).all() or ball_ldr.min() < 0 or ball_ldr.max() > 1:
        raise ImageError("ball", "holds values outside [0, 1], or NaN")
    small = ball_ldr.detach().float().cpu().permute(0, 3, 1, 2)
    if small.shape[2] != SIDE:
        small = F.interpolate(small, (SIDE, SIDE), mode="bilinear", antialias=True, align_corners=False).clamp(0, 1)
    grey, disc = small.mean(dim=1)[0], _disc()
    finest, fine, sixteenth, eighth, half = (_strength(grey, SIDE // part, disc) for part in (SIDE, 32, 16, 8, 2))
    light = decode_display(small.permute(0, 2, 3, 1))
    return BallFeatures(
        **_fits(grey, disc),
        detail=math.log2(sixteenth / half),
        edges=math.log2(fine / eighth),
        grain=math.log2(finest / sixteenth),
        colour=_colour(light, disc),
        upright=_upright(light, disc),
    )


def _fits(grey: Float[Tensor, "d d"], disc: _Disc) -> dict[str, float]:
    """How well mirror balls of several places explain the gradients."""
    right, below = _gradients(grey)
    strength = right.square() + below.square()
    inside = disc.inside * (disc.x.square() + disc.y.square() < RIM**2)
    weight = strength / (strength + CLEAR**2) * inside
    total = float(weight.sum()) + 1e-3
    own = _explained(right, below, disc, (0.0, 0.0)) * weight
    others = (
        _explained(right, below, disc, (away * math.cos(turn), away * math.sin(turn)))
        for away in ELSEWHERE
        for turn in (math.pi / 4 * k for k in range(8))
    )
    squeeze = float(own.sum()) / total
    ring = disc.x.square() + disc.y.square() > RING**2
    sums = [torch.zeros(SECTORS).index_add(0, disc.sector.flatten(), (part * ring).flatten()) for part in (own, weight)]
    sums = [sum((part.roll(k) for k in range(1, WINDOW)), start=part) for part in sums]
    return {
        "squeeze": squeeze,
        "elsewhere": max(float((other * weight).sum()) for other in others) / total - squeeze,
        # Two pixels' worth of gradients that run every way: an empty sky says little against a ball.
        "weakest": float((sums[0] / (sums[1] + 2)).min()),
        "cut": -min(float((own * beyond).sum()) for beyond in _cuts()) / total,
        "busy": math.log2(total / float(inside.sum())),
    }


@lru_cache(maxsize=1)
def _cuts() -> tuple[Float[Tensor, "d d"], ...]:
    """Parts of the square that straight cuts take away, 1 there and 0 elsewhere."""
    disc = _disc()
    return tuple(
        (disc.x * math.cos(turn) + disc.y * math.sin(turn) > away).float()
        for turn in (2 * math.pi * k / SECTORS for k in range(SECTORS))
        for away in CUTS
    )


def _gradients(grey: Float[Tensor, "d d"]) -> tuple[Float[Tensor, "d d"], Float[Tensor, "d d"]]:
    """Central differences of the picture, smoothed over three pixels against noise; 0 at the border."""
    binomial = torch.tensor([0.25, 0.5, 0.25])
    padded = F.pad(grey[None, None], (1, 1, 1, 1), mode="replicate")
    smooth = F.conv2d(F.conv2d(padded, binomial.view(1, 1, 3, 1)), binomial.view(1, 1, 1, 3))[0, 0]
    right, below = torch.zeros_like(smooth), torch.zeros_like(smooth)
    right[:, 1:-1] = smooth[:, 2:] - smooth[:, :-2]
    below[1:-1] = smooth[2:] - smooth[:-2]
    return right, below


def _explained(
    right: Float[Tensor, "d d"], below: Float[Tensor, "d d"], disc: _Disc, centre: tuple[float, float]
) -> Float[Tensor, "d d"]:
    """Log density of the gradients' angles under a ball, over that of angles of every way; 0 off that ball."""
    x, y = disc.x - centre[0], disc.y - centre[1]
    square = x.square() + y.square()
    radial = (right * x + below * y).square()
    around = (below * x - right * y).square()
    both = (radial + around).clamp(min=1e-12)
    squeezed = 1 - square.clamp(max=RIM**2)  # 1 / A
    found = squeezed.log() - (radial / both * squeezed.square() + around / both).clamp(min=1e-3).log()
    return found * (square < 1)


def _strength(grey: Float[Tensor, "d d"], width: int, disc: _Disc) -> float:
    """RMS of detail of a width: what means over boxes of it show and those over twice it do not."""
    detail = (_mean(grey, width, disc) - _mean(grey, 2 * width, disc)).square() * disc.inside
    return math.sqrt(float(detail.sum() / disc.inside.sum()) + NOISE**2)


def _mean(grey: Float[Tensor, "d d"], width: int, disc: _Disc) -> Float[Tensor, "d d"]:
    """Means over boxes of the disc alone; of odd width, so that they have a middle."""
    if width == 1:
        return grey
    both = torch.stack((grey * disc.inside, disc.inside))[None]
    sums = F.avg_pool2d(both, width | 1, stride=1, padding=width // 2)[0]
    return sums[0] / sums[1].clamp(min=1e-6)


def _colour(light: BallImage, disc: _Disc) -> float:
    mean = (light[0] * disc.inside[..., None]).sum(dim=(0, 1)) / disc.inside.sum() + DARKEST / 3
    cosine = float(mean.sum() / (math.sqrt(3) * mean.norm()))
    return math.degrees(math.acos(min(1.0, cosine)))


def _upright(light: BallImage, disc: _Disc) -> float:
    shown = luminance(light)[0, ..., 0] * disc.inside
    least = DARKEST * float(disc.inside.sum()) / 2
    return math.log2((float(shown[: SIDE // 2].sum()) + least) / (float(shown[SIDE // 2 :].sum()) + least))
