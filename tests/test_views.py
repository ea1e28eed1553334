"""Views of a panorama for training pairs: photograph and ball agree about the camera, and the ball with Blender's."""

from __future__ import annotations

import json
import math
from pathlib import Path

import numpy as np
import OpenEXR
import pytest
import torch
from hypothesis import given
from hypothesis import strategies as st

from dl_core.bench.blender_maps import environment
from dl_core.geometry import (
    ball_coverage,
    camera_rotation,
    latlong_directions,
    latlong_energy,
    latlong_to_ball,
    latlong_to_perspective,
)
from dl_core.projection import Perspective, disc_directions
from dl_core.training.data.views import Camera, Surroundings, rows_shown, take_ball, take_photograph

BLENDER = Path(__file__).parent / "data" / "blender"
cameras = st.builds(
    Camera,
    yaw=st.floats(-180, 180),
    pitch=st.floats(-40, 40),
    roll=st.floats(-10, 10),
    fov=st.floats(40, 80),
    mirrored=st.booleans(),
)


def lamp(towards: torch.Tensor, rows: int, radius: float) -> torch.Tensor:
    """A map that is black but for a disc of radiance 1 around a direction; radius in degrees."""
    cosine = latlong_directions(rows) @ (towards / torch.linalg.norm(towards))
    return (cosine > math.cos(math.radians(radius))).float()[None, ..., None].expand(-1, -1, -1, 3).contiguous()


def away(rays: torch.Tensor, ray: torch.Tensor) -> torch.Tensor:
    """Angles in degrees between directions and one more."""
    unit = torch.nn.functional.normalize(rays, dim=-1)
    return torch.rad2deg(torch.acos((unit @ torch.nn.functional.normalize(ray, dim=0)).clamp(-1, 1)))


@given(camera=cameras, x=st.floats(-0.8, 0.8), y=st.floats(-0.5, 0.5))
def test_lamps_are_where_the_camera_says_on_photograph_and_ball(camera: Camera, x: float, y: float) -> None:
    """One lamp is in the photograph, another behind the camera; the ball shows both, the first near its rim."""
    width, height, diameter, rows, radius = 48, 32, 64, 64, 16.0
    focal = width / 2 / math.tan(math.radians(camera.fov) / 2)
    ahead = torch.tensor([x * width / 2, y * height / 2, -focal])
    behind = ahead * torch.tensor([1, 1, -1])
    lamps = torch.maximum(*(lamp(camera.axes @ ray, rows, radius) for ray in (ahead, behind)))
    scene = Surroundings.of(lamps, width, camera.fov, diameter)
    columns, lines = torch.meshgrid(torch.arange(width) + 0.5, torch.arange(height) + 0.5, indexing="xy")
    rays = torch.stack((columns - width / 2, height / 2 - lines, torch.full_like(columns, -focal)), dim=-1)
    position = (torch.arange(diameter) + 0.5) * 2 / diameter - 1
    disc = torch.stack((position[None, :].expand(diameter, -1), -position[:, None].expand(-1, diameter)), dim=-1)
    reflected = disc_directions(disc)
    # A lamp's edge is a map pixel's diagonal uncertain, and what a picture's pixel sees of the map: on the ball twice
    # what its middle does, since towards the rim a pixel sees more on its outer side.
    edge = 180 / rows * math.sqrt(2)
    seen = torch.rad2deg(8 / diameter / torch.sqrt((1 - disc.square().sum(-1)).clamp(min=1e-6)))
    views = (
        (take_photograph(scene, camera, height, width), away(rays, ahead), edge + math.degrees(1 / focal)),
        (
            take_ball(scene, camera, diameter),
            torch.minimum(*(away(reflected, ray) for ray in (ahead, behind))),
            edge + seen,
        ),
    )
    for picture, angle, margin in views:
        shown = picture[0, ..., 0]
        inside, outside = angle < radius - margin, angle > radius + margin
        assert inside.any()
        assert outside.any()
        torch.testing.assert_close(shown[inside], torch.ones(int(inside.sum())))
        assert float(shown[outside].abs().max()) == 0


def test_on_the_ball_of_a_mirrored_panorama_left_and_right_are_exchanged() -> None:
    latlong = torch.exp(latlong_directions(32))[None]
    straight, mirrored = (Camera(0, 20, 0, 60, mirrored=flag) for flag in (False, True))
    scene, flipped = (Surroundings.of(image, 64, 60, 32) for image in (latlong, latlong.flip(2)))
    torch.testing.assert_close(take_ball(scene, mirrored, 32), take_ball(flipped, straight, 32))
    photos = take_photograph(scene, mirrored, 48, 64), take_photograph(flipped, straight, 48, 64)
    torch.testing.assert_close(*photos)


