from __future__ import annotations

import json
import math
from pathlib import Path
from typing import Any

import OpenEXR
import pytest
import torch
from tolerances import assert_close

from dl_core.bench.blender_maps import environment
from dl_core.errors import OptionError
from dl_core.geometry import camera_rotation, latlong_directions, latlong_solid_angles, rotate_latlong
from dl_core.microfacet import Surface
from dl_core.sphere_scene import AUTHORS_SPHERES, AUTHORS_VIEW, View, render_sphere, view_coverage

BLENDER = Path(__file__).parent / "data" / "blender"
SMALL = View(30, 40, 14.0, distance=8.0, elevation=20.0)
LAMBERT_BODY = Surface(base=0.8, metallic=False, roughness=0.5, ior=1.0 + 1e-6)
"""A coat that reflects nothing: what is left is Lambert's law."""


def points_on_sphere(view: View) -> tuple[torch.Tensor, torch.Tensor, torch.Tensor]:
    """By intersecting rays: which pixel centres show the sphere, the normals there, and the unit vectors to the camera.

    The camera stands at distance d on the axis; a ball of radius 1 has its silhouette where rays are tangent, at
    focal length x 1/√(d² - 1) pixels.
    """
    focal = view.radius * math.sqrt(view.distance**2 - 1)
    right, up, axis = view.axes.double()
    x = torch.arange(view.columns).double() + 0.5 - view.columns / 2
    y = view.rows / 2 - torch.arange(view.rows).double() - 0.5
    rays = x[None, :, None] * right + y[:, None, None] * up - focal * axis
    rays = rays / rays.norm(dim=-1, keepdim=True)
    eye = view.distance * axis
    half = rays @ eye
    inside = half**2 - view.distance**2 + 1
    normals = eye + (-half - torch.sqrt(inside.clamp(min=0)))[..., None] * rays
    return inside > 0, normals, -rays


def shown_well_inside(view: View, share: float = 0.9) -> torch.Tensor:
    x = torch.arange(view.columns) + 0.5 - view.columns / 2
    y = torch.arange(view.rows) + 0.5 - view.rows / 2
    return torch.hypot(x[None, :], y[:, None]) < share * view.radius


# --- closed forms ---


def test_the_silhouette_is_where_it_should_be() -> None:
    covered = float(view_coverage(AUTHORS_VIEW).sum())
    # Coverage is counted on 8 x 8 points a pixel: 1e-4 of the disc at this size.
    assert covered == pytest.approx(math.pi * AUTHORS_VIEW.radius**2, rel=1e-4)
    # 85 mm on 36 mm over 960 px, a unit sphere √260 away.
    assert AUTHORS_VIEW.radius == pytest.approx(85 / 36 * 960 / math.sqrt(259))


@pytest.mark.parametrize("surface", AUTHORS_SPHERES.values(), ids=AUTHORS_SPHERES)
def test_a_furnace_shows_the_albedo(surface: Surface) -> None:
    picture = render_sphere(torch.full((1, 32, 64, 1), 2.0), surface, SMALL)[0, ..., 0]
    _, normals, views = points_on_sphere(SMALL)
    inside = shown_well_inside(SMALL)
    cosines = (normals * views).sum(-1)[inside]
    # A pixel is the mean over its area and the formula its centre's value: up to 0.2% where the coat brightens.
    expected = 2 * surface.albedo(cosines).float()
    torch.testing.assert_close(picture[inside], expected, rtol=3e-3, atol=0)


def test_a_distant_light_on_lambert_is_a_cosine() -> None:
    """One map pixel of radiance L: albedo / π · L ω (n·l), with the whole coat's share gone."""
    light = torch.zeros(1, 128, 256, 1)
    light[0, 40, 150] = 1000.0
    direction = latlong_directions(128)[40, 150].double()
    _, normals, _ = points_on_sphere(SMALL)
    inside = shown_well_inside(SMALL)
    cosine = (normals @ direction).clamp(min=0)[inside].float()
    strength = 0.8 / math.pi * 1000 * float(latlong_solid_angles(128)[40])
    picture = render_sphere(light, LAMBERT_BODY, SMALL)[0, ..., 0][inside]
    # The terminator is a kink in the middle of a pixel of 1/14 radius: its mean differs by up to 1/14/8 of the light.
    torch.testing.assert_close(picture, strength * cosine, rtol=5e-3, atol=strength / 112)


