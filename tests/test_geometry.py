"""Geometry against closed forms: conventions, inverses, energy, and the places where maps are singular."""

from __future__ import annotations

import math
from pathlib import Path

import pytest
import torch
from hypothesis import given
from hypothesis import strategies as st
from tolerances import assert_close

import dl_core
from dl_core.bench.skies import SunAndSky, sun_direction
from dl_core.errors import OptionError
from dl_core.geometry import (
    ball_coverage,
    ball_directions,
    ball_solid_angle,
    ball_to_latlong,
    camera_rotation,
    latlong_coordinates,
    latlong_directions,
    latlong_energy,
    latlong_neighbours,
    latlong_solid_angles,
    latlong_to_ball,
    latlong_to_perspective,
    rotate_latlong,
    sample_latlong,
)
from dl_core.imageio import read_envmap
from dl_core.projection import disc_coordinates, disc_directions

SHIPPED = sorted((Path(dl_core.__file__).parent / "data" / "hdri").glob("*.exr"))
RIGHT, UP, AHEAD, BEHIND = (1.0, 0.0, 0.0), (0.0, 1.0, 0.0), (0.0, 0.0, -1.0), (0.0, 0.0, 1.0)
SLANT = math.sqrt(0.5)

angles = st.floats(-math.pi, math.pi)
heights = st.floats(-1, 1)


def unit(height: float, azimuth: float) -> torch.Tensor:
    """A direction by its height (y) and azimuth to the right of straight ahead, in double precision."""
    ring = math.sqrt(max(0.0, 1 - height * height))
    return torch.tensor([ring * math.sin(azimuth), height, -ring * math.cos(azimuth)], dtype=torch.float64)


def lobes(height: int, sharpness: float = 20.0) -> torch.Tensor:
    """(1, height, 2 height, 3) smooth radiance from 1 to 1000: one lobe a channel, right, up-behind and ahead."""
    axes = torch.tensor([RIGHT, (0.0, SLANT, SLANT), AHEAD])
    return 1 + 999 * torch.exp(sharpness * (latlong_directions(height) @ axes.T - 1))[None]


def ball_energy(ball: torch.Tensor) -> torch.Tensor:
    size = ball.shape[1]
    return (ball * ball_coverage(size)[None, ..., None]).sum(dim=(1, 2)) * ball_solid_angle(size / 2)


def peak(latlong: torch.Tensor) -> tuple[float, float]:
    """(u, v) of the brightest pixel's centre."""
    row, column = divmod(int(latlong[0].sum(-1).argmax()), latlong.shape[2])
    return (column + 0.5) / latlong.shape[2], (row + 0.5) / latlong.shape[1]


# --- latlong -----------------------------------------------------------------------------------------------------


@pytest.mark.parametrize(
    ("direction", "u", "v"),
    [
        (AHEAD, 0.5, 0.5),
        (RIGHT, 0.75, 0.5),
        ((-1.0, 0.0, 0.0), 0.25, 0.5),
        (UP, 0.5, 0.0),
        ((0.0, -1.0, 0.0), 0.5, 1.0),
    ],
)
def test_latlong_convention(direction: tuple[float, ...], u: float, v: float) -> None:
    found = latlong_coordinates(torch.tensor(direction))
    assert_close(torch.stack(found), torch.tensor([u, v]))


def test_behind_the_camera_is_the_seam() -> None:
    u, v = latlong_coordinates(torch.tensor([BEHIND, (-0.0, 0.0, 1.0)]))
    assert_close(torch.sin(u * math.pi), torch.zeros(2))
    assert_close(v, 0.5)


@given(heights, angles)
def test_latlong_coordinates_invert_the_sphere(height: float, azimuth: float) -> None:
    u, v = latlong_coordinates(unit(height, azimuth))
    again = unit(math.cos(float(v) * math.pi), (float(u) - 0.5) * 2 * math.pi)
    # cos(acos y) keeps half the digits at the poles: sqrt(2^-52) = 1.5e-8 in the horizontal components.
    torch.testing.assert_close(again, unit(height, azimuth), rtol=0, atol=1e-7)


