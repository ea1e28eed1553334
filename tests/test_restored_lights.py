"""Lights that a median loses: they come back, where they are likeliest, and nothing else changes."""

from __future__ import annotations

from dataclasses import replace

import pytest
import torch
from analytic_painter import AnalyticPainter
from hypothesis import given, settings
from hypothesis import strategies as st
from test_iterative import LIGHT, Sparing, request

from dl_core.ball import crop_disc, inscribed_disc, place_ball
from dl_core.errors import ImageError, OptionError
from dl_core.estimate import Settings, estimate, planned_evaluations
from dl_core.exposure import luminance
from dl_core.iterative import Rounds, iterative_inpaint, rounds_evaluations
from dl_core.median import pixelwise_median
from dl_core.metrics import energy_kept, rgb_angles
from dl_core.painter import Observer, PaintRequest, PaintResult
from dl_core.restored_lights import RESTORED_SHARE, restore_lights

SIDE = 48
DISC = inscribed_disc(SIDE) > 0
ROUNDS = Rounds(5, 1, 0.8, 2, final=False, light_balls=3)
PHOTO = torch.full((1, 48, 64, 3), 0.5)


def balls(count: int, seed: int) -> torch.Tensor:
    generator = torch.Generator().manual_seed(seed)
    return torch.rand(count, SIDE, SIDE, 3, generator=generator) ** 4 * 8


def ranked(ball: torch.Tensor) -> torch.Tensor:
    return luminance(ball[0, DISC])[:, 0].sort().values


def test_the_disc_of_a_crop_is_that_of_a_picture_so_large() -> None:
    for diameter, x in ((16, None), (31, 47.0), (64, 40.0)):
        assert torch.equal(crop_disc(place_ball(128, diameter, x=x)), inscribed_disc(diameter))


@given(seed=st.integers(0, 2**31), count=st.integers(1, 5), share=st.floats(0.01, 1.0))
@settings(deadline=None, max_examples=40)
def test_only_the_brightest_change_and_keep_hue_and_rank(seed: int, count: int, share: float) -> None:
    ball, whole = balls(1, seed), balls(count, seed + 1) * 2
    restored = restore_lights(ball, whole, share)
    before, after = ball[0, DISC], restored[0, DISC]
    assert torch.equal(restored[0, ~DISC], ball[0, ~DISC])
    assert (after >= before).all()
    assert float(rgb_angles(after, before).max()) < 1e-6
    order = luminance(before)[:, 0].argsort()
    least = int((1 - share) * len(order))
    assert torch.equal(after[order[:least]], before[order[:least]])
    assert float(luminance(after)[order, 0].diff().min()) > -1e-5


@given(seed=st.integers(0, 2**31))
@settings(deadline=None, max_examples=20)
def test_balls_that_are_no_brighter_change_nothing(seed: int) -> None:
    ball = balls(1, seed)
    assert torch.equal(restore_lights(ball, ball), ball)
    mixed = ball.flatten(1, 2)[:, torch.randperm(SIDE * SIDE)].reshape(ball.shape).clamp(max=float(ball.min()))
    assert torch.equal(restore_lights(ball, mixed), ball)
    assert torch.equal(restore_lights(torch.zeros_like(ball), ball), torch.zeros_like(ball))


def test_the_brightest_pixel_becomes_as_bright_as_the_middle_ball_s_brightest() -> None:
    ball, whole = balls(1, 0), balls(3, 1) * torch.tensor([1.0, 5.0, 40.0])[:, None, None, None]
    top = float(ranked(restore_lights(ball, whole))[-1])
    middle = float(ranked(whole[1:2])[-1])
    # A rank is the middle of its pixel: the weight of the highest one is half a pixel short of 1.
    assert top == pytest.approx(middle, rel=0.02)


def test_pixels_of_one_luminance_stay_equal() -> None:
    ball = torch.full((1, SIDE, SIDE, 3), 0.25)
    restored = restore_lights(ball, balls(2, 3))[0, DISC]
    assert float(restored.max() - restored.min()) == 0
    assert float(restored.min()) > 0.25


