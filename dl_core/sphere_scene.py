"""Spheres of any of Blender's grey surfaces in the light of a map, seen by any camera that looks at their centre.

A sphere seen from distance d (in radii) shows at ρ, the share of its silhouette's radius, the point whose incidence γ
(between normal n and view v) and angle β off the camera's axis are

    tan β = ρ / √(d² - 1),   sin γ = d sin β;   n lies γ - β off the axis, v lies β off it on the other side,

and its mirror direction is 2γ - β off it. An orthographic camera has d = ∞, β = 0 and sin γ = ρ.

Nothing here is random. A mirror averages the map over each pixel. Any other surface looks the same from all sides of
the camera's axis, so a ring of equal γ is a circular convolution of the map's rows around that axis with what the
surface reflects: reflection integrated over each pixel of a map turned to the axis, computed once for a surface and a
distance, and multiplied in the frequencies of the azimuth (as Ramamoorthi and Hanrahan do for whole rotations). Each
ring's weights are scaled so that a uniform map gives the surface's albedo exactly.

Sources: `microfacet` for the surfaces; DiffusionLight, Sec. 5, and its public evaluation for camera and materials;
Ramamoorthi and Hanrahan, A signal-processing framework for inverse rendering (SIGGRAPH 2001).
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass
from functools import lru_cache
from typing import Final

import torch
import torch.nn.functional as F
from jaxtyping import Float
from torch import Tensor

from .errors import OptionError
from .geometry import latlong_neighbours, require_latlong
from .microfacet import Surface
from .shapes import Image, Latlong
from .sparse_rows import SparseRows

__all__ = ["AUTHORS_SPHERES", "AUTHORS_VIEW", "View", "render_sphere", "view_coverage"]

_ROWS: Final = 128
"""Rows of the map around the camera's axis; twice as many columns, and as many azimuths of each ring."""
_RINGS: Final = 96
"""Rings of equal incidence, 0.94 degrees apart."""
_STEEP: Final = 65.0
"""Incidence in degrees above which highlights are narrow, and map pixels are cut into more parts."""


@dataclass(frozen=True)
class View:
    """A picture with a sphere in its middle.

    Attributes:
        rows: of the picture.
        columns: of the picture.
        radius: of the sphere's silhouette in pixels.
        distance: of the camera from the sphere's centre in radii of the sphere, above 1; infinite: orthographic.
        elevation: degrees that the camera stands above the sphere, -90 to 90; it looks at the centre.
    """

    rows: int
    columns: int
    radius: float
    distance: float = math.inf
    elevation: float = 0.0

    def __post_init__(self) -> None:
        if min(self.rows, self.columns) < 1:
            raise OptionError("size", (self.rows, self.columns), "1 or more rows and columns")
        if not 0 < self.radius < math.inf:
            raise OptionError("radius", self.radius, "a radius above 0 pixels")
        if not self.distance > 1:
            raise OptionError("distance", self.distance, "above 1 radius")
        if not -90 <= self.elevation <= 90:
            raise OptionError("elevation", self.elevation, "-90 to 90 degrees")

    @classmethod
    def square(cls, size: int) -> View:
        """The orthographic crop that the sphere fills."""
        return cls(size, size, size / 2)

    @property
    def axes(self) -> Float[Tensor, "3 3"]:
        """Rows: right and up of the picture, and towards the camera."""
        sin, cos = math.sin(math.radians(self.elevation)), math.cos(math.radians(self.elevation))
        return torch.tensor([[1.0, 0.0, 0.0], [0.0, cos, -sin], [0.0, sin, cos]])

    def tilt(self, incidence: Float[Tensor, "*n"]) -> Float[Tensor, "*n"]:
        """β of points of given incidence γ, in radians."""
        return torch.asin(torch.sin(incidence) / self.distance)

    def incidence(self, rho: Float[Tensor, "*n"]) -> Float[Tensor, "*n"]:
        """γ at shares of the silhouette's radius, 0 to 1, in radians."""
        if math.isinf(self.distance):
            return torch.asin(rho.clamp(max=1))
        beta = torch.atan(rho / math.sqrt(self.distance**2 - 1))
        return torch.asin((self.distance * torch.sin(beta)).clamp(max=1))


_CAMERA: Final = (16.0, 2.0)
"""Of the authors' camera: how far off in front, and how far up; the sphere has radius 1."""
_FOCAL: Final = 85 / 36 * 960

