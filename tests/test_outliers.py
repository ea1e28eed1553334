"""Balls unlike the others: disco balls and matte ones are found, good ones stay."""

from __future__ import annotations

from dataclasses import replace

import torch
from analytic_painter import AnalyticPainter, Flaws
from hypothesis import given, settings
from hypothesis import strategies as st
from test_iterative import Sparing
from test_settling import DISC, REQUEST, painter_with

from dl_core.estimate import Settings, estimate
from dl_core.geometry import ball_to_latlong, latlong_directions, latlong_to_ball
from dl_core.iterative import Rounds, iterative_inpaint, rounds_evaluations, tally_lines
from dl_core.outliers import find_outliers
from dl_core.painter import SilentObserver

COUNT = 12


def trial(flaws: Flaws, first: int, count: int = COUNT) -> tuple[torch.Tensor, torch.Tensor]:
    """Which balls are found to be outliers, and which are."""
    painter, wanted = painter_with(flaws), tuple(range(first, first + count))
    balls = painter.paint(replace(REQUEST, seeds=wanted), SilentObserver()).balls
    return find_outliers(balls, DISC), torch.tensor([painter.is_flawed(seed) for seed in wanted])


def shares(flaws: Flaws) -> tuple[float, float]:
    """Share of bad balls that are found, and of good ones that are taken for bad."""
    trials = [trial(flaws, 1000 * t) for t in range(60)]
    trials = [(found, bad) for found, bad in trials if int(bad.sum()) <= COUNT // 3]
    found, bad = (torch.cat(part) for part in zip(*trials, strict=True))
    return float(found[bad].float().mean()), float(found[~bad].float().mean())


def test_disco_balls_are_found_and_good_balls_stay() -> None:
    caught, blamed = shares(Flaws(noise=0.03, uneven=0.03, disco=0.2))
    assert caught > 0.97
    assert blamed < 0.01


def test_matte_balls_are_found_by_their_missing_detail() -> None:
    caught, blamed = shares(Flaws(noise=0.01, uneven=0.01, matte=0.2))
    assert caught > 0.97
    assert blamed < 0.01


def test_good_balls_stay_whatever_their_error_looks_like() -> None:
    for flaws in (Flaws(noise=0.1), Flaws(uneven=0.05), Flaws(noise=0.02, uneven=0.1)):
        painter_says = torch.cat([trial(flaws, 1000 * t)[0] for t in range(30)])
        assert float(painter_says.float().mean()) < 0.02


@given(st.integers(4, 12), st.integers(0, 2**31))
def test_never_half_of_the_balls_and_no_order(count: int, seed: int) -> None:
    generator = torch.Generator().manual_seed(seed)
    balls = torch.rand(count, 32, 32, 3, generator=generator) * torch.rand(count, 1, 1, 1, generator=generator)
    found = find_outliers(balls, DISC)
    assert 2 * int(found.sum()) < count
    order = torch.randperm(count, generator=generator)
    assert torch.equal(find_outliers(balls[order], DISC), found[order])


def test_equal_balls_and_few_balls_have_no_outliers() -> None:
    one = torch.rand(1, 32, 32, 3, generator=torch.Generator().manual_seed(0))
    assert not find_outliers(one.expand(9, -1, -1, -1), DISC).any()
    # 8-bit codes that differ by one are equal balls, too.
    assert not find_outliers(one + torch.tensor([0.0] * 8 + [1 / 255])[:, None, None, None], DISC).any()
    few = torch.rand(3, 32, 32, 3, generator=torch.Generator().manual_seed(1))
    few[0] = 0
    assert not find_outliers(few, DISC).any()


# --- left out of medians -----------------------------------------------------------------------------------------


def test_three_bad_balls_in_ten_cost_nothing_but_their_painting() -> None:
    """Of the map's log radiance, over five seeds: 15% disco balls and 15% matte ones among balls that differ."""
    light = torch.exp(1.5 * latlong_directions(64))[None].roll(20, 2) / 6
    light = light * (1 + 0.8 * torch.sin(9 * latlong_directions(64)[None, ..., :1]))
    photo = torch.full((1, 48, 64, 3), 0.5)

    def error(flaws: Flaws, reject: bool) -> float:
        found = []
        for seed in range(0, 500, 100):
            rounds = Rounds(30, 1, 0.8, 2, final=False, reject=reject)
            settings = Settings(rounds, (0.0, -2.5), seed, canvas=96, diameter=48, height=32)
            probe = estimate(photo, AnalyticPainter(light, flaws), settings)
            truth = ball_to_latlong(latlong_to_ball(light, 48, samples=4), 32, painted=True)
            found.append(
                float((probe.latlong_hdr.clamp(min=0.01) / truth.clamp(min=0.01)).log2().square().mean().sqrt())
            )
            left_out = {s for exposure in probe.exposures for tally in exposure.tallies for s in tally.left_out}
            assert bool(left_out) <= reject
        return sum(found) / len(found)

    good, bad = Flaws(noise=0.02, uneven=0.04), Flaws(noise=0.02, uneven=0.04, disco=0.15, matte=0.15)
    none, kept, rejected = error(good, False), error(bad, False), error(bad, True)
    # As far off as 30 good balls are; of 21 alone a median would be √(30 / 21) times as far.
    assert rejected < 1.1 * none
    assert rejected < kept
    assert error(good, True) < 1.05 * none


def test_what_was_left_out_is_told() -> None:
    light = torch.exp(latlong_directions(64))[None] / 4
    painter = AnalyticPainter(light, Flaws(noise=0.01, disco=0.3))
    rounds = Rounds(12, 1, 0.8, 2, final=False, reject=True)
    probe = estimate(
        torch.full((1, 48, 64, 3), 0.5), painter, Settings(rounds, (0.0,), canvas=96, diameter=48, height=32)
    )
    (tally,) = probe.exposures[0].tallies
    assert set(tally.left_out) == {seed for seed in range(tally.painted) if painter.is_flawed(seed)}
    assert len(probe.exposures[0].balls) >= 12
    assert len(probe.exposures[0].balls) == tally.painted - len(tally.left_out)
    (line,) = tally_lines(probe.exposures[0], rounds)
    assert f"{tally.painted} balls painted for a median of {len(probe.exposures[0].balls)}" in line
    assert f"seeds {', '.join(map(str, tally.left_out))}" in line


@given(st.integers(0, 2**31), st.sampled_from((0.0, 0.1, 0.3, 0.45)))
@settings(max_examples=15)
def test_what_is_left_out_is_replaced_within_half_of_the_balls(seed: int, disco: float) -> None:
    rounds = Rounds(12, 2, 0.5, 2, final=False, reject=True)
    painter, observer = painter_with(Flaws(noise=0.01, disco=disco)), Sparing()
    before = painter.spent
    result = iterative_inpaint(painter, replace(REQUEST, seeds=(seed,)), rounds, observer)
    for tally in result.tallies:
        median_of = tally.painted - len(tally.left_out)
        # With more balls to compare with, one that was left out may come back.
        assert median_of >= 12 or tally.painted == 18
    assert observer.done == painter.spent - before == result.evaluations
    assert observer.done + observer.spared_in_all == rounds_evaluations(painter, rounds)
    if not disco:
        plain = iterative_inpaint(painter, replace(REQUEST, seeds=(seed,)), replace(rounds, reject=False))
        assert torch.equal(plain.ball, result.ball) or any(tally.left_out for tally in result.tallies)
