"""Training pictures: a photograph taken inside a panorama, with a chrome ball in it.

Every picture follows from (seed, index), so a stream of them resumes anywhere.

Source: DiffusionLight, Sec. 4.2 (training set) and Appendix C.1: a small-field-of-view crop tone-mapped at EV 0 with
a mirror ball whose radiance is scaled by 2^EV before the same tone mapping.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Final, Literal

import torch
import torch.nn.functional as F
from jaxtyping import Float
from torch import Generator, Tensor

from ...ball import Ball, crop_ball, place_ball
from ...exposure import auto_exposure, expose
from ...geometry import ball_coverage, camera_rotation, latlong_to_perspective, sample_latlong
from ...projection import disc_directions
from ...prompts import DARK_PROMPT, NEGATIVE_PROMPT, PROMPT
from ...shapes import BallImage, Image, Latlong

__all__ = ["ASPECTS", "BASE_CAPTIONS", "Picture", "SceneSampler"]

BASE_CAPTIONS: Final = (PROMPT, DARK_PROMPT, NEGATIVE_PROMPT, "")
"""Everything base training is told, by index."""

ASPECTS: Final = (1.0, 4 / 3, 3 / 2, 16 / 9, 3 / 4, 2 / 3)
"""Width over height of the photographs."""
TINT: Final = 0.2
"""Deviation of the random white balance of panoramas, in natural logarithms of each channel. Few maps have few colours
of light; with this, the ball's colour has to be taken from the photograph."""

Look = Literal["mirror", "disco", "matte", "tinted"]


@dataclass(frozen=True)
class Picture:
    """A training picture.

    Attributes:
        canvas_ldr: (1, S, S, 3) display-encoded, the ball painted in.
        ball: where it is.
        ev: of the ball; the photograph around it is at EV 0.
        caption: index into `BASE_CAPTIONS`.
    """

    canvas_ldr: Image
    ball: Ball
    ev: float
    caption: int


class SceneSampler:
    """Draws training pictures from a bank of panoramas.

    Args:
        panoramas: (N, H, 2H, 3) linear radiance.
        canvas: side of the pictures, pixels.
        diameter: usual diameter of the ball, pixels.
        seed: of the whole stream.
        bracket: draw good mirror balls at EVs uniform in [ev_min, 0] (LoRA training) instead of the base's mixture.
        centred: share of pictures with the usual ball in the middle; the rest have another size elsewhere.
        ev_min: darkest exposure.
    """

    def __init__(
        self,
        panoramas: Latlong,
        canvas: int,
        diameter: int,
        seed: int,
        *,
        bracket: bool = False,
        centred: float = 0.7,
        ev_min: float = -5.0,
    ) -> None:
        self.panoramas = panoramas
        self.canvas = canvas
        self.diameter = diameter
        self.seed = seed
        self.bracket = bracket
        self.centred = centred
        self.ev_min = ev_min

    def draw(self, index: int) -> Picture:
        """The picture of an index."""
        generator = torch.Generator().manual_seed(self.seed * 1_000_003 + index)
        light, rotation, photo = self._view(generator)
        canvas = expose(photo, 0.0)
        ball = self._place(generator)
        look, ev, caption = self._bracket_kind(generator) if self.bracket else _base_kind(generator)
        radiance = _reflect(light, rotation, ball.diameter, look, generator)
        crop = expose(radiance, ev)
        return Picture(_blend(canvas, crop, ball), ball, ev, caption)

    def light(self, index: int) -> tuple[Latlong, Tensor]:
        """The panorama around the picture of an index, on its scale of exposure, and its camera's rotation, (3, 3)."""
        light, rotation, _ = self._view(torch.Generator().manual_seed(self.seed * 1_000_003 + index))
        return light, rotation

    def _view(self, generator: Generator) -> tuple[Latlong, Tensor, Float[Tensor, "1 side side 3"]]:
        """A panorama on the scale of a photograph's exposure, the camera's rotation, and the photograph; radiance."""
        panorama = self._panorama(generator)
        rotation = camera_rotation(
            yaw=_uniform(generator, -180, 180),
            pitch=max(-35.0, min(35.0, 12 * _normal(generator))),
            roll=2 * _normal(generator),
        )
        photo = self._photograph(generator, panorama, rotation)
        scale = auto_exposure(photo[photo.amax(dim=-1) > 0]) * 2 ** _uniform(generator, -0.3, 0.3)
        return panorama * scale, rotation, photo * scale

    def _panorama(self, generator: Generator) -> Latlong:
        panorama = self.panoramas[int(torch.randint(len(self.panoramas), (), generator=generator))][None]
        if _uniform(generator, 0, 1) < 0.5:
            panorama = panorama.flip(2)
        return panorama * torch.exp(TINT * torch.randn(3, generator=generator))

    def _photograph(self, generator: Generator, panorama: Tensor, rotation: Tensor) -> Image:
        """The scene fitted into the canvas with black bars, as a photograph of some aspect would be; radiance."""
        aspect = ASPECTS[int(torch.randint(len(ASPECTS), (), generator=generator))]
        width = self.canvas if aspect >= 1 else round(self.canvas * aspect)
        height = self.canvas if aspect <= 1 else round(self.canvas / aspect)
        fov = _uniform(generator, 45, 85)
        photo = latlong_to_perspective(panorama, height, width, fov=fov, rotation=rotation, samples=1)
        top, left = (self.canvas - height) // 2, (self.canvas - width) // 2
        bars = (0, 0, left, self.canvas - width - left, top, self.canvas - height - top)
        return F.pad(photo, bars)

    def _place(self, generator: Generator) -> Ball:
        if _uniform(generator, 0, 1) < self.centred:
            return place_ball(self.canvas, self.diameter)
        diameter = 2 * round(self.diameter * _uniform(generator, 0.6, 1.1) / 2)
        reach = self.canvas - diameter
        x, y = (diameter / 2 + reach * _uniform(generator, 0.1, 0.9) for _ in range(2))
        return place_ball(self.canvas, diameter, x=x, y=y)

    def _bracket_kind(self, generator: Generator) -> tuple[Look, float, int]:
        return "mirror", _uniform(generator, self.ev_min, 0), 0