AUTHORS_VIEW: Final = View(
    rows=540,
    columns=960,
    radius=_FOCAL / math.sqrt(math.hypot(*_CAMERA) ** 2 - 1),
    distance=math.hypot(*_CAMERA),
    elevation=math.degrees(math.atan2(_CAMERA[1], _CAMERA[0])),
)
"""The camera of the authors' evaluation: 85 mm on 36 mm, 960 x 540, at (0, -16, 2), looking at a sphere at the origin.

That it looks down at the sphere, rather than straight ahead past a raised one, was read from their renders: the floor's
lowest point shows 107 pixels below the centre (this camera: 107.7; a level one: 102.5).
"""

AUTHORS_SPHERES: Final[dict[str, Surface]] = {
    "diffuse": Surface(base=0.8, metallic=False, roughness=0.364),
    "matte": Surface(base=0.8, metallic=True, roughness=0.3271),
    "mirror": Surface(base=0.8, metallic=True, roughness=0.0),
}
"""The authors' gray-diffuse, silver-matte and silver-mirror spheres."""


# --- pixels ------------------------------------------------------------------------------------------------------


@dataclass(frozen=True)
class _Samples:
    """Points over the pixels that show the sphere: each field (pixels, samples).

    Attributes:
        pixels: which pixels of the picture, (pixels,), row by row.
        incidence: γ in radians.
        azimuth: around the camera's axis, from right towards up, in radians.
        inside: 1 where the point is on the sphere.
    """

    pixels: Tensor
    incidence: Tensor
    azimuth: Tensor
    inside: Tensor

    def average(self, values: Float[Tensor, "b n s c"]) -> Float[Tensor, "b n c"]:
        """Mean over the part of each pixel that shows the sphere."""
        weights = self.inside / self.inside.sum(-1, keepdim=True)
        return (values * weights[None, :, :, None]).sum(2)


@lru_cache(maxsize=8)
def _samples(view: View, count: int) -> _Samples:
    """`count` x `count` points in each pixel of which one is on the sphere."""
    offsets = (torch.arange(count) + 0.5) / count
    down = torch.arange(view.rows)[:, None] + offsets - view.rows / 2
    right = torch.arange(view.columns)[:, None] + offsets - view.columns / 2
    shape = (view.rows, view.columns, count, count)
    x = (right[None, :, None, :] / view.radius).expand(shape).reshape(-1, count * count)
    y = (-down[:, None, :, None] / view.radius).expand(shape).reshape(-1, count * count)
    rho = torch.hypot(x, y)
    pixels = torch.nonzero((rho < 1).any(-1)).squeeze(1)
    rho, x, y = rho[pixels], x[pixels], y[pixels]
    return _Samples(pixels, view.incidence(rho), torch.atan2(y, x), (rho < 1).float())


def _directions(axes: Tensor, angle: Tensor, azimuth: Tensor) -> Float[Tensor, "*n 3"]:
    """Unit vectors at angles off the camera's axis."""
    across = torch.sin(angle)
    parts = torch.stack((across * torch.cos(azimuth), across * torch.sin(azimuth), torch.cos(angle)), dim=-1)
    return parts @ axes


def _place(view: View, pixels: Tensor, values: Float[Tensor, "b n c"]) -> Image:
    picture = values.new_zeros(values.shape[0], view.rows * view.columns, values.shape[-1])
    picture[:, pixels.to(values.device)] = values
    return picture.unflatten(1, (view.rows, view.columns))


def view_coverage(view: View, *, samples: int = 8) -> Float[Tensor, "h w"]:
    """How much of each pixel the sphere covers, 0 to 1: the alpha of a render."""
    points = _samples(view, samples)
    return _place(view, points.pixels, points.inside.mean(-1)[None, :, None])[0, ..., 0]


# --- mirrors -----------------------------------------------------------------------------------------------------


def _mirror(latlong_hdr: Latlong, surface: Surface, view: View) -> Float[Tensor, "b rows columns c"]:
    """Mean of what each pixel reflects: 0.3 map pixels of a 128-row map between samples at the centre."""
    pixels, seen = _reflections(surface, view, latlong_hdr.shape[1])
    return _place(view, pixels, _read(latlong_hdr, [seen]))


def _read(latlong: Latlong, strips: Sequence[SparseRows]) -> Float[Tensor, "b n c"]:
    """What rows of sparse matrices read of the pixels of maps."""
    dense = latlong.permute(1, 2, 0, 3).flatten(0, 1).flatten(1)
    rows = torch.cat([strip.to(latlong.device) @ dense for strip in strips])
    return rows.unflatten(1, (latlong.shape[0], -1)).transpose(0, 1)


