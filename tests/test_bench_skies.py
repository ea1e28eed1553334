"""The analytic sky: a sun whose energy, place and irradiance are exact at any size of map."""

from __future__ import annotations

import math

import pytest
import torch

from dl_core.bench.skies import SunAndSky, sun_direction
from dl_core.errors import OptionError
from dl_core.geometry import latlong_coordinates, latlong_directions, latlong_energy, latlong_solid_angles
from dl_core.metrics import irradiance

BLACK = (0.0, 0.0, 0.0)


def sun_alone(elevation: float, azimuth: float, radius: float) -> SunAndSky:
    return SunAndSky(sun=sun_direction(elevation, azimuth), sun_radius=radius, zenith=BLACK, ground=BLACK)


@pytest.mark.parametrize("height", [16, 64, 256])
@pytest.mark.parametrize("radius", [0.266, 2.0, 20.0])
@pytest.mark.parametrize(("elevation", "azimuth"), [(30.0, 50.0), (5.0, 180.0), (90.0, 0.0)])
def test_the_suns_energy_is_exact(elevation: float, azimuth: float, radius: float, height: int) -> None:
    sky = sun_alone(elevation, azimuth, radius)
    expected = torch.tensor([sky.sun_energy])
    torch.testing.assert_close(latlong_energy(sky.latlong(height)), expected, rtol=1e-5, atol=0)


def test_the_suns_irradiance_is_as_stated() -> None:
    sky = sun_alone(40.0, 60.0, 0.266)
    facing = irradiance(sky.latlong(512), torch.tensor([sun_direction(40.0, 60.0)]))[0, 0]
    # A pixel of 0.35 degrees around the sun's centre: its cosine is above 1 - 1e-4.
    torch.testing.assert_close(facing, torch.tensor(sky.sun_irradiance), rtol=2e-4, atol=0)


@pytest.mark.parametrize("radius", [0.266, 3.0])
@pytest.mark.parametrize(("elevation", "azimuth"), [(30.0, 50.0), (0.0, 180.0), (75.0, -100.0), (90.0, 0.0)])
def test_the_sun_stands_where_it_should(elevation: float, azimuth: float, radius: float) -> None:
    latlong = sun_alone(elevation, azimuth, radius).latlong(128)
    weights = latlong_solid_angles(128) * latlong[0].sum(-1)
    centroid = (latlong_directions(128) * weights[..., None]).sum(dim=(0, 1))
    cosine = torch.nn.functional.cosine_similarity(centroid, torch.tensor(sun_direction(elevation, azimuth)), dim=0)
    # A sun smaller than a pixel of 1.4 degrees stands at the centre of the pixels it touches.
    assert math.degrees(math.acos(min(1.0, float(cosine)))) < 0.75


def test_directions_of_the_sun_follow_the_maps_convention() -> None:
    u, v = latlong_coordinates(torch.tensor([sun_direction(30.0, 90.0), sun_direction(0.0, 0.0)]))
    torch.testing.assert_close(u, torch.tensor([0.75, 0.5]))
    torch.testing.assert_close(v, torch.tensor([1 / 3, 0.5]))


def test_the_zenith_has_its_radiance() -> None:
    sky = SunAndSky()
    torch.testing.assert_close(sky.radiance(torch.tensor([0.0, 1.0, 0.0])), torch.tensor(sky.zenith))


def test_the_sky_is_the_cie_clear_sky() -> None:
    # CIE clear sky with the sun at 45 degrees, at the point 45 degrees up on the other side: χ = 90, Z = 45.
    # f(90°) = 1; f(45°) = 0.91 + 10 exp(-3π/4) + 0.45 / 2; φ(45°) / φ(0) = (1 - exp(-0.32 √2)) / (1 - exp(-0.32)).
    sky = SunAndSky(sun=sun_direction(45.0, 0.0), zenith=(1.0, 1.0, 1.0))
    opposite = torch.tensor(sun_direction(45.0, 180.0), dtype=torch.float64)
    sunward = 1 + 10 * (math.exp(-3 * math.pi / 4) - math.exp(-3 * math.pi / 2)) + 0.45 / 2
    expected = (1 - math.exp(-0.32 * math.sqrt(2))) / (1 - math.exp(-0.32)) / sunward
    assert float(sky.radiance(opposite)[0]) == pytest.approx(expected, rel=1e-6)


def test_the_ground_is_flat_grey() -> None:
    sky = SunAndSky()
    below = sky.latlong(32)[0, 17:]
    torch.testing.assert_close(below, torch.tensor(sky.ground).expand_as(below))


@pytest.mark.parametrize(
    ("options", "name"),
    [({"sun": (1.0, 1.0, 0.0)}, "sun"), ({"sun_radius": 0.0}, "sun_radius"), ({"sun_radius": math.nan}, "sun_radius")],
)
def test_impossible_suns_are_named(options: dict[str, object], name: str) -> None:
    with pytest.raises(OptionError) as raised:
        SunAndSky(**options)  # type: ignore[arg-type]
    assert raised.value.name == name
