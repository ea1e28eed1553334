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
from dl_core.harmonics import sh_map
from dl_core.metrics import (
    angular_error,
    dominant_light,
    energy_kept,
    irradiance,
    light_direction_error,
    sh_band_errors,
    si_rmse,
    spread_directions,
)


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


# --- the strongest light -----------------------------------------------------------------------------------------


def lamp(direction: torch.Tensor, height: int, radius: float, radiance: float) -> torch.Tensor:
    """A dim map with a round lamp of an angular radius in degrees."""
    inside = latlong_directions(height) @ direction >= math.cos(math.radians(radius))
    return (
        torch.where(inside[..., None], torch.tensor(radiance), torch.tensor(0.2)).expand(-1, -1, 3)[None].contiguous()
    )


@given(seed=st.integers(0, 2**16), radius=st.floats(3, 9))
def test_a_lamp_is_found_where_it_is(seed: int, radius: float) -> None:
    direction = torch.randn(3, generator=torch.Generator().manual_seed(seed))
    direction = direction / direction.norm()
    found = dominant_light(lamp(direction, 96, radius, 50.0))[0]
    # The lamp's edge is ragged by half a pixel of 1.9 degrees, which its centroid averages out in part. A cap whose
    # axis lies up to half a search pixel (2 degrees) off the lamp's may cut 1 degree of a lamp of 9.
    assert math.degrees(math.acos(min(1.0, float(found @ direction)))) < 1.0


def test_a_lone_bright_pixel_does_not_win_over_a_lamp() -> None:
    towards = latlong_directions(96)[30, 40]
    latlong = lamp(towards, 96, 6.0, 20.0)
    latlong[0, 70, 150] = 500.0  # five times fewer watts than the lamp
    assert float(dominant_light(latlong)[0] @ towards) > math.cos(math.radians(1))


def test_the_error_between_two_lamps_is_their_angle() -> None:
    directions = latlong_directions(96)
    first, second = lamp(directions[40, 60], 96, 5, 30.0), lamp(directions[40, 90], 96, 5, 30.0)
    expected = math.degrees(math.acos(float(directions[40, 60].double() @ directions[40, 90].double())))
    assert float(light_direction_error(first, second)) == pytest.approx(expected, abs=0.5)
    assert float(light_direction_error(second, first)) == pytest.approx(float(light_direction_error(first, second)))
    assert float(light_direction_error(first, first)) == 0


def test_the_strongest_light_sees_no_scale_and_no_size() -> None:
    truth = lamp(latlong_directions(64)[20, 30], 64, 8, 30.0)
    assert float(light_direction_error(truth * 1024, truth)) == pytest.approx(0, abs=1e-4)
    larger = truth.repeat_interleave(4, 1).repeat_interleave(4, 2)
    assert float(light_direction_error(larger, truth)) < 0.2


# --- harmonics ---------------------------------------------------------------------------------------------------


def test_band_errors_are_zero_on_identity_and_scale_with_the_difference(generator: torch.Generator) -> None:
    truth = torch.rand(2, 32, 64, 3, generator=generator)
    assert_close(sh_band_errors(truth, truth), 0.0)
    errors = sh_band_errors(truth * 1.5, truth)
    assert_close(errors[:, 0], 0.5, dtype=torch.float32)
    assert_close(sh_band_errors(truth * 2, truth), 2 * errors, dtype=torch.float32)


def test_a_difference_in_one_band_shows_in_that_band_alone(generator: torch.Generator) -> None:
    for band in range(5):
        added = torch.zeros(1, 25, 3, dtype=torch.float64)
        added[:, band * band : (band + 1) ** 2] = torch.randn(1, 2 * band + 1, 3, generator=generator).double()
        truth = torch.ones(1, 128, 256, 3)
        errors = sh_band_errors(truth + sh_map(added, 128), truth)[0]
        wanted = torch.linalg.norm(added) / math.sqrt(3 * 4 * math.pi)
        # Sampling a function of band 4 at 128 rows moves 5e-4 of it to other bands.
        torch.testing.assert_close(errors[band], wanted, rtol=2e-3, atol=0)
        assert float(errors.sum() - errors[band]) < 5e-3 * float(wanted)


def test_band_errors_do_not_turn_with_the_world() -> None:
    estimate, truth = torch.rand(2, 1, 32, 64, 3, generator=torch.Generator().manual_seed(6))
    turned = [torch.roll(latlong, 17, dims=2) for latlong in (estimate, truth)]
    torch.testing.assert_close(sh_band_errors(*turned), sh_band_errors(estimate, truth), rtol=1e-9, atol=1e-12)


@pytest.mark.parametrize("measure", [sh_band_errors, light_direction_error])
def test_dark_maps_have_no_light_to_compare_with(measure: object) -> None:
    with pytest.raises(ImageError, match="no light"):
        measure(torch.ones(1, 8, 16, 3), torch.zeros(1, 8, 16, 3))  # type: ignore[operator]