@lru_cache(maxsize=4)
@torch.inference_mode(mode=False)  # a cached inference tensor could never take part in a gradient
def _reflections(surface: Surface, view: View, height: int) -> tuple[Tensor, SparseRows]:
    """Pixels that show a mirror, and what each sees of a map."""
    points = _samples(view, min(16, max(4, math.ceil(560 / view.radius))))
    columns, shares = latlong_neighbours(_mirror_directions(view, points), height)
    covered = points.inside / points.inside.sum(-1, keepdim=True)
    shares = shares * (covered * surface.fresnel(torch.cos(points.incidence)))[..., None]
    return points.pixels, SparseRows.gathered(columns.flatten(1), shares.flatten(1), 2 * height**2)


def _mirror_directions(view: View, points: _Samples) -> Float[Tensor, "n s 3"]:
    return _directions(view.axes, 2 * points.incidence - view.tilt(points.incidence), points.azimuth)


# --- rough surfaces ----------------------------------------------------------------------------------------------


def _ring_incidence() -> Float[Tensor, "rings"]:
    return (torch.arange(_RINGS) + 0.5) * (math.pi / 2 / _RINGS)


def _reflectance(surface: Surface, view: View, incidence: Tensor, parts: int) -> Float[Tensor, "rings rows half"]:
    """What rings reflect of each pixel of a map around the camera's axis, by how far round it is from the point.

    Every pixel is cut into parts x parts, and the ring's weights are scaled to its albedo; half a turn is enough.
    """
    steps = (torch.arange(parts) + 0.5) / parts
    polar = ((torch.arange(_ROWS)[:, None] + steps) * (math.pi / _ROWS)).reshape(1, -1, 1)
    around = ((torch.arange(_ROWS + 1)[:, None] + steps - 0.5) * (math.pi / _ROWS)).reshape(1, 1, -1)
    tilt = view.tilt(incidence)[:, None, None]
    normal = incidence[:, None, None] - tilt
    sideways = torch.sin(polar) * torch.cos(around)
    cos_light = (torch.cos(normal) * torch.cos(polar) + torch.sin(normal) * sideways).clamp(min=0).flatten(1)
    cos_between = (torch.cos(tilt) * torch.cos(polar) - torch.sin(tilt) * sideways).flatten(1)
    cos_view = torch.cos(incidence)
    gloss = surface.gloss(cos_view, cos_light, cos_between)
    area = torch.sin(polar).expand(-1, -1, around.shape[-1])
    body, gloss = (
        _by_pixel(values.reshape(len(incidence), *area.shape[1:]) * area, parts) for values in (cos_light, gloss)
    )
    return _scaled(body, surface.body(cos_view)) + _scaled(gloss, surface.gloss_albedo(cos_view))


