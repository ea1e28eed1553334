"""Light models against maps whose light is known, and the choice among them."""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import replace

import pytest
import torch
from hypothesis import assume, given, settings
from hypothesis import strategies as st
from tolerances import assert_close

from dl_core.errors import ImageError, OptionError
from dl_core.geometry import latlong_directions, latlong_energy, latlong_solid_angles
from dl_core.harmonics import sh_map, sh_project
from dl_core.lights import shading
from dl_core.lights.choose import LEVELS, choose_light, extract_lights
from dl_core.lights.discs import disc_maps
from dl_core.lights.model import Light, LightModel
from dl_core.lights.search import FULL_MAP
from dl_core.lights.shading import errors_of, shade_harmonics, shade_lights, shade_map, shade_model
from dl_core.metrics import irradiance
from dl_core.spheres import ALBEDO, MATERIALS, sphere_normals

HEIGHT = 256
SUMMED = 3e-4
"""Of band 2 on a map of 128 rows: what a pixel holds is taken at its centre."""


def towards(elevation: float, azimuth: float) -> tuple[float, float, float]:
    """Unit vector, degrees up and to the right of straight ahead."""
    up, right = math.radians(elevation), math.radians(azimuth)
    return math.cos(up) * math.sin(right), math.sin(up), -math.cos(up) * math.cos(right)


def angle(first: Sequence[float], second: Sequence[float]) -> float:
    """Degrees between unit vectors."""
    return 2 * math.degrees(math.asin(min(1.0, math.dist(first, second) / 2)))


def sun_map(light: Light, height: int = HEIGHT) -> torch.Tensor:
    """(height, 2 height, 3): a disc drawn with 8 x 8 samples in each pixel, scaled to its irradiance."""
    axis = torch.tensor(light.direction, dtype=torch.float64)
    radius = math.radians(light.angular_radius or 0)
    directions = latlong_directions(height).double()
    rows, columns = torch.nonzero(directions @ axis >= math.cos(radius + 2.5 * math.pi / height), as_tuple=True)
    steps = (torch.arange(8, dtype=torch.float64) + 0.5) / 8
    polar = ((rows[:, None] + steps) * (math.pi / height))[:, :, None].expand(-1, 8, 8)
    azimuth = (((columns[:, None] + steps) / (2 * height) - 0.5) * 2 * math.pi)[:, None, :].expand(-1, 8, 8)
    fine = torch.stack((polar.sin() * azimuth.sin(), polar.cos(), -polar.sin() * azimuth.cos()), dim=-1)
    inside = (fine @ axis >= math.cos(radius)).double() * polar.sin()
    cover = torch.zeros(height, 2 * height, dtype=torch.float64)
    cover[rows, columns] = inside.sum(dim=(1, 2)) / polar.sin().sum(dim=(1, 2))
    received = (cover * latlong_solid_angles(height) * (directions @ axis)).sum()
    return (cover / received)[..., None] * torch.tensor(light.irradiance, dtype=torch.float64)


def background(seed: int, spread: float, height: int = HEIGHT) -> torch.Tensor:
    """(height, 2 height, 3): harmonics to band 2 about an even light of 0.3 to 1.3."""
    generator = torch.Generator().manual_seed(seed)
    coefficients = torch.randn(1, 9, 3, generator=generator, dtype=torch.float64) * spread
    coefficients[:, 0] = math.sqrt(4 * math.pi) * (0.3 + torch.rand(3, generator=generator, dtype=torch.float64))
    return sh_map(coefficients, height)[0].double().clamp(min=0)


def with_suns(base: torch.Tensor, *lights: Light) -> torch.Tensor:
    return (base + sum(sun_map(light, base.shape[0]) for light in lights)).float()[None]


SUN = Light(towards(40, 30), (6.0, 5.0, 4.0), 1.0)


# --- models ------------------------------------------------------------------------------------------------------


def test_prices_and_names_count_what_describes_a_light() -> None:
    lamp = Light((0.0, 1.0, 0.0), (1.0, 2.0, 3.0))
    coefficients = torch.zeros(9, 3, dtype=torch.float64)
    assert LightModel(coefficients[:1]).parameters == 3
    assert LightModel(coefficients[:4]).name == "sh1"
    model = LightModel(coefficients, (lamp, replace(lamp, angular_radius=2.0), lamp))
    assert model.name == "sh2 + 2 directional + 1 area"
    assert model.parameters == 27 + 5 + 6 + 5


