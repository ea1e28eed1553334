"""The array of spheres: symmetries, energy, shadows counted ray by ray, and Blender."""

from __future__ import annotations

import json
import math
from pathlib import Path
from typing import Any

import OpenEXR
import pytest
import torch
from hypothesis import given, settings
from hypothesis import strategies as st
from tolerances import assert_close

from dl_core.array_scene import ALBEDO, CAMERA_HEIGHT, PLANE_HALF, SIZE, SPACING, render_array
from dl_core.bench.blender_maps import environment
from dl_core.errors import OptionError
from dl_core.geometry import latlong_directions, latlong_solid_angles, sample_latlong

BLENDER = Path(__file__).parent / "data" / "blender"
STEP = SPACING / math.sqrt(2)
CENTRES = torch.tensor(
    [[(i + j) * STEP, 1.0, (i - j) * STEP] for i in (-1, 0, 1) for j in (-1, 0, 1)], dtype=torch.float64
)


def entries(place: torch.Tensor, directions: torch.Tensor) -> torch.Tensor:
    """Distance to each sphere along rays from a place, infinite where they miss: (..., 9), in float64."""
    offset = place - CENTRES
    half = directions @ offset.T
    root = half.square() - offset.square().sum(-1) + 1
    near = -half - root.clamp(min=0).sqrt()
    return torch.where((root > 0) & (near > 1e-9), near, math.inf)


def shown() -> tuple[torch.Tensor, torch.Tensor, torch.Tensor]:
    """What pixel centres show, by intersecting rays: places and normals (256, 256, 3), and which sphere (-1: plane)."""
    axis = ((torch.arange(SIZE).double() + 0.5) / SIZE * 2 - 1) * PLANE_HALF
    z, x = torch.meshgrid(axis, axis, indexing="ij")
    eye = torch.tensor([0.0, CAMERA_HEIGHT, 0.0], dtype=torch.float64)
    floor = torch.stack((x, torch.zeros_like(x), z), dim=-1)
    rays = torch.nn.functional.normalize(floor - eye, dim=-1)
    distance, owner = entries(eye, rays).min(-1)
    hit = torch.isfinite(distance)
    places = torch.where(hit[..., None], eye + distance.clamp(max=1e3)[..., None] * rays, floor)
    normals = torch.where(hit[..., None], places - CENTRES[owner], torch.tensor([0.0, 1.0, 0.0]).double())
    return places, normals, torch.where(hit, owner, -1)


PLACES, NORMALS, OWNER = shown()


def uncut() -> torch.Tensor:
    """Pixels that show one surface, and whose neighbours show the same."""
    same = torch.ones(SIZE, SIZE, dtype=torch.bool)
    for rows in (-1, 0, 1):
        for columns in (-1, 0, 1):
            same &= torch.roll(OWNER, (rows, columns), (0, 1)) == OWNER
    return same


UNCUT = uncut()


def sun(row: int, column: int) -> tuple[torch.Tensor, torch.Tensor, float]:
    """A map with one pixel lit, its direction, and its irradiance on a surface that faces it."""
    latlong = torch.zeros(1, 128, 256, 1)
    latlong[0, row, column] = 1000.0
    return latlong, latlong_directions(128)[row, column].double(), 1000.0 * float(latlong_solid_angles(128)[row])


# --- the scene ---------------------------------------------------------------------------------------------------


def test_a_quarter_turn_of_the_map_turns_the_picture(generator: torch.Generator) -> None:
    latlong = torch.rand(1, 32, 64, 3, generator=generator)
    turned = render_array(torch.roll(latlong, 16, dims=2))
    assert_close(turned, torch.rot90(render_array(latlong), -1, dims=(1, 2)))


def test_a_mirrored_map_mirrors_the_picture(generator: torch.Generator) -> None:
    """Nothing in the computation is mirrored: this sees what a quarter turn hides."""
    latlong = torch.rand(1, 32, 64, 1, generator=generator)
    picture, mirrored = render_array(latlong), render_array(latlong.flip(2))
    # Directions in which light is gathered are not symmetrical, and shadows begin at 512 azimuths: 1% where spheres
    # meet the plane, a tenth of that elsewhere.
    torch.testing.assert_close(mirrored, picture.flip(2), rtol=0, atol=0.015)
    assert float((mirrored - picture.flip(2)).square().mean().sqrt()) < 2e-3


@settings(max_examples=3)
@given(seed=st.integers(0, 99), scale=st.floats(1e-2, 1e3))
def test_the_picture_is_linear_in_the_map(seed: int, scale: float) -> None:
    maps = torch.rand(2, 16, 32, 3, generator=torch.Generator().manual_seed(seed))
    both = render_array(torch.cat((maps, scale * maps.sum(0, keepdim=True))))
    assert_close(scale * (both[0] + both[1]), both[2])