def _by_pixel(values: Tensor, parts: int) -> Tensor:
    rings, tall, wide = values.shape
    return values.reshape(rings, tall // parts, parts, wide // parts, parts).sum(dim=(2, 4))


def _scaled(weights: Tensor, total: Tensor) -> Tensor:
    """Weights of half a turn, scaled so that those of the whole turn add up to a total for each ring."""
    twice = torch.full((weights.shape[-1],), 2.0)
    twice[0] = twice[-1] = 1
    return weights * (total / (weights.double() @ twice.double()).sum(-1)).float()[:, None, None]


@lru_cache(maxsize=16)
def _kernel(surface: Surface, distance: float) -> Float[Tensor, "frequencies rings rows"]:
    """Spectrum over the azimuth of what each ring reflects of each row; real, because left and right are alike."""
    view = View(1, 1, 1.0, distance)
    rings = []
    for incidence in _ring_incidence().split(4):
        weights = _reflectance(surface, view, incidence, 4 if float(incidence[-1]) > math.radians(_STEEP) else 2)
        whole = torch.cat((weights, weights[..., 1:-1].flip(-1)), dim=-1)
        rings.append(torch.fft.rfft(whole, dim=-1).real)
    return torch.cat(rings).permute(2, 0, 1).contiguous()


@lru_cache(maxsize=4)
@torch.inference_mode(mode=False)
def _axis_rows(elevation: float, height: int) -> tuple[SparseRows, ...]:
    """What pixels of a map around the camera's axis read of one around the vertical, in strips of rows.

    Four samples along a pixel of the map keep the energy of a light one pixel wide within 0.1%; two only within 0.6%.
    """
    parts = min(12, max(2, math.ceil(4 * height / _ROWS)))
    steps = (torch.arange(parts) + 0.5) / parts
    azimuth = ((torch.arange(2 * _ROWS)[:, None] + steps) * (math.pi / _ROWS))[None, :, None, :]
    axes = View(1, 1, 1.0, elevation=elevation).axes
    strips = []
    for rows in torch.arange(_ROWS).split(8):
        polar = ((rows[:, None] + steps) * (math.pi / _ROWS))[:, None, :, None]
        directions = _directions(axes, *torch.broadcast_tensors(polar, azimuth))
        columns, shares = latlong_neighbours(directions, height)
        weight = torch.sin(polar) / (torch.sin(polar).sum(dim=2, keepdim=True) * parts)
        shares = shares * weight[..., None]
        strips.append(
            SparseRows.gathered(columns.flatten(0, 1).flatten(1), shares.flatten(0, 1).flatten(1), 2 * height**2)
        )
    return tuple(strips)


def _around_axis(latlong_hdr: Latlong, elevation: float) -> Float[Tensor, "b rows columns c"]:
    """The map with the camera's axis for its pole, its pixels averaged."""
    return _read(latlong_hdr, _axis_rows(elevation, latlong_hdr.shape[1])).unflatten(1, (_ROWS, 2 * _ROWS))


def _rings(around: Latlong, kernel: Tensor) -> Float[Tensor, "b rings azimuths c"]:
    spectrum = torch.fft.rfft(around, dim=2)
    weights = kernel.to(around)
    parts = (_mixed(weights, spectrum.real), _mixed(weights, spectrum.imag))
    return torch.fft.irfft(torch.complex(*parts), n=around.shape[2], dim=2)


def _mixed(weights: Tensor, rows: Tensor) -> Tensor:
    """Rows of the map -> rings of the sphere, at each frequency."""
    batch, _, frequencies, channels = rows.shape
    flat = rows.permute(2, 1, 0, 3).reshape(frequencies, -1, batch * channels)
    return torch.bmm(weights, flat).reshape(frequencies, -1, batch, channels).permute(2, 1, 0, 3)


def _rough(latlong_hdr: Latlong, surface: Surface, view: View) -> Float[Tensor, "b rows columns c"]:
    kernel = _kernel(surface, view.distance)
    rings = _rings(_around_axis(latlong_hdr, view.elevation), kernel)
    points = _samples(view, 2)
    values = _between_rings(rings, points.incidence.to(rings), points.azimuth.to(rings))
    return _place(view, points.pixels, points.average(values).clamp(min=0))


def _between_rings(rings: Tensor, incidence: Tensor, azimuth: Tensor) -> Float[Tensor, "b n s c"]:
    """Cubic interpolation between rings and around them; beyond the first ring lies the far side of the centre."""
    count, around = rings.shape[1:3]
    across = torch.roll(rings[:, :2].flip(1), around // 2, dims=2)
    tall = torch.cat((across, rings, rings[:, -1:].expand(-1, 2, -1, -1)), dim=1)
    padded = torch.cat((tall[:, :, -2:], tall, tall[:, :, :2]), dim=2)
    column = torch.remainder(azimuth, 2 * math.pi) * (around / (2 * math.pi)) + 2
    row = incidence * (count * 2 / math.pi) + 2
    grid = torch.stack((column * (2 / padded.shape[2]) - 1, row * (2 / padded.shape[1]) - 1), dim=-1)
    grid = grid[None].expand(rings.shape[0], -1, -1, -1)
    values = F.grid_sample(padded.permute(0, 3, 1, 2), grid, mode="bicubic", align_corners=False)
    return values.permute(0, 2, 3, 1)


def render_sphere(latlong_hdr: Latlong, surface: Surface, view: View) -> Float[Tensor, "b rows columns c"]:
    """A sphere in the light of a map.

    Args:
        latlong_hdr: (B, H, 2H, C) linear radiance, read between its pixels as `geometry.sample_latlong` does.
        surface: what the sphere is made of.
        view: the picture; a level camera looks along -Z, at the centre of the map.

    Returns:
        (B, rows, columns, C) linear radiance, the mean over the part of each pixel that shows the sphere; zero off
        it. Multiply by `view_coverage` for a render with alpha.

    Raises:
        OptionError: a map that is not 2:1.

    Warnings:
        Under a rough surface the map is reduced to 128 rows. Lights one pixel wide keep their energy up to 384 rows;
        reduce larger maps first, by solid angle.
    """
    require_latlong(latlong_hdr)
    return (_mirror if surface.is_mirror else _rough)(latlong_hdr, surface, view)
