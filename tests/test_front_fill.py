"""The photograph as the front of the map: its own directions, nothing else, and no light lost where it clips."""

from __future__ import annotations

import math

import pytest
import torch
from hypothesis import given, settings
from hypothesis import strategies as st

from dl_core.errors import OptionError
from dl_core.exposure import decode_display, encode_display, expose
from dl_core.front_fill import FEATHER, frame_distance, front_fill
from dl_core.geometry import (
    camera_rotation,
    latlong_directions,
    latlong_solid_angles,
    latlong_to_perspective,
    perspective_to_latlong,
)

HEIGHT = 64
BLACK = torch.zeros(1, HEIGHT, 2 * HEIGHT, 3)
ANGLES = st.floats(-80, 80)
FOVS = st.floats(20, 120)


def smooth() -> torch.Tensor:
    """Radiance below clipping that differs in every direction and channel."""
    return 0.3 + 0.2 * latlong_directions(HEIGHT)[None]


def photograph(light: torch.Tensor, fov: float, pitch: float = 0.0, roll: float = 0.0) -> torch.Tensor:
    rotation = camera_rotation(0.0, pitch, roll)
    return expose(latlong_to_perspective(light, 96, 128, fov=fov, rotation=rotation), 0.0)


@given(FOVS, ANGLES, ANGLES)
def test_a_photograph_fills_its_own_directions_with_what_they_hold(fov: float, pitch: float, roll: float) -> None:
    truth = smooth()
    filled, mask, _ = front_fill(BLACK, photograph(truth, fov, pitch, roll), fov, pitch=pitch, roll=roll)
    inside = mask[0] == 1
    # Linear in the direction, a map's pixel of 2.8 degrees departs from its centre by 0.2 x 0.05 / 2 within it, and the
    # photograph holds its outer half pixel: 120 degrees over 128 pixels, 1.6 degrees at the middle, 0.2 x 0.028 / 2.
    # At the poles a pixel is a wedge with its centre in it, 0.2 x 0.025 off.
    assert bool(inside.any())
    assert float((filled - truth)[0][inside].abs().max()) < 0.01
    assert torch.equal(filled[0][mask[0] == 0], BLACK[0][mask[0] == 0])


@given(FOVS, ANGLES, ANGLES, st.floats(0, 20))
def test_what_is_filled_is_the_frame_and_grows_inward(fov: float, pitch: float, roll: float, feather: float) -> None:
    photo = photograph(smooth(), fov)
    _, mask, _ = front_fill(BLACK, photo, fov, pitch=pitch, roll=roll, feather=feather)
    distance = frame_distance(HEIGHT, 96, 128, fov, camera_rotation(0.0, pitch, roll))
    assert float(mask.min()) >= 0
    assert float(mask.max()) <= 1
    pixel = 180 / HEIGHT
    assert not bool(mask[0][distance < -pixel].any())
    clear = distance > pixel  # the picture shows all of these pixels, away from the poles' wedges
    order = distance[clear].argsort()
    rises = mask[0][clear][order]
    low = latlong_directions(HEIGHT)[..., 1].abs()[clear][order] < 0.9
    assert bool((rises[low].diff() >= -1e-5).all())
    assert bool((rises[low & (distance[clear][order] > max(feather, pixel))] >= 1 - 1e-5).all())


def test_directions_that_are_not_filled_stay_bit_for_bit() -> None:
    generator = torch.Generator().manual_seed(0)
    latlong = torch.rand(2, HEIGHT, 2 * HEIGHT, 3, generator=generator) * 50
    filled, mask, _ = front_fill(latlong, torch.ones(1, 30, 40, 3), 60.0)  # all of it clips
    outside = mask[0] == 0
    assert torch.equal(filled[:, outside], latlong[:, outside])
    assert bool((mask > 0).any())


def test_a_mirrored_photograph_fills_a_mirrored_front() -> None:
    generator = torch.Generator().manual_seed(1)
    latlong = torch.rand(1, HEIGHT, 2 * HEIGHT, 3, generator=generator)
    photo = torch.rand(1, 48, 64, 3, generator=generator)
    filled, mask, _ = front_fill(latlong, photo, 70.0)
    mirrored, mirrored_mask, _ = front_fill(latlong.flip(2), photo.flip(2), 70.0)
    torch.testing.assert_close(mirrored.flip(2), filled, rtol=1e-4, atol=1e-5)
    torch.testing.assert_close(mirrored_mask.flip(2), mask, rtol=1e-4, atol=1e-5)