@given(
    elevation=st.floats(-90, 90),
    azimuth=st.floats(-180, 180),
    radius=st.floats(0, 40),
    height=st.sampled_from([32, 64, 128]),
)
def test_a_disc_gives_the_irradiance_it_is_drawn_for(
    elevation: float, azimuth: float, radius: float, height: int
) -> None:
    direction = torch.tensor([towards(elevation, azimuth)])
    drawn = disc_maps(direction, torch.tensor([math.radians(radius)]), height)
    # Drawn about pixel centres, discs a few pixels wide are off centre by part of a pixel.
    assert_close(irradiance(drawn, direction).double(), 1.0, dtype=torch.float32)
    assert float(drawn.min()) == 0
    smallest = 0.75 * math.pi / height
    lit = torch.nonzero(drawn[0, ..., 0])
    furthest = float(torch.acos((latlong_directions(height)[lit[:, 0], lit[:, 1]] @ direction[0]).clamp(-1, 1)).max())
    assert furthest <= max(math.radians(radius), smallest) + math.pi / height


def test_a_models_map_holds_its_light() -> None:
    coefficients = sh_project(background(1, 0.1, 64).float()[None], 2)[0]
    model = LightModel(coefficients, (SUN, replace(SUN, direction=towards(-60, 200), angular_radius=None)))
    rest = sh_map(coefficients[None], 128)
    added = model.radiance_map(128) - rest
    towards_sun = torch.tensor([SUN.direction])
    assert_close(irradiance(added, towards_sun)[0, 0], torch.tensor(SUN.irradiance), dtype=torch.float16)


def test_negative_harmonics_are_kept_and_their_cost_as_a_map_is_told() -> None:
    """1 + 3 y is negative below y = -1/3: raised to 0 there, it gains ∫ (-1 - 3y) = 2π (4/6) = 4π / 3."""
    coefficients = torch.zeros(4, 1, dtype=torch.float64)
    coefficients[0], coefficients[2] = math.sqrt(4 * math.pi), 3 * math.sqrt(4 * math.pi / 3)
    model = LightModel(coefficients.expand(-1, 3))
    assert float(model.harmonics_map(64).min()) < -1.9
    assert float(model.background_map(64).min()) == 0
    gained = latlong_energy(model.background_map(256)) / latlong_energy(model.harmonics_map(256)) - 1
    torch.testing.assert_close(gained, torch.full((1, 3), 1 / 3), rtol=1e-3, atol=0)
    assert model.negative_share() == pytest.approx(1 / 3, rel=2e-3)


# --- spheres -----------------------------------------------------------------------------------------------------


@pytest.mark.parametrize("name", MATERIALS)
def test_harmonics_shade_as_their_map_does(name: str) -> None:
    coefficients = sh_project(background(3, 0.15, 128).float()[None], 2)
    summed = shade_harmonics(coefficients, (name,))
    rendered = shade_map(sh_map(coefficients, 128), (name,))
    assert float(errors_of(summed, rendered)[name]) < SUMMED


@pytest.mark.parametrize("name", MATERIALS)
def test_negative_harmonics_shade_negatively(name: str) -> None:
    coefficients = torch.randn(1, 9, 3, generator=torch.Generator().manual_seed(4), dtype=torch.float64)
    positive, negative = (shade_harmonics(sign * coefficients, (name,))[name] for sign in (1, -1))
    assert_close(positive, -negative)


def test_a_directional_light_shades_by_the_cosine_and_is_not_seen_in_a_mirror() -> None:
    light = Light(towards(35, 130), (3.0, 2.0, 1.0))
    spheres = shade_lights((light, replace(light, angular_radius=3.0)), tuple(MATERIALS))
    normals = sphere_normals(24).reshape(-1, 3)[shading._covered(24)[0]]
    cosine = (normals @ torch.tensor(light.direction)).clamp(min=0)
    expected = cosine[:, None] * torch.tensor(light.irradiance) * (ALBEDO / math.pi)
    # The smallest disc on the map has a radius r of 1.05 degrees and an edge: 1 part in 6,000 of cosine, and half of it
    # above the horizon gives 2 r / (3π) of the irradiance where there should be none.
    atol = 2 * math.radians(1.3) / (3 * math.pi) * 3.0 * ALBEDO / math.pi
    torch.testing.assert_close(spheres["diffuse"][0], expected, rtol=1e-3, atol=atol)
    assert float(spheres["mirror"][0].max()) == 0
    assert float(spheres["mirror"][1].max()) > 0
    assert float(spheres["matte"][0].max()) > 0