def _uniform(generator: Generator, low: float, high: float) -> float:
    return low + (high - low) * float(torch.rand((), generator=generator))


def _normal(generator: Generator) -> float:
    return float(torch.randn((), generator=generator))


def _base_kind(generator: Generator) -> tuple[Look, float, int]:
    """What a base model has seen: mostly good balls, an honest share of bad ones under the same words, dark ones."""
    draw = _uniform(generator, 0, 1)
    caption = 3 if _uniform(generator, 0, 1) < 0.08 else -1
    if draw < 0.70:
        look, ev, own = "mirror", 0.0, 0
    elif draw < 0.82:
        look, ev, own = ("disco", "matte", "tinted")[int(_uniform(generator, 0, 2.99))], 0.0, 0
    elif draw < 0.88:
        look, ev, own = "matte", 0.0, 2
    else:
        look, ev, own = "mirror", _uniform(generator, -4, -1), 1
    return look, ev, own if caption < 0 else caption  # type: ignore[return-value]


def _reflect(panorama: Latlong, rotation: Tensor, diameter: int, look: Look, generator: Generator) -> BallImage:
    """Radiance of a ball of a given look in the light of a panorama, (1, d, d, 3)."""
    positions = (torch.arange(diameter) + 0.5) * (2 / diameter) - 1
    disc = torch.stack((positions[None, :].expand(diameter, -1), -positions[:, None].expand(-1, diameter)), dim=-1)
    if look == "disco":
        facets = _uniform(generator, 5, 10)
        cell = torch.floor(disc * facets)
        tilt = torch.randn(32, 32, 2, generator=generator)[(cell[..., 1] + 16).long(), (cell[..., 0] + 16).long()]
        disc = (cell + 0.5 + 0.35 * tilt) / facets
        disc = disc / torch.linalg.norm(disc, dim=-1, keepdim=True).clamp(min=1)
    if look == "matte":
        rows = 4
        blurred = F.avg_pool2d(panorama.permute(0, 3, 1, 2), panorama.shape[1] // rows).permute(0, 2, 3, 1)
        return 0.7 * sample_latlong(blurred, disc_directions(disc * 0.72) @ rotation.T)
    radiance = sample_latlong(panorama, disc_directions(disc) @ rotation.T)
    if look == "tinted":
        radiance = radiance * torch.exp(0.5 * torch.randn(3, generator=generator) - 0.2)
    return radiance


def _blend(canvas: Image, crop: BallImage, ball: Ball) -> Image:
    """Paste with a soft edge of one pixel: the share of each pixel that the ball covers."""
    cover = ball_coverage(ball.diameter, samples=4)[None, ..., None]
    result = canvas.clone()
    window = crop_ball(result, ball)
    window.copy_(window * (1 - cover) + crop * cover)
    return result