@pytest.mark.parametrize("name", ["dancing_hall", "kloppenheim_05"])
@pytest.mark.parametrize("diameter", [64, 160])
def test_few_samples_show_what_many_do(name: str, diameter: int) -> None:
    latlong = torch.from_numpy(environment(name, 256))[None]
    camera = Camera(40, 10, 3, 60)
    scene = Surroundings.of(latlong, 128, camera.fov, diameter)
    few, many = take_ball(scene, camera, diameter), latlong_to_ball(latlong, diameter, rotation=camera.axes)
    cover = ball_coverage(diameter)[..., None]
    energies = [(ball[0] * cover).sum(dim=(0, 1)) for ball in (few, many)]
    assert float((energies[0] / energies[1] - 1).abs().max()) < 0.01
    photo, exact = (
        take_photograph(scene, camera, 96, 128),
        latlong_to_perspective(latlong, 96, 128, fov=60, rotation=camera.axes, samples=8),
    )
    assert float((photo.mean() / exact.mean() - 1).abs()) < 0.01


@given(yaw=st.integers(0, 7), upside_down=st.booleans())
def test_a_turned_camera_in_a_turned_panorama_sees_the_same_ball(yaw: int, upside_down: bool) -> None:
    # Turns that move whole pixels: nothing is resampled.
    latlong = torch.rand(1, 16, 32, 3, generator=torch.Generator().manual_seed(yaw))
    turned = torch.roll(latlong, 4 * yaw, dims=2)
    rotation = camera_rotation(yaw=45 * yaw)
    if upside_down:
        turned, rotation = turned.flip(1, 2), camera_rotation(roll=180) @ rotation
    balls = latlong_to_ball(latlong, 32), latlong_to_ball(turned, 32, rotation=rotation)
    # Turned by an angle that is no exact float, samples move by parts in a million, across edges of pixels.
    torch.testing.assert_close(*balls, atol=1e-4, rtol=0)
    torch.testing.assert_close(latlong_energy(turned), latlong_energy(latlong))


@pytest.mark.parametrize("fov", [40, 60])
def test_the_ball_of_a_turned_camera_is_blenders(fov: int) -> None:
    path = BLENDER / f"perspective_fov{fov}_dancing_hall.exr"
    scene = json.loads(path.with_suffix(".json").read_text())
    rendered = torch.from_numpy(
        np.asarray(next(iter(OpenEXR.File(str(path)).channels().values())).pixels, dtype=np.float32)
    )[..., :3]
    latlong = torch.from_numpy(environment(scene["panorama"], scene["panorama_height"]))[None]
    radius, centre = scene["silhouette_radius_px"], tuple(map(float, scene["centre_in_crop_px"]))
    camera = Perspective(scene["fov_deg"], max(scene["frame_px"]), centre)
    # Turned upside down and then by whole pixels: nothing is resampled.
    turned = torch.roll(latlong.flip(1, 2), 40, dims=2)
    rotation = camera_rotation(yaw=40 * 360 / latlong.shape[2]) @ camera_rotation(roll=180)
    size = rendered.shape[0]
    ball = latlong_to_ball(turned, size, radius=radius, centre=centre, projection=camera, rotation=rotation)
    position = torch.arange(size) + 0.5
    inside = torch.hypot(position[None] - centre[0], position[:, None] - centre[1]) < 0.9 * radius
    rms = [values[inside].square().mean().sqrt() for values in (ball[0] - rendered, rendered)]
    # The render's own noise and no more.
    assert float(rms[0] / rms[1]) < 1.2 * scene["noise_relative_rms"]
    assert float(ball[0][inside].mean() / rendered[inside].mean()) == pytest.approx(1, abs=2e-3)


def test_maps_are_reduced_no_further_than_a_photograph_shows() -> None:
    latlong = torch.rand(1, 512, 1024, 3, generator=torch.Generator().manual_seed(0))
    assert Surroundings.of(latlong, 1024, 60, 256).ahead is latlong
    scene = Surroundings.of(latlong, 128, 60, 32)
    assert scene.ahead.shape[1] == rows_shown(128, 60) == math.ceil(math.pi / (2 * math.tan(math.pi / 6) / 128))
    assert scene.around.shape[1] == 256
    torch.testing.assert_close(latlong_energy(scene.around), latlong_energy(latlong))
