from __future__ import annotations

import math
from pathlib import Path

import pytest
import torch
from hypothesis import given
from hypothesis import strategies as st
from tolerances import assert_close

import dl_core
from dl_core.errors import ImageError, OptionError
from dl_core.geometry import (
    ball_coverage,
    ball_directions,
    camera_rotation,
    latlong_directions,
    latlong_solid_angles,
    latlong_to_ball,
    rotate_latlong,
)
from dl_core.imageio import read_envmap
from dl_core.spheres import MATERIALS, gathered_irradiance, render_spheres, sphere_normals, sphere_sheet

PANORAMAS = sorted((Path(dl_core.__file__).parent / "data" / "hdri").glob("*.exr"))
# What the docstring of `gathered_irradiance` states; see there.
PATCHES = 1.2e-3


@pytest.fixture
def normals(generator: torch.Generator) -> torch.Tensor:
    """Random normals, and those straight along every axis."""
    random = torch.randn(200, 3, generator=generator)
    axes = torch.eye(3)
    return torch.nn.functional.normalize(torch.cat((random, axes, -axes)), dim=-1)


def irradiance_by_definition(latlong: torch.Tensor, normals: torch.Tensor) -> torch.Tensor:
    """Sum over all pixels of L ω max(0, n·l), in double precision."""
    height = latlong.shape[1]
    light = latlong[0].double() * latlong_solid_angles(height).double()[..., None]
    cosines = torch.einsum("nk,hwk->nhw", normals.double(), latlong_directions(height).double()).clamp(min=0)
    return torch.einsum("nhw,hwc->nc", cosines, light)


# --- irradiance against closed forms ---


@pytest.mark.parametrize("height", [32, 64, 100, 128])
def test_furnace(normals: torch.Tensor, height: int) -> None:
    """Under a uniform map E = π L from every side; patches on the horizon take a little, and never add."""
    received = gathered_irradiance(torch.full((1, height, 2 * height, 3), 2.0), normals) / (2 * math.pi)
    assert received.max() < 1 + 1e-5
    assert received.min() > 1 - PATCHES


def test_hemisphere_of_sky(normals: torch.Tensor) -> None:
    """A uniform sky above, nothing below: E = π (1 + cos θ) / 2, θ being the normal's angle from straight up."""
    sky = (latlong_directions(64)[..., 1:2] > 0).float().expand(-1, -1, 3)[None]
    expected = math.pi * (1 + normals[:, 1:2].expand(-1, 3)) / 2
    torch.testing.assert_close(gathered_irradiance(sky, normals)[0], expected, rtol=0, atol=math.pi * PATCHES)


def test_linear_gradient(normals: torch.Tensor) -> None:
    """L = 1 + a·l gives E = π + (2π/3) a·n (Ramamoorthi and Hanrahan 2001: the cosine's band-1 factor)."""
    along = torch.tensor([[0.5, 0.2, -0.3], [0, 1, 0], [-0.6, 0, 0.8]])
    gradient = 1 + latlong_directions(128) @ along.T
    expected = math.pi + 2 * math.pi / 3 * normals @ along.T
    torch.testing.assert_close(
        gathered_irradiance(gradient[None], normals)[0], expected, rtol=0, atol=math.pi * PATCHES
    )


@given(row=st.integers(0, 127), column=st.integers(0, 255), channel=st.integers(0, 2))
def test_single_light_is_a_cosine(row: int, column: int, channel: int) -> None:
    """One bright pixel: E = L ω max(0, n·l), at both poles and the seam as well."""
    light = torch.zeros(1, 128, 256, 3)
    light[0, row, column, channel] = 1000.0
    normals = sphere_normals(9).reshape(-1, 3)
    direction = latlong_directions(128)[row, column]
    expected = torch.zeros(1, len(normals), 3)
    expected[0, :, channel] = 1000 * latlong_solid_angles(128)[row] * (normals @ direction).clamp(min=0)
    # A pixel is 1.4 degrees: its mean direction is up to 1.5e-4 shorter than 1, and beside a pole up to half a pixel
    # (6e-3 rad) from its centre, by area instead of by angle.
    off = float(expected.max()) * 7e-3 + 1e-6
    torch.testing.assert_close(gathered_irradiance(light, normals), expected, rtol=2e-4, atol=off)


