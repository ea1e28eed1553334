"""Algorithm 1: what it asks of the painter, what it costs, and that its median is better than its balls."""

from __future__ import annotations

import math
from dataclasses import dataclass, replace

import pytest
import torch
from analytic_painter import GUIDED, AnalyticPainter, Flaws
from tolerances import assert_close

from dl_core.ball import disc_mask, paint_depth, paste_ball, place_ball
from dl_core.bench.skies import SunAndSky
from dl_core.errors import Interrupted, OptionError
from dl_core.exposure import expose
from dl_core.geometry import latlong_to_ball
from dl_core.iterative import Rounds, Tally, iterative_inpaint, rounds_evaluations, tally_lines
from dl_core.median import pixelwise_median
from dl_core.painter import Observer, PaintRequest, PaintResult, SilentObserver, first_step
from dl_core.presets import PRESETS, preset

BALL = place_ball(96, 32, x=40, y=56)
LIGHT = SunAndSky(sun_radius=10.0).latlong(32)


def request(seed: int = 7, ev: float = 0.0) -> PaintRequest:
    photo = torch.rand(1, 96, 96, 3, generator=torch.Generator().manual_seed(1))
    return PaintRequest(photo, paint_depth(None, BALL), BALL, ev, (seed,))


@dataclass
class StopAfter:
    """An observer that stops the run at its n-th call."""

    calls_left: int

    def evaluated(self, count: int) -> None:
        self._heard()

    def painted(self, ev: float, round_index: int, balls: torch.Tensor) -> None:
        self._heard()

    def _heard(self) -> None:
        self.calls_left -= 1
        if self.calls_left < 0:
            raise Interrupted("stopped by the test")


def rmse(ball: torch.Tensor, ev: float = 0.0) -> float:
    """Distance on the disc from the true ball, display-encoded."""
    truth = expose(latlong_to_ball(LIGHT, BALL.diameter), ev)
    radius = torch.hypot(*torch.meshgrid(*[torch.arange(32) - 15.5] * 2, indexing="ij"))
    return float((ball - truth)[0][radius < 16].square().mean().sqrt())


# --- the calls of Algorithm 1 ------------------------------------------------------------------------------------


def test_calls_follow_algorithm_1() -> None:
    painter, asked = AnalyticPainter(LIGHT, Flaws(noise=0.05)), request(seed=7, ev=-2.5)
    iterative_inpaint(painter, asked, Rounds(balls=4, rounds=3, strength=0.8, steps=10))
    assert [call.seeds for call in painter.requests] == [(7, 8, 9, 10)] * 3 + [(7,)]
    assert [call.strength for call in painter.requests] == [1.0, 0.8, 0.8, 0.8]
    for call in painter.requests:
        assert (call.steps, call.ev, call.ball) == (10, -2.5, BALL)
        assert torch.equal(call.depth, asked.depth)


def test_canvases_are_the_photograph_with_the_last_median() -> None:
    painter, asked = AnalyticPainter(LIGHT, Flaws(noise=0.05)), request()
    iterative_inpaint(painter, asked, Rounds(balls=3, rounds=2, steps=10))
    assert torch.equal(painter.requests[0].canvas, asked.canvas)
    again = AnalyticPainter(LIGHT, painter.flaws)
    for before, after in zip(painter.requests[:2], painter.requests[1:], strict=True):
        median = pixelwise_median(again.paint(before, SilentObserver()).balls)
        assert torch.equal(after.canvas, paste_ball(asked.canvas, median, BALL))
        outside = disc_mask(BALL)[0] == 0
        assert torch.equal(after.canvas[:, outside], asked.canvas[:, outside])


def test_the_result_reports_its_last_round() -> None:
    painter = AnalyticPainter(LIGHT, Flaws(noise=0.05))
    result = iterative_inpaint(painter, request(), Rounds(balls=5, rounds=2, steps=10))
    assert result.balls.shape == (5, 32, 32, 3)
    assert torch.equal(result.median, pixelwise_median(result.balls))
    assert float(result.spread.mean()) > 0
    assert result.ball.shape == (1, 32, 32, 3)
    assert not torch.equal(result.ball, result.median)


