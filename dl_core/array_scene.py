"""Nine matt spheres on a plane, seen from straight above, in the light of a map: with shadows and light between them.

Lengths are in radii of the spheres. The layout was measured on renders of the authors' scene: a square lattice of 3 x 3
spheres, 2.89 apart, with its diagonals along the sides of the picture; a camera 14.6 above the centres with a lens of
50 mm on 36 mm; a square plane that fills the frame, beyond which light comes from below the horizon. Theirs is turned
by -1.3 degrees in the picture and its plane ends just inside the frame; this one is straight, so that a quarter turn
leaves it as it is. What renders cannot tell was chosen: Lambert's law with an albedo of 0.8, and -Z at the top of the
picture, +X at its right.

Nothing here is random, and the picture is linear in the map. From a point, spheres cover circles of the sky, and each
row of the map is covered between azimuths that have a closed form; what is left of a row is the difference of its
running integral, taken where the gaps between covers begin and end. Where those are is computed once, for a quarter of
the picture: the other three are this quarter under the map turned by 90 degrees. Light between surfaces is gathered
along fixed directions from patches, as often as it bounces, and scaled so that what is not open sky is surface.

Sources: DiffusionLight, Sec. 5.1, and Weber et al., Editable indoor lighting estimation (ECCV 2022), for the scene;
Goral et al., Modeling the interaction of light between diffuse surfaces (SIGGRAPH 1984), for the bounces.
"""

from __future__ import annotations

import math
from dataclasses import dataclass
from functools import lru_cache
from typing import Final

import torch
import torch.nn.functional as F
from jaxtyping import Bool, Float, Int
from torch import Tensor

from .errors import OptionError
from .geometry import require_latlong, sample_latlong
from .resize import resize_latlong
from .shapes import Latlong

__all__ = ["ALBEDO", "BOUNCES", "CAMERA_HEIGHT", "PLANE_HALF", "SIZE", "SPACING", "render_array"]

SPACING: Final = 2.89
"""Of the lattice, in radii."""
CAMERA_HEIGHT: Final = 15.6
"""Of the camera above the plane, in radii: 14.6 above the centres."""
PLANE_HALF: Final = CAMERA_HEIGHT * 18 / 50
"""Half of the plane's side, in radii: what 50 mm on 36 mm see from there."""
SIZE: Final = 256
"""Rows and columns of the picture."""
ALBEDO: Final = 0.8
BOUNCES: Final = 12
"""Of light between surfaces: what is left after them is 1e-4 of the picture's RMS."""

_MAP_ROWS: Final = 128
_ROWS: Final = 2 * _MAP_ROWS
"""Rows of the sky in which shadows are found: two to a row of the map, or a small sun's shadow has steps."""
_COLUMNS: Final = 512
"""Azimuths at which a shadow may begin."""
_CELLS: Final = 64
"""Patches along a side of the plane."""
_RINGS: Final = 16
"""Patches of a sphere from pole to pole; twice as many around it."""
_GATHERED: Final = 256
"""Directions along which a point gathers light from surfaces."""
_SUBPIXELS: Final = 4


def _centres() -> Float[Tensor, "9 3"]:
    step = SPACING / math.sqrt(2)
    return torch.tensor([[(i + j) * step, 1.0, (i - j) * step] for i in (-1, 0, 1) for j in (-1, 0, 1)])


def _turned(vectors: Float[Tensor, "*n 3"]) -> Float[Tensor, "*n 3"]:
    """A quarter turn to the right: what was ahead is right."""
    x, y, z = vectors.unbind(-1)
    return torch.stack((-z, y, x), dim=-1)


@dataclass(frozen=True)
class _Points:
    """Points of one kind of surface.

    Attributes:
        places: (n, 3), the plane at y = 0.
        normals: (n, 3) unit vectors.
        owner: (n,) which sphere each is on; -1 on the plane.
    """

    places: Tensor
    normals: Tensor
    owner: Tensor

    def __getitem__(self, chosen: Tensor) -> _Points:
        return _Points(self.places[chosen], self.normals[chosen], self.owner[chosen])

    @property
    def in_quarter(self) -> Bool[Tensor, "n"]:
        """Which lie right of the middle and ahead of it."""
        return (self.places[:, 0] > 0) & (self.places[:, 2] < 0)

    @property
    def on_spheres(self) -> bool:
        return bool((self.owner >= 0).any())

    def turned(self) -> _Points:
        places = _turned(self.places)
        owner = torch.cdist(_turned(_centres()), _centres()).argmin(-1)[self.owner]
        return _Points(places, _turned(self.normals), torch.where(self.owner < 0, self.owner, owner))


