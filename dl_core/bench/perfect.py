"""A painter that knows the light and makes no mistake but 8 bits: the ceiling of every accuracy table."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, field, replace
from typing import Final

from ..ball import crop_ball, paste_ball
from ..exposure import expose, quantize
from ..geometry import latlong_to_ball
from ..painter import Observer, PaintRequest, PaintResult, SilentObserver, steps_run
from ..shapes import BallImage, Image, Latlong

__all__ = ["PerfectPainter", "RoundTripPainter"]

_GUIDED: Final = 2
"""Denoiser evaluations a step, as with classifier-free guidance."""


@dataclass
class PerfectPainter:
    """Paints the true ball, whatever the seed. Its cost is that of a model doing as many steps.

    Attributes:
        latlong_hdr: (1, H, 2H, 3) the light, on the scale of the photograph's EV 0.
    """

    latlong_hdr: Latlong
    _balls: dict[int, BallImage] = field(default_factory=dict)

    def evaluations(self, balls: int, steps: int, strength: float, until: float = 1.0) -> int:
        """See `painter.Painter`."""
        return _GUIDED * balls * len(steps_run(steps, strength, until))

    def paint(self, request: PaintRequest, observer: Observer) -> PaintResult:
        """See `painter.Painter`."""
        diameter = request.ball.diameter
        if diameter not in self._balls:
            self._balls[diameter] = latlong_to_ball(self.latlong_hdr, diameter)
        painted = quantize(expose(self._balls[diameter], request.ev))
        spent = self.evaluations(len(request.seeds), request.steps, request.strength, request.until)
        observer.evaluated(spent)
        return PaintResult(painted.expand(len(request.seeds), -1, -1, -1), spent)


@dataclass
class RoundTripPainter:
    """Paints the true ball as an autoencoder gives it back: the floor of what a model with this autoencoder can reach.

    Attributes:
        truth: paints the true ball.
        code: (B, S, S, 3) display-encoded -> the same, encoded and decoded.
    """

    truth: PerfectPainter
    code: Callable[[Image], Image]

    def evaluations(self, balls: int, steps: int, strength: float, until: float = 1.0) -> int:
        """None: no denoiser is asked."""
        return 0

    def paint(self, request: PaintRequest, observer: Observer) -> PaintResult:
        """See `painter.Painter`."""
        one = self.truth.paint(replace(request, seeds=request.seeds[:1]), SilentObserver())
        canvas = paste_ball(request.canvas, one.balls, request.ball)
        ball = crop_ball(self.code(canvas).clamp(0, 1), request.ball)
        return PaintResult(ball.expand(len(request.seeds), -1, -1, -1), 0)
