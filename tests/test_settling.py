"""When a median is settled: the bound against known errors, and the sequential median against the truth."""

from __future__ import annotations

import math
from collections.abc import Callable
from dataclasses import replace
from itertools import pairwise

import pytest
import torch
import torch.nn.functional as F
from analytic_painter import AnalyticPainter, Flaws
from hypothesis import given
from hypothesis import strategies as st
from scipy import stats
from tolerances import assert_close

from dl_core.ball import crop_disc, paint_depth, place_ball
from dl_core.bench.skies import SunAndSky
from dl_core.errors import OptionError
from dl_core.exposure import expose
from dl_core.geometry import latlong_to_ball
from dl_core.iterative import IterativeResult, Rounds, iterative_inpaint
from dl_core.median import pixelwise_median
from dl_core.painter import PaintRequest
from dl_core.settling import CONFIDENCE, error_bound, f_quantile, looks, low_pass

SIDE = 32
BALL = place_ball(64, SIDE)
DISC = crop_disc(BALL)
LIGHT = SunAndSky(sun_radius=10.0).latlong(32)
TRUTH = expose(latlong_to_ball(LIGHT, SIDE, samples=4), 0.0)

seeds = st.integers(0, 2**31)
counts = st.integers(3, 12)


def drawn(count: int, seed: int, side: int = SIDE) -> torch.Tensor:
    return torch.rand(count, side, side, 3, generator=torch.Generator().manual_seed(seed))


def error_of(median: torch.Tensor, truth: torch.Tensor, weight: torch.Tensor = DISC) -> float:
    """RMS error of a ball's low-pass, over cells by their solid angle and over channels."""
    (found, shares), (true, _) = low_pass(median, weight), low_pass(truth, weight)
    return float(((found - true)[0].square().mean(dim=-1) * shares).sum().sqrt())


# --- the low-pass ------------------------------------------------------------------------------------------------


@given(counts, seeds, st.integers(8, 40))
def test_cells_together_hold_the_mean_of_the_disc(count: int, seed: int, side: int) -> None:
    balls, weight = drawn(count, seed, side), drawn(1, seed + 1, side)[0, ..., 0]
    means, shares = low_pass(balls, weight)
    assert float(shares.sum()) == pytest.approx(1, abs=1e-5)
    whole = (balls * weight[..., None]).sum(dim=(1, 2)) / weight.sum()
    assert_close((means * shares[:, None]).sum(dim=1), whole)


def test_cells_are_those_of_the_disc_and_means_are_exact() -> None:
    ramp = torch.arange(SIDE).float()[:, None, None].expand(SIDE, SIDE, 3)[None]
    means, shares = low_pass(ramp, torch.ones(SIDE, SIDE))
    assert_close(means[0].reshape(8, 8, 3)[..., 0], (torch.arange(8.0)[:, None] * 4 + 1.5).expand(8, 8))
    assert_close(shares, 1 / 64)
    assert low_pass(ramp, DISC)[0].shape[1] == 64 - 4  # the corner cells hold no pixel of the disc


# --- the bound ---------------------------------------------------------------------------------------------------


@pytest.mark.parametrize("probability", [0.9, 0.95, 0.99, 0.995])
@pytest.mark.parametrize("numerator", [1.0, 2.5, 9.0, 60.0])
@pytest.mark.parametrize("denominator", [5.0, 20.0, 500.0])
def test_the_quantile_is_that_of_f(probability: float, numerator: float, denominator: float) -> None:
    exact = float(stats.f.ppf(probability, numerator, denominator))
    # With few degrees of freedom it errs to the safe side, by up to a fifth; its root counts.
    assert exact * 0.96 < f_quantile(probability, numerator, denominator) < exact * (1.2 if denominator < 9 else 1.05)


def test_a_probability_that_is_no_confidence_is_refused() -> None:
    with pytest.raises(OptionError, match="probability"):
        f_quantile(1.0, 3, 3)


@given(counts, seeds, st.floats(0.1, 10), st.floats(-1, 1))
def test_the_bound_scales_with_the_balls_and_knows_no_order(count: int, seed: int, scale: float, shift: float) -> None:
    balls = drawn(count, seed, 16)
    weight = drawn(1, seed + 1, 16)[0, ..., 0]
    bound = error_bound(balls, weight)
    assert error_bound(balls * scale + shift, weight) == pytest.approx(scale * bound, rel=1e-3)
    assert error_bound(balls.flip(0), weight) == pytest.approx(bound, rel=1e-5)


@given(counts, seeds)
def test_more_confidence_is_a_wider_bound(count: int, seed: int) -> None:
    balls = drawn(count, seed, 16)
    bounds = [error_bound(balls, torch.ones(16, 16), confidence) for confidence in (0.6, 0.9, 0.95, 0.995)]
    assert all(narrow < wide for narrow, wide in pairwise(bounds))


def test_balls_that_agree_have_no_error_and_two_say_nothing() -> None:
    balls = drawn(1, 0).expand(5, -1, -1, -1)
    assert error_bound(balls, DISC) == 0
    assert error_bound(balls[:2], DISC) == math.inf
    assert error_bound(drawn(5, 0), torch.zeros_like(DISC)) == 0  # nothing of them is used