def test_without_a_last_ball_the_median_is_the_answer() -> None:
    painter = AnalyticPainter(LIGHT, Flaws(noise=0.05))
    result = iterative_inpaint(painter, request(), Rounds(balls=3, rounds=1, steps=10, final=False))
    assert torch.equal(result.ball, result.median)
    assert len(painter.requests) == 1


def test_no_rounds_paint_one_ball_from_noise() -> None:
    painter = AnalyticPainter(LIGHT)
    result = iterative_inpaint(painter, request(seed=3), Rounds(balls=9, rounds=0, steps=10))
    assert [(call.seeds, call.strength) for call in painter.requests] == [((3,), 1.0)]
    assert_close(result.spread, 0.0)


def test_a_seed_fixes_the_result() -> None:
    first, same, other = (
        iterative_inpaint(AnalyticPainter(LIGHT, Flaws(noise=0.1)), request(seed), Rounds(balls=3, steps=5)).ball
        for seed in (5, 5, 50)
    )
    assert torch.equal(first, same)
    assert not torch.equal(first, other)


# --- depth of every round ----------------------------------------------------------------------------------------


def test_every_median_gets_a_depth_of_its_own() -> None:
    """The first round's is the request's; each later one is that of the composite, with the ball painted nearest."""
    painter, asked, seen = AnalyticPainter(LIGHT, Flaws(noise=0.05)), request(), list[torch.Tensor]()

    def depth_of(canvas: torch.Tensor) -> torch.Tensor:
        seen.append(canvas)
        return canvas.mean(dim=-1, keepdim=True)

    iterative_inpaint(painter, asked, Rounds(balls=3, rounds=2, steps=5), depth_of=depth_of)
    first, *later = painter.requests
    assert torch.equal(first.depth, asked.depth)
    assert len(later) == len(seen) == 2
    for call, canvas in zip(later, seen, strict=True):
        assert torch.equal(call.canvas, canvas)
        assert torch.equal(call.depth, paint_depth(canvas.mean(dim=-1, keepdim=True), BALL))
        assert call.depth[:, disc_mask(BALL)[0] == 1].min() == 1


def test_what_the_painter_notes_is_in_the_result() -> None:
    class Talkative(AnalyticPainter):
        def paint(self, request: PaintRequest, observer: Observer) -> PaintResult:
            result = super().paint(request, observer)
            return replace(result, notes=(f"painted {len(request.seeds)}",))

    for rounds, notes in ((2, ("painted 3", "painted 3", "painted 1")), (0, ("painted 1",))):
        result = iterative_inpaint(Talkative(LIGHT), request(), Rounds(balls=3, rounds=rounds, steps=5))
        assert result.notes == notes


# --- cost --------------------------------------------------------------------------------------------------------


def test_the_papers_schedule_costs_what_the_paper_says() -> None:
    # Per EV 30 x 30 + 30 x 24 + 1 x 24 = 1,644 guided steps; three EVs 4,932.
    paper = preset("paper")
    painter = AnalyticPainter(LIGHT)
    results = [iterative_inpaint(painter, request(ev=ev), paper.rounds) for ev in paper.evs]
    assert [result.evaluations for result in results] == [GUIDED * 1644] * 3
    assert painter.spent == GUIDED * 4932
    assert paper.guided_steps == 4932


@pytest.mark.parametrize("name", PRESETS)
def test_every_preset_costs_what_its_row_says(name: str) -> None:
    row, painter = PRESETS[name], AnalyticPainter(LIGHT)
    planned = sum(rounds_evaluations(painter, row.rounds) for _ in row.evs)
    spent = sum(iterative_inpaint(painter, request(ev=ev), row.rounds).evaluations for ev in row.evs)
    assert spent == planned == painter.spent == GUIDED * row.guided_steps


@pytest.mark.parametrize("rounds", [Rounds(2, 0, 0.8, 7), Rounds(1, 1, 0.3, 10, final=False), Rounds(3, 4, 0.55, 9)])
def test_any_schedule_costs_what_was_planned(rounds: Rounds) -> None:
    painter = AnalyticPainter(LIGHT)
    assert iterative_inpaint(painter, request(), rounds).evaluations == rounds_evaluations(painter, rounds)