def test_a_lamp_that_every_ball_has_elsewhere_keeps_its_energy() -> None:
    """Nine balls, a lamp of 60 somewhere in each: the median has none, and what is restored has about one lamp."""
    generator = torch.Generator().manual_seed(4)
    count, lamp = 9, 5
    sky = 0.3 + 0.2 * torch.linspace(1, 0, SIDE)[None, :, None, None].expand(1, SIDE, SIDE, 3)
    scene = sky.repeat(count, 1, 1, 1)
    for ball in scene:
        top, left = (torch.randint(0, 22, (2,), generator=generator) + torch.tensor([3, 12])).tolist()
        ball[top : top + lamp, left : left + lamp] = 60.0
    median = pixelwise_median(scene)
    energies = [float(picture[DISC].sum()) for picture in (*scene, median[0], restore_lights(median, scene)[0])]
    one, lost, found = energies[0], energies[-2], energies[-1]
    assert lost < 0.4 * one
    assert one * 0.7 < found < one * 1.05
    # The sky is brighter above, so that is where the lamp goes; nothing below the middle is raised.
    assert torch.equal(restore_lights(median, scene)[0, SIDE // 2 :], median[0, SIDE // 2 :])


@pytest.mark.parametrize("share", [RESTORED_SHARE, 1.0])
def test_other_balls_of_another_size_or_none_are_refused(share: float) -> None:
    ball = balls(1, 0)
    for whole in (ball[:0], ball[:, 1:, 1:]):
        with pytest.raises(ImageError, match="light balls"):
            restore_lights(ball, whole, share)
    with pytest.raises(ImageError, match="square"):
        restore_lights(ball[:, 1:], ball[:, 1:], share)


# --- in the method -----------------------------------------------------------------------------------------------


def test_light_balls_are_painted_from_noise_to_the_end_and_counted() -> None:
    painter = AnalyticPainter(LIGHT)
    rounds = Rounds(4, 2, 0.5, 10, final=False, until=0.6, light_balls=3)
    result = iterative_inpaint(painter, request(), rounds)
    last = painter.requests[-1]
    assert (last.strength, last.until, len(last.seeds)) == (1.0, 1.0, 3)
    assert torch.equal(last.canvas, request().canvas)
    assert result.light_balls is not None
    assert len(result.light_balls) == 3
    assert torch.equal(result.ball, result.median)
    assert result.evaluations == rounds_evaluations(painter, rounds) == painter.spent
    without = iterative_inpaint(AnalyticPainter(LIGHT), request(), replace(rounds, light_balls=0))
    assert torch.equal(without.ball, result.ball)
    assert torch.equal(without.whole_balls, without.ball)


@pytest.mark.parametrize(
    "options", [{"light_balls": -1, "final": False}, {"light_balls": 2}, {"light_balls": 2, "rounds": 0}]
)
def test_light_balls_for_nothing_are_refused(options: dict[str, int]) -> None:
    with pytest.raises(OptionError, match="light_balls"):
        Rounds(**options)  # type: ignore[arg-type]


def test_a_perfect_painter_s_light_stays_bit_for_bit() -> None:
    canvas = Settings(ROUNDS, canvas=128, diameter=64, height=32)
    with_lights = estimate(PHOTO, AnalyticPainter(LIGHT), canvas)
    bare = replace(canvas, rounds=replace(ROUNDS, light_balls=0))
    assert torch.equal(with_lights.latlong_hdr, estimate(PHOTO, AnalyticPainter(LIGHT), bare).latlong_hdr)


class Wandering:
    """A painter that has the light right, but for its azimuth: 40 degrees further with every seed."""

    def __init__(self, latlong_hdr: torch.Tensor) -> None:
        self.latlong_hdr = latlong_hdr

    def paint(self, asked: PaintRequest, observer: Observer) -> PaintResult:
        results = [
            AnalyticPainter(self.latlong_hdr.roll(7 * seed, 2)).paint(replace(asked, seeds=(seed,)), observer)
            for seed in asked.seeds
        ]
        return PaintResult(torch.cat([one.balls for one in results]), sum(one.evaluations for one in results))

    def evaluations(self, balls: int, steps: int, strength: float, until: float = 1.0) -> int:
        return AnalyticPainter(self.latlong_hdr).evaluations(balls, steps, strength, until)


def test_a_sun_that_wanders_is_lost_to_the_median_and_comes_back() -> None:
    """Its light, and with a bracket sized to the scene the exposures that show it."""
    light = torch.full((1, 32, 64, 3), 0.2)
    light[:, 6:10, 30:34] = 15.0
    asked = Settings(Rounds(9, 1, 0.8, 2, final=False), canvas=128, diameter=64, height=32, bracket="scene", darkest=-5)
    bare = estimate(PHOTO, Wandering(light), asked)
    lit = estimate(PHOTO, Wandering(light), replace(asked, rounds=replace(asked.rounds, light_balls=5)))
    assert bare.evs == (0.0,)
    assert lit.evs == (0.0, -2.5, -5.0)
    assert bare.clipped == 0
    assert energy_kept(bare.latlong_hdr, light) < 0.7
    assert energy_kept(lit.latlong_hdr, light) == pytest.approx(1, abs=0.25)
    assert float(lit.latlong_hdr.max()) > 1 > float(bare.latlong_hdr.max())


def test_progress_is_told_of_what_is_painted() -> None:
    painter, observer = AnalyticPainter(LIGHT), Sparing()
    canvas = Settings(ROUNDS, (0.0, -2.5), canvas=128, diameter=64, height=32)
    probe = estimate(PHOTO, painter, canvas, observer=observer)
    assert probe.evaluations == planned_evaluations(painter, canvas) == painter.spent