def test_the_error_is_the_relative_rms() -> None:
    truth = shade_map(background(5, 0.1, 128).float()[None], tuple(MATERIALS))
    for factor, error in ((1.0, 0.0), (1.1, 0.1), (0.0, 1.0)):
        for found in errors_of({name: factor * sphere for name, sphere in truth.items()}, truth).values():
            assert float(found) == pytest.approx(error, abs=1e-6)


def test_a_sphere_that_is_lit_nowhere_has_no_error() -> None:
    dark = {"diffuse": torch.zeros_like(shade_map(torch.ones(1, 128, 256, 3), ("diffuse",))["diffuse"])}
    with pytest.raises(ImageError, match="no part of the diffuse sphere"):
        errors_of(dark, dark)


# --- extraction --------------------------------------------------------------------------------------------------


@st.composite
def suns(draw: st.DrawFn) -> Light:
    """Suns anywhere, and often at the poles and across the seam."""
    place = draw(st.sampled_from(["anywhere", "pole", "seam"]))
    azimuth = draw(st.floats(176, 184)) if place == "seam" else draw(st.floats(-180, 180))
    height = draw(st.floats(-1, 1))
    elevation = math.degrees(math.asin(height))
    if place == "pole":
        elevation = math.copysign(90 - 4 * abs(height), height)
    radius = draw(st.sampled_from([0.5, 1.0, 2.0, 4.0, 7.0, 10.0]))
    level = draw(st.floats(2.0, 20.0))
    colour = [level * draw(st.floats(0.5, 1.0)) for _ in range(3)]
    return Light(towards(elevation, azimuth), (colour[0], colour[1], colour[2]), radius)


@settings(max_examples=10)
@given(lights=st.lists(suns(), min_size=1, max_size=3), seed=st.integers(0, 2**16), spread=st.sampled_from([0.0, 0.15]))
def test_known_suns_are_found_again(lights: list[Light], seed: int, spread: float) -> None:
    """Within 1 degree and 2% of each colour, and, where pixels of 1.4 degrees show it, the radius too."""
    for index, light in enumerate(lights):
        assume(all(angle(light.direction, other.direction) > 45 for other in lights[:index]))
    model = extract_lights(with_suns(background(seed, spread), *lights), len(lights))
    assert len(model.lights) == len(lights)
    for light in lights:
        found = min(model.lights, key=lambda one: angle(one.direction, light.direction))
        assert angle(found.direction, light.direction) < 1
        assert found.irradiance == pytest.approx(light.irradiance, rel=0.02)
        assert light.angular_radius is not None
        if light.angular_radius >= 2:
            assert found.angular_radius == pytest.approx(light.angular_radius, abs=0.35)  # a quarter of a pixel


@settings(max_examples=5)
@given(seed=st.integers(0, 2**16))
def test_the_harmonics_are_those_of_what_is_left(seed: int) -> None:
    base = background(seed, 0.15)
    expected = sh_project(base.float()[None], 2)[0]
    found = extract_lights(with_suns(base, SUN), 1).coefficients
    # 2% of the sun's 6 units would leave 0.05 x 6 in a coefficient; found is a tenth of that.
    torch.testing.assert_close(found, expected, rtol=0, atol=0.03)


def test_no_light_is_lost_or_made() -> None:
    latlong = with_suns(background(9, 0.15), SUN)
    model = extract_lights(latlong, 1)
    assert_close(latlong_energy(model.radiance_map(128)), latlong_energy(latlong), dtype=torch.float16)


def test_an_even_map_has_no_lights() -> None:
    assert extract_lights(torch.ones(1, 32, 64, 3), 3).lights == ()


# --- the choice --------------------------------------------------------------------------------------------------


def band_map(band: int) -> torch.Tensor:
    """Even light and one harmonic of a band."""
    coefficients = torch.zeros(1, 9, 3, dtype=torch.float64)
    coefficients[:, 0] = math.sqrt(4 * math.pi)
    coefficients[:, band * band + band] += band > 0
    return sh_map(coefficients, 64).clamp(min=0)


