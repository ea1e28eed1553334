"""Spherical harmonics against quadrature, closed forms and scipy's."""

from __future__ import annotations

import math

import numpy as np
import pytest
import torch
from hypothesis import given
from hypothesis import strategies as st
from scipy.special import sph_harm_y
from tolerances import assert_close

from dl_core.errors import OptionError
from dl_core.geometry import latlong_directions, latlong_energy
from dl_core.harmonics import BAND_LIMIT, sh_basis, sh_map, sh_project

BAND = 6


def quadrature(band: int) -> tuple[torch.Tensor, torch.Tensor]:
    """Directions and weights that integrate products of two functions up to a band exactly.

    Gauss-Legendre in height (2n - 1 degrees) and evenly spaced azimuths (orders below their number).
    """
    heights, weights = np.polynomial.legendre.leggauss(band + 1)
    azimuths = np.arange(2 * band + 1) * (2 * math.pi / (2 * band + 1))
    y, azimuth = np.meshgrid(heights, azimuths, indexing="ij")
    ring = np.sqrt(1 - y * y)
    directions = np.stack((ring * np.sin(azimuth), y, ring * np.cos(azimuth)), axis=-1).reshape(-1, 3)
    areas = np.repeat(weights, len(azimuths)) * (2 * math.pi / len(azimuths))
    return torch.from_numpy(directions), torch.from_numpy(areas)


@pytest.mark.parametrize("band", [0, 1, 4, BAND, BAND_LIMIT])
def test_the_basis_is_orthonormal(band: int) -> None:
    directions, areas = quadrature(band)
    basis = sh_basis(directions, band)
    # Recurrences over 32 bands and a thousand terms lose four of float64's sixteen digits.
    torch.testing.assert_close(
        basis.T @ (areas[:, None] * basis), torch.eye((band + 1) ** 2, dtype=torch.float64), rtol=0, atol=1e-12
    )


def test_the_basis_is_scipys(generator: torch.Generator) -> None:
    """Real functions from scipy's complex ones: √2 times real and imaginary part, without their phase (-1)^m."""
    directions = torch.nn.functional.normalize(torch.randn(40, 3, generator=generator, dtype=torch.float64), dim=-1)
    b, c, a = directions.numpy().T
    polar, azimuth = np.arccos(c), np.arctan2(b, a)
    expected = []
    for degree in range(BAND + 1):
        for order in range(-degree, degree + 1):
            value = sph_harm_y(degree, abs(order), polar, azimuth) * (-1) ** order
            factor = 1 if order == 0 else math.sqrt(2)
            expected.append(factor * (value.imag if order < 0 else value.real))
    found = sh_basis(directions, BAND).numpy()
    np.testing.assert_allclose(found, np.stack(expected, axis=-1), rtol=0, atol=1e-12)


def test_the_first_four_are_the_ones_everyone_prints() -> None:
    right, up, back = torch.eye(3)
    band_0, band_1 = 0.5 * math.sqrt(1 / math.pi), math.sqrt(3 / (4 * math.pi))
    rows = [[band_0, band_1, 0, 0], [band_0, 0, band_1, 0], [band_0, 0, 0, band_1]]
    assert_close(sh_basis(torch.stack((right, up, back)), 1), torch.tensor(rows, dtype=torch.float64))


@pytest.mark.parametrize("height", [1, 5, 32, 128])
def test_an_even_map_has_band_0_alone(height: int) -> None:
    band = min(4, height)
    found = sh_project(torch.ones(1, height, 2 * height, 1), band)[0, :, 0]
    expected = torch.zeros((band + 1) ** 2, dtype=torch.float64)
    expected[0] = math.sqrt(4 * math.pi)
    # Eight nodes integrate a single row of 180 degrees to 1e-9, more rows to rounding.
    torch.testing.assert_close(found, expected, rtol=0, atol=1e-6 if height == 1 else 1e-11)


def test_band_0_is_the_energy(generator: torch.Generator) -> None:
    latlong = torch.rand(2, 24, 48, 3, generator=generator)
    assert_close((sh_project(latlong, 2)[:, 0] * math.sqrt(4 * math.pi)).float(), latlong_energy(latlong))


def test_pixels_are_integrated_not_sampled() -> None:
    """A coarse map and the same map with every pixel split have the same coefficients."""
    coarse = torch.rand(1, 6, 12, 3, generator=torch.Generator().manual_seed(1))
    fine = coarse.repeat_interleave(9, 1).repeat_interleave(9, 2)
    # Coarse rows of 30 degrees hold the quadrature to 1e-9.
    torch.testing.assert_close(sh_project(coarse, 4), sh_project(fine, 4), rtol=0, atol=1e-8)


@given(seed=st.integers(0, 2**16))
def test_coefficients_come_back_from_their_map(seed: int) -> None:
    wanted = torch.randn(1, 25, 3, generator=torch.Generator().manual_seed(seed), dtype=torch.float64)
    found = sh_project(sh_map(wanted, 128), 4)
    # Pixel means against pixel centres: relative l(l + 1) (π/128)² / 24 = 5e-4 at band 4, of terms up to 3.
    torch.testing.assert_close(found, wanted, rtol=0, atol=3e-3)


def test_a_lamp_has_the_basis_of_its_direction() -> None:
    latlong = torch.zeros(1, 256, 512, 1)
    latlong[0, 70, 100] = 1
    energy = float(latlong_energy(latlong))
    expected = sh_basis(latlong_directions(256)[70, 100], 4) * energy
    # The pixel's extent of 0.7 degrees blurs band 4 by 1e-4 of itself.
    torch.testing.assert_close(sh_project(latlong, 4)[0, :, 0], expected, rtol=1e-3, atol=1e-4 * energy)


@pytest.mark.parametrize("band", [-1, 33])
def test_bands_are_checked(band: int) -> None:
    with pytest.raises(OptionError, match="0 to 32"):
        sh_project(torch.ones(1, 64, 128, 3), band)


def test_maps_and_coefficients_are_checked() -> None:
    with pytest.raises(OptionError, match="2 x height"):
        sh_project(torch.ones(1, 8, 8, 3), 2)
    with pytest.raises(OptionError, match="up to 2, the rows"):
        sh_project(torch.ones(1, 2, 4, 3), 3)
    with pytest.raises(OptionError, match="1, 4, 9"):
        sh_map(torch.ones(1, 5, 3, dtype=torch.float64), 8)