def _on_plane(places: Float[Tensor, "n 3"]) -> _Points:
    up = torch.tensor([0.0, 1.0, 0.0]).expand_as(places)
    return _Points(places, up, torch.full((len(places),), -1))


def _on_spheres(normals: Float[Tensor, "n 3"], owner: Int[Tensor, "n"]) -> _Points:
    return _Points(_centres()[owner] + normals, normals, owner)


def _entries(places: Float[Tensor, "n 3"], directions: Float[Tensor, "n rays 3"]) -> Float[Tensor, "n rays 9"]:
    """How far rays from outside enter each sphere; infinite where they miss it."""
    along = directions @ _centres().T - (directions @ places[..., None])
    beyond = torch.cdist(places, _centres()).square()[:, None] - 1
    root = along.square() - beyond
    return torch.where((root > 0) & (along > 0), along - root.clamp(min=0).sqrt(), math.inf)


# --- open sky ----------------------------------------------------------------------------------------------------


@dataclass(frozen=True)
class _Sky:
    """What points see of the sky: differences of the rows' running integrals.

    Attributes:
        normals: (n, 3).
        starts: (n,) where the entries of each begin.
        low: (entries,) of the table of integrals, where open sky begins.
        high: where it ends.
    """

    normals: Tensor
    starts: Tensor
    low: Tensor
    high: Tensor

    def irradiance(self, table: Float[Tensor, "3 cells width"]) -> Float[Tensor, "n width"]:
        """Light from the open sky, given `_integrals`."""
        starts, low, high = (part.to(table.device) for part in (self.starts, self.low, self.high))
        light = table.new_zeros(len(starts), table.shape[2])
        for part, along in zip(table, self.normals.to(table).unbind(1), strict=True):
            if bool(along.any()):
                seen = F.embedding_bag(high, part, starts, mode="sum") - F.embedding_bag(low, part, starts, mode="sum")
                light = light + along[:, None] * seen
        return light


def _sky_polar() -> Float[Tensor, "rows"]:
    return (torch.arange(_ROWS) + 0.5) * (math.pi / _ROWS)


def _arcs(centre: Float[Tensor, "*n"], half_cosine: Float[Tensor, "*n"]) -> tuple[Int[Tensor, "*n"], Int[Tensor, "*n"]]:
    """Columns where arcs around an azimuth begin, and where they end, which may be in the next turn.

    Args:
        centre: azimuths in radians.
        half_cosine: cosine of half an arc's width; no arc above 1, the whole row below -1.
    """
    unit = _COLUMNS / (2 * math.pi)
    middle, half = (centre + math.pi) * unit, torch.acos(half_cosine.clamp(-1, 1)) * unit
    begin = torch.round(middle - half)
    length = (torch.round(middle + half) - begin).int()
    first = torch.where(length > 0, torch.remainder(begin, _COLUMNS).int(), 0)
    return first, first + length


def _gaps(first: Int[Tensor, "*n arcs"], last: Int[Tensor, "*n arcs"]) -> tuple[Tensor, Tensor]:
    """What arcs leave of a row: beginnings and ends, one more than arcs; nothing where an end is not greater."""
    shift = 2 * _COLUMNS + 1
    ordered = (first * shift + last).sort(dim=-1).values
    over = (last.amax(-1, keepdim=True) - _COLUMNS).clamp(min=0)
    reached = torch.cat((over, ordered % shift), dim=-1).cummax(-1).values.clamp(max=_COLUMNS)
    begun = torch.div(ordered, shift, rounding_mode="floor")
    return reached, torch.cat((begun, torch.full_like(over, _COLUMNS)), dim=-1)


def _caps(axes: Tensor, cosine: Tensor, polar: Tensor) -> tuple[Tensor, Tensor]:
    """Arcs that circles of the sky cover of each row: (n, caps, 3) -> (n, rows, caps)."""
    azimuth = torch.atan2(axes[..., 0], -axes[..., 2])[:, None]
    height, across = axes[:, None, :, 1], torch.hypot(axes[..., 0], axes[..., 2]).clamp(min=1e-6)[:, None]
    row = polar[None, :, None]
    half = (cosine[:, None] - torch.cos(row) * height) / (torch.sin(row) * across)
    return _arcs(azimuth.expand_as(half), half)