@pytest.mark.parametrize(("steps", "strength", "first"), [(30, 1.0, 0), (30, 0.8, 6), (10, 0.55, 5), (3, 0.34, 2)])
def test_sdedit_starts_where_diffusers_does(steps: int, strength: float, first: int) -> None:
    assert first_step(steps, strength) == first


# --- rounds that end when their median is settled ------------------------------------------------------------------


class Sparing:
    """An observer that counts what is done and what is spared, and hears of balls so far."""

    def __init__(self) -> None:
        self.done = self.spared_in_all = 0
        self.heard: list[int] = []

    def evaluated(self, count: int) -> None:
        self.done += count

    def spared(self, count: int) -> None:
        self.spared_in_all += count

    def painted(self, ev: float, round_index: int, balls: torch.Tensor) -> None:
        self.heard.append(len(balls))


SETTLING = Rounds(balls=12, rounds=2, strength=0.5, steps=4, tolerance=0.05, min_balls=4)


def test_a_tolerance_asks_for_balls_a_few_at_a_time() -> None:
    painter, observer = AnalyticPainter(LIGHT, Flaws(noise=0.02)), Sparing()
    result = iterative_inpaint(painter, request(seed=7), SETTLING, observer)
    assert [call.seeds for call in painter.requests] == [(7, 8, 9, 10), (7, 8, 9, 10), (7,)]
    assert observer.heard == [4, 4]
    assert [tally.painted for tally in result.tallies] == [4, 4]
    assert result.evaluations == observer.done == painter.spent
    assert observer.done + observer.spared_in_all == rounds_evaluations(painter, SETTLING)


def test_a_tolerance_out_of_reach_paints_the_same_balls_as_none() -> None:
    """None of them an outlier: the same seeds in the same order, and so the same medians to the bit."""
    flaws, strict = Flaws(noise=0.02, uneven=0.05), replace(SETTLING, tolerance=1e-6)
    painter, observer = AnalyticPainter(LIGHT, flaws), Sparing()
    found = iterative_inpaint(painter, request(), strict, observer)
    fixed = iterative_inpaint(AnalyticPainter(LIGHT, flaws), request(), replace(strict, tolerance=None))
    assert observer.heard == [4, 5, 6, 7, 8, 10, 12] * 2
    assert observer.spared_in_all == 0
    assert [tally.left_out for tally in found.tallies] == [(), ()]
    assert torch.equal(found.ball, fixed.ball)
    assert torch.equal(found.balls, fixed.balls)
    assert found.evaluations == fixed.evaluations


def test_balls_left_out_are_named_by_their_seeds() -> None:
    flaws = Flaws(noise=0.01, disco=0.25)
    painter = AnalyticPainter(LIGHT, flaws)
    rounds = Rounds(balls=12, rounds=1, steps=1, tolerance=1e-6, final=False)
    result = iterative_inpaint(painter, request(seed=40), rounds)
    flawed = [seed for seed in range(40, 52) if painter.is_flawed(seed)]
    assert flawed
    assert list(result.tallies[0].left_out) == flawed
    assert rmse(result.median) < rmse(pixelwise_median(iterative_inpaint(painter, request(40), FIXED_12).balls))
    (line,) = tally_lines(result, rounds)
    assert "not settled after 12 of at most 12 balls" in line
    assert line.endswith(f"seeds {', '.join(map(str, flawed))}")


FIXED_12 = Rounds(balls=12, rounds=1, steps=1, final=False)


def test_without_a_tolerance_rounds_are_told_of_and_nothing_is_left_out() -> None:
    result = iterative_inpaint(
        AnalyticPainter(LIGHT, Flaws(disco=0.3)), request(), replace(FIXED_12, rounds=2, steps=2)
    )
    assert result.tallies == (Tally(12), Tally(12))
    assert tally_lines(result, FIXED_12) == []


def test_only_what_the_merge_uses_is_waited_for() -> None:
    """Nothing of the ball is used: the fewest balls do, however they differ."""
    painter, nothing = AnalyticPainter(LIGHT, Flaws(uneven=0.2)), torch.zeros(1, 32, 32)
    rounds = replace(SETTLING, rounds=1, tolerance=0.001)
    assert iterative_inpaint(painter, request(), rounds, used=nothing).tallies[0].painted == 4
    assert iterative_inpaint(painter, request(), rounds, used=nothing + 1).tallies[0].painted == 12