@pytest.mark.parametrize("height", [1, 2, 7, 64])
def test_latlong_directions_are_the_pixel_centres(height: int) -> None:
    directions = latlong_directions(height)
    assert directions.shape == (height, 2 * height, 3)
    u, v = latlong_coordinates(directions)
    columns, rows = (torch.arange(2 * height) + 0.5) / (2 * height), (torch.arange(height) + 0.5) / height
    assert_close(u, columns.expand(height, -1))
    assert_close(v, rows[:, None].expand(-1, 2 * height))


@pytest.mark.parametrize("height", [1, 2, 33, 256])
def test_solid_angles_cover_the_sphere(height: int) -> None:
    angles = latlong_solid_angles(height)
    assert_close(angles.double().sum() * 2 * height, 4 * math.pi, dtype=torch.float32)
    cap = 2 * math.pi * (1 - math.cos(math.pi / height))
    assert_close(angles[0, 0] * 2 * height, cap)


def test_energy_is_the_integral() -> None:
    assert_close(latlong_energy(torch.full((2, 16, 32, 3), 0.5)), 2 * math.pi)
    # ∫ (1 + y) dω = 4π; the midpoint rule over rows of exact solid angle is exact by symmetry.
    assert_close(latlong_energy(1 + latlong_directions(32)[None, ..., 1:2]), 4 * math.pi)


def test_sampling_at_pixel_centres_returns_the_pixels() -> None:
    latlong = lobes(32)
    # Coordinates carry 1e-7 of the map's width, times a slope of at most 100 a pixel, 64 pixels.
    torch.testing.assert_close(sample_latlong(latlong, latlong_directions(32)), latlong, rtol=1e-4, atol=1e-3)


@given(angles)
def test_sampling_is_continuous_over_the_poles_and_the_seam(azimuth: float) -> None:
    latlong = lobes(32)
    step = 1e-3
    over_pole = torch.stack([unit(math.cos(step), azimuth), unit(math.cos(step), azimuth + math.pi)]).float()
    over_seam = torch.stack([unit(math.sin(azimuth), math.pi - step), unit(math.sin(azimuth), math.pi + step)]).float()
    steepest = float((latlong[:, 1:] - latlong[:, :-1]).abs().max()) / (math.pi / 32)
    for pair in (over_pole, over_seam):
        values = sample_latlong(latlong, pair)
        assert float((values[:, 0] - values[:, 1]).abs().max()) <= 2 * steepest * 2 * step


# --- rotation ----------------------------------------------------------------------------------------------------


def test_half_a_turn_is_a_roll() -> None:
    latlong = lobes(32)
    turned = rotate_latlong(latlong, camera_rotation(yaw=180.0))
    still = rotate_latlong(latlong, torch.eye(3))
    # The rotation's zeros are 1e-7, times a slope of at most 100 a pixel, 64 pixels.
    torch.testing.assert_close(turned, still.roll(32, dims=2), rtol=1e-4, atol=2e-3)


@pytest.mark.parametrize(
    ("rotation", "u", "v"),
    [
        (camera_rotation(yaw=90.0), 0.75, 0.5),
        (camera_rotation(yaw=-90.0), 0.25, 0.5),
        (camera_rotation(pitch=45.0), 0.5, 0.25),
    ],
)
def test_a_light_ahead_turns_with_the_world(rotation: torch.Tensor, u: float, v: float) -> None:
    light_ahead = torch.exp(50 * (latlong_directions(64) @ torch.tensor(AHEAD) - 1))[None, ..., None]
    found = peak(rotate_latlong(light_ahead, rotation))
    assert found == pytest.approx((u, v), abs=0.6 / 64)


