"""Real spherical harmonics: the basis, a map's coefficients, and the map of given coefficients.

Axes: the polar axis is up (+Y), azimuth counts from behind the camera (+Z) towards the right of the photograph (+X).
With (a, b, c) = (z, x, y) the basis is the usual one of graphics in a, b, c: Y00 = ½√(1/π), Y1,-1 = √(3/4π) b,
Y10 = √(3/4π) c, Y11 = √(3/4π) a, without the Condon-Shortley phase.

Coefficients come in the order l² + l + m: L00, L1-1, L10, L11, L2-2, and so on.

Sources: Ramamoorthi and Hanrahan, An efficient representation for irradiance environment maps (SIGGRAPH 2001), for
basis and order; Press et al., Numerical Recipes (2007), Sec. 6.7, for the recurrence of normalized Legendre functions.
"""

from __future__ import annotations

import math
from functools import lru_cache
from typing import Final

import numpy as np
import torch
from jaxtyping import Float
from torch import Tensor

from .errors import OptionError
from .geometry import latlong_directions
from .shapes import Directions, Latlong

__all__ = ["BAND_LIMIT", "sh_basis", "sh_map", "sh_project"]

BAND_LIMIT: Final = 32
"""Highest band that is computed; light is usually described by band 2 to 4."""

_NODES: Final = 8
"""Gauss-Legendre nodes in a row of a map: with one band per row they integrate to 1e-12."""


def _require_band(band: int) -> None:
    if not 0 <= band <= BAND_LIMIT:
        raise OptionError("band", band, f"0 to {BAND_LIMIT}")


def _legendre(cosine: Tensor, sine: Tensor, band: int) -> dict[tuple[int, int], Tensor]:
    """Associated Legendre functions of order m >= 0, normalized so that ∫ P² over the sphere's height is 1 / 2π."""
    values = {(0, 0): torch.full_like(cosine, math.sqrt(1 / (4 * math.pi)))}
    for m in range(1, band + 1):
        values[m, m] = values[m - 1, m - 1] * sine * math.sqrt((2 * m + 1) / (2 * m))
    for m in range(band):
        values[m + 1, m] = values[m, m] * cosine * math.sqrt(2 * m + 3)
    for m in range(band + 1):
        for l in range(m + 2, band + 1):  # noqa: E741  the degree's own letter
            scale = math.sqrt((4 * l * l - 1) / (l * l - m * m))
            before = math.sqrt(((l - 1) ** 2 - m * m) / (4 * (l - 1) ** 2 - 1))
            values[l, m] = scale * (cosine * values[l - 1, m] - before * values[l - 2, m])
    return values


def _orders(band: int) -> list[tuple[int, int]]:
    """(l, m) of the coefficients, in their order."""
    return [(l, m) for l in range(band + 1) for m in range(-l, l + 1)]  # noqa: E741


def sh_basis(directions: Directions, band: int) -> Float[Tensor, "*n k"]:
    """Values of the basis in given directions.

    Args:
        directions: (..., 3) unit vectors.
        band: highest degree l, 0 to 32.

    Returns:
        (..., (band + 1)²), in float64: the functions are orthonormal over the sphere.

    Raises:
        OptionError: a band outside 0 to 32.
    """
    _require_band(band)
    b, c, a = directions.double().unbind(-1)
    legendre = _legendre(c, torch.hypot(a, b), band)
    azimuth = torch.atan2(b, a)
    waves = {m: _wave(azimuth, m) for m in range(-band, band + 1)}
    return torch.stack([legendre[l, abs(m)] * waves[m] for l, m in _orders(band)], dim=-1)  # noqa: E741


def _wave(azimuth: Tensor, m: int) -> Tensor:
    """The azimuthal factor: sine for m < 0, cosine for m > 0; of mean square 1 over the turn."""
    if m == 0:
        return torch.ones_like(azimuth)
    return math.sqrt(2) * (torch.sin(-m * azimuth) if m < 0 else torch.cos(m * azimuth))


@lru_cache(maxsize=8)
def _row_integrals(height: int, band: int) -> dict[tuple[int, int], Tensor]:
    """∫ P(cos θ) sin θ dθ over each row of a map."""
    nodes, weights = (torch.from_numpy(values) for values in np.polynomial.legendre.leggauss(_NODES))
    step = math.pi / height
    polar = (torch.arange(height, dtype=torch.float64)[:, None] + 0.5 + nodes / 2) * step
    measure = weights * torch.sin(polar) * (step / 2)
    legendre = _legendre(torch.cos(polar), torch.sin(polar), band)
    return {order: (values * measure).sum(-1) for order, values in legendre.items()}


@lru_cache(maxsize=8)
def _column_integrals(width: int, band: int) -> Float[Tensor, "m w"]:
    """∫ of the azimuthal factors over each column of a map, for m from -band to band; in closed form."""
    # The left edge of a map looks to +Z, and a quarter of the way right of it to -X.
    azimuth = (torch.arange(width, dtype=torch.float64) + 0.5) * (-2 * math.pi / width)
    half = math.pi / width
    share = [2 * half if m == 0 else 2 * math.sin(m * half) / m for m in range(-band, band + 1)]
    return torch.stack([_wave(azimuth, m) * share[m + band] for m in range(-band, band + 1)])


def sh_project(latlong_hdr: Latlong, band: int) -> Float[Tensor, "b k c"]:
    """Coefficients of a map: ∫ L Y dω, with Y integrated exactly over every pixel.

    Args:
        latlong_hdr: (B, H, 2H, C) linear radiance, constant within a pixel.
        band: highest degree, 0 to 32 and at most H: a row must not hold a whole wave.

    Returns:
        (B, (band + 1)², C), float64, radiance units x √sr. A uniform map of radiance 1 gives √(4π), 0, 0, ...

    Raises:
        OptionError: a map that is not 2:1, or such a band.
    """
    height, width = latlong_hdr.shape[1:3]
    if width != 2 * height:
        raise OptionError("latlong", tuple(latlong_hdr.shape), "shape (batch, height, 2 x height, channels)")
    _require_band(band)
    if band > height:
        raise OptionError("band", band, f"up to {height}, the rows of the map")
    columns = _column_integrals(width, band).to(latlong_hdr.device)
    waves = torch.einsum("bhwc,mw->bmhc", latlong_hdr.double(), columns)
    rows = _row_integrals(height, band)
    terms = [
        torch.einsum("bhc,h->bc", waves[:, m + band], rows[l, abs(m)].to(waves))
        for l, m in _orders(band)  # noqa: E741
    ]
    return torch.stack(terms, dim=1)


def sh_map(coefficients: Float[Tensor, "b k c"], height: int) -> Latlong:
    """The map of given coefficients, at the pixel centres: (B, height, 2 height, C), float32; it may be negative.

    Raises:
        OptionError: a number of coefficients that is no square, or of a band above 32.
    """
    band = math.isqrt(coefficients.shape[1]) - 1
    if (band + 1) ** 2 != coefficients.shape[1]:
        raise OptionError("coefficients", coefficients.shape[1], "1, 4, 9, 16, ... terms")
    basis = sh_basis(latlong_directions(height, device=coefficients.device), band)
    return torch.einsum("hwk,bkc->bhwc", basis, coefficients.double()).float()
