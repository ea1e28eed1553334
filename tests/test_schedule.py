"""Schedules cut at both ends: what is run of them, what it costs, and what is refused."""

from __future__ import annotations

import math

import pytest
import torch
from analytic_painter import GUIDED, AnalyticPainter
from hypothesis import given
from hypothesis import strategies as st

from dl_core.ball import paint_depth, place_ball
from dl_core.bench.perfect import PerfectPainter
from dl_core.bench.skies import SunAndSky
from dl_core.bracket_painter import BracketPainter
from dl_core.errors import OptionError
from dl_core.finished import content_key
from dl_core.iterative import Rounds, iterative_inpaint, rounds_evaluations
from dl_core.painter import Painter, PaintRequest, SilentObserver, check_schedule, first_step, steps_run

LIGHT = SunAndSky(sun_radius=10.0).latlong(32)
BALL = place_ball(96, 32, x=40, y=56)


def request(seeds: tuple[int, ...] = (7,), **schedule: float) -> PaintRequest:
    photo = torch.rand(1, 96, 96, 3, generator=torch.Generator().manual_seed(1))
    return PaintRequest(photo, paint_depth(None, BALL), BALL, 0.0, seeds, **schedule)  # type: ignore[arg-type]


SHARES = st.floats(0.01, 1)


@given(steps=st.integers(1, 60), strength=SHARES, until=SHARES)
def test_each_end_is_rounded_as_diffusers_rounds_strength(steps: int, strength: float, until: float) -> None:
    run = steps_run(steps, strength, until)
    assert (run.start, run.stop) == (first_step(steps, strength), int(steps * until))
    assert steps_run(steps, strength) == range(run.start, steps)
    if run:
        check_schedule(steps, strength, until)
    else:
        with pytest.raises(OptionError) as raised:
            check_schedule(steps, strength, until)
        assert raised.value.name == ("until" if run.start < steps else "strength")


@given(steps=st.integers(1, 998), first=st.integers(0, 997))
def test_the_share_that_an_error_offers_is_accepted_and_no_smaller_one_of_three_digits(steps: int, first: int) -> None:
    strength = min(1.0, (steps - min(first, steps - 1)) / steps + 1e-9)
    with pytest.raises(OptionError) as raised:
        check_schedule(steps, strength, 1e-9)
    offered = float(raised.value.accepted.split()[2])
    check_schedule(steps, strength, offered)
    assert int(steps * (offered - 1e-3)) <= first_step(steps, strength)


@pytest.mark.parametrize(
    ("options", "name"),
    [
        ({"until": 0.0}, "until"),
        ({"until": 1.1}, "until"),
        ({"until": math.nan}, "until"),
        ({"until": 0.2, "strength": 0.8}, "until"),
        ({"strength": 0.02, "until": 0.5}, "strength"),
    ],
)
def test_requests_and_rounds_that_run_no_step_are_refused(options: dict[str, float], name: str) -> None:
    with pytest.raises(OptionError) as raised:
        request(**options)
    assert raised.value.name == name
    with pytest.raises(OptionError) as raised:
        Rounds(rounds=2, **options)  # type: ignore[arg-type]
    assert raised.value.name == name


@pytest.mark.parametrize(
    ("rounds", "medians"),
    [
        (Rounds(3, 2, 0.8, 10, until=0.5), [(0, 5), (2, 5)]),
        (Rounds(2, 1, 0.8, 10, until=0.35), [(0, 3)]),
        (Rounds(2, 3, 0.8, 7, final=False, until=0.9), [(0, 6), (2, 6), (2, 6)]),
        (Rounds(3, 0, 0.8, 10, until=0.5), []),
    ],
)
def test_medians_stop_early_and_the_last_ball_runs_to_the_end(rounds: Rounds, medians: list[tuple[int, int]]) -> None:
    painter = AnalyticPainter(LIGHT)
    result = iterative_inpaint(painter, request(), rounds)
    ran = [steps_run(asked.steps, asked.strength, asked.until) for asked in painter.requests]
    assert [(run.start, run.stop) for run in ran[: rounds.rounds]] == medians
    last = [(2, 10)] if rounds.final else []
    assert [(run.start, run.stop) for run in ran[rounds.rounds :]] == (last if rounds.rounds else [(0, 10)])
    cost = GUIDED * sum(len(run) * len(asked.seeds) for run, asked in zip(ran, painter.requests, strict=True))
    assert result.evaluations == rounds_evaluations(painter, rounds) == painter.spent == cost


@pytest.mark.parametrize("painter", [PerfectPainter(LIGHT), BracketPainter({0.0: PerfectPainter(LIGHT)})], ids=type)
def test_painters_without_a_denoiser_cost_what_one_would(painter: Painter) -> None:
    asked = request((1, 2, 3), steps=10, strength=0.8, until=0.5)
    spent = painter.paint(asked, SilentObserver()).evaluations
    assert spent == painter.evaluations(3, 10, 0.8, 0.5) == GUIDED * 3 * 3
    assert painter.evaluations(3, 10, 0.8) == GUIDED * 3 * 8


def test_balls_kept_for_later_tell_early_answers_from_whole_ones() -> None:
    keys = {content_key(request(steps=10, until=until)) for until in (0.3, 0.5, 1.0)}
    assert len(keys) == 3
    assert content_key(request(steps=10)) in keys
