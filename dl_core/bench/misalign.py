"""Brackets that do not align: what a painter's darker exposures show instead of the ball that EV 0 shows.

A painter paints every exposure anew. The darker ones show the scene a little elsewhere, bent, brighter or darker than
their EV says, or with other detail. Each misalignment maps the true ball to the ball each darker exposure is a picture
of; EV 0 is the truth, so that what a merge is to return is known. All are seeded: one seed, one bracket.

Lengths are pixels of a ball 256 pixels wide and scale with it.

Source: the kinds of disagreement are those the paper names as its reason for merging luminance only (DiffusionLight,
Sec. 4.2); patterns of displacement are band-limited Gaussian noise.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass
from functools import lru_cache
from typing import Final

import torch
import torch.nn.functional as F
from jaxtyping import Bool, Float
from torch import Tensor

from ..errors import ImageError, OptionError
from ..exposure import expose, quantize
from ..geometry import ball_coverage
from ..shapes import BallImage

__all__ = ["MISALIGNMENTS", "Misalignment", "displace", "misaligned_bracket", "smooth_noise"]

REFERENCE_DIAMETER: Final = 256
"""Pixels of the ball that lengths are given for."""

Scene = Callable[[BallImage, BallImage, torch.Generator], BallImage]
"""(true ball, ball of another scene, source of noise) -> the ball a darker exposure is a picture of."""


@dataclass(frozen=True)
class Misalignment:
    """One level of disagreement between exposures.

    Attributes:
        summary: one line for people.
        scene: what each darker exposure shows; called once for each of them.
    """

    summary: str
    scene: Scene


def smooth_noise(
    size: int, channels: int, generator: torch.Generator, *, cells: int = 4
) -> Float[Tensor, "1 channels size size"]:
    """Band-limited noise of mean 0 and root mean square 1 in each channel.

    Args:
        size: side in pixels.
        channels: independent patterns.
        generator: of the CPU, seeded by the caller.
        cells: control points along a side; features are about size / cells pixels wide.
    """
    coarse = torch.randn(1, channels, cells, cells, generator=generator)
    fine = F.interpolate(coarse, size=(size, size), mode="bicubic", align_corners=True)
    fine = fine - fine.mean(dim=(2, 3), keepdim=True)
    return fine / fine.square().mean(dim=(2, 3), keepdim=True).sqrt()


def displace(ball: BallImage, offsets: Float[Tensor, "1 2 d d"] | Float[Tensor, "1 2 1 1"]) -> BallImage:
    """Move what a ball shows; its outline stays, and what comes in from beyond the rim repeats the rim.

    Args:
        ball: fills its crop.
        offsets: right and down, in pixels, of what each pixel shows.
    """
    size = ball.shape[1]
    centres = (torch.arange(size) + 0.5) - size / 2
    rows, columns = torch.meshgrid(centres, centres, indexing="ij")
    source = torch.stack((columns, rows))[None] - offsets
    # One pixel inside the rim: beyond it the pixels of the crop are partly off the ball.
    limit = size / 2 - 1
    source = source * (limit / source.norm(dim=1, keepdim=True).clamp(min=limit))
    grid = (source * (2 / size)).permute(0, 2, 3, 1).to(ball)
    planes = ball.permute(0, 3, 1, 2)
    moved = F.grid_sample(planes, grid.expand(len(ball), -1, -1, -1), mode="bilinear", align_corners=False)
    return moved.permute(0, 2, 3, 1) * _touched(size).to(ball)[None, :, :, None]


@lru_cache(maxsize=4)
def _touched(size: int) -> Bool[Tensor, "d d"]:
    """Pixels of a crop that the ball covers any part of."""
    return ball_coverage(size) > 0


def _shift(pixels: float) -> Scene:
    """By so many pixels in a random direction."""

    def scene(ball: BallImage, other: BallImage, generator: torch.Generator) -> BallImage:
        direction = F.normalize(torch.randn(1, 2, 1, 1, generator=generator), dim=1)
        return displace(ball, direction * (pixels * ball.shape[1] / REFERENCE_DIAMETER))

    return scene


def _warp(pixels: float) -> Scene:
    """Bent smoothly, by a root mean square of so many pixels along each axis."""

    def scene(ball: BallImage, other: BallImage, generator: torch.Generator) -> BallImage:
        offsets = smooth_noise(ball.shape[1], 2, generator)
        return displace(ball, offsets * (pixels * ball.shape[1] / REFERENCE_DIAMETER))

    return scene


def _exposure(low: float, high: float) -> Scene:
    """Off by a random number of stops between two."""

    def scene(ball: BallImage, other: BallImage, generator: torch.Generator) -> BallImage:
        stops = low + (high - low) * float(torch.rand((), generator=generator))
        return ball * 2.0**stops

    return scene


def _patches(ball: BallImage, share: float, generator: torch.Generator) -> Float[Tensor, "1 d d 1"]:
    """Smooth blobs that cover a share of the crop: 1 inside."""
    pattern = smooth_noise(ball.shape[1], 1, generator)
    level = torch.quantile(pattern, 1 - share) if share < 1 else pattern.min()
    return (pattern >= level).to(ball).permute(0, 2, 3, 1)


def _highlights(share: float) -> Scene:
    """In patches of a share of the ball, what lies above white is another scene's."""

    def scene(ball: BallImage, other: BallImage, generator: torch.Generator) -> BallImage:
        patches = _patches(ball, share, generator)
        clipped = (ball.amax(dim=-1, keepdim=True) >= 1).to(ball)
        replaced = ball.clamp(max=1) + (other - 1).clamp(min=0) * clipped
        return torch.lerp(ball, replaced, patches)

    return scene