def test_gradients_are_those_of_a_linear_function(generator: torch.Generator) -> None:
    latlong = torch.rand(1, 16, 32, 1, generator=generator, dtype=torch.float64, requires_grad=True)
    picture = render_array(latlong, bounces=2)
    picture.sum().backward()
    assert_close((latlong.grad * latlong).sum().detach(), picture.sum().detach())


def test_options_are_checked() -> None:
    with pytest.raises(OptionError, match="latlong"):
        render_array(torch.ones(1, 8, 15, 3))
    with pytest.raises(OptionError, match=r"albedo is 1.5; accepted: 0 to 1"):
        render_array(torch.ones(1, 8, 16, 3), albedo=1.5)
    with pytest.raises(OptionError, match="bounces is -1"):
        render_array(torch.ones(1, 8, 16, 3), bounces=-1)


# --- energy ------------------------------------------------------------------------------------------------------


def test_a_furnace_shows_nothing() -> None:
    """White surfaces in uniform light are as bright as the light: open sky and light gathered add up to everything."""
    picture = render_array(torch.full((1, 16, 32, 1), 2.0), albedo=1.0, bounces=60)
    # Points near the tops of spheres see up to 1.1% of plane, edge on, where none of 256 directions goes.
    assert float(picture.min()) > 2 * (1 - 0.012)
    assert float(picture.max()) < 2 * (1 + 1e-4)


def test_a_top_sees_the_whole_sky() -> None:
    """Irradiance π of uniform light; the middle four pixels lean from the top by 0.04 radii, 2e-4 of the sky."""
    picture = render_array(torch.ones(1, 16, 32, 1), bounces=0)[0, 127:129, 127:129]
    torch.testing.assert_close(picture, torch.full_like(picture, ALBEDO), rtol=5e-4, atol=0)


def test_the_plane_misses_what_spheres_cover() -> None:
    """A sphere that rests on the plane covers 1/D³ of the light, D to its centre; together at most their sum."""
    picture = render_array(torch.ones(1, 16, 32, 1), bounces=0)[0, ..., 0].double() / ALBEDO
    covered = torch.cdist(PLACES.flatten(0, 1), CENTRES).unflatten(0, (SIZE, SIZE)) ** -3
    plane = (OWNER < 0) & UNCUT
    # Azimuths are rounded to 1/512 of a turn: 2e-3 at most of what a row holds.
    assert bool((picture >= 1 - covered.sum(-1) - 2e-3)[plane].all())
    assert bool((picture <= 1 - covered.amax(-1) + 2e-3)[plane].all())


def test_light_from_below_reaches_spheres_past_the_edge_and_never_the_plane() -> None:
    latlong = torch.zeros(1, 32, 64, 1)
    latlong[:, 17:20] = 1.0  # 6 to 22 degrees below the horizon
    picture = render_array(latlong, bounces=0)[0, ..., 0]
    assert not picture[(OWNER < 0) & UNCUT].any()
    assert float(picture[OWNER >= 0].max()) > 0.05


# --- shadows -----------------------------------------------------------------------------------------------------


def counted(pixel: tuple[int, int], latlong: torch.Tensor) -> torch.Tensor:
    """Direct irradiance of what a pixel centre shows, ray by ray over 256 x 512 directions."""
    place, normal, owner = PLACES[pixel], NORMALS[pixel], int(OWNER[pixel])
    directions = latlong_directions(256).double()
    distance = entries(place, directions)
    if owner >= 0:
        distance[..., owner] = math.inf  # its own sphere is below its horizon
    landing = place - directions * (place[1] / directions[..., 1:2])
    on_plane = (directions[..., 1] < 0) & (landing[..., [0, 2]].abs() < PLANE_HALF).all(-1)
    cosine = (directions @ normal).clamp(min=0)
    open_sky = torch.isinf(distance).all(-1) & ~on_plane
    weights = cosine * open_sky * latlong_solid_angles(256).double()
    return (sample_latlong(latlong, directions.float())[0].double() * weights[..., None]).sum((0, 1))


def test_light_from_the_map_is_that_of_counted_rays(generator: torch.Generator) -> None:
    """Plane and spheres, all over the picture, in a map that differs from pixel to pixel."""
    latlong = torch.rand(1, 128, 256, 3, generator=generator) ** 4 + latlong_directions(128)[None].clamp(min=0)
    picture = render_array(latlong, bounces=0)[0].double() * (math.pi / ALBEDO)
    candidates = torch.nonzero(UNCUT)
    for index in torch.linspace(0, len(candidates) - 1, 16).long().tolist():
        row, column = candidates[index].tolist()
        # A pixel is a mean over 0.04 radii and the count its middle: 0.5% beside a contact or at a rim.
        torch.testing.assert_close(picture[row, column], counted((row, column), latlong), rtol=6e-3, atol=1e-3)