def test_only_what_is_used_counts() -> None:
    """Balls that agree on the left half and nowhere else."""
    balls, left = drawn(7, 3), torch.zeros_like(DISC)
    left[:, : SIDE // 2] = 1
    balls = torch.where(left[..., None] == 1, balls[:1], balls)
    assert error_bound(balls, left) == 0
    assert error_bound(balls, 1 - left) > 0.01


def even(count: int, generator: torch.Generator) -> torch.Tensor:
    return torch.randn(count, 1, 1, 1, generator=generator).expand(-1, SIDE, SIDE, 3) * 0.05


def smooth(count: int, generator: torch.Generator) -> torch.Tensor:
    coarse = torch.randn(count, 3, 3, 3, generator=generator) * 0.05
    return F.interpolate(coarse, (SIDE, SIDE), mode="bicubic", align_corners=True).permute(0, 2, 3, 1)


def white(count: int, generator: torch.Generator) -> torch.Tensor:
    return torch.randn(count, SIDE, SIDE, 3, generator=generator) * 0.1


def flat(count: int, generator: torch.Generator) -> torch.Tensor:
    """Uniform: no unimodal law makes medians worse for its variance."""
    return (torch.rand(count, 1, 1, 3, generator=generator) - 0.5).expand(-1, SIDE, SIDE, 3) * 0.2


def peaked(count: int, generator: torch.Generator) -> torch.Tensor:
    """Laplace."""
    u = torch.rand(count, 1, 1, 3, generator=generator) - 0.5
    return (-0.05 * u.sign() * torch.log1p(-2 * u.abs())).expand(-1, SIDE, SIDE, 3)


@pytest.mark.parametrize("law", [even, smooth, white, flat, peaked])
@pytest.mark.parametrize("count", [6, 15])
def test_the_bound_holds_as_often_as_it_says(law: Callable[[int, torch.Generator], torch.Tensor], count: int) -> None:
    generator, trials = torch.Generator().manual_seed(0), 200
    held, bounds, errors = 0, 0.0, 0.0
    for _ in range(trials):
        balls = law(count, generator)
        error, bound = error_of(pixelwise_median(balls), torch.zeros_like(balls[:1])), error_bound(balls, DISC)
        held, bounds, errors = held + (error <= bound), bounds + bound, errors + error
    # Two standard deviations of a binomial share below what it says.
    assert held / trials >= CONFIDENCE - 2 * math.sqrt(CONFIDENCE * (1 - CONFIDENCE) / trials)
    # And it is no empty promise: of one degree of freedom F(1, 5) at 0.95 is 6.6, its root 2.6 standard errors or 3.2
    # mean absolute ones.
    assert bounds < 4 * errors


# --- looks -------------------------------------------------------------------------------------------------------


@given(st.integers(3, 1000), st.integers(1, 1000))
def test_looks_lead_from_the_minimum_to_the_maximum(minimum: int, maximum: int) -> None:
    found = looks(minimum, maximum)
    assert found[0] == min(minimum, maximum)
    assert found[-1] == maximum
    assert all(a < b <= a + max(1, a // 4) for a, b in pairwise(found))


# --- the sequential median ---------------------------------------------------------------------------------------

REQUEST = PaintRequest(torch.full((1, 64, 64, 3), 0.5), paint_depth(None, BALL), BALL, 0.0, (0,))


PAINTER = AnalyticPainter(LIGHT)
"""One for all trials: rendering the true ball takes longer than painting from it."""


def painter_with(flaws: Flaws) -> AnalyticPainter:
    """The painter, with these flaws from now on."""
    PAINTER.flaws = flaws
    PAINTER.requests.clear()
    return PAINTER


def painted(trial: int, flaws: Flaws, rounds: Rounds) -> tuple[list[int], IterativeResult]:
    """Seeds asked for, and what was found."""
    painter = painter_with(flaws)
    result = iterative_inpaint(painter, replace(REQUEST, seeds=(1000 * trial,)), rounds)
    return [seed for call in painter.requests for seed in call.seeds], result


SEQUENTIAL = Rounds(balls=40, rounds=1, steps=1, final=False, tolerance=0.02, min_balls=6)


def test_it_stops_at_the_wanted_error() -> None:
    """The bar: a fifth of the balls are disco balls, and 95 of 100 medians are within the tolerance of the truth."""
    flaws, trials = Flaws(noise=0.05, uneven=0.04, disco=0.2), 500
    within, spent = 0, 0
    for trial in range(trials):
        asked, result = painted(trial, flaws, SEQUENTIAL)
        (tally,) = result.tallies
        assert 6 <= tally.painted <= 40
        assert tally.error is not None
        assert tally.error <= 0.02 or tally.painted == 40
        assert asked == [1000 * trial + j for j in range(tally.painted)]
        within += error_of(result.median, TRUTH) <= 0.02
        spent += tally.painted
    assert within >= 0.95 * trials
    assert 7 < spent / trials < 20  # it neither stops blindly nor paints them all


@given(st.floats(0.0, 0.06), st.floats(0.0, 0.3), st.floats(0.005, 0.05), st.integers(3, 20), seeds)
def test_it_never_passes_its_maximum_and_stops_only_when_settled(
    uneven: float, disco: float, tolerance: float, most: int, trial: int
) -> None:
    rounds = Rounds(balls=most, rounds=1, steps=1, final=False, tolerance=tolerance, min_balls=4)
    asked, result = painted(trial, Flaws(uneven=uneven, disco=disco), rounds)
    (tally,) = result.tallies
    assert min(4, most) <= tally.painted <= most
    assert len(asked) == tally.painted
    assert tally.error is not None
    assert tally.painted == most or tally.error <= tolerance
    assert len(result.balls) == tally.painted - len(tally.left_out) > tally.painted / 2
    assert torch.equal(result.median, pixelwise_median(result.balls))


def test_noisier_balls_take_more_of_them() -> None:
    spent = [
        sum(painted(trial, Flaws(uneven=level), SEQUENTIAL)[1].tallies[0].painted for trial in range(10))
        for level in (0.0, 0.03, 0.06)
    ]
    assert spent[0] == 60  # the minimum, of balls that are all alike
    assert spent[0] < spent[1] < spent[2]
