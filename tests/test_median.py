"""The median against NumPy, and the properties that define it."""

from __future__ import annotations

from collections.abc import Callable

import numpy as np
import pytest
import torch
from hypothesis import given
from hypothesis import strategies as st
from tolerances import assert_close
from torch.profiler import ProfilerActivity, profile

from dl_core.errors import OptionError
from dl_core.median import pixelwise_median, pixelwise_spread

counts = st.integers(1, 9)
seeds = st.integers(0, 2**31)


def balls_of(count: int, seed: int) -> torch.Tensor:
    return torch.rand(count, 5, 5, 3, generator=torch.Generator().manual_seed(seed))


@given(counts, seeds)
def test_median_is_numpys(count: int, seed: int) -> None:
    balls = balls_of(count, seed)
    assert_close(pixelwise_median(balls), torch.from_numpy(np.median(balls.numpy(), axis=0, keepdims=True)))


@given(counts.filter(lambda count: count % 2 == 1), seeds)
def test_odd_median_is_torchs_and_one_of_the_balls(count: int, seed: int) -> None:
    balls = balls_of(count, seed)
    median = pixelwise_median(balls)
    assert torch.equal(median, balls.median(dim=0, keepdim=True).values)
    assert bool((balls == median).any(dim=0).all())


@given(counts, seeds)
def test_order_does_not_matter(count: int, seed: int) -> None:
    balls = balls_of(count, seed)
    shuffled = balls[torch.randperm(count, generator=torch.Generator().manual_seed(seed))]
    assert torch.equal(pixelwise_median(balls), pixelwise_median(shuffled))
    assert torch.equal(pixelwise_spread(balls), pixelwise_spread(shuffled))


@given(st.integers(3, 9), seeds)
def test_a_minority_of_bad_balls_does_not_reach_the_median(count: int, seed: int) -> None:
    balls = balls_of(count, seed)
    good = (count + 2) // 2
    spoiled = balls.clone()
    spoiled[good:] = 1e6
    median = pixelwise_median(spoiled)
    assert bool((median <= balls[:good].amax(dim=0, keepdim=True)).all())


def test_spread_is_the_median_absolute_deviation() -> None:
    values = torch.tensor([1.0, 1.0, 2.0, 2.0, 4.0, 6.0, 9.0]).reshape(-1, 1, 1, 1).expand(-1, 2, 2, 3)
    # Median 2; deviations 1 1 0 0 2 4 7; their median 1.
    assert_close(pixelwise_spread(values), 1.0)


def test_spread_of_gaussian_balls_estimates_sigma(generator: torch.Generator) -> None:
    balls = 0.5 + 0.02 * torch.randn(101, 16, 16, 3, generator=generator)
    # MAD = 0.6745 sigma for a normal law; averaged over 768 pixels its error is below 1%.
    assert float(pixelwise_spread(balls).mean()) / 0.6745 == pytest.approx(0.02, rel=0.02)


def test_one_ball_has_no_spread() -> None:
    ball = balls_of(1, 0)
    assert torch.equal(pixelwise_median(ball), ball)
    assert_close(pixelwise_spread(ball), 0.0)


def test_no_balls_are_refused() -> None:
    with pytest.raises(OptionError, match="balls"):
        pixelwise_median(torch.zeros(0, 4, 4, 3))


@pytest.mark.parametrize("function", [pixelwise_median, pixelwise_spread])
def test_it_needs_less_memory_than_its_balls(function: Callable[[torch.Tensor], torch.Tensor]) -> None:
    """A sort of all balls at once would take three times as much as they do: values, and indices twice as wide."""
    balls = torch.rand(60, 128, 128, 3, generator=torch.Generator().manual_seed(0))
    with profile(activities=[ProfilerActivity.CPU], profile_memory=True) as profiled:
        function(balls)
    held = peak = 0
    for event in profiled.profiler.kineto_results.events():
        if event.name() == "[memory]":
            held += event.nbytes()
            peak = max(peak, held)
    assert balls.nbytes / 100 < peak < balls.nbytes