def _detail(share: float) -> Scene:
    """In patches of a share of the ball, everything is another scene's."""

    def scene(ball: BallImage, other: BallImage, generator: torch.Generator) -> BallImage:
        return torch.lerp(ball, other, _patches(ball, share, generator))

    return scene


def _tint(spread: float) -> Scene:
    """Another exposure for each channel, varying smoothly: a standard deviation in stops."""

    def scene(ball: BallImage, other: BallImage, generator: torch.Generator) -> BallImage:
        stops = smooth_noise(ball.shape[1], 3, generator) * spread
        return ball * 2.0 ** stops.permute(0, 2, 3, 1).to(ball)

    return scene


def _all(*scenes: Scene) -> Scene:
    """One after the other."""

    def scene(ball: BallImage, other: BallImage, generator: torch.Generator) -> BallImage:
        for each in scenes:
            ball = each(ball, other, generator)
        return ball

    return scene


MISALIGNMENTS: Final[dict[str, Misalignment]] = {
    "aligned": Misalignment("none", lambda ball, other, generator: ball),
    "shift-0.5": Misalignment("shifted by 0.5 px", _shift(0.5)),
    "shift-1": Misalignment("shifted by 1 px", _shift(1)),
    "shift-2": Misalignment("shifted by 2 px", _shift(2)),
    "shift-4": Misalignment("shifted by 4 px", _shift(4)),
    "warp-1": Misalignment("bent by 1 px rms", _warp(1)),
    "warp-2": Misalignment("bent by 2 px rms", _warp(2)),
    "warp-4": Misalignment("bent by 4 px rms", _warp(4)),
    "exposure-0.5": Misalignment("exposed wrongly by up to half a stop", _exposure(-0.5, 0.5)),
    "exposure-1": Misalignment("exposed wrongly by up to a stop", _exposure(-1, 1)),
    "a-stop-over": Misalignment("every darker exposure a stop too bright", _exposure(1, 1)),
    "a-stop-under": Misalignment("every darker exposure a stop too dark", _exposure(-1, -1)),
    "tint-0.25": Misalignment("tinted by a quarter of a stop", _tint(0.25)),
    "highlights-0.25": Misalignment("another scene's highlights on a quarter of the ball", _highlights(0.25)),
    "highlights-1": Misalignment("another scene's highlights", _highlights(1)),
    "detail-0.25": Misalignment("another scene on a quarter of the ball", _detail(0.25)),
    "detail-1": Misalignment("another scene", _detail(1)),
    "seeds": Misalignment(
        "balls of different seeds: shifted, bent, tinted, exposed wrongly, other highlights here and there",
        _all(_highlights(0.1), _warp(1.5), _shift(1), _tint(0.2), _exposure(-0.5, 0.5)),
    ),
}
"""Levels by name, the aligned bracket first; a new one is tested and measured by being listed."""


def misaligned_bracket(
    ball_hdr: BallImage, evs: Sequence[float], level: str, *, seed: int, other: Float[Tensor, "n e e k"] | None = None
) -> list[BallImage]:
    """The 8-bit pictures a painter whose exposures disagree would paint of a ball.

    Args:
        ball_hdr: (B, D, D, 3) linear radiance; fills its crop.
        evs: exposure values, descending from 0.
        level: of `MISALIGNMENTS`.
        seed: of the disagreement; each darker exposure has its own.
        other: a ball of another scene, of the same shape; when not given, the ball turned by a quarter.

    Returns:
        One display-encoded ball per EV, rounded to 8 bits. EV 0 shows the ball itself.

    Raises:
        OptionError: an unknown level.
        ImageError: another scene of another shape.
    """
    if level not in MISALIGNMENTS:
        raise OptionError("misaligned", level, ", ".join(MISALIGNMENTS))
    other = torch.rot90(ball_hdr, 1, (1, 2)) if other is None else other
    if other.shape != ball_hdr.shape:
        raise ImageError("other", f"has shape {tuple(other.shape)}, the ball has {tuple(ball_hdr.shape)}")
    generator = torch.Generator().manual_seed(seed)
    scene = MISALIGNMENTS[level].scene
    scenes = [ball_hdr, *(scene(ball_hdr, other, generator) for _ in evs[1:])]
    return [quantize(expose(shown, ev)) for shown, ev in zip(scenes, evs, strict=True)]