def test_small_maps_need_no_patches(normals: torch.Tensor, generator: torch.Generator) -> None:
    """Below 33 rows every pixel is a patch of its own; what is left is a pixel's extent, (π/32)²/12 of its light."""
    noise = torch.rand(1, 32, 64, 3, generator=generator)
    torch.testing.assert_close(
        gathered_irradiance(noise, normals)[0].double(), irradiance_by_definition(noise, normals), rtol=2e-3, atol=0
    )


@pytest.mark.parametrize("path", PANORAMAS, ids=lambda path: path.stem)
def test_patches_cost_what_the_docstring_says(path: Path, normals: torch.Tensor) -> None:
    latlong = read_envmap(path)
    exact = irradiance_by_definition(latlong, normals)
    error = gathered_irradiance(latlong, normals)[0].double() - exact
    relative = (error.square().mean() / exact.square().mean()).sqrt()
    assert 1e-5 < relative < PATCHES


def test_light_turns_with_the_world(smooth_map: torch.Tensor, normals: torch.Tensor) -> None:
    rotation = camera_rotation(yaw=37, pitch=20, roll=-10)
    turned = gathered_irradiance(rotate_latlong(smooth_map, rotation, samples=4), normals @ rotation.T)
    # The rotation resamples a map of 2.8 degree pixels: 1e-3 beside the patches' own error.
    torch.testing.assert_close(turned, gathered_irradiance(smooth_map, normals), rtol=1e-3 + PATCHES, atol=0)


