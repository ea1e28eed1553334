"""Taking one light out of a map: where it is, how wide, what it gives, and the map that is left.

A light is what stands above its surroundings within a cap of a given radius. The surroundings are a plane fitted to the
ring outside the cap, without the ring's own lamps, and the light is all that the cap holds above (or below) that plane:
what is left in the cap is the plane, and nothing is lost or made. Its direction and irradiance are those of the
excess's light vector ∫ L l dω, which is exact for any distribution; its angular radius is that of the uniform disc
with the same share of energy squared, (∫ L dω)² / ∫ L² dω, which is the solid angle of such a disc and, of a peaked
light, that of its core.

The right radius of the cap is not known from the map alone: a sun with its glare is wide for a diffuse sphere and
narrow for a mirror. So a light is offered at several, and who asks chooses.

Source: Gershun, "The light field" (1939), for the light vector; the rest is this package's own.
"""

from __future__ import annotations

import math
from dataclasses import dataclass
from functools import lru_cache
from typing import Final

import torch
import torch.nn.functional as F
from jaxtyping import Float, Int
from torch import Tensor

from ..exposure import luminance
from ..geometry import latlong_directions, latlong_solid_angles
from ..harmonics import sh_basis
from ..resize import resize_latlong
from ..shapes import Latlong
from .model import Light

__all__ = ["Extraction", "offer_lights"]

_NEAR_SCALES: Final = (2.5, 4.0, 6.5, 10.0, 16.0)
_FAR_SCALES: Final = (16.0, 25.0)
"""Radii of caps in degrees, each about 1.6 times the one before, from either start."""
_NEAR, _FAR = 8.0, 24.0
"""Radii in degrees of the caps that compete for the most light: for lamps and suns, and for windows and glare."""
_SEARCH_ROWS: Final = 32
_RECENTRINGS: Final = 6
_SPARE: Final = 1.1
_MARGIN: Final = 1.5
"""Factor and rows by which a cap is wider than its light's disc at least: a disc that is cut off measures less than it
is, and pixels that its edge crosses belong to it."""
_WIDENINGS: Final = 6
"""Times that a cap is widened because its light's disc is not all in it, and by what factor at least."""
_STEP: Final = 1.3
_OUTSHINES: Final = 3.0
"""Luminance relative to the ring's median from which a pixel of the ring is a lamp of its own."""


@dataclass(frozen=True)
class Extraction:
    """A light, and what it takes out of its map.

    Attributes:
        light: with an angular radius.
        pixels: which pixels of the map change, row by row.
        excess: (m, 3) radiance that is taken from each, float64; negative where the surroundings are brighter.
    """

    light: Light
    pixels: Int[Tensor, "m"]
    excess: Float[Tensor, "m 3"]

    def rest(self, latlong_hdr: Latlong) -> Latlong:
        """The map without the light, 0 or above."""
        left = latlong_hdr.flatten(1, 2).clone()
        left[0, self.pixels] = (left[0, self.pixels].double() - self.excess).clamp(min=0).float()
        return left.reshape(latlong_hdr.shape)

    def harmonics(self, height: int) -> Float[Tensor, "k 3"]:
        """Coefficients to band 2 of what is taken, each pixel counted at its centre."""
        grid = _grid(height)
        return grid.basis[self.pixels].T @ (self.excess * grid.areas[self.pixels, None])


@dataclass(frozen=True)
class _Grid:
    """Pixels of a map in one row.

    Attributes:
        near: (n, 3) directions in float32, to tell which are near.
        directions: (n, 3) float64.
        areas: (n,) solid angles.
        basis: (n, 9) harmonics.
        row: angle of a row, radians.
    """

    near: Tensor
    directions: Tensor
    areas: Tensor
    basis: Tensor
    row: float


