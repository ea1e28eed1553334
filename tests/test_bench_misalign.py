"""The misalignment model: it does what its names say, and the robust merge is never worse for it than the paper's."""

from __future__ import annotations

import math

import pytest
import torch
from tolerances import assert_close

from dl_core.bench.misalign import MISALIGNMENTS, displace, misaligned_bracket, smooth_noise
from dl_core.bench.skies import SunAndSky, sun_direction
from dl_core.errors import ImageError, OptionError
from dl_core.exposure import decode_display, expose, merge_bracket, quantize
from dl_core.geometry import ball_coverage, ball_directions, latlong_directions, latlong_to_ball
from dl_core.metrics import angular_error, si_rmse, spread_directions

EVS = (0.0, -2.5, -5.0)


@pytest.fixture(scope="module")
def ball() -> torch.Tensor:
    """(1, 128, 128, 3): a smooth scene."""
    return latlong_to_ball(torch.exp(2 * latlong_directions(64))[None], 128)


@pytest.mark.parametrize("level", MISALIGNMENTS)
def test_a_seed_makes_a_bracket(level: str, ball: torch.Tensor) -> None:
    first, again, other = (misaligned_bracket(ball, EVS, level, seed=seed) for seed in (1, 1, 2))
    for a, b in zip(first, again, strict=True):
        assert torch.equal(a, b)
    # EV 0 is the truth at every level.
    assert torch.equal(first[0], quantize(expose(ball, 0.0)))
    assert torch.equal(first[0], other[0])
    fixed = level in ("aligned", "a-stop-over", "a-stop-under", "highlights-1", "detail-1")
    assert torch.equal(first[1], other[1]) == fixed


def test_a_shift_moves_what_is_shown_by_its_length(ball: torch.Tensor) -> None:
    # Away from the rim, where what comes in from beyond repeats it.
    inside = (ball_coverage(128, radius=60) == 1)[None, :, :, None].expand_as(ball)
    moved = displace(ball, torch.tensor([1.0, 0.0]).reshape(1, 2, 1, 1))
    # Bilinear samples at whole pixels are the pixels; grid coordinates round.
    torch.testing.assert_close(moved[inside], torch.roll(ball, 1, dims=2)[inside], rtol=1e-3, atol=1e-4)
    still = displace(ball, torch.zeros(1, 2, 1, 1))
    torch.testing.assert_close(still[inside], ball[inside], rtol=1e-3, atol=1e-4)


@pytest.mark.parametrize("pixels", [1, 2, 4])
def test_shifts_are_of_256_pixels(pixels: int) -> None:
    """A spot on a ball of 128 moves by half the length."""
    spot = torch.zeros(1, 128, 128, 3)
    spot[:, 60, 60] = 1
    shown = decode_display(misaligned_bracket(spot * 5, (0.0, -2.5), f"shift-{pixels}", seed=3)[1])[0, :, :, 0].double()
    rows, columns = torch.meshgrid(torch.arange(128.0), torch.arange(128.0), indexing="ij")
    moved = math.hypot(
        float((shown * rows).sum() / shown.sum()) - 60, float((shown * columns).sum() / shown.sum()) - 60
    )
    # The spot is one pixel, so its centroid is exact but for 8-bit codes.
    assert moved == pytest.approx(pixels / 2, abs=0.05)


def test_smooth_noise_has_unit_power_and_is_smooth(generator: torch.Generator) -> None:
    noise = smooth_noise(64, 3, generator)
    assert_close(noise.square().mean(dim=(2, 3)), torch.ones(1, 3))
    assert_close(noise.mean(dim=(2, 3)), torch.zeros(1, 3))
    # Control points 21 pixels apart: a step between neighbours is a small part of the whole range.
    assert float((noise[..., 1:] - noise[..., :-1]).abs().max()) < 0.35


def test_wrong_exposures_are_wrong_by_their_stops(ball: torch.Tensor) -> None:
    for level, stops in (("a-stop-over", 1), ("a-stop-under", -1)):
        found = misaligned_bracket(ball, EVS, level, seed=0)
        for shown, ev in zip(found[1:], EVS[1:], strict=True):
            assert torch.equal(shown, quantize(expose(ball, ev + stops)))


def test_highlights_alone_are_replaced(ball: torch.Tensor) -> None:
    shown = misaligned_bracket(ball, EVS, "highlights-1", seed=0)[1]
    kept = ball.amax(dim=-1) < 1
    assert torch.equal(shown[kept], quantize(expose(ball, -2.5))[kept])
    assert not torch.equal(shown, quantize(expose(ball, -2.5)))


def test_unknown_levels_and_unlike_scenes_are_named(ball: torch.Tensor) -> None:
    with pytest.raises(OptionError, match="shift-1"):
        misaligned_bracket(ball, EVS, "shift", seed=0)
    with pytest.raises(ImageError, match="other"):
        misaligned_bracket(ball, EVS, "aligned", seed=0, other=ball[:, :64, :64])


@pytest.fixture(scope="module")
def scenes() -> list[torch.Tensor]:
    """Balls of four skies with broad suns in colours of their own, above white and within the bracket's reach."""
    found = []
    for i, colour in enumerate(((9.0, 5.0, 1.5), (6.0, 6.5, 8.0), (4.0, 8.0, 3.0), (12.0, 3.0, 2.0))):
        # Radiance of the sun's disc: irradiance / (π sin² 14°) = 5.4 times that; 20 at most after scaling.
        place = sun_direction(20.0 + 12 * i, 50.0 + 80 * i)
        sky = SunAndSky(place, sun_radius=14.0, sun_irradiance=colour, zenith=(1, 1.2, 1.6), ground=(0.8, 0.7, 0.6))
        found.append(latlong_to_ball(sky.latlong(64) * 0.3, 128))
    return found


UNRELATED = ("highlights-1", "detail-1")
"""Levels whose darker exposures hold nothing of this scene's lights: no merge can be right there, and luck decides. On
these suns paper is luckier than robust and channel (0.38 against 0.42 si-RMSE); over photographed panoramas it is not
(`lightprobe bench oracle --misaligned`)."""


def errors(level: str, merge: str, scenes: list[torch.Tensor]) -> torch.Tensor:
    """Medians over scenes of the errors of irradiance: si-RMSE, and angle in degrees.

    Irradiance on a ball is a sum over its pixels: each covers the same.
    """
    weights = (spread_directions(100) @ ball_directions(128).reshape(-1, 3).T).clamp(min=0)
    weights = weights * ball_coverage(128).reshape(-1)
    found = []
    for i, ball in enumerate(scenes):
        balls = misaligned_bracket(ball, EVS, level, seed=i, other=scenes[i - 1])
        lit, truth = (weights @ light.reshape(-1, 3) for light in (merge_bracket(balls, EVS, merge), ball))
        found.append((si_rmse(lit, truth), angular_error(lit, truth)))
    return torch.tensor(found).median(dim=0).values


@pytest.mark.parametrize("level", MISALIGNMENTS)
def test_robust_is_at_least_as_good_as_the_others(level: str, scenes: list[torch.Tensor]) -> None:
    robust, channel, paper = (errors(level, merge, scenes) for merge in ("robust", "channel", "paper"))
    # Where no error of exposure is found, both merge the same values but for float32 roundings.
    assert bool((robust <= channel * (1 + 1e-4)).all()), (robust, channel)
    if level not in UNRELATED:
        assert bool((robust <= paper).all()), (robust, paper)