def _sphere_caps(points: _Points, polar: Tensor) -> tuple[Tensor, Tensor]:
    towards = _centres() - points.places[:, None]
    distance = towards.norm(dim=-1)
    own = torch.arange(9) == points.owner[:, None]
    cosine = (1 - 1 / distance.clamp(min=1).square()).sqrt()
    return _caps(towards / distance[..., None], torch.where(own, 2.0, cosine), polar)


def _plane_arcs(points: _Points, polar: Tensor) -> tuple[Tensor, Tensor]:
    """What the plane covers of rows below the horizon: all but the arcs past each of its sides."""
    reach = points.places[:, None, 1] * torch.tan(math.pi - polar)
    x, z = points.places[:, 0], points.places[:, 2]
    margin = PLANE_HALF - torch.stack((-z, x, z, -x), dim=-1)
    side = torch.arange(4) * (math.pi / 2)
    half = margin[:, None] / reach.clamp(min=1e-6)[..., None]
    first, last = _gaps(*_arcs(side.expand_as(half), torch.where(polar[:, None] > math.pi / 2, half, -1.0)))
    return torch.where(last > first, first, 0), torch.where(last > first, last, 0)


def _covers(points: _Points, polar: Tensor) -> tuple[Tensor, Tensor]:
    covers = [_sphere_caps(points, polar)]
    if points.on_spheres:
        level = torch.zeros(len(points.places), 1)
        covers += [_caps(-points.normals[:, None], level, polar), _plane_arcs(points, polar)]
    return torch.cat([first for first, _ in covers], -1), torch.cat([last for _, last in covers], -1)