def test_a_sun_straight_above_shades_what_is_under_the_spheres_alone() -> None:
    """A light of up to 2.1 degrees around the zenith: at the height of a centre its shadow's edge is 0.037 wide."""
    latlong = torch.zeros(1, 128, 256, 1)
    latlong[:, 0] = 1.0
    picture, plane = render_array(latlong, bounces=0)[0, ..., 0], (OWNER < 0) & UNCUT
    aside = (PLACES[..., None, :] - CENTRES)[..., [0, 2]].norm(dim=-1).amin(-1)
    # Half a pixel more, 0.03 across its diagonal.
    shaded, lit = picture[plane & (aside < 0.93)], picture[plane & (aside > 1.07)]
    assert len(shaded) > 100
    assert not shaded.any()
    torch.testing.assert_close(lit, lit.mean().expand_as(lit), rtol=1e-4, atol=0)


@pytest.mark.parametrize(("row", "column"), [(18, 128), (18, 40), (40, 201)])
def test_a_sun_casts_elliptic_shadows_and_lights_spheres_by_the_cosine(row: int, column: int) -> None:
    """A sphere's shadow is where lines towards the sun pass its centre within 1: an ellipse of 1 and 1 / sin e."""
    latlong, towards, strength = sun(row, column)
    lit = render_array(latlong, bounces=0)[0, ..., 0].double() * (math.pi / ALBEDO / strength)
    plane = (OWNER < 0) & UNCUT
    offset = CENTRES - PLACES[..., None, :]
    along = offset @ towards
    passing = (offset.square().sum(-1) - along.square()).sqrt()
    shadow = (passing < 1).any(-1)
    area = (2 * PLANE_HALF / SIZE) ** 2
    missing = float((1 - lit / towards[1])[plane].sum()) * area
    # Penumbrae, of up to 1.4 degrees on either side, are shed on both sides alike; sky rows of 0.7 degrees move a tip
    # by 0.6%.
    assert missing == pytest.approx(float(shadow[plane].sum()) * area, rel=0.02)
    deep, far = (passing < 0.9).any(-1) & plane, (passing > 1.1).all(-1) & plane
    assert float(lit[deep].abs().max()) < 1e-3
    # Two sky rows stand for the sun's height.
    torch.testing.assert_close(lit[far], towards[1].expand_as(lit[far]), rtol=5e-3, atol=0)
    cosine = NORMALS @ towards
    # A sphere's own side is dark; what others shade is left out.
    others = torch.where(torch.arange(9) == OWNER[..., None], math.inf, torch.where(along > 0, passing, math.inf))
    free = (OWNER >= 0) & UNCUT & (cosine > 0.1) & (others > 1.1).all(-1)
    torch.testing.assert_close(lit[free], cosine[free], rtol=0.01, atol=5e-3)


# --- Blender -----------------------------------------------------------------------------------------------------

RENDERS = [path.stem for path in sorted(BLENDER.glob("array_*.json"))]


def reference(stem: str) -> tuple[torch.Tensor, dict[str, Any]]:
    """A render, (rows, columns, 3), and what is known about it."""
    facts = json.loads((BLENDER / f"{stem}.json").read_text(encoding="utf-8"))
    channels = OpenEXR.File(str(BLENDER / f"{stem}.exr"), separate_channels=True).channels()
    return torch.stack([torch.from_numpy(channels[key].pixels.astype("float32")) for key in "RGB"], dim=-1), facts


def test_there_is_a_render_under_six_panoramas() -> None:
    assert sum(stem != "array_uniform" for stem in RENDERS) >= 6


@pytest.mark.parametrize("stem", RENDERS)
def test_the_array_agrees_with_blender(stem: str) -> None:
    """RMSE relative to the render's RMS, less the render's own noise in squares; its pixels are 2 x 2 of ours."""
    expected, facts = reference(stem)
    assert facts["noise_relative_rms"] < 0.02
    latlong = torch.from_numpy(environment(facts["panorama"], facts["panorama_height"]))[None]
    ours = render_array(latlong)[0].unflatten(0, (-1, 2)).unflatten(2, (-1, 2)).mean((1, 3))
    relative = float((ours - expected).square().mean() / expected.square().mean())
    assert math.sqrt(max(0.0, relative - facts["noise_relative_rms"] ** 2)) < 0.01, math.sqrt(relative)
    # Noise has no mean: brightness is compared without taking it off.
    assert float(ours.mean()) == pytest.approx(float(expected.mean()), rel=0.005)