@pytest.mark.parametrize("polar", [0.0, 0.3, 2.0, 10.0, 90.0])
def test_a_lone_pixel_keeps_its_light_wherever_it_turns(polar: float) -> None:
    """Narrow pixels near the poles are found by the wide ones that they turn into."""
    height = 64
    row = min(height - 1, int(polar / 180 * height))
    latlong = torch.zeros(1, height, 2 * height, 1)
    latlong[0, row, 20] = 100.0
    fine = sample_latlong(latlong, latlong_directions(32 * height))
    light = latlong_energy(fine)  # of the interpolated map, 32 samples to a pixel
    turned = rotate_latlong(latlong, camera_rotation(pitch=90.0) @ camera_rotation(yaw=30.0))
    # Two samples a pixel, a tent a pixel wide on each side: the midpoint rule errs by at most (1/2)² / 8 = 3%.
    assert float(latlong_energy(turned) / light) == pytest.approx(1, abs=0.03)


def test_roll_turns_the_camera_clockwise() -> None:
    # Turned clockwise by a quarter, the camera's right side points at the ground.
    assert_close(camera_rotation(roll=90.0) @ torch.tensor(RIGHT), torch.tensor([0.0, -1.0, 0.0]))


@given(angles, angles, angles)
def test_camera_rotations_are_rotations(yaw: float, pitch: float, roll: float) -> None:
    rotation = camera_rotation(*(math.degrees(angle) for angle in (yaw, pitch, roll)))
    assert_close(rotation @ rotation.T, torch.eye(3))
    assert_close(torch.linalg.det(rotation), 1.0)


# --- the ball's geometry -----------------------------------------------------------------------------------------


@pytest.mark.parametrize(
    ("disc", "direction"),
    [
        ((0.0, 0.0), BEHIND),
        ((SLANT, 0.0), RIGHT),
        ((0.0, SLANT), UP),
        ((1.0, 0.0), AHEAD),
        ((0.0, -1.0), AHEAD),
        ((-0.6, 0.8), AHEAD),
    ],
)
def test_disc_convention(disc: tuple[float, float], direction: tuple[float, ...]) -> None:
    found = disc_directions(torch.tensor(disc, dtype=torch.float64))
    # On the rim the normal's z is the root of a rounding error, 1e-16.
    torch.testing.assert_close(found, torch.tensor(direction, dtype=torch.float64), rtol=0, atol=3e-8)


@given(heights, angles)
def test_disc_coordinates_invert_the_reflection(height: float, azimuth: float) -> None:
    direction = unit(height, azimuth)
    disc = disc_coordinates(direction)
    assert float(torch.linalg.norm(disc)) <= 1 + 1e-12
    # Near the rim the normal's z = sqrt(1 - r²) keeps half of the digits.
    torch.testing.assert_close(disc_directions(disc), direction, rtol=0, atol=1e-7)


@given(st.floats(0, 0.9999), angles)
def test_reflection_inverts_disc_coordinates(radius: float, angle: float) -> None:
    disc = torch.tensor([radius * math.cos(angle), radius * math.sin(angle)], dtype=torch.float64)
    torch.testing.assert_close(disc_coordinates(disc_directions(disc)), disc, rtol=0, atol=1e-9)


@given(st.floats(0, 0.999), angles)
def test_reflection_obeys_the_mirror_law(radius: float, angle: float) -> None:
    x, y = radius * math.cos(angle), radius * math.sin(angle)
    normal = torch.tensor([x, y, math.sqrt(1 - x * x - y * y)], dtype=torch.float64)
    reflected = disc_directions(normal[:2])
    to_viewer = torch.tensor(BEHIND, dtype=torch.float64)
    assert_close(torch.linalg.norm(reflected), 1.0)
    assert_close(reflected @ normal, to_viewer @ normal)
    assert_close(torch.linalg.cross(reflected, normal), torch.linalg.cross(normal, to_viewer))