@pytest.mark.parametrize(("band", "name"), [(0, "ambient"), (1, "sh1"), (2, "sh2")])
def test_a_band_takes_its_own_harmonics_and_no_more(band: int, name: str) -> None:
    decision = choose_light(band_map(band), 0.01)
    assert decision.chosen.name == name
    assert decision.chosen.parameters == 3 * (band + 1) ** 2
    assert decision.chosen.relative_error < 0.005


@pytest.mark.parametrize(
    ("materials", "radius", "name"),
    [
        (("diffuse",), 1.0, "sh2 + 1 directional"),
        (("diffuse", "matte"), 1.0, "sh2 + 1 directional"),
        (("matte",), 12.0, "sh2 + 1 area"),
        (("mirror",), 12.0, "sh2 + 1 area"),
    ],
)
def test_a_sun_takes_one_light_with_a_radius_only_where_it_shows(
    materials: tuple[str, ...], radius: float, name: str
) -> None:
    decision = choose_light(with_suns(background(2, 0.05), replace(SUN, angular_radius=radius)), 0.05, materials)
    assert decision.chosen.name == name


def test_two_suns_take_two_lights() -> None:
    other = Light(towards(20, -70), (5.0, 5.0, 6.0), 1.0)
    decision = choose_light(with_suns(background(2, 0.05), SUN, other), 0.05, ("diffuse", "matte"))
    assert decision.chosen.name.startswith("sh2 + 2")
    assert decision.cheapest(0.2).parameters <= decision.chosen.parameters


def test_an_even_map_is_ambient_light_at_any_tolerance() -> None:
    decision = choose_light(torch.ones(1, 16, 32, 3), 0.001)
    assert decision.chosen.name == "ambient"


def test_nothing_dearer_than_the_map_is_a_candidate() -> None:
    latlong = torch.tensor([[1.0, 9.0], [0.0, 1.0], [3.0, 0.0]]).T[None, None]
    names = [candidate.name for candidate in choose_light(latlong, 0.01).candidates]
    assert names == ["ambient", FULL_MAP]  # 1 x 2 pixels are 6 numbers


def test_noise_takes_the_full_map(generator: torch.Generator) -> None:
    latlong = torch.rand(1, 32, 64, 3, generator=generator) ** 8
    decision = choose_light(latlong, 0.05, ("mirror",))
    assert decision.chosen.name == FULL_MAP
    assert decision.chosen.parameters == 32 * 64 * 3
    assert decision.chosen.relative_error == 0


def some_map(seed: int) -> torch.Tensor:
    """Blobs of light over harmonics: nothing that fits any candidate."""
    generator = torch.Generator().manual_seed(seed)
    axes = torch.nn.functional.normalize(torch.randn(4, 3, generator=generator), dim=-1)
    colours = torch.rand(4, 3, generator=generator) * 8
    width = torch.rand(4, generator=generator) * 60 + 5
    blobs = torch.exp(width * (latlong_directions(64) @ axes.T - 1))
    return (background(seed, 0.15, 64).float() + blobs @ colours)[None]


@settings(max_examples=5)
@given(seed=st.integers(0, 2**16), materials=st.sets(st.sampled_from(list(MATERIALS)), min_size=1))
def test_the_choice_is_the_cheapest_within_the_tolerance(seed: int, materials: set[str]) -> None:
    decision = choose_light(some_map(seed), 0.1, sorted(materials), most_lights=3)
    assert decision.chosen.relative_error <= 0.1
    prices = [candidate.parameters for candidate in decision.candidates]
    assert prices == sorted(prices)
    cheaper = [one for one in decision.candidates if one.parameters < decision.chosen.parameters]
    assert all(one.relative_error > 0.1 for one in cheaper)
    for candidate in decision.candidates:
        assert candidate.relative_error == max(candidate.errors.values())
        assert set(candidate.errors) == materials
    levels = [decision.cheapest(level).parameters for level in (*LEVELS, 0.1)]
    assert levels == sorted(levels, reverse=True)


