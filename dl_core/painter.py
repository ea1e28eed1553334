"""The Painter port: the only way an algorithm reaches a diffusion model.

A painter gets one frozen request and gives one frozen result. Implementations: `backends.diffusers_painter`, the
node pack's ComfyPainter, and the tests' AnalyticPainter, which draws true balls of a known panorama.
"""

from __future__ import annotations

import math
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
    "check_schedule",
    "first_step",
    "steps_run",
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
        steps: length of the full schedule; `strength` and `until` decide how much of it is run.
        until: share of the schedule after which denoising stops, counted over all `steps` whatever the strength. The
            answer is then the clean image that the last evaluation predicted. 1 runs to the end.
    """

    canvas: Image
    depth: Image
    ball: Ball
    ev: float
    seeds: tuple[int, ...]
    strength: float = 1.0
    steps: int = 30
    until: float = 1.0

    def __post_init__(self) -> None:
        if not self.seeds:
            raise OptionError("balls", 0, "1 or more")
        check_schedule(self.steps, self.strength, self.until)


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

    def evaluations(self, balls: int, steps: int, strength: float, until: float = 1.0) -> int:
        """Denoiser evaluations that painting so many balls will take, exactly."""


def first_step(steps: int, strength: float) -> int:
    """Index of the first step SDEdit runs: `steps` less the share that `strength` asks for, rounded as diffusers does.

    Strength 0.8 of 30 steps starts at step 6 and runs 24.
    """
    return steps - min(int(steps * strength), steps)


def steps_run(steps: int, strength: float, until: float = 1.0) -> range:
    """Indices of the steps that are run, of a schedule of `steps`; empty where `until` comes before the first.

    Strength 0.8 of 30 steps until 0.5 runs steps 6 to 14.
    """
    return range(first_step(steps, strength), min(int(steps * until), steps))


def check_schedule(steps: int, strength: float, until: float = 1.0) -> None:
    """Raise OptionError for a schedule that is out of range or runs no step; the option at fault is named."""
    if not 0 < strength <= 1:
        raise OptionError("strength", strength, "above 0, up to 1")
    if not 0 < until <= 1:
        raise OptionError("until", until, "above 0, up to 1")
    if steps < 1:
        raise OptionError("steps", steps, "1 or more")
    first = first_step(steps, strength)
    if first >= steps:
        raise OptionError("strength", strength, f"at least {_share(1, steps)} with {steps} steps")
    if not steps_run(steps, strength, until):
        accepted = f"at least {_share(first + 1, steps)} with {steps} steps at strength {strength:g}"
        raise OptionError("until", until, accepted)


def _share(part: int, steps: int) -> str:
    """The smallest share of three digits that holds so many steps, in floating point too."""
    thousandths = math.ceil(1000 * part / steps)
    if int(steps * (thousandths / 1000)) < part:
        thousandths += 1
    return f"{thousandths / 1000:g}"
