"""Balls with faults, painted into photographs: what a check of balls has to tell from good ones.

All balls of a photograph are drawn into the same canvas, soft or not and with a little noise, as painters leave them.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Iterator
from dataclasses import dataclass
from typing import Final

import torch
import torch.nn.functional as F
from jaxtyping import Float
from torch import Generator, Tensor

from ..ball import Ball, crop_ball, fit_canvas, paste_ball, place_ball
from ..exposure import expose
from ..geometry import latlong_to_ball
from ..resize import resize_latlong
from ..shapes import BallImage, Latlong
from .cameras import Shot

__all__ = ["FAULTS", "Example", "examples"]

Canvas = Float[Tensor, "b side side k"]

CANVAS: Final = 256
DIAMETER: Final = 64
NOISE: Final = 0.01
"""Standard deviation of noise, display values."""


@dataclass(frozen=True)
class Example:
    """A ball of a kind.

    Attributes:
        fault: `good`, or of `FAULTS`.
        canvas_ldr: (1, S, S, 3) the photograph with the ball.
        ball: where it was to be.
    """

    fault: str
    canvas_ldr: Canvas
    ball: Ball

    @property
    def crop(self) -> BallImage:
        """(1, D, D, 3) the ball, cut out."""
        return crop_ball(self.canvas_ldr, self.ball)


def _drawn(generator: Generator, low: float, high: float) -> float:
    return low + (high - low) * float(torch.rand((), generator=generator))


def _disco(light_hdr: Latlong, canvas: Canvas, ball: Ball, generator: Generator) -> Canvas:
    """Facets, each a mirror of a random tilt: it shows one place of the true ball."""
    shown = expose(latlong_to_ball(light_hdr, ball.diameter, samples=2), 0.0)
    size, facets = ball.diameter, round(_drawn(generator, 5, 10))
    cell = (torch.arange(size) * facets / size).long()
    tilt = torch.randn(facets, facets, 2, generator=generator) * size / 6
    centres = (torch.arange(facets) + 0.5) * size / facets
    rows = (centres[:, None] + tilt[..., 0]).clamp(0, size - 1).long()
    columns = (centres[None, :] + tilt[..., 1]).clamp(0, size - 1).long()
    return paste_ball(canvas, shown[:, rows[cell][:, cell], columns[cell][:, cell]], ball)


def _matte(light_hdr: Latlong, canvas: Canvas, ball: Ball, generator: Generator) -> Canvas:
    """A rough ball: it shows means over cones some 40 to 80 degrees wide."""
    shown = latlong_to_ball(light_hdr, ball.diameter, samples=2)
    width = round(_drawn(generator, 0.2, 0.4) * ball.diameter) // 2 * 2 + 1
    padded = F.pad(shown.permute(0, 3, 1, 2), [width // 2] * 4, mode="replicate")
    return paste_ball(canvas, expose(F.avg_pool2d(padded, width, stride=1).permute(0, 2, 3, 1), 0.0), ball)


def _off_centre(light_hdr: Latlong, canvas: Canvas, ball: Ball, generator: Generator) -> Canvas:
    """A good ball an eighth to a third of its width beside its place."""
    turn, away = _drawn(generator, 0, 2 * math.pi), _drawn(generator, 0.125, 0.33) * ball.diameter
    x, y = (c + round(away * f(turn)) for c, f in zip(ball.centre, (math.cos, math.sin), strict=True))
    elsewhere = place_ball(ball.canvas, ball.diameter, x=x, y=y)
    return _good(light_hdr, canvas, elsewhere, generator)


def _partial(light_hdr: Latlong, canvas: Canvas, ball: Ball, generator: Generator) -> Canvas:
    """A good ball of which a fifth to a half is missing on one side."""
    painted = _good(light_hdr, canvas, ball, generator)
    place = torch.arange(ball.canvas) + 0.5
    turn, cut = _drawn(generator, 0, 2 * math.pi), _drawn(generator, 0.0, 0.6) * ball.diameter / 2
    x, y = ball.centre
    beyond = (place - x)[None, :] * math.cos(turn) + (place - y)[:, None] * math.sin(turn) > cut
    return torch.where(beyond[None, ..., None], canvas, painted)


def _tinted(light_hdr: Latlong, canvas: Canvas, ball: Ball, generator: Generator) -> Canvas:
    """Coloured metal, such as gold or blue steel."""
    tint = torch.exp(0.5 * torch.randn(3, generator=generator) - 0.2)
    return _good(light_hdr * tint, canvas, ball, generator)


def _good(light_hdr: Latlong, canvas: Canvas, ball: Ball, generator: Generator) -> Canvas:
    return paste_ball(canvas, expose(latlong_to_ball(light_hdr, ball.diameter, samples=2), 0.0), ball)


Draw = Callable[[Latlong, Canvas, Ball, Generator], Canvas]

FAULTS: Final[dict[str, Draw]] = {
    "disco": _disco,
    "matte": _matte,
    "off-centre": _off_centre,
    "partial": _partial,
    "tinted": _tinted,
}
"""Kinds of bad balls by name: (light, canvas, place, source of chance) -> the canvas with the ball."""


def examples(shot: Shot, seed: int) -> Iterator[Example]:
    """A good ball and one of each fault in a photograph; they follow from the seed."""
    light = resize_latlong(shot.truth_hdr, min(128, shot.truth_hdr.shape[1]))
    canvas, ball = fit_canvas(shot.photo_ldr, CANVAS), place_ball(CANVAS, DIAMETER)
    for number, (fault, draw) in enumerate({"good": _good, **FAULTS}.items()):
        generator = torch.Generator().manual_seed(1000 * seed + number)
        yield Example(fault, _finished(draw(light, canvas, ball, generator), generator), ball)


def _finished(canvas: Canvas, generator: Generator) -> Canvas:
    """As painters leave it: with noise, and half of the time a little soft."""
    if _drawn(generator, 0, 1) < 0.5:
        padded = F.pad(canvas.permute(0, 3, 1, 2), (1, 1, 1, 1), mode="replicate")
        canvas = torch.lerp(canvas, F.avg_pool2d(padded, 3, stride=1).permute(0, 2, 3, 1), 0.6)
    return (canvas + NOISE * torch.randn(canvas.shape, generator=generator)).clamp(0, 1)