@settings(max_examples=3)
@given(seed=st.integers(0, 2**16))
def test_errors_are_those_of_the_models_own_spheres(seed: int) -> None:
    """What was summed on the way is what the finished model gives."""
    latlong = some_map(seed)
    decision = choose_light(latlong, 0.05, most_lights=2)
    truth = shade_map(extract_input(latlong), tuple(MATERIALS))
    for candidate in decision.candidates[:-1]:
        assert candidate.model is not None
        found = errors_of(shade_model(candidate.model, tuple(MATERIALS)), truth)
        assert candidate.errors == pytest.approx({name: float(error) for name, error in found.items()}, abs=1e-4)


def extract_input(latlong: torch.Tensor) -> torch.Tensor:
    """The map as spheres see it: at 128 rows, here each pixel four times."""
    return latlong.repeat_interleave(2, 1).repeat_interleave(2, 2)


@settings(max_examples=3)
@given(seed=st.integers(0, 2**16), factor=st.sampled_from([1e-4, 0.5, 1e4]))
def test_brightness_changes_the_lights_alone(seed: int, factor: float) -> None:
    latlong = some_map(seed)
    plain, bright = (choose_light(one, 0.05, ("diffuse",), most_lights=2) for one in (latlong, factor * latlong))
    assert [one.name for one in plain.candidates] == [one.name for one in bright.candidates]
    for one, other in zip(plain.candidates[:-1], bright.candidates[:-1], strict=True):
        assert one.errors == pytest.approx(other.errors, rel=1e-3, abs=1e-5)
        assert one.model is not None
        assert other.model is not None
        for light, twin in zip(one.model.lights, other.model.lights, strict=True):
            assert twin.irradiance == pytest.approx([factor * value for value in light.irradiance], rel=1e-3)
            assert twin.direction == pytest.approx(light.direction, abs=1e-4)


def test_a_mirrored_map_has_mirrored_lights() -> None:
    latlong = with_suns(background(2, 0.15), SUN)
    plain, mirrored = (extract_lights(one, 1).lights[0] for one in (latlong, latlong.flip(2)))
    x, y, z = plain.direction
    assert angle(mirrored.direction, (-x, y, z)) < 0.05
    assert mirrored.irradiance == pytest.approx(plain.irradiance, rel=1e-3)


def test_harmonics_are_rendered_once_for_all_maps(monkeypatch: pytest.MonkeyPatch) -> None:
    """A decision renders the map once a material, and each light where it is offered and once without its radius."""
    latlong = some_map(1)
    choose_light(latlong, 0.01, most_lights=1)
    rendered = 0
    original = shading._seen

    def counted(pictures: torch.Tensor) -> torch.Tensor:
        nonlocal rendered
        rendered += len(pictures)
        return original(pictures)

    monkeypatch.setattr(shading, "_seen", counted)
    choose_light(latlong, 0.01, most_lights=4)
    offers = 7  # at five radii from one start and two from the other
    as_a_map = 1
    assert rendered <= len(MATERIALS) * (1 + 4 * (offers + 1) + as_a_map)
    assert rendered > len(MATERIALS)


# --- what is refused ---------------------------------------------------------------------------------------------


@pytest.mark.parametrize("tolerance", [0.0, -0.1, 1.0, math.nan, math.inf])
def test_tolerances_are_checked(tolerance: float) -> None:
    with pytest.raises(OptionError, match=r"tolerance is .*above 0, below 1"):
        choose_light(band_map(0), tolerance)


def test_materials_and_maps_are_checked() -> None:
    with pytest.raises(OptionError, match="materials is 'chrome'; accepted: diffuse, matte, mirror"):
        choose_light(band_map(0), materials=("diffuse", "chrome"))
    with pytest.raises(OptionError, match="one or more of"):
        choose_light(band_map(0), materials=())
    with pytest.raises(OptionError, match="0 to 32"):
        choose_light(band_map(0), most_lights=33)
    with pytest.raises(OptionError, match="2 x height"):
        choose_light(torch.ones(1, 8, 8, 3))
    with pytest.raises(ImageError, match="holds 2 maps"):
        choose_light(torch.ones(2, 8, 16, 3))
    with pytest.raises(ImageError, match="holds no light"):
        choose_light(torch.zeros(1, 8, 16, 3))
    for value in (math.nan, math.inf, -1.0):
        with pytest.raises(ImageError, match="no radiance"):
            choose_light(torch.full((1, 8, 16, 3), value))
