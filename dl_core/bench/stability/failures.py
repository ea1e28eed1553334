"""Photographs that the paper says it fails on, made from panoramas whose light is known.

Source: DiffusionLight, the appendix on failure cases: overhead and bird's-eye views, other styles than photographs,
macro shots, and high-key and low-key pictures with an empty background.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from typing import Final

import torch
import torch.nn.functional as F
from torch import Tensor

from ...exposure import expose, luminance, quantize
from ...geometry import ball_coverage
from ...shapes import Image, Latlong
from ...spheres import render_spheres
from ..cameras import Camera, Shot, take

__all__ = ["FAILURES", "Failure"]

DIFFUSE: Final = "diffuse"
LEVEL: Final = Camera()


@dataclass(frozen=True)
class Failure:
    """A kind of photograph that is hard.

    Attributes:
        family: kind of failure.
        variant: which one, for people.
        camera: that takes it.
        drawn: what is made of the photograph it takes.
    """

    family: str
    variant: str
    camera: Camera = LEVEL
    drawn: Callable[[Shot], Image] = lambda shot: shot.photo_ldr

    def of(self, panorama_hdr: Latlong) -> Shot:
        """The picture, and the light it was taken in."""
        shot = take(panorama_hdr, self.camera)
        return Shot(quantize(self.drawn(shot).clamp(0, 1)), shot.truth_hdr)


def _posterized(levels: int) -> Callable[[Shot], Image]:
    """Few levels a channel, with flat regions, as in prints and cartoons."""

    def drawn(shot: Shot) -> Image:
        smooth = _blurred(shot.photo_ldr, 3)
        return (smooth * (levels - 1)).round() / (levels - 1)

    return drawn


def _blurred(image: Image, width: int) -> Image:
    planes = F.pad(image.permute(0, 3, 1, 2), [width // 2] * 4, mode="replicate")
    return F.avg_pool2d(planes, width, stride=1).permute(0, 2, 3, 1)


def _line_drawing(shot: Shot) -> Image:
    """Dark lines on white paper where the luminance changes."""
    level = _blurred(luminance(shot.photo_ldr), 3)[..., 0]
    padded = F.pad(level[:, None], [1, 1, 1, 1], mode="replicate")[:, 0]
    across = padded[:, 1:-1, 2:] - padded[:, 1:-1, :-2]
    down = padded[:, 2:, 1:-1] - padded[:, :-2, 1:-1]
    strength = (across.square() + down.square()).sqrt()
    lines = (strength / torch.quantile(strength, 0.95).clamp(min=1e-3)).clamp(max=1)
    return (1 - lines)[..., None].expand(-1, -1, -1, 3)


def _grey(shot: Shot) -> Image:
    return luminance(shot.photo_ldr).expand(-1, -1, -1, 3)


def _empty(level: float) -> Callable[[Shot], Image]:
    return lambda shot: torch.full_like(shot.photo_ldr, level)


def _object_on(level: float) -> Callable[[Shot], Image]:
    """A matte sphere in the scene's light, lit as the photograph is exposed, cut out and put on one tone."""

    def drawn(shot: Shot) -> Image:
        picture = torch.full_like(shot.photo_ldr, level)
        rows, columns = picture.shape[1:3]
        size = rows // 3
        sphere = expose(render_spheres(shot.truth_hdr, size, (DIFFUSE,))[DIFFUSE], 0.0)
        top, left = round(0.55 * rows), round(0.08 * columns)
        place = (slice(None), slice(top, top + size), slice(left, left + size))
        cover: Tensor = ball_coverage(size).to(picture)[None, ..., None]
        picture[place] = torch.lerp(picture[place], sphere, cover)
        return picture

    return drawn


FAILURES: Final[tuple[Failure, ...]] = (
    Failure("ordinary", "level, 60 degrees high"),
    *(Failure("overhead", f"elevation {pitch:g}", Camera(pitch=pitch)) for pitch in (-60.0, -75.0, -90.0)),
    *(Failure("macro", f"field of view {fov:g}", Camera(fov=fov)) for fov in (15.0, 10.0, 5.0)),
    *(Failure("style", f"{levels} levels a channel", drawn=_posterized(levels)) for levels in (4, 2)),
    Failure("style", "line drawing", drawn=_line_drawing),
    Failure("style", "grey", drawn=_grey),
    Failure("empty background", "white", drawn=_empty(1.0)),
    Failure("empty background", "black", drawn=_empty(0.0)),
    Failure("empty background", "white, with a shaded object", drawn=_object_on(1.0)),
    Failure("empty background", "black, with a shaded object", drawn=_object_on(0.0)),
)
"""Hard photographs, after the ordinary one that they are compared with."""
