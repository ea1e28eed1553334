"""Metrics against closed forms, and the invariances their names promise."""

from __future__ import annotations

import math

import pytest
import torch
from hypothesis import given
from hypothesis import strategies as st
from tolerances import assert_close

from dl_core.errors import ImageError
from dl_core.geometry import latlong_directions
from dl_core.metrics import angular_error, energy_kept, irradiance, si_rmse, spread_directions


@pytest.mark.parametrize("count", [1, 10, 400])
def test_spread_directions_are_unit_and_balanced(count: int) -> None:
    directions = spread_directions(count)
    assert_close(directions.norm(dim=-1), 1.0)
    if count > 1:
        # Equal steps in height: the mean height is exactly 0, the rest cancels around the axis.
        assert float(directions.mean(dim=0).norm()) < 2 / count


def test_spread_directions_keep_their_distance() -> None:
    directions = spread_directions(400).double()
    cosines = directions @ directions.T - 2 * torch.eye(400, dtype=torch.float64)
    nearest = torch.arccos(cosines.amax(dim=1).clamp(-1, 1))
    # 400 equal discs of area 4π/400 have a radius of 0.1; packing cannot beat twice that, a random set has far less.
    assert float(nearest.min()) > 0.1
    assert float(nearest.max()) < 0.2


def test_a_uniform_sky_gives_pi() -> None:
    # The cosine over pixel centres is off by the pixel's curvature, (π/64)²/24 = 1e-4.
    found = irradiance(torch.ones(1, 64, 128, 3), spread_directions(50))
    torch.testing.assert_close(found, torch.full_like(found, math.pi), rtol=5e-4, atol=0)


def test_irradiance_of_a_linear_sky_is_exact() -> None:
    # L = 1 + ω·a integrates to π + (2π/3) n·a (Ramamoorthi and Hanrahan: bands 0 and 1 scale by π and 2π/3).
    axis = torch.tensor([0.6, 0.0, -0.8])
    latlong = (1 + latlong_directions(64) @ axis)[None, ..., None]
    normals = spread_directions(50)
    expected = math.pi + 2 * math.pi / 3 * (normals @ axis)
    torch.testing.assert_close(irradiance(latlong, normals)[0, :, 0], expected, rtol=0, atol=2e-3)


def test_a_small_light_gives_lamberts_cosine() -> None:
    latlong = torch.zeros(1, 64, 128, 1)
    latlong[0, 20, 90] = 1000.0
    towards = latlong_directions(64)[20, 90]
    normals = spread_directions(100)
    found = irradiance(latlong, normals)[0, :, 0]
    facing = irradiance(latlong, towards[None])[0, 0, 0]
    torch.testing.assert_close(found, facing * (normals @ towards).clamp(min=0), rtol=1e-4, atol=1e-5)


@given(st.floats(1e-3, 1e3))
def test_si_rmse_sees_no_scale(scale: float) -> None:
    generator = torch.Generator().manual_seed(3)
    estimate, truth = torch.rand(2, 40, 3, generator=generator)
    assert si_rmse(truth * scale, truth) == pytest.approx(0, abs=1e-6)
    assert si_rmse(estimate * scale, truth) == pytest.approx(si_rmse(estimate, truth), rel=1e-4)
    assert si_rmse(estimate, truth * scale) == pytest.approx(si_rmse(estimate, truth), rel=1e-4)


def test_si_rmse_is_the_least_over_all_scales() -> None:
    estimate, truth = torch.rand(2, 40, 3, generator=torch.Generator().manual_seed(4)).double()
    scales = torch.linspace(0, 3, 3001, dtype=torch.float64)
    tried = (scales[:, None, None] * estimate - truth).square().mean(dim=(1, 2)).sqrt() / truth.mean()
    # Between scales 0.001 apart a parabola's minimum is missed by the square of that.
    assert si_rmse(estimate, truth) == pytest.approx(float(tried.min()), rel=1e-5)


def test_a_black_estimate_misses_everything() -> None:
    # ‖0 - t‖ over the mean: 1 for a constant truth.
    assert si_rmse(torch.zeros(5, 3), torch.full((5, 3), 2.0)) == pytest.approx(1)


@pytest.mark.parametrize("degrees", [0.0, 1e-3, 1.0, 45.0, 90.0])
def test_angular_error_measures_a_known_angle(degrees: float) -> None:
    turned = torch.tensor([[math.cos(math.radians(degrees)), math.sin(math.radians(degrees)), 0.0]])
    # Components in float32 hold an angle to 6e-8 rad.
    assert angular_error(turned * 7, torch.tensor([[3.0, 0.0, 0.0]])) == pytest.approx(degrees, abs=1e-5)


def test_angular_error_leaves_black_out() -> None:
    truth = torch.tensor([[1.0, 0.0, 0.0], [0.0, 0.0, 0.0]])
    estimate = torch.tensor([[0.0, 1.0, 0.0], [1.0, 1.0, 1.0]])
    assert angular_error(estimate, truth) == pytest.approx(90)
    assert angular_error(torch.zeros(2, 3), truth) == 0


@given(st.floats(0.01, 100))
def test_energy_kept_is_a_share(share: float) -> None:
    truth = torch.rand(1, 8, 16, 3, generator=torch.Generator().manual_seed(5))
    assert energy_kept(truth * share, truth) == pytest.approx(share, rel=1e-5)


@pytest.mark.parametrize(
    "call", [lambda dark: energy_kept(dark + 1, dark), lambda dark: si_rmse(dark[0, 0] + 1, dark[0, 0])]
)
def test_a_dark_truth_is_refused(call: object) -> None:
    with pytest.raises(ImageError, match="truth"):
        call(torch.zeros(1, 8, 16, 3))  # type: ignore[operator]
