"""A painter that knows the light: it draws true balls of a panorama, with as much error as it is told to make."""

from __future__ import annotations

from dataclasses import dataclass, field
from functools import lru_cache

import torch
import torch.nn.functional as F
from torch import Tensor

from dl_core.ball import crop_ball
from dl_core.exposure import expose
from dl_core.geometry import camera_rotation, latlong_to_ball, rotate_latlong
from dl_core.painter import Observer, PaintRequest, PaintResult, steps_run

GUIDED = 2
"""Denoiser evaluations a step: with and without the prompt."""


@dataclass(frozen=True)
class Flaws:
    """How wrong the balls are.

    Attributes:
        noise: standard deviation of Gaussian noise on display values, drawn per seed.
        disco: share of seeds whose noise leads to a faceted ball, at every EV.
        matte: share of seeds that lead to a ball that shows no detail finer than a third of it.
        uneven: standard deviation of a smooth error on display values, drawn per seed, 3 x 3 and colours apart: light
            that every ball imagines differently.
        stops: how much brighter than asked the exposures are painted, EVs below 0 only: they disagree with EV 0.
        drift: degrees by which the scene turns per EV step down: exposures that do not align.
        pull: how far SDEdit stays with the ball on the canvas: 0 forgets it, 1 returns it.
        mend: share of the canvas ball's own error that SDEdit repairs on the way; a chrome ball that is nearly
            right is drawn to the right one.
    """

    noise: float = 0.0
    disco: float = 0.0
    matte: float = 0.0
    uneven: float = 0.0
    stops: float = 0.0
    drift: float = 0.0
    pull: float = 0.5
    mend: float = 0.5


@dataclass
class AnalyticPainter:
    """`dl_core.painter.Painter` without a network.

    Attributes:
        latlong_hdr: (1, H, 2H, 3) the light, on the scale whose EV 0 is shown.
        flaws: how wrong the balls are.
        requests: what was asked for, in order.
        spent: denoiser evaluations reported to observers.
    """

    latlong_hdr: Tensor
    flaws: Flaws = Flaws()
    requests: list[PaintRequest] = field(default_factory=list)
    spent: int = 0

    def __post_init__(self) -> None:
        self._true_ball = lru_cache(self._render)

    def evaluations(self, balls: int, steps: int, strength: float, until: float = 1.0) -> int:
        return GUIDED * balls * len(steps_run(steps, strength, until))

    def paint(self, request: PaintRequest, observer: Observer) -> PaintResult:
        self.requests.append(request)
        for _ in steps_run(request.steps, request.strength, request.until):
            self.spent += GUIDED * len(request.seeds)
            observer.evaluated(GUIDED * len(request.seeds))
        drawn = torch.cat([self._draw(request, seed) for seed in request.seeds])
        if request.strength < 1:
            drawn = torch.lerp(drawn, self._mended(request), self.flaws.pull)
        cost = self.evaluations(len(request.seeds), request.steps, request.strength, request.until)
        return PaintResult(drawn, cost)

    def _mended(self, request: PaintRequest) -> Tensor:
        """The canvas' ball on its way to the true one."""
        true = expose(self._true_ball(request.ball.diameter, self.flaws.drift * request.ev), request.ev)
        return torch.lerp(crop_ball(request.canvas, request.ball), true, self.flaws.mend)

    def _draw(self, request: PaintRequest, seed: int) -> Tensor:
        generator = torch.Generator().manual_seed(seed)
        ball = self._true_ball(request.ball.diameter, self.flaws.drift * request.ev)
        kind = float(torch.rand((), generator=generator))
        if kind < self.flaws.disco:
            ball = _disco(ball, generator)
        elif kind < self.flaws.disco + self.flaws.matte:
            ball = _matte(ball)
        shown = expose(ball, request.ev + self.flaws.stops * (request.ev < 0))
        shown = shown + self.flaws.noise * torch.randn(shown.shape, generator=generator)
        if self.flaws.uneven:
            shown = shown + self.flaws.uneven * _smooth(ball.shape[1], generator)
        return shown.clamp(0, 1)

    def is_flawed(self, seed: int) -> bool:
        """Whether a seed leads to a disco ball or a matte one."""
        kind = float(torch.rand((), generator=torch.Generator().manual_seed(seed)))
        return kind < self.flaws.disco + self.flaws.matte

    def _render(self, diameter: int, turn: float) -> Tensor:
        light = self.latlong_hdr if turn == 0 else rotate_latlong(self.latlong_hdr, camera_rotation(yaw=turn))
        return latlong_to_ball(light, diameter, samples=4)


def _disco(ball: Tensor, generator: torch.Generator) -> Tensor:
    """Facets an eighth of the ball wide, each a mirror of a random tilt: it shows one place of the true ball."""
    size, facet = ball.shape[1], max(2, ball.shape[1] // 8)
    cells = -(-size // facet)
    tilt = torch.randn(cells, cells, 2, generator=generator) * (size / 5)
    centres = (torch.arange(cells) + 0.5) * facet
    rows = (centres[:, None] + tilt[..., 0]).clamp(0, size - 1).long()
    columns = (centres[None, :] + tilt[..., 1]).clamp(0, size - 1).long()
    cell = torch.arange(size) // facet
    return ball[:, rows[cell][:, cell], columns[cell][:, cell]]


def _matte(ball: Tensor) -> Tensor:
    """Every pixel shows the mean of its surroundings, a third of the ball wide."""
    width = ball.shape[1] // 6 * 2 + 1
    padded = F.pad(ball.permute(0, 3, 1, 2), [width // 2] * 4, mode="replicate")
    return F.avg_pool2d(padded, width, stride=1).permute(0, 2, 3, 1)


def _smooth(size: int, generator: torch.Generator) -> Tensor:
    """(1, size, size, 3) of mean 0 and standard deviation near 1, without detail finer than half the ball."""
    coarse = torch.randn(1, 3, 3, 3, generator=generator)
    return F.interpolate(coarse, (size, size), mode="bicubic", align_corners=True).permute(0, 2, 3, 1)
