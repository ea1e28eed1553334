"""Time budgets, on painters whose pace is known exactly."""

from __future__ import annotations

from dataclasses import dataclass, field

import pytest
import torch
from hypothesis import given, settings
from hypothesis import strategies as st

from dl_core.ball import place_ball
from dl_core.budget import Pace, best_within, calibrate, painted_balls
from dl_core.errors import OptionError
from dl_core.iterative import Rounds, iterative_inpaint
from dl_core.painter import Observer, PaintRequest, PaintResult, steps_run
from dl_core.presets import Preset

BALL = place_ball(64, 32)
REQUEST = PaintRequest(torch.zeros(1, 64, 64, 3), torch.zeros(1, 64, 64, 3), BALL, 0.0, (0,))


@dataclass
class Timed:
    """A painter that takes a known time on a clock of its own, and longer the first time."""

    each_evaluation: float
    each_ball: float
    loading: float = 60.0
    now: float = 0.0
    asked: list[PaintRequest] = field(default_factory=list)

    def evaluations(self, balls: int, steps: int, strength: float, until: float = 1.0) -> int:
        return 2 * balls * len(steps_run(steps, strength, until))

    def paint(self, request: PaintRequest, observer: Observer) -> PaintResult:
        count = len(request.seeds)
        evaluations = self.evaluations(count, request.steps, request.strength)
        self.now += self.loading * (not self.asked) + evaluations * self.each_evaluation + count * self.each_ball
        self.asked.append(request)
        return PaintResult(torch.zeros(count, 32, 32, 3), evaluations)

    def clock(self) -> float:
        return self.now


def preset(error: float | None, balls: int = 1, steps: int = 2) -> Preset:
    return Preset(Rounds(balls, 1, 0.8, steps, final=False), (0.0, -2.5), "", error_deg=error)


PRESETS = {"cheap": preset(4.0), "good": preset(3.0, 5, 10), "bad": preset(5.0, 4, 10), "best": preset(2.0, 30, 30)}


@given(evaluation=st.floats(1e-4, 1.0), ball=st.floats(0.0, 2.0))
def test_calibration_tells_evaluations_from_balls(evaluation: float, ball: float) -> None:
    painter = Timed(evaluation, ball)
    pace = calibrate(painter, 64, 32, painter.clock)
    assert pace.evaluation == pytest.approx(evaluation, rel=1e-6)
    assert pace.ball == pytest.approx(ball, rel=1e-6, abs=1e-6)


@settings(deadline=None)
@given(
    balls=st.integers(1, 6),
    rounds=st.integers(0, 3),
    steps=st.integers(2, 8),
    final=st.booleans(),
    lights=st.integers(0, 3),
)
def test_the_time_foretold_is_the_time_taken(balls: int, rounds: int, steps: int, final: bool, lights: int) -> None:
    schedule = Rounds(balls, rounds, 0.8, steps, final, light_balls=0 if final or not rounds else lights)
    painter = Timed(0.25, 1.5, loading=0.0)
    evs = (0.0, -2.5, -5.0)
    for _ in evs:
        iterative_inpaint(painter, REQUEST, schedule)
    foretold = Pace(0.25, 1.5).seconds(painter, Preset(schedule, evs, ""))
    assert foretold == pytest.approx(painter.now)
    assert sum(len(request.seeds) for request in painter.asked) == len(evs) * painted_balls(schedule)


def test_the_best_that_is_ready_is_chosen() -> None:
    painter, pace = Timed(0.01, 0.0), Pace(0.01, 0.0)
    needed = {name: pace.seconds(painter, preset) for name, preset in PRESETS.items()}
    assert best_within(needed["best"], painter, pace, PRESETS) == "best"
    assert best_within(needed["best"] * 0.99, painter, pace, PRESETS) == "good"
    # A cheaper preset that is worse is no choice, whatever time is left.
    assert best_within(needed["bad"], painter, pace, PRESETS) == "cheap"
    assert needed["cheap"] < needed["bad"] < needed["good"] < needed["best"]


def test_presets_for_other_models_are_no_choice() -> None:
    painter, pace = Timed(0.01, 0.0), Pace(0.01, 0.0)
    assert best_within(1e9, painter, pace, PRESETS | {"lora": preset(None)}) == "best"


def test_a_budget_too_small_for_anything_is_told_what_would_do() -> None:
    painter, pace = Timed(0.5, 1.0), Pace(0.5, 1.0)
    least = pace.seconds(painter, PRESETS["cheap"])
    with pytest.raises(OptionError, match=rf"--budget.*{least:.1f} s or more.*cheap"):
        best_within(least - 0.01, painter, pace, PRESETS, option="--budget")
    assert best_within(least, painter, pace, PRESETS) == "cheap"