def test_a_mirror_shows_what_its_points_reflect() -> None:
    """In colours of direction, r = 2 (n·v) n - v by ray tracing, dimmed by Schlick's factor."""
    latlong = latlong_directions(128)[None] + 2
    _, normals, views = points_on_sphere(SMALL)
    inside = shown_well_inside(SMALL, 0.8)
    cosine = (normals * views).sum(-1, keepdim=True)
    reflected = (2 * cosine * normals - views)[inside].float() + 2
    schlick = (0.8 + 0.2 * (1 - cosine) ** 5)[inside].float()
    picture = render_sphere(latlong, AUTHORS_SPHERES["mirror"], SMALL)[0][inside]
    # Second order in the pixel: it turns the reflection by up to 0.24 rad, and averaging shortens it by 0.24²/24 x 2.
    torch.testing.assert_close(picture, reflected * schlick, rtol=0, atol=6e-3)


def test_a_mirror_is_linear_in_maps_of_any_size_and_gives_gradients() -> None:
    """Its matrix is that of `sample_latlong`: uniform light comes back dimmed by Schlick's factor."""
    inside = shown_well_inside(SMALL, 0.8)
    for height in (2, 31, 128):
        latlong = torch.full((2, height, 2 * height, 3), 3.0, requires_grad=True)
        picture = render_sphere(latlong, AUTHORS_SPHERES["mirror"], SMALL)
        _, normals, views = points_on_sphere(SMALL)
        schlick = (0.8 + 0.2 * (1 - (normals * views).sum(-1)) ** 5)[inside].float()
        # A pixel is the mean over its area: second order in its size, 1e-3 here.
        torch.testing.assert_close(picture[1, ..., 0][inside], 3 * schlick, rtol=3e-3, atol=0)
        picture.sum().backward()
        assert_close(latlong.grad.sum() * 3, picture.detach().sum())
    with pytest.raises(OptionError, match="latlong"):
        render_sphere(torch.ones(1, 8, 15, 3), AUTHORS_SPHERES["mirror"], SMALL)


def test_a_highlight_is_where_the_mirror_shows_the_light() -> None:
    light = (
        latlong_directions(128) @ torch.nn.functional.normalize(torch.tensor([0.5, 0.4, 0.7]), dim=0) > 0.998
    ).float()
    view = View.square(48)
    matte, mirror = (
        render_sphere(light[None, ..., None], AUTHORS_SPHERES[name], view)[0, ..., 0] for name in ("matte", "mirror")
    )
    brightest = divmod(int(matte.argmax()), 48)
    rows, columns = torch.nonzero(mirror > 0.1 * mirror.max(), as_tuple=True)
    # A pixel of the ball is 2/24 rad of the reflection; the lobe's peak leans towards grazing by less.
    assert brightest == pytest.approx((float(rows.float().mean()), float(columns.float().mean())), abs=1.5)


def test_the_camera_may_move_instead_of_the_world(smooth_map: torch.Tensor) -> None:
    """From 25 degrees above, the world looks as from the front when it is turned down by 25 degrees."""
    above, level = View(24, 24, 11.0, 9.0, elevation=25.0), View(24, 24, 11.0, 9.0)
    turned = rotate_latlong(smooth_map, camera_rotation(pitch=-25.0).T.contiguous(), samples=3)
    pictures = render_sphere(smooth_map, AUTHORS_SPHERES["matte"], above)
    others = render_sphere(turned, AUTHORS_SPHERES["matte"], level)
    # Rotation resamples a map of 2.8 degree pixels.
    torch.testing.assert_close(pictures, others, rtol=2e-3, atol=1e-6)