@given(st.floats(0, 0.99), angles)
def test_the_ball_is_equal_area(radius: float, angle: float) -> None:
    step = 1e-6
    x, y = radius * math.cos(angle), radius * math.sin(angle)
    points = torch.tensor([[x - step, y], [x + step, y], [x, y - step], [x, y + step]], dtype=torch.float64)
    left, right, below, above = disc_directions(points)
    area = torch.linalg.norm(torch.linalg.cross(right - left, above - below)) / (2 * step) ** 2
    # Central differences: the third derivative grows as (1 - r²)^-5/2 = 2e4 at r = 0.99, times step² = 1e-12.
    assert float(area) == pytest.approx(4.0, rel=1e-5)


@pytest.mark.parametrize(("size", "radius"), [(64, 32.0), (65, 30.25), (256, 127.5)])
def test_the_ball_covers_the_whole_sphere(size: int, radius: float) -> None:
    covered = float(ball_coverage(size, radius=radius).sum()) * ball_solid_angle(radius)
    # 8 x 8 samples a pixel: the rim's counting error grows slower than its length; 0.1% is generous at R = 30.
    assert covered == pytest.approx(4 * math.pi, rel=1e-3)


def test_ball_directions_have_no_mean() -> None:
    # An equal-area map of the whole sphere: directions average to zero.
    mean = (ball_directions(128) * ball_coverage(128)[..., None]).mean(dim=(0, 1))
    torch.testing.assert_close(mean, torch.zeros(3), rtol=0, atol=2e-3)  # the rim's pixels are 1/R of the radius wide


# --- handedness, seen on balls and maps --------------------------------------------------------------------------


@pytest.mark.parametrize(
    ("column", "row", "u", "v"),
    [
        (0.5 + SLANT / 2, 0.5, 0.75, 0.5),  # right of the ball's middle: right of the camera
        (0.5 - SLANT / 2, 0.5, 0.25, 0.5),
        (0.5, 0.5 - SLANT / 2, None, 0.0),  # upper half of the picture: straight up
        (0.5, 0.5 + SLANT / 2, None, 1.0),
        (0.5, 0.5, 0.0, 0.5),  # the middle: behind the camera, at the map's left and right edges
    ],
)
def test_a_light_on_the_ball_comes_from_there(column: float, row: float, u: float | None, v: float) -> None:
    position = (torch.arange(128) + 0.5) / 128
    blob = torch.exp(-((position[None, :] - column) ** 2 + (position[:, None] - row) ** 2) / (2 * 0.03**2))
    found_u, found_v = peak(ball_to_latlong(blob[None, ..., None], 64))
    assert found_v == pytest.approx(v, abs=1 / 64)
    if u is not None:
        assert math.cos(2 * math.pi * (found_u - u)) > math.cos(2 * math.pi / 64)


def test_the_rim_is_straight_ahead() -> None:
    position = (torch.arange(128) + 0.5) / 64 - 1
    radius = torch.hypot(position[None, :], position[:, None])
    ring = (radius > 0.97).float()[None, ..., None]
    latlong = ball_to_latlong(ring, 64)
    # r = 0.97 reflects 2 acos(0.97) = 28 degrees from straight ahead; a pixel of the ball blurs that by two pixels.
    ahead = torch.rad2deg(torch.arccos(-latlong_directions(64)[..., 2]))
    assert float(latlong[0, ..., 0][ahead < 12].min()) == pytest.approx(1, abs=1e-5)
    assert float(latlong[0, ..., 0][ahead > 40].max()) == 0


@pytest.mark.parametrize("azimuth", [90.0, 180.0, -120.0])
@pytest.mark.parametrize("elevation", [0.0, 45.0, 85.0])
def test_a_sun_survives_the_round_trip_in_place(elevation: float, azimuth: float) -> None:
    sun = torch.tensor(sun_direction(elevation, azimuth))
    found = ball_to_latlong(
        latlong_to_ball(torch.exp(200 * (latlong_directions(128) @ sun - 1))[None, ..., None], 256), 128
    )
    weights = latlong_solid_angles(128) * found[0, ..., 0]
    centroid = (latlong_directions(128) * weights[..., None]).sum(dim=(0, 1))
    cosine = torch.nn.functional.cosine_similarity(centroid, sun, dim=0)
    # A tenth of the map's 1.4 degree pixels.
    assert math.degrees(math.acos(min(1.0, float(cosine)))) < 0.14


