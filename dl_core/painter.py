"""The Painter port: the only way an algorithm reaches a diffusion model.

A painter gets one frozen request and gives one frozen result. Implementations: `backends.diffusers_painter`, the
node pack's ComfyPainter, and the tests' AnalyticPainter, which draws true balls of a known panorama.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Final, Literal, Protocol, get_args, runtime_checkable

from .ball import Ball
from .errors import OptionError
from .shapes import BallImage, Image

__all__ = [
    "IMPUTINGS",
    "Imputing",
    "Observer",
    "PaintRequest",
    "PaintResult",
    "Painter",
    "SilentObserver",
    "first_step",
]

Imputing = Literal["initial", "predicted"]
"""Noise put on the photograph outside the mask at every step: `initial`, the noise the ball started from, as in the
authors' code; `predicted`, what the denoiser just predicted, as the paper's Algorithm 0 writes it."""

IMPUTINGS: Final[tuple[Imputing, ...]] = get_args(Imputing)


@dataclass(frozen=True)
class PaintRequest:
    """Balls to paint into one canvas at one exposure.

    Attributes:
        canvas: (1, S, S, 3) display-encoded: the photograph, or its composite with a median ball.
        depth: (1, S, S, 3) in [0, 1], the ball painted nearest.
        ball: where the ball goes.
        ev: exposure value of the ball, 0 or below.
        seeds: one per ball wanted. The same seed starts from the same noise at every EV and strength.
        strength: 1 paints from pure noise; below 1 is SDEdit from the canvas.
        steps: length of the full schedule; `strength` decides how much of it is run.
    """

    canvas: Image
    depth: Image
    ball: Ball
    ev: float
    seeds: tuple[int, ...]
    strength: float = 1.0
    steps: int = 30

    def __post_init__(self) -> None:
        if not self.seeds:
            raise OptionError("balls", 0, "1 or more")
        if not 0 < self.strength <= 1:
            raise OptionError("strength", self.strength, "above 0, up to 1")
        if self.steps < 1:
            raise OptionError("steps", self.steps, "1 or more")
        if first_step(self.steps, self.strength) >= self.steps:
            raise OptionError("strength", self.strength, f"at least {1 / self.steps:.3g} with {self.steps} steps")


@dataclass(frozen=True)
class PaintResult:
    """Painted balls and what they cost.

    Attributes:
        balls: (N, D, D, 3) display-encoded in [0, 1], in the order of the seeds.
        evaluations: evaluations of the denoiser (NFE) that this took: one a ball and step, two with guidance.
        notes: what a user should know of how it went, one sentence each: batches halved, balls of an earlier run.
    """

    balls: BallImage
    evaluations: int
    notes: tuple[str, ...] = ()


@runtime_checkable
class Observer(Protocol):
    """Hears of progress. Raising `Interrupted` from any call stops the run there."""

    def evaluated(self, count: int) -> None:
        """`count` more denoiser evaluations are done; those of balls that an earlier run finished count at once."""

    def painted(self, ev: float, round_index: int, balls: BallImage) -> None:
        """Balls of a round are finished: all those so far, (n, D, D, 3)."""


class SilentObserver:
    """An observer that does nothing."""

    def evaluated(self, count: int) -> None:
        """Ignore it."""

    def painted(self, ev: float, round_index: int, balls: BallImage) -> None:
        """Ignore it."""


@runtime_checkable
class Painter(Protocol):
    """Paints chrome balls."""

    def paint(self, request: PaintRequest, observer: Observer) -> PaintResult:
        """Paint the balls of a request, telling the observer of each denoising step."""

    def evaluations(self, balls: int, steps: int, strength: float) -> int:
        """Denoiser evaluations that painting so many balls will take, exactly."""


def first_step(steps: int, strength: float) -> int:
    """Index of the first step SDEdit runs: `steps` less the share that `strength` asks for, rounded as diffusers does.

    Strength 0.8 of 30 steps starts at step 6 and runs 24.
    """
    return steps - min(int(steps * strength), steps)