def _sky(points: _Points) -> _Sky:
    """Open sky of points of one kind; from the plane, only rows above the horizon are sky."""
    polar = _sky_polar() if points.on_spheres else _sky_polar()[: _ROWS // 2]
    counts, low, high = [], [], []
    for some in torch.arange(len(points.places)).split(512):
        begin, end = _gaps(*_covers(points[some], polar))
        row = (torch.arange(len(polar), dtype=torch.int32) * (_COLUMNS + 1))[None, :, None]
        open_sky = end > begin
        counts.append(open_sky.sum((1, 2)))
        low.append((row + begin)[open_sky])
        high.append((row + end)[open_sky])
    count = torch.cat(counts)
    return _Sky(points.normals, (count.cumsum(0) - count).int(), torch.cat(low), torch.cat(high))


def _sphere_directions(rows: int, columns: int) -> Float[Tensor, "rows columns 3"]:
    """Middles of the pixels of a map of any shape."""
    polar = ((torch.arange(rows) + 0.5) * (math.pi / rows))[:, None]
    azimuth = ((torch.arange(columns) + 0.5) * (2 * math.pi / columns) - math.pi)[None]
    across = torch.sin(polar)
    parts = (across * torch.sin(azimuth), torch.cos(polar).expand(-1, columns), -across * torch.cos(azimuth))
    return torch.stack(parts, dim=-1)


@lru_cache(maxsize=1)
@torch.inference_mode(mode=False)  # a cached inference tensor could never take part in a gradient
def _sky_grid() -> tuple[Float[Tensor, "rows columns 3"], Float[Tensor, "3 rows columns"]]:
    """Directions of the parts of the sky, and their parts times the solid angle."""
    directions = _sphere_directions(_ROWS, _COLUMNS)
    angle = 2 * math.sin(math.pi / _ROWS / 2) * torch.sin(_sky_polar()) * (2 * math.pi / _COLUMNS)
    return directions, directions.permute(2, 0, 1) * angle[:, None]


def _integrals(latlong_hdr: Latlong) -> Float[Tensor, "3 cells width"]:
    """Running integrals of rows of the sky, times the parts of the direction, for four quarter turns of the map."""
    directions, weights = (part.to(latlong_hdr) for part in _sky_grid())
    values = sample_latlong(latlong_hdr, directions).permute(1, 2, 0, 3).flatten(2)
    turns = torch.stack([torch.roll(values, -k * (_COLUMNS // 4), dims=1) for k in range(4)], dim=2).flatten(2)
    # An empty column in front of the first: nothing is left of it.
    return (F.pad(turns, (0, 0, 1, 0)) * F.pad(weights, (1, 0))[..., None]).cumsum(2).flatten(1, 2)


# --- surfaces ----------------------------------------------------------------------------------------------------


@lru_cache(maxsize=1)
def _patches() -> tuple[_Points, _Points]:
    """Middles of the patches of the plane, and of the spheres, each in the order of `_patch_of`."""
    cell = (torch.arange(_CELLS) + 0.5) * (2 * PLANE_HALF / _CELLS) - PLANE_HALF
    z, x = torch.meshgrid(cell, cell, indexing="ij")
    plane = _on_plane(torch.stack((x, torch.zeros_like(x), z), dim=-1).flatten(0, 1))
    normals = _sphere_directions(_RINGS, 2 * _RINGS).flatten(0, 1)
    owner = torch.arange(9).repeat_interleave(len(normals))
    return plane, _on_spheres(normals.repeat(9, 1), owner)


def _patch_of(places: Float[Tensor, "*n 3"], owner: Int[Tensor, "*n"]) -> Int[Tensor, "*n"]:
    """Which patch a place is on, those of the plane first."""
    x, z = ((places[..., i] + PLANE_HALF) * (_CELLS / (2 * PLANE_HALF)) for i in (0, 2))
    column, row = (axis.floor().clamp(0, _CELLS - 1).long() for axis in (x, z))
    normals = places - _centres()[owner.clamp(min=0)]
    polar = torch.acos(normals[..., 1].clamp(-1, 1)) * (_RINGS / math.pi)
    azimuth = torch.atan2(normals[..., 0], -normals[..., 2]) * (_RINGS / math.pi) + _RINGS
    ring = polar.floor().clamp(0, _RINGS - 1).long()
    on_sphere = (owner * _RINGS + ring) * (2 * _RINGS) + torch.remainder(azimuth.floor().long(), 2 * _RINGS)
    return torch.where(owner < 0, row * _CELLS + column, _CELLS**2 + on_sphere)


def _cosine_directions() -> Float[Tensor, "gathered 3"]:
    """Directions around +Z, as many as the cosine weighs, on a Fibonacci spiral."""
    index = torch.arange(_GATHERED) + 0.5
    across = (index / _GATHERED).sqrt()
    turn = index * (math.pi * (3 - math.sqrt(5)))
    return torch.stack((across * torch.cos(turn), across * torch.sin(turn), (1 - across**2).sqrt()), dim=-1)


def _around(normals: Float[Tensor, "n 3"]) -> Float[Tensor, "n gathered 3"]:
    helper = torch.where(normals[:, :1].abs() > 0.7, torch.tensor([0.0, 0.0, 1.0]), torch.tensor([1.0, 0.0, 0.0]))
    side = F.normalize(torch.linalg.cross(helper, normals), dim=-1)
    frame = torch.stack((side, torch.linalg.cross(normals, side), normals), dim=1)
    return _cosine_directions() @ frame


def _seen_patches(points: _Points) -> Int[Tensor, "n gathered"]:
    """The patch in each direction; -1 where the sky is."""
    directions = _around(points.normals)
    places = points.places[:, None]
    own = torch.arange(9) == points.owner[:, None]
    entry = torch.where(own[:, None], math.inf, _entries(points.places, directions))
    distance, owner = entry.min(-1)
    down = torch.where(directions[..., 1] < -1e-6, -places[..., 1] / directions[..., 1], math.inf)
    down = torch.where((points.owner < 0)[:, None], math.inf, down)
    landing = places + down.clamp(max=1e3)[..., None] * directions
    inside = (landing[..., [0, 2]].abs() < PLANE_HALF).all(-1) & torch.isfinite(down)
    on_plane = inside & (down < distance)
    hit = places + torch.where(on_plane, down, distance).clamp(max=1e3)[..., None] * directions
    patch = _patch_of(hit, torch.where(on_plane, -1, owner))
    return torch.where(on_plane | torch.isfinite(distance), patch, -1)


@dataclass(frozen=True)
class _Surfaces:
    """What points see of patches.

    Attributes:
        starts: (n,) where the entries of each begin.
        patches: (entries,).
        share: (n,) of the irradiance of a uniform surrounding that each entry stands for.
    """

    starts: Tensor
    patches: Tensor
    share: Tensor

    def irradiance(self, radiosity: Float[Tensor, "patches width"]) -> Float[Tensor, "n width"]:
        device = radiosity.device
        seen = F.embedding_bag(self.patches.to(device), radiosity, self.starts.to(device), mode="sum")
        return seen * self.share.to(radiosity)[:, None]


def _surfaces(points: _Points, sky: Float[Tensor, "n"]) -> _Surfaces:
    """What points gather along, given the share of a uniform surrounding that the open sky gives them.

    Points near the tops of spheres see up to 1.1% of plane, edge on, where none of the directions goes: it stays black.
    """
    seen = torch.cat([_seen_patches(points[some]) for some in torch.arange(len(points.places)).split(512)])
    count = (seen >= 0).sum(-1)
    return _Surfaces(
        (count.cumsum(0) - count).int(), seen[seen >= 0].int(), (1 - sky).clamp(min=0) / count.clamp(min=1)
    )


@dataclass(frozen=True)
class _Lighting:
    """How points of the plane, and of the spheres, are lit."""

    skies: tuple[_Sky, _Sky]
    surfaces: tuple[_Surfaces, _Surfaces]

    def direct(self, table: Float[Tensor, "3 cells width"]) -> Float[Tensor, "n width"]:
        return torch.cat([sky.irradiance(table) for sky in self.skies])

    def gathered(self, radiosity: Float[Tensor, "patches width"]) -> Float[Tensor, "n width"]:
        return torch.cat([seen.irradiance(radiosity) for seen in self.surfaces])


def _lighting(plane: _Points, spheres: _Points) -> _Lighting:
    skies = (_sky(plane), _sky(spheres))
    uniform = _integrals(torch.full((1, _MAP_ROWS, 2 * _MAP_ROWS, 1), 1 / math.pi))
    open_sky = [sky.irradiance(uniform)[:, 0] for sky in skies]
    return _Lighting(skies, (_surfaces(plane, open_sky[0]), _surfaces(spheres, open_sky[1])))


# --- the picture -------------------------------------------------------------------------------------------------


@dataclass(frozen=True)
class _Quarter:
    """The upper right quarter of the picture.

    Attributes:
        plane: a point of each pixel that shows plane.
        spheres: a point of each pixel that shows a sphere.
        on_plane: (pixels,) which show plane.
        on_spheres: (pixels,) which show a sphere.
        coverage: (pixels,) share of each that a sphere covers.
    """

    plane: _Points
    spheres: _Points
    on_plane: Tensor
    on_spheres: Tensor
    coverage: Tensor


def _quarter() -> _Quarter:
    """Mean points of what rays through each pixel meet."""
    half = SIZE // 2
    steps = (torch.arange(half * _SUBPIXELS) + 0.5) * (PLANE_HALF / half / _SUBPIXELS)
    z, x = torch.meshgrid(-steps.flip(0), steps, indexing="ij")
    grid = torch.stack((x, torch.zeros_like(x), z), dim=-1)
    grid = grid.unflatten(0, (half, _SUBPIXELS)).unflatten(2, (half, _SUBPIXELS)).transpose(1, 2)
    floor = grid.reshape(half**2, _SUBPIXELS**2, 3)
    eye = torch.tensor([0.0, CAMERA_HEIGHT, 0.0])
    rays = F.normalize(floor - eye, dim=-1)
    distance, owner = (found.squeeze(0) for found in _entries(eye[None], rays.flatten(0, 1)[None]).min(-1))
    distance, owner = distance.view(rays.shape[:2]), owner.view(rays.shape[:2])
    hit = torch.isfinite(distance)
    normals = eye + distance.clamp(max=1e3)[..., None] * rays - _centres()[owner]
    coverage = hit.float().mean(-1)
    on_plane, on_spheres = (torch.nonzero(share > 0).squeeze(1) for share in (1 - coverage, coverage))
    spheres = F.normalize((normals * hit[..., None]).sum(1)[on_spheres], dim=-1)
    owner = torch.where(hit, owner, -1).amax(-1)[on_spheres]
    plane = (floor * ~hit[..., None]).sum(1)[on_plane] / (~hit).sum(-1)[on_plane, None]
    return _Quarter(_on_plane(plane), _on_spheres(spheres, owner), on_plane, on_spheres, coverage)


@dataclass(frozen=True)
class _Transport:
    """All that does not depend on the map.

    Attributes:
        quarter: of the picture.
        pixels: how its points are lit.
        patches: how the patches of a quarter of the scene are lit.
        places: (4, n) which patches those are, after each number of quarter turns.
        turns: (4, patches) where every patch is after them.
    """

    quarter: _Quarter
    pixels: _Lighting
    patches: _Lighting
    places: Tensor
    turns: Tensor

    def spread(self, quarter: Float[Tensor, "n width"]) -> Float[Tensor, "patches width"]:
        """Values of a quarter's patches under four turns of the map -> of all patches under each."""
        under = quarter.unflatten(1, (4, -1))
        every = under.new_empty(self.turns.shape[1], under.shape[2])
        every[self.places.to(under.device)] = under.transpose(0, 1)
        return every[self.turns.to(under.device)].transpose(0, 1).flatten(1)


@lru_cache(maxsize=1)
@torch.inference_mode(mode=False)  # a cached inference tensor could never take part in a gradient
def _transport() -> _Transport:
    kinds = _patches()
    every = [kinds]
    for _ in range(3):
        every.append((every[-1][0].turned(), every[-1][1].turned()))
    turns = torch.stack([torch.cat([_patch_of(kind.places, kind.owner) for kind in turn]) for turn in every])
    inside = torch.cat([kind.in_quarter for kind in kinds])
    quarter = _quarter()
    lit = _lighting(*(kind[kind.in_quarter] for kind in kinds))
    return _Transport(quarter, _lighting(quarter.plane, quarter.spheres), lit, turns[:, inside], turns)


def _mixed(quarter: _Quarter, values: Float[Tensor, "points width"]) -> Float[Tensor, "pixels width"]:
    coverage = quarter.coverage.to(values)[:, None]
    plane, spheres = values.split([len(quarter.on_plane), len(quarter.on_spheres)])
    picture = values.new_zeros(len(coverage), values.shape[1])
    on_plane, on_spheres = quarter.on_plane.to(values.device), quarter.on_spheres.to(values.device)
    picture = picture.index_add(0, on_plane, plane * (1 - coverage[on_plane]))
    return picture.index_add(0, on_spheres, spheres * coverage[on_spheres])


def _assembled(quarters: Float[Tensor, "pixels 4 b c"]) -> Float[Tensor, "b rows columns c"]:
    right, below, left, above = (
        torch.rot90(turn.unflatten(0, (SIZE // 2, -1)), -k) for k, turn in enumerate(quarters.unbind(1))
    )
    picture = torch.cat((torch.cat((above, right), dim=1), torch.cat((left, below), dim=1)))
    return picture.permute(2, 0, 1, 3)


def render_array(
    latlong_hdr: Latlong, *, albedo: float = ALBEDO, bounces: int = BOUNCES
) -> Float[Tensor, "b rows columns c"]:
    """The array of spheres in the light of a map. Differentiable; the first call takes some seconds longer.

    Args:
        latlong_hdr: (B, H, 2H, C) linear radiance; it is reduced to 128 rows by solid angle and read bilinearly.
        albedo: of spheres and plane, 0 to 1.
        bounces: of light between surfaces, 0 or more; 0 leaves only light that comes straight from the map.

    Returns:
        (B, 256, 256, C) linear radiance, the mean over each pixel. The plane fills the frame.

    Raises:
        OptionError: a map that is not 2:1, an albedo outside 0 to 1, or a negative number of bounces.
    """
    require_latlong(latlong_hdr)
    if not 0 <= albedo <= 1:
        raise OptionError("albedo", albedo, "0 to 1")
    if bounces < 0:
        raise OptionError("bounces", bounces, "0 or more")
    batch = latlong_hdr.shape[0]
    scene = _transport()
    table = _integrals(resize_latlong(latlong_hdr, _MAP_ROWS))
    direct = scene.patches.direct(table)
    lit = direct
    for _ in range(bounces - 1):
        lit = direct + scene.patches.gathered(albedo * scene.spread(lit))
    irradiance = scene.pixels.direct(table)
    if bounces:
        irradiance = irradiance + scene.pixels.gathered(albedo * scene.spread(lit))
    radiance = _mixed(scene.quarter, irradiance) * (albedo / math.pi)
    return _assembled(radiance.unflatten(1, (4, batch, -1)))