# --- resampling --------------------------------------------------------------------------------------------------


def test_a_uniform_map_stays_uniform() -> None:
    ball = latlong_to_ball(torch.full((1, 32, 64, 3), 0.7), 48)
    covered = ball_coverage(48, samples=4) > 0
    assert_close(ball[0][covered], 0.7)
    assert_close(ball_to_latlong(ball, 32), 0.7)


def test_a_smooth_hdr_map_returns_within_one_percent() -> None:
    latlong = lobes(128)
    again = ball_to_latlong(latlong_to_ball(latlong, 1024), 128)
    error = (again - latlong).square().mean().sqrt() / latlong.square().mean().sqrt()
    assert float(error) < 0.01


@pytest.mark.parametrize(
    ("elevation", "azimuth", "tolerance"),
    [
        # A sun 1.4 pixels wide is sampled 6 times a pixel: the tent's alias is sinc²(6.5) = 0.24% at the worst phase.
        *((elevation, azimuth, 3e-3) for elevation in (4.0, 30.0, 80.0) for azimuth in (20.0, 90.0, 180.0)),
        # Within 5 degrees of straight ahead it lies in slivers of the rim's pixels, the last that Sinkhorn's sweeps
        # balance.
        *((elevation, azimuth, 1e-2) for elevation, azimuth in ((0.0, 0.0), (2.0, 0.0), (0.0, 5.0), (-3.0, 3.0))),
    ],
)
def test_a_sun_keeps_its_energy(elevation: float, azimuth: float, tolerance: float) -> None:
    latlong = SunAndSky(sun=sun_direction(elevation, azimuth), sun_radius=1.0).latlong(128)
    energy = latlong_energy(latlong).sum()
    ball = latlong_to_ball(latlong, 256)
    assert float(ball_energy(ball).sum() / energy) == pytest.approx(1, abs=3e-3)
    assert float(latlong_energy(ball_to_latlong(ball, 128)).sum() / energy) == pytest.approx(1, abs=tolerance)


@pytest.mark.parametrize("path", SHIPPED, ids=lambda path: path.stem)
def test_shipped_panoramas_keep_their_energy(path: Path) -> None:
    latlong = read_envmap(path)
    energy = latlong_energy(latlong).sum()
    ball = latlong_to_ball(latlong, 256)
    assert float(ball_energy(ball).sum() / energy) == pytest.approx(1, abs=2e-3)
    assert float(latlong_energy(ball_to_latlong(ball, latlong.shape[1])).sum() / energy) == pytest.approx(1, abs=2e-3)


@pytest.mark.parametrize("radius", [60.0, 57.3])
def test_every_pixel_of_the_ball_counts_for_the_area_it_covers(radius: float) -> None:
    # The energy of the unwrapped map is linear in the ball: its gradient is each pixel's share of the sphere.
    ball = torch.ones(1, 120, 120, 1, requires_grad=True)
    latlong_energy(ball_to_latlong(ball, 128, radius=radius, samples=6)).sum().backward()
    assert ball.grad is not None
    share = ball.grad[0, ..., 0] / ball_solid_angle(radius)
    rings = torch.hypot(*torch.meshgrid(*[torch.arange(120) - 59.5] * 2, indexing="ij"))
    for low, high in ((0, 20), (20, 50), (50, radius - 3), (radius - 3, radius + 2)):
        ring = (rings >= low) & (rings < high)
        covered = ball_coverage(120, radius=radius, samples=16)[ring].sum()
        # Sinkhorn's sweeps leave the rim's shares within 2%, of either sign; sampling noise is below.
        assert float(share[ring].sum() / covered) == pytest.approx(1, abs=5e-3)


