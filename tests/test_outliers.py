"""Balls unlike the others: disco balls and matte ones are found, good ones stay."""

from __future__ import annotations

from dataclasses import replace

import torch
from analytic_painter import Flaws
from hypothesis import given
from hypothesis import strategies as st
from test_settling import DISC, REQUEST, painter_with

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
