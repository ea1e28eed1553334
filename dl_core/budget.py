"""Time budgets: how long presets take on this machine, and the best that is ready in time.

A short calibration paints a few balls with few denoising steps and with more. What the steps add is the price of an
evaluation; what is left is that of a ball: encoding, decoding, and whatever else a painting begins with.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping
from dataclasses import dataclass, replace
from time import perf_counter
from typing import Final

import torch

from .ball import paint_depth, place_ball
from .errors import OptionError
from .iterative import Rounds, rounds_evaluations
from .painter import Painter, PaintRequest, SilentObserver
from .presets import PRESETS, Preset

__all__ = ["Choice", "Pace", "best_within", "calibrate", "check_budget", "choose", "painted_balls"]

BALLS: Final = 4
"""Balls of the calibration: painters work on about so many at once."""
FEW: Final = 2
MORE: Final = 4
"""Steps of its two paintings; ComfyUI's uni_pc runs no fewer than two."""


@dataclass(frozen=True)
class Pace:
    """How fast a painter is on this machine.

    Attributes:
        evaluation: seconds of a denoiser evaluation.
        ball: seconds of a ball beside its evaluations.
    """

    evaluation: float
    ball: float

    def seconds(self, painter: Painter, preset: Preset) -> float:
        """How long painting a preset will take, at most."""
        exposures = len(preset.evs)
        evaluations = exposures * rounds_evaluations(painter, preset.rounds)
        return evaluations * self.evaluation + exposures * painted_balls(preset.rounds) * self.ball


@dataclass(frozen=True)
class Choice:
    """A preset that is ready in time.

    Attributes:
        name: of `presets.PRESETS`.
        seconds: that painting it will take, at most.
        calibration: seconds that finding out took.
    """

    name: str
    seconds: float
    calibration: float

    def line(self, budget: float) -> str:
        """What a report says of it."""
        return (
            f"budget {budget:g} s: preset {self.name}, {self.seconds:.1f} s of painting foretold after "
            f"{self.calibration:.1f} s of calibration"
        )


def painted_balls(rounds: Rounds) -> int:
    """Balls that a schedule paints at one exposure, at most."""
    return 1 if rounds.rounds == 0 else rounds.most * rounds.rounds + rounds.final + rounds.light_balls


def calibrate(painter: Painter, canvas: int, diameter: int, clock: Callable[[], float] = perf_counter) -> Pace:
    """Measure a painter's pace.

    Args:
        painter: to measure. A first painting that is not counted lets it load and warm up.
        canvas: side of the canvas, pixels.
        diameter: of the ball on it, pixels.
        clock: tells seconds.
    """
    ball = place_ball(canvas, diameter)
    grey = torch.full((1, canvas, canvas, 3), 0.5)
    request = PaintRequest(grey, paint_depth(None, ball), ball, 0.0, tuple(range(BALLS)))

    def paint(steps: int) -> tuple[float, int]:
        started = clock()
        result = painter.paint(replace(request, steps=steps), SilentObserver())
        return clock() - started, result.evaluations

    paint(FEW)
    (short, few), (long, more) = paint(FEW), paint(MORE)
    evaluation = max(0.0, long - short) / max(1, more - few)
    return Pace(evaluation, max(0.0, short - few * evaluation) / BALLS)


def check_budget(seconds: float, option: str = "budget") -> None:
    """Raise OptionError for a budget of 0 or less."""
    if not seconds > 0:
        raise OptionError(option, seconds, "seconds, above 0")


def choose(
    budget: float,
    painter: Painter,
    canvas: int,
    diameter: int,
    presets: Mapping[str, Preset] = PRESETS,
    *,
    option: str = "budget",
    clock: Callable[[], float] = perf_counter,
) -> Choice:
    """The best preset whose painting is done within a budget, less the time that finding out takes.

    Args:
        budget: seconds.
        painter: to paint with.
        canvas: side of the canvas, pixels.
        diameter: of the ball on it, pixels.
        presets: to choose from.
        option: what an error calls the budget.
        clock: tells seconds.

    Raises:
        OptionError: a budget of 0 or less, or one that no preset fits in.
    """
    check_budget(budget, option)
    started = clock()
    pace = calibrate(painter, canvas, diameter, clock)
    taken = clock() - started
    name = best_within(budget - taken, painter, pace, presets, option)
    return Choice(name, pace.seconds(painter, presets[name]), taken)


def best_within(
    seconds: float, painter: Painter, pace: Pace, presets: Mapping[str, Preset] = PRESETS, option: str = "budget"
) -> str:
    """The preset with the smallest measured error among those that are ready in time.

    Presets without a measured error, which are for other models, are left out.

    Args:
        seconds: for all painting.
        painter: counts evaluations.
        pace: of the painter here.
        presets: to choose from.
        option: what an error calls the budget.

    Returns:
        Its name.

    Raises:
        OptionError: not even the cheapest one is.
    """
    takes = {name: pace.seconds(painter, preset) for name, preset in presets.items() if preset.error_deg is not None}
    ready = [name for name, needed in takes.items() if needed <= seconds]
    if not ready:
        cheapest = min(takes, key=lambda name: takes[name])
        accepted = f"{takes[cheapest]:.1f} s or more: the cheapest preset, {cheapest}, takes that long here"
        raise OptionError(option, f"{seconds:g} s", accepted)
    return min(ready, key=lambda name: (presets[name].error_deg, takes[name]))