def test_no_line_at_the_seam() -> None:
    latlong = ball_to_latlong(latlong_to_ball(lobes(64), 256), 64)
    neighbours = (latlong[:, :, 1:] - latlong[:, :, :-1]).abs()
    seam = (latlong[:, :, 0] - latlong[:, :, -1]).abs()
    beside = torch.maximum(neighbours[:, :, :4].amax(dim=2), neighbours[:, :, -4:].amax(dim=2))
    # Smooth in between: the step over the seam is like its neighbours' steps, give or take the curvature.
    assert bool((seam <= 1.2 * beside + 0.01 * latlong.mean()).all())


def test_no_line_at_the_poles() -> None:
    latlong = ball_to_latlong(latlong_to_ball(lobes(64), 256), 64)
    for pole, inner in ((0, 1), (-1, -2)):
        over = (latlong[:, pole] - latlong[:, pole].roll(64, dims=1)).abs()
        step = (latlong[:, pole] - latlong[:, inner]).abs()
        # Across the pole is one row's step: from half a row on one side to half a row on the other.
        assert float(over.max()) <= 1.2 * float(step.max()) + 0.01 * float(latlong.mean())


def test_an_off_centre_ball_is_found_where_it_is() -> None:
    latlong = lobes(64)
    crop = torch.zeros(1, 200, 200, 3)
    crop[:, 31 : 31 + 128, 17 : 17 + 128] = latlong_to_ball(latlong, 128)
    centred = ball_to_latlong(latlong_to_ball(latlong, 128), 64)
    found = ball_to_latlong(crop, 64, radius=64.0, centre=(17 + 64.0, 31 + 64.0))
    torch.testing.assert_close(found, centred, rtol=1e-3, atol=1e-2)  # positions in a wider crop round differently


def test_the_background_of_a_painted_ball_does_not_light_the_map() -> None:
    ball = latlong_to_ball(lobes(64), 128)
    offset = torch.arange(128) - 63.5
    off_ball = torch.hypot(offset[None, :], offset[:, None])[None, ..., None] > 64
    dark, bright = (
        ball_to_latlong(torch.where(off_ball, torch.tensor(shown), ball), 64, painted=True) for shown in (0.0, 1e6)
    )
    assert torch.equal(dark, bright)
    # What the slivers of the rim would have told is told by their neighbours, half a pixel further in. The third
    # channel's lobe is narrower than that: 15 degrees straight ahead, where the last pixel spans 20.
    resolved = lobes(64)[..., :2]
    error = (dark[..., :2] - resolved).square().mean().sqrt() / resolved.square().mean().sqrt()
    assert float(error) < 0.02


@pytest.mark.parametrize("direction", [(0.0, 1.0, 0.0), (0.0, -1.0, 0.0), (0.05, 0.998, 0.03), (1.0, 0.0, 0.0)])
def test_a_single_pixel_lights_the_map_with_its_solid_angle_at_the_poles_too(direction: tuple[float, ...]) -> None:
    towards = torch.nn.functional.normalize(torch.tensor(direction), dim=0)
    x, y = (64 * disc_coordinates(towards)).tolist()
    ball = torch.zeros(1, 128, 128, 1)
    ball[0, math.floor(64 - y), math.floor(64 + x)] = 1
    energy = float(latlong_energy(ball_to_latlong(ball, 128)))
    # Sinkhorn's iteration is stopped early; single pixels at the poles are the last to settle.
    assert energy == pytest.approx(ball_solid_angle(64), rel=0.03)


def test_a_ball_smaller_than_its_crop_leaves_the_rest_dark() -> None:
    ball = latlong_to_ball(torch.ones(1, 16, 32, 3), 64, radius=20.0)
    assert float(ball[0, 0].max()) == 0
    assert float(ball[0, 32, 32].min()) == 1
    assert float((ball[0, ..., 0] > 0).sum()) == pytest.approx(math.pi * 20**2, rel=0.1)


# --- perspective -------------------------------------------------------------------------------------------------