def test_batches_are_independent(smooth_map: torch.Tensor, normals: torch.Tensor) -> None:
    both = gathered_irradiance(torch.cat((smooth_map, smooth_map.flip(1))), normals.reshape(2, -1, 3))
    assert both.shape == (2, 2, len(normals) // 2, 3)
    assert_close(both[1].reshape(1, -1, 3), gathered_irradiance(smooth_map.flip(1), normals))


# --- spheres ---


def test_normals_face_the_viewer_and_halve_the_reflection() -> None:
    """r = 2 (n·v) n - v with v = +Z, on the ball; unit length everywhere."""
    normals = sphere_normals(64)
    assert_close(normals.norm(dim=-1), 1.0)
    reflected = 2 * normals[..., 2:] * normals - torch.tensor([0.0, 0, 1])
    # z = sqrt(1 - x² - y²) has an absolute error of 1e-7 / z; pixel centres on the ball have z above 0.05.
    on_ball = normals[..., 2] > 0.05
    assert on_ball.sum() > 0.78 * 64 * 64
    torch.testing.assert_close(reflected[on_ball], ball_directions(64)[on_ball], rtol=0, atol=1e-5)
    assert normals[0, 31, 1] > 0.9  # the top row faces up
    assert normals[31, -1, 0] > 0.9  # the right column faces right


@pytest.mark.parametrize("albedo", [0.0, 0.8, 1.0])
def test_a_furnace_shows_the_albedo(albedo: float) -> None:
    """In a uniform world a mirror is invisible and a diffuse sphere shows its albedo."""
    uniform = torch.full((1, 64, 128, 3), 3.0)
    spheres = render_spheres(uniform, 33, albedo=albedo)
    assert list(spheres) == ["diffuse", "matte", "mirror"]
    on_sphere = ball_coverage(33)[None] > 0
    assert_close(spheres["mirror"][on_sphere], 3.0)
    diffuse = spheres["diffuse"]
    torch.testing.assert_close(
        diffuse[on_sphere], torch.full_like(diffuse[on_sphere], 3 * albedo), rtol=PATCHES, atol=0
    )
    assert not diffuse[~on_sphere].any()


@pytest.mark.parametrize(
    ("direction", "brightest"),
    [((1, 0, 0), "right"), ((-1, 0, 0), "left"), ((0, 1, 0), "top"), ((0, -1, 0), "bottom")],
)
def test_the_lit_side_is_the_side_of_the_light(direction: tuple[float, float, float], brightest: str) -> None:
    light = (latlong_directions(64) @ torch.tensor(direction, dtype=torch.float32) > 0.95).float()
    sphere = render_spheres(light[None, :, :, None].expand(-1, -1, -1, 3), 32, ("diffuse",))["diffuse"][0, ..., 0]
    halves = {"left": sphere[:, :16], "right": sphere[:, 16:], "top": sphere[:16], "bottom": sphere[16:]}
    opposite = {"left": "right", "right": "left", "top": "bottom", "bottom": "top"}[brightest]
    assert halves[brightest].sum() > 10 * halves[opposite].sum()


def test_a_light_behind_the_sphere_leaves_it_dark() -> None:
    """Straight ahead of the camera is behind the sphere: only the rim, at right angles to it, could see it."""
    ahead = (latlong_directions(64)[..., 2] < -0.99).float()[None, :, :, None].expand(-1, -1, -1, 3)
    sphere = render_spheres(ahead, 32, ("diffuse",))["diffuse"]
    facing = sphere_normals(32)[..., 2] > 0.5
    assert not sphere[0, facing].any()


def test_the_mirror_is_the_ball_of_the_map(smooth_map: torch.Tensor) -> None:
    assert torch.equal(render_spheres(smooth_map, 24, ["mirror"])["mirror"], latlong_to_ball(smooth_map, 24))


def test_options_are_checked(smooth_map: torch.Tensor) -> None:
    with pytest.raises(OptionError, match=r"albedo is 1\.5; accepted: 0 to 1"):
        render_spheres(smooth_map, 8, albedo=1.5)
    with pytest.raises(OptionError, match="material is 'chrome'; accepted: " + ", ".join(MATERIALS)):
        render_spheres(smooth_map, 8, ["chrome"])
    with pytest.raises(OptionError, match="size is 0"):
        render_spheres(smooth_map, 0)
    with pytest.raises(OptionError, match="latlong"):
        gathered_irradiance(smooth_map[:, :, :64], torch.eye(3))


# --- the sheet ---


@pytest.mark.parametrize("evs", [(), (0.0,), (0.0, -2.5, -5.0), (0.0, -1.0, -2.0, -3.0, -4.0)])
def test_the_sheet_shows_everything_it_is_given(smooth_map: torch.Tensor, evs: tuple[float, ...]) -> None:
    """Red photographs and green balls cannot come from this grey map: their areas on the sheet are theirs."""
    grey = smooth_map.mean(-1, keepdim=True).expand(-1, -1, -1, 3)
    photo = torch.tensor([1.0, 0, 0]).expand(1, 100, 100, 3) if evs else None
    balls = [torch.tensor([0, 1.0, 0]).expand(1, 32, 32, 3)] * len(evs)
    sheet = sphere_sheet(grey, composite_ldr=photo, balls_ldr=balls, evs=evs, size=64)
    assert sheet.min() >= 0
    assert sheet.max() <= 1
    red = ((sheet[..., 0] > 0.9) & (sheet[..., 1] < 0.1)).sum()
    green = ((sheet[..., 1] > 0.9) & (sheet[..., 0] < 0.1)).sum()
    assert red == (64 * 64 if evs else 0)
    # A disc of 64 pixels covers 3,217; those of its rim are mixed with the background.
    assert abs(int(green) - 3217 * len(evs)) <= 64 * math.pi * len(evs)


def test_a_sheet_of_a_bright_sky_is_not_white() -> None:
    """A small sun far above the 99th percentile: the diffuse sphere is shown darker, and still has a terminator."""
    sky = torch.full((1, 128, 256, 3), 0.1)
    sky[0, 40, 200] = 1e5
    sheet = sphere_sheet(sky, size=64)
    diffuse = sheet[-80:-16, 2 * 64 + 32 : 3 * 64 + 32]
    assert 0.85 < diffuse[diffuse < 0.95].max() <= 0.95
    assert diffuse.min() < 0.3


def test_the_sheet_checks_its_input(smooth_map: torch.Tensor) -> None:
    with pytest.raises(OptionError, match="one ball image per EV, that is 2"):
        sphere_sheet(smooth_map, evs=(0.0, -1.0))
    with pytest.raises(ImageError, match="2 maps"):
        sphere_sheet(torch.cat((smooth_map, smooth_map)))