def test_shading_is_linear_in_the_map(generator: torch.Generator) -> None:
    """Batches are independent, and light adds up."""
    maps = torch.rand(2, 16, 32, 3, generator=generator)
    for surface in AUTHORS_SPHERES.values():
        both = render_sphere(torch.cat((maps, maps.sum(0, keepdim=True))), surface, SMALL)
        assert_close(both[0] + both[1], both[2])


def test_views_are_checked() -> None:
    with pytest.raises(OptionError, match="distance is 1; accepted: above 1 radius"):
        View(8, 8, 4.0, distance=1)
    with pytest.raises(OptionError, match="radius is 0"):
        View(8, 8, 0.0)
    with pytest.raises(OptionError, match="elevation is 91"):
        View(8, 8, 4.0, elevation=91)
    with pytest.raises(OptionError, match="rows and columns"):
        View(0, 8, 4.0)


# --- Blender ---


def reference(name: str) -> tuple[torch.Tensor, dict[str, Any]]:
    """A render with alpha, (rows, columns, 4), and what is known about it."""
    facts = json.loads((BLENDER / f"{name}.json").read_text(encoding="utf-8"))
    channels = OpenEXR.File(str(BLENDER / f"{name}.exr"), separate_channels=True).channels()
    return torch.stack([torch.from_numpy(channels[key].pixels.astype("float32")) for key in "RGBA"], dim=-1), facts


BARS = {"diffuse": 0.01, "matte": 0.02, "mirror": 0.02}
RENDERS = [path.stem for name in BARS for path in sorted(BLENDER.glob(f"{name}_*.json"))]


def test_there_is_a_render_of_every_sphere_under_six_panoramas() -> None:
    for name in BARS:
        assert sum(stem.startswith(f"{name}_") and not stem.endswith("_uniform") for stem in RENDERS) >= 6


def block_means(values: torch.Tensor, inside: torch.Tensor, side: int) -> torch.Tensor:
    """Means over the pixels inside of blocks of side x side that are at least half inside."""
    masked = (values * inside[..., None]).permute(2, 0, 1)[None]
    share = torch.nn.functional.avg_pool2d(inside.float()[None, None], side)
    means = torch.nn.functional.avg_pool2d(masked, side) / share.clamp(min=0.5)
    return means[0, :, share[0, 0] >= 0.5]


@pytest.mark.parametrize("stem", RENDERS)
def test_spheres_agree_with_blender(stem: str) -> None:
    """RMSE relative to the render's RMS, after the render's own noise; a mirror inside 0.95 of its radius.

    A mirror is compared pixel by pixel, suns and all, and nothing is taken off. Rough spheres are compared by means of
    3 x 3 pixels, over which Blender's noise averages out and an error of shading does not: independent noise shrinks by
    3, and what is left is taken off in squares.
    """
    render, facts = reference(stem)
    name = stem.split("_", 1)[0]
    latlong = torch.from_numpy(environment(facts["panorama"], facts["panorama_height"]))[None]
    view = View(
        facts["crop_px"]["height"],
        facts["crop_px"]["width"],
        facts["silhouette_radius_px"],
        facts["distance_in_radii"],
        elevation=-facts["pitch_deg"],
    )
    side, share = (1, 0.95) if name == "mirror" else (3, 1.0)
    inside = (render[..., 3] > 0.999) & shown_well_inside(view, share)
    expected = render[..., :3]
    ours = render_sphere(latlong, AUTHORS_SPHERES[name], view)[0]
    error = block_means(ours - expected, inside, side).square().mean()
    relative = float(error / block_means(expected, inside, side).square().mean())
    noise = 0.0 if name == "mirror" else (facts["noise_relative_rms"] / side) ** 2
    assert math.sqrt(max(0.0, relative - noise)) < BARS[name], math.sqrt(relative)
