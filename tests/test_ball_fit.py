"""The circle of a ball: fitted to true balls placed off it, and kept where nothing shows another."""

from __future__ import annotations

import math
from pathlib import Path

import pytest
import torch
from torch import Tensor

from dl_core.ball import place_ball
from dl_core.ball_fit import fit_ball, nominal_fit
from dl_core.bench.fit import FAULTS, Circle, composite, direction_error
from dl_core.errors import ImageError, OptionError
from dl_core.exposure import auto_exposure, expose, quantize
from dl_core.geometry import latlong_to_perspective
from dl_core.imageio import read_envmap

PANORAMA = Path(__file__).parents[1] / "dl_core" / "data" / "hdri" / "dancing_hall.exr"
BALL = place_ball(512, 128)


TRUE = Circle(128.6, 512.4, 511.5)
PLACE = place_ball(1024, 256)


@pytest.fixture(scope="module")
def pictures() -> tuple[Tensor, Tensor, Tensor]:
    """A photograph with a true ball in it, the ball's share of each pixel, and the photograph."""
    latlong = read_envmap(PANORAMA)
    photo = latlong_to_perspective(latlong, 1024, 1024, samples=1)
    scale = auto_exposure(photo)
    painted, covered = composite(latlong * scale, photo * scale, TRUE)
    return painted, covered, quantize(expose(photo * scale, 0.0))


def test_finds_a_true_ball_of_another_radius_and_centre(pictures: tuple[Tensor, Tensor, Tensor]) -> None:
    painted, _, photo = pictures
    fit = fit_ball(quantize(painted), PLACE, photograph_ldr=photo)
    assert fit.clear, fit.reason
    assert fit.reason == ""
    errors = (fit.radius - TRUE.radius, fit.centre[0] - TRUE.x, fit.centre[1] - TRUE.y)
    # A pixel of radius moves a light 20 degrees from straight ahead by 5 degrees: half a degree is 0.1 px.
    assert max(abs(error) for error in errors) < 0.1
    assert all(0 < sigma < 0.03 for sigma in fit.sigma)


def test_keeps_the_circle_of_a_blurred_ball(pictures: tuple[Tensor, Tensor, Tensor]) -> None:
    painted, covered, photo = pictures
    blurred = quantize(FAULTS["blur"](painted, covered, torch.Generator()))
    fit = fit_ball(blurred, PLACE, photograph_ldr=photo)
    assert (fit.radius, fit.centre, fit.clear) == (128.0, PLACE.centre, False)


def test_says_that_a_flat_scene_shows_nothing() -> None:
    flat = torch.full((1, 512, 512, 3), 0.5)
    fit = fit_ball(flat, BALL, photograph_ldr=flat)
    assert not fit.clear
    assert fit.reason
    assert (fit.radius, fit.centre) == (64.0, (256.0, 256.0))
    assert all(math.isinf(sigma) for sigma in fit.sigma)


def test_says_that_a_matte_ball_is_no_mirror() -> None:
    photo = torch.rand(1, 64, 64, 3, generator=torch.Generator().manual_seed(0)).repeat_interleave(8, 1)
    photo = photo.repeat_interleave(8, 2) * 0.9
    painted = photo.clone()
    y, x = torch.meshgrid(torch.arange(512) + 0.5, torch.arange(512) + 0.5, indexing="ij")
    painted[0, torch.hypot(x - 256, y - 256) < 64] = torch.tensor([0.4, 0.5, 0.6])
    assert not fit_ball(painted, BALL, photograph_ldr=photo).clear


def test_small_balls_keep_their_circle() -> None:
    ball = place_ball(64, 16)
    assert fit_ball(torch.rand(1, 64, 64, 3), ball) == nominal_fit(ball, "the ball is smaller than 32 pixels")


def test_refuses_pictures_of_another_canvas() -> None:
    with pytest.raises(ImageError, match="photograph"):
        fit_ball(torch.zeros(1, 512, 512, 3), BALL, photograph_ldr=torch.zeros(1, 256, 256, 3))
    with pytest.raises(OptionError, match="fov"):
        fit_ball(torch.zeros(1, 512, 512, 3), BALL, fov=180.0)


def test_direction_error_of_a_wrong_radius_is_that_of_the_law_of_reflection() -> None:
    # Up to 20 degrees from straight ahead r = R cos(10 deg); on a ball of R + 0.5 that is 2 acos(r / (R + 0.5)).
    seen = 2 * math.degrees(math.acos(128 * math.cos(math.radians(10)) / 128.5))
    error = direction_error(Circle(128.5, 0, 0), Circle(128, 0, 0))
    assert error == pytest.approx(seen - 20, abs=1e-6)