@lru_cache(maxsize=4)
@torch.inference_mode(mode=False)  # a cached inference tensor could never take part in a gradient
def _grid(height: int) -> _Grid:
    directions = F.normalize(latlong_directions(height).double().reshape(-1, 3), dim=-1)
    areas = latlong_solid_angles(height).double().expand(-1, 2 * height).reshape(-1)
    return _Grid(directions.float(), directions, areas, sh_basis(directions, 2), math.pi / height)


@dataclass(frozen=True)
class _Map:
    """A map's pixels in one row: radiance (n, 3) and luminance (n,), float32, on their grid."""

    radiance: Tensor
    shine: Tensor
    grid: _Grid

    @classmethod
    def of(cls, latlong_hdr: Latlong) -> _Map:
        radiance = latlong_hdr[0].reshape(-1, 3)
        return cls(radiance, luminance(radiance)[:, 0], _grid(latlong_hdr.shape[1]))


def offer_lights(latlong_hdr: Latlong, coefficients: Float[Tensor, "k 3"]) -> list[Extraction]:
    """What can be taken for the map's strongest light, at several radii of its cap.

    Args:
        latlong_hdr: (1, H, 2H, 3) linear radiance, 0 or above, float32; at least 32 rows.
        coefficients: (9, 3) the map's own harmonics.

    Returns:
        Lights of positive irradiance; none for a map in which nothing stands out.
    """
    world = _Map.of(latlong_hdr)
    near, far = _starts(world, coefficients)
    trials = [(near, scale) for scale in _NEAR_SCALES] + [(far, scale) for scale in _FAR_SCALES]
    return list(filter(None, (_extract(world, axis, math.radians(scale)) for axis, scale in trials)))


# --- where to look -----------------------------------------------------------------------------------------------


@lru_cache(maxsize=2)
@torch.inference_mode(mode=False)
def _within(radius: float) -> Float[Tensor, "n n"]:
    """1 for pixels of the search's map in the cap around each."""
    directions = _grid(_SEARCH_ROWS).near
    return (directions @ directions.T >= math.cos(math.radians(radius))).float()


def _starts(world: _Map, coefficients: Tensor) -> tuple[Tensor, Tensor]:
    """Two directions to look in: the brightest pixel of the richest small cap, and the middle of the richest wide one.

    Caps compete by what the map holds beyond its own harmonics, which the model has already.
    """
    grid, coarse = world.grid, _grid(_SEARCH_ROWS)
    beyond = world.shine - (grid.basis @ luminance(coefficients)[:, 0]).float()
    height = round(math.pi / grid.row)
    energy = resize_latlong(beyond.reshape(1, height, 2 * height, 1), _SEARCH_ROWS).flatten() * coarse.areas.float()
    near, far = (coarse.near[int((_within(radius) @ energy).argmax())] for radius in (_NEAR, _FAR))
    bright = world.shine * (grid.near @ near >= math.cos(math.radians(_NEAR)))
    return grid.near[int(bright.argmax())], far


# --- one light ---------------------------------------------------------------------------------------------------


def _extract(world: _Map, axis: Float[Tensor, "3"], radius: float) -> Extraction | None:
    """The light in the cap that a walk from `axis` ends at, or in one wide enough for its disc; None for none."""
    centre = _recentred(world, axis, radius)
    found = None if centre is None else _taken(world, centre, radius)
    for _ in range(_WIDENINGS):
        if found is None:
            return None
        whole = _SPARE * math.radians(found.light.angular_radius or 0.0) + _MARGIN * world.grid.row
        if whole <= radius:
            break
        radius = max(whole, _STEP * radius)
        found = _taken(world, torch.tensor(found.light.direction), radius)
    return found


def _recentred(world: _Map, axis: Float[Tensor, "3"], radius: float) -> Float[Tensor, "3"] | None:
    """The axis of a cap, walked to the centroid of what stands above the ring around it; None if nothing does."""
    grid = world.grid
    for _ in range(_RECENTRINGS):
        cap, ring = _cap_and_ring(grid, axis, radius)
        shine = (world.shine[cap] - world.shine[ring].median()).clamp(min=0) * grid.areas[cap]
        if float(shine.sum()) <= 0:
            return None
        before, axis = axis, F.normalize(shine @ grid.directions[cap], dim=0).float()
        if float(torch.linalg.norm(axis - before)) < 0.05 * grid.row:
            break
    return axis