# --- interruption ------------------------------------------------------------------------------------------------


def test_it_stops_at_any_step_and_breaks_nothing() -> None:
    rounds = Rounds(balls=2, rounds=2, strength=0.5, steps=4)
    asked = request()
    before = asked.canvas.clone()
    whole = iterative_inpaint(AnalyticPainter(LIGHT, Flaws(noise=0.1)), asked, rounds)
    painter = AnalyticPainter(LIGHT, Flaws(noise=0.1))
    calls = 4 + 1 + 2 + 1 + 2  # steps of each request, and a finished round after each of the first two
    for n in range(calls):
        with pytest.raises(Interrupted):
            iterative_inpaint(painter, asked, rounds, StopAfter(n))
        assert torch.equal(asked.canvas, before)
    again = iterative_inpaint(painter, asked, rounds, StopAfter(calls))
    assert torch.equal(again.ball, whole.ball)


# --- what it is for ----------------------------------------------------------------------------------------------


def test_the_median_of_n_balls_has_the_error_the_median_should_have() -> None:
    sigma, n = 0.02, 25
    result = iterative_inpaint(
        AnalyticPainter(LIGHT, Flaws(noise=sigma)), request(), Rounds(balls=n, rounds=1, final=False)
    )
    # SE(median) = sqrt(π / 2N) sigma for a normal law. Clipping to [0, 1] shrinks it where the light is white.
    assert rmse(result.ball) == pytest.approx(math.sqrt(math.pi / (2 * n)) * sigma, rel=0.15)


@pytest.mark.parametrize("ev", [0.0, -2.5])
def test_the_median_beats_a_single_ball_when_some_are_disco_balls(ev: float) -> None:
    flaws = Flaws(noise=0.03, disco=0.3)
    asked = request(seed=0, ev=ev)
    singles = [
        rmse(iterative_inpaint(AnalyticPainter(LIGHT, flaws), replace(asked, seeds=(seed,)), Rounds(rounds=0)).ball, ev)
        for seed in range(12)
    ]
    median = rmse(iterative_inpaint(AnalyticPainter(LIGHT, flaws), asked, Rounds(balls=12, rounds=1)).median, ev)
    assert median < min(singles)
    assert median < 0.5 * sorted(singles)[len(singles) // 2]


def test_a_second_round_mends_what_the_first_left() -> None:
    flaws = Flaws(noise=0.1, disco=0.4)
    errors = [
        rmse(iterative_inpaint(AnalyticPainter(LIGHT, flaws), request(seed=0), Rounds(balls=7, rounds=k)).ball)
        for k in (0, 1, 2)
    ]
    assert errors[2] < errors[1] < errors[0]


@pytest.mark.parametrize(
    ("options", "name"),
    [
        ({"balls": 0}, "balls"),
        ({"balls": 1001}, "balls"),
        ({"rounds": -1}, "rounds"),
        ({"strength": 0.0}, "strength"),
        ({"strength": 1.1}, "strength"),
        ({"strength": math.nan}, "strength"),
        ({"steps": 0}, "steps"),
        ({"tolerance": 0.0}, "tolerance"),
        ({"tolerance": 1.0}, "tolerance"),
        ({"tolerance": math.nan}, "tolerance"),
        ({"min_balls": 2}, "min_balls"),
        ({"min_balls": 1001}, "min_balls"),
    ],
)
def test_wrong_rounds_are_named(options: dict[str, float], name: str) -> None:
    with pytest.raises(OptionError) as raised:
        Rounds(**options)  # type: ignore[arg-type]
    assert raised.value.name == name


def test_a_strength_that_leaves_no_step_is_named() -> None:
    with pytest.raises(OptionError, match="strength"):
        iterative_inpaint(AnalyticPainter(LIGHT), request(), Rounds(balls=1, rounds=2, strength=0.05, steps=10))


def test_an_unknown_preset_is_refused_with_the_known_ones() -> None:
    with pytest.raises(OptionError, match="draft, fast, balanced, best, turbo, paper"):
        preset("quick")