@pytest.mark.parametrize("fov", [40.0, 60.0, 90.0])
@pytest.mark.parametrize(("height", "width"), [(24, 32), (32, 24), (15, 15)])
def test_perspective_sees_the_closed_form(height: int, width: int, fov: float) -> None:
    rotation = camera_rotation(yaw=30.0, pitch=-20.0, roll=10.0)
    picture = latlong_to_perspective(
        latlong_directions(256)[None], height, width, fov=fov, rotation=rotation, samples=1
    )
    focal = max(height, width) / 2 / math.tan(math.radians(fov) / 2)
    x, y = torch.arange(width) + 0.5 - width / 2, height / 2 - torch.arange(height) - 0.5
    rays = torch.stack(torch.broadcast_tensors(x[None, :], y[:, None], torch.tensor(-focal)), dim=-1)
    expected = torch.nn.functional.normalize(rays @ rotation.T, dim=-1)
    # Bilinear between directions π/256 apart: the chord's sagitta is (π/256)²/8 = 2e-5 an axis.
    torch.testing.assert_close(picture[0], expected, rtol=0, atol=6e-5)


def test_a_small_picture_of_a_large_map_shows_its_mean() -> None:
    """Every pixel of the map counts: noise comes out as its mean, as far as the number of pixels averages it."""
    noise = torch.rand(1, 256, 512, 1, generator=torch.Generator().manual_seed(0))
    picture = latlong_to_perspective(noise, 6, 8, fov=90.0)
    # A pixel of the picture spans at least 22 x 22 of the map's at 256 / π rad: deviation 0.29 / 22, six of them.
    assert float((picture - 0.5).abs().max()) < 6 * 0.29 / 22
    point_samples = latlong_to_perspective(noise, 6, 8, fov=90.0, samples=1)
    assert float((point_samples - 0.5).abs().max()) > 6 * 0.29 / 22


@pytest.mark.parametrize(
    ("call", "name"),
    [
        (lambda: latlong_directions(0), "height"),
        (lambda: latlong_energy(torch.ones(1, 4, 4, 3)), "latlong"),
        (lambda: latlong_to_ball(torch.ones(1, 4, 9, 3), 16), "latlong"),
        (lambda: latlong_to_ball(torch.ones(1, 4, 8, 3), 16, samples=0), "samples"),
        (lambda: latlong_to_ball(torch.ones(1, 4, 8, 3), 16, radius=0.0), "radius"),
        (lambda: ball_to_latlong(torch.ones(1, 16, 16, 3), 8, radius=-1.0), "radius"),
        (lambda: ball_to_latlong(torch.ones(1, 16, 16, 3), 8, radius=math.nan), "radius"),
        (lambda: ball_to_latlong(torch.ones(1, 16, 16, 3), 8, samples=65), "samples"),
        (lambda: ball_to_latlong(torch.ones(1, 16, 16, 3), 0), "height"),
        (lambda: ball_coverage(16, samples=0), "samples"),
        (lambda: latlong_to_perspective(torch.ones(1, 4, 8, 3), 4, 4, fov=180.0), "fov"),
    ],
)
def test_wrong_options_are_named(call: object, name: str) -> None:
    with pytest.raises(OptionError) as raised:
        call()  # type: ignore[operator]
    assert raised.value.name == name


def test_neighbours_are_those_that_sampling_reads(generator: torch.Generator) -> None:
    """Directions from everywhere, both poles and the seam among them."""
    latlong = torch.rand(1, 9, 18, 3, generator=generator)
    special = torch.tensor([[0.0, 1.0, 0.0], [0.0, -1.0, 0.0], [0.0, 0.0, 1.0], [1e-7, 0.0, 1.0], [-1e-7, 0.1, 1.0]])
    directions = torch.cat((torch.randn(500, 3, generator=generator), special))
    pixels, shares = latlong_neighbours(directions, 9)
    read = (latlong[0].flatten(0, 1)[pixels] * shares[..., None]).sum(-2)
    # Positions in a map of 18 columns are rounded to 18 x 6e-8 of a pixel, twice.
    torch.testing.assert_close(read, sample_latlong(latlong, directions)[0], rtol=0, atol=1e-5)