def _taken(world: _Map, axis: Float[Tensor, "3"], radius: float) -> Extraction | None:
    """All that a cap holds above its surroundings, as a light; None where they are brighter."""
    grid = world.grid
    cap, ring = _cap_and_ring(grid, axis, radius)
    excess = world.radiance[cap].double() - _surroundings(world, axis.double(), cap, ring)
    vectors = (excess * grid.areas[cap, None]).T @ grid.directions[cap]
    direction = F.normalize(luminance(vectors.T)[:, 0], dim=0)
    irradiance = vectors @ direction
    if float(direction @ axis.double()) <= 0 or float(luminance(irradiance)) <= 0:
        return None
    kept = (irradiance > 0).double()  # a light has no negative colour: what it lacks stays in the map
    disc = _disc_radius(luminance(excess)[:, 0].clamp(min=0), grid.areas[cap], grid.row)
    light = Light(_three(direction), _three(irradiance * kept), math.degrees(min(radius, disc)))
    return Extraction(light, cap, excess * kept)


def _three(values: Float[Tensor, "3"]) -> tuple[float, float, float]:
    first, second, third = values.tolist()
    return first, second, third


def _disc_radius(shine: Float[Tensor, "n"], areas: Float[Tensor, "n"], row: float) -> float:
    """Radius, in radians, of the disc with the same (∫ L dω)² / ∫ L² dω on a map of given rows.

    A map's pixels blur the disc's edge over a row, which takes 2π r row / 6 from ∫ L² dω.
    """
    solid_angle = float((shine * areas).sum() ** 2 / (shine.square() * areas).sum())
    blurred = math.acos(max(-1.0, 1 - solid_angle / (2 * math.pi)))
    return math.hypot(row / 6, blurred) - row / 6


def _cap_and_ring(grid: _Grid, axis: Tensor, radius: float) -> tuple[Int[Tensor, "m"], Int[Tensor, "n"]]:
    """Pixels of a cap, and of the ring around it; pixels that straddle the cap's edge are in neither."""
    cosines = grid.near @ axis
    inner = radius + 1.5 * grid.row
    outer = inner + max(3 * grid.row, radius / 3)
    cap = cosines >= min(math.cos(radius), float(cosines.max()))
    ring = (cosines <= math.cos(inner)) & (cosines >= math.cos(outer))
    return torch.nonzero(cap).squeeze(1), torch.nonzero(ring).squeeze(1)


def _surroundings(
    world: _Map, axis: Float[Tensor, "3"], cap: Int[Tensor, "m"], ring: Int[Tensor, "n"]
) -> Float[Tensor, "m 3"]:
    """What the ring around a cap says that the cap's pixels would be without a light."""
    grid, shine = world.grid, world.shine[ring]
    ring = ring[shine <= _OUTSHINES * shine.median()]
    places, weights = _tangent(grid.directions[ring], axis), grid.areas[ring].sqrt()[:, None]
    plane = torch.linalg.lstsq(places * weights, world.radiance[ring].double() * weights).solution
    return (_tangent(grid.directions[cap], axis) @ plane).clamp(min=0)


def _tangent(directions: Float[Tensor, "n 3"], axis: Float[Tensor, "3"]) -> Float[Tensor, "n 3"]:
    """1, x and y: coordinates in a plane across the axis, and the constant."""
    other = F.one_hot(axis.abs().argmin(), 3).to(axis)
    x = F.normalize(torch.linalg.cross(axis, other), dim=0)
    y = torch.linalg.cross(axis, x)
    return torch.stack((torch.ones_like(directions[:, 0]), directions @ x, directions @ y), dim=-1)