@pytest.mark.parametrize(("fov", "relative"), [(5.0, 0.04), (60.0, 0.005), (170.0, 0.005)])
def test_the_share_seen_is_the_solid_angle_of_the_frame(fov: float, relative: float) -> None:
    # Of a pyramid with half angles a and b: 4 asin(sin a sin b). Its borders are found to a quarter of a pixel, 0.18
    # degrees: 0.04 of 5 degrees, and less than 0.005 of 60.
    _, share = perspective_to_latlong(torch.ones(1, 30, 40, 1), 256, fov=fov)
    across = math.radians(fov) / 2
    up = math.atan(math.tan(across) * 30 / 40)
    solid = float((share[0] * latlong_solid_angles(256)).sum())
    assert solid == pytest.approx(4 * math.asin(math.sin(across) * math.sin(up)), rel=relative)


def test_a_large_photograph_is_averaged_not_sampled() -> None:
    # Stripes one pixel wide, 0 and 1: every pixel of the map is between them.
    stripes = (torch.arange(1600) % 2).float()[None, None, :, None].expand(1, 1200, -1, 1)
    means, share = perspective_to_latlong(stripes, HEIGHT, fov=60.0)
    inside = means[0][share[0] == 1]
    assert float((inside - 0.5).abs().max()) < 0.1


def test_clipped_pixels_keep_the_radiance_of_the_map() -> None:
    photo = torch.full((1, 60, 80, 3), 0.5)
    photo[:, 20:40, 30:50] = 1.0
    photo[:, 20:40, 30:50, 2] = 0.5  # blue does not clip
    latlong = torch.zeros_like(BLACK)
    latlong[..., 0], latlong[..., 1], latlong[..., 2] = 20.0, 10.0, 5.0
    latlong = latlong * (
        front_fill(BLACK, photo, 60.0)[0][..., :1] > 0.95
    )  # the map's lamp is where the photograph clips
    filled, mask, _ = front_fill(latlong, photo, 60.0)
    lamp = (latlong[0, ..., 0] > 0) & (mask[0] == 1)
    assert bool(lamp.any())
    assert bool((filled[0][lamp][:, :2] >= latlong[0][lamp][:, :2] - 1e-4).all())
    torch.testing.assert_close(filled[0][lamp][:, 2], decode_display(torch.full((int(lamp.sum()),), 0.5)))


@given(st.floats(-18, 18), st.floats(-9, 9), st.floats(3, 5), st.floats(2, 2.5))
@settings(max_examples=8)
def test_light_smeared_around_a_clipped_lamp_is_gathered_in_it(
    azimuth: float, elevation: float, radius: float, smear: float
) -> None:
    # The map smears a lamp in the frame over some times its radius: what the photograph shows dark beside it is not
    # lost.
    across, up = math.radians(azimuth), math.radians(elevation)
    lamp = torch.tensor([math.sin(across) * math.cos(up), math.sin(up), -math.cos(across) * math.cos(up)])
    angle = torch.rad2deg(torch.acos((latlong_directions(128) @ lamp).clamp(-1, 1)))
    weights = latlong_solid_angles(128)[..., None]
    sharp = 0.2 + 100.0 * (angle < radius).float()[None, ..., None].expand(-1, -1, -1, 3)
    spread = (angle < smear * radius).float()[None, ..., None].expand(-1, -1, -1, 3)
    smeared = 0.2 + spread * ((sharp - 0.2) * weights).sum() / (spread * weights).sum()
    filled, mask, _ = front_fill(smeared, photograph(sharp, 80.0), 80.0)
    total = [float((latlong * weights).sum()) for latlong in (smeared, filled)]
    assert total[1] == pytest.approx(total[0], rel=0.02)
    # A pixel of the photograph, 0.75 degrees, and two of the map, 1.4, from its edge.
    beside = (angle > radius + 3.6) & (mask[0] == 1)
    assert float(filled[0][beside].max()) < 0.25


def test_a_map_that_is_only_too_bright_gives_a_lamp_nothing_beyond_its_surroundings() -> None:
    photo = encode_display(torch.full((1, 60, 80, 3), 0.2))
    filled, _, _ = front_fill(BLACK + 5.0, photo, 60.0)  # nothing clips: the photograph knows
    assert float(filled[0, HEIGHT // 2, HEIGHT].max()) == pytest.approx(0.2, rel=1e-3)


@pytest.mark.parametrize(
    ("options", "name"),
    [
        ({"fov": 4.9}, "fov"),
        ({"fov": 170.5}, "fov"),
        ({"fov": math.nan}, "fov"),
        ({"fov": 60.0, "pitch": 91.0}, "pitch"),
        ({"fov": 60.0, "roll": math.nan}, "roll"),
        ({"fov": 60.0, "feather": -1.0}, "feather"),
    ],
)
def test_angles_out_of_range_are_named(options: dict[str, float], name: str) -> None:
    with pytest.raises(OptionError) as raised:
        front_fill(BLACK, torch.ones(1, 3, 4, 3), **options)
    assert raised.value.name == name


def test_a_narrow_photograph_is_not_all_feather() -> None:
    _, mask, _ = front_fill(torch.zeros(1, 512, 1024, 3), torch.ones(1, 30, 40, 3) * 0.5, 5.0, feather=FEATHER)
    assert float(mask.max()) == 1
