"""Procedural HDR panoramas: open skies and furnished rooms, to go beyond the few panoramas at hand.

They are closed forms evaluated per direction, cheap enough to draw hundreds in seconds: the sky follows the shape of
Preetham's gradients (A Practical Analytic Model for Daylight, SIGGRAPH 1999) without its spectral fits, rooms are a
box with textured walls lit by lamps and windows through point-to-rectangle form factors (diffuse, one bounce, no
occlusion by furniture). They teach a model that skies are above, that lamps are small and strong, that walls
continue; they are not meant as ground truth of light transport.
"""

from __future__ import annotations

import math
from typing import Final

import torch
import torch.nn.functional as F
from jaxtyping import Float
from torch import Generator, Tensor

from ...geometry import latlong_directions
from ...shapes import Directions, Latlong

__all__ = [
    "MEDIAN",
    "draw_panorama",
    "draw_room",
    "draw_sky",
    "random_colour",
    "random_log_uniform",
    "random_uniform",
]

MEDIAN: Final = 0.2
"""Median luminance of the panoramas drawn."""


def random_uniform(generator: Generator, low: float, high: float) -> float:
    """A number drawn evenly from low to high."""
    return low + (high - low) * float(torch.rand((), generator=generator))


def random_log_uniform(generator: Generator, low: float, high: float) -> float:
    """A number whose logarithm is drawn evenly, from low to high, both above 0."""
    return math.exp(random_uniform(generator, math.log(low), math.log(high)))


def random_colour(generator: Generator, saturation: float) -> Float[Tensor, "3"]:
    """A random colour of mean 1, each channel within `saturation` of it."""
    colour = 1 + saturation * (2 * torch.rand(3, generator=generator) - 1)
    return colour / colour.mean()


def _random_sizes(generator: Generator, *spans: tuple[float, float]) -> Float[Tensor, "3"]:
    return torch.tensor([random_uniform(generator, *span) for span in spans])


def _noise_map(generator: Generator, height: int, octaves: int) -> Latlong:
    """Smooth noise on the sphere of zero mean and about unit deviation, (1, height, 2 height, 1)."""
    total = torch.zeros(1, 1, height, 2 * height)
    for octave in range(octaves):
        rows = min(height, 4 << octave)
        grid = torch.randn(1, 1, rows, 2 * rows, generator=generator)
        grid = torch.cat((grid[..., -2:], grid, grid[..., :2]), dim=-1)
        fine = F.interpolate(grid, size=(height, round(height * 2 * (1 + 2 / rows))), mode="bicubic")
        start = (fine.shape[-1] - 2 * height) // 2
        total = total + fine[..., start : start + 2 * height] * 0.6**octave
    return (total / total.std()).permute(0, 2, 3, 1)


def draw_sky(generator: Generator, height: int) -> Latlong:
    """An outdoor scene: sky gradient, sun or overcast, clouds, textured ground and a broken skyline.

    Args:
        generator: decides everything random.
        height: rows of the map.

    Returns:
        (1, height, 2 height, 3) linear radiance, of no particular scale.
    """
    directions = latlong_directions(height)
    elevation = directions[..., 1:2]
    sun = _sun_direction(generator)
    overcast = float(torch.rand((), generator=generator)) ** 2
    towards_sun = (directions * sun).sum(-1, keepdim=True)

    zenith = torch.tensor([0.22, 0.42, 0.9]) * random_colour(generator, 0.2)
    horizon = torch.tensor([0.75, 0.8, 0.85]) * random_colour(generator, 0.25) * random_uniform(generator, 0.8, 1.8)
    falloff = torch.exp(-elevation.clamp(min=0) * random_uniform(generator, 1.5, 5))
    sky = zenith * (1 - falloff) + horizon * falloff
    sky = sky + torch.exp((towards_sun - 1) * random_uniform(generator, 4, 30)) * random_colour(generator, 0.2) * 1.2
    clouds = torch.sigmoid((_noise_map(generator, height, 5)[0] - random_uniform(generator, -0.5, 2)) * 3)
    sky = sky * (1 - clouds) + clouds * random_uniform(generator, 0.5, 1.6) * (0.7 + 0.6 * towards_sun.clamp(min=0))
    sky = sky * (1 - overcast) + overcast * (0.5 + 0.5 * elevation.clamp(min=0)) * random_colour(generator, 0.1)
    disc = torch.sigmoid((towards_sun - math.cos(math.radians(random_uniform(generator, 1.2, 3)))) * 4000)
    warmth = 1 - torch.tensor([0.0, 0.35, 0.75]) * math.exp(-4 * max(0.0, float(sun[1])))
    sun_level = random_log_uniform(generator, 30, 3000) * (1 - overcast) ** 3
    sky = sky + disc * sun_level * warmth

    albedo = random_uniform(generator, 0.08, 0.5) * random_colour(generator, 0.4)
    texture = (1 + 0.35 * _noise_map(generator, height, 6)[0]).clamp(0.2, 2)
    lit = 0.35 + (1 - overcast) * max(0.0, float(sun[1])) * random_uniform(generator, 0.2, 1.5)
    ground = albedo * texture * lit
    skyline = _skyline(generator, directions)
    above = torch.sigmoid((elevation - skyline) * 150)
    return (above * sky + (1 - above) * ground).clamp(min=0)[None]


def _sun_direction(generator: Generator) -> Float[Tensor, "3"]:
    azimuth, elevation = random_uniform(generator, -math.pi, math.pi), math.radians(random_uniform(generator, 3, 75))
    level = math.cos(elevation)
    return torch.tensor([level * math.sin(azimuth), math.sin(elevation), -level * math.cos(azimuth)])


def _skyline(generator: Generator, directions: Directions) -> Float[Tensor, "h w 1"]:
    """Sine of the elevation at which the sky begins, per azimuth: hills or blocks of houses."""
    azimuth = torch.atan2(directions[..., 0:1], -directions[..., 2:3])
    profile = torch.zeros_like(azimuth)
    for harmonic in range(1, 7):
        phase, gain = random_uniform(generator, 0, 2 * math.pi), random_uniform(generator, 0, 0.12 / harmonic)
        profile = profile + gain * torch.sin(harmonic * azimuth + phase)
    if float(torch.rand((), generator=generator)) < 0.5:
        blocks = torch.rand(24, generator=generator) * random_uniform(generator, 0.05, 0.6)
        profile = profile + blocks[((azimuth / (2 * math.pi) + 0.5) * 23.99).long()]
    return profile


def draw_room(generator: Generator, height: int) -> Latlong:
    """An indoor scene: a box of textured walls seen from inside, with lamps, windows and furniture blocks.

    Args, Returns: as `draw_sky`.
    """
    directions = latlong_directions(height)
    half = torch.tensor(
        [random_uniform(generator, 1.5, 6), random_uniform(generator, 1.2, 2.0), random_uniform(generator, 1.5, 6)]
    )
    eye = (torch.rand(3, generator=generator) * 1.2 - 0.6) * half
    points, normals, wall = _hit_box(directions, eye, half)
    albedo = _wall_colours(generator)[wall] * (1 + 0.2 * _noise_map(generator, height, 6)[0]).clamp(0.3, 1.6)
    points, normals, albedo = _furnish(generator, directions, eye, half, (points, normals, albedo))

    light = random_uniform(generator, 0.05, 0.4) * random_colour(generator, 0.15) * torch.ones_like(albedo)
    emitted = torch.zeros_like(albedo)
    for _ in range(1 + int(random_uniform(generator, 0, 4.99))):
        corner, edge_u, edge_v, radiance, picture = _lamp(generator, half, height)
        light = light + _irradiance(points, normals, corner, edge_u, edge_v) * radiance
        emitted = torch.maximum(emitted, _inside(points, corner, edge_u, edge_v) * radiance * picture)
    return (emitted + (emitted == 0) * albedo * light).clamp(min=0)[None]


def _hit_box(directions: Directions, eye: Tensor, half: Tensor) -> tuple[Tensor, Tensor, Tensor]:
    """Where rays from inside a box leave it: points, inward normals, and the wall's number (0 to 5)."""
    distance = (torch.sign(directions) * half - eye) / torch.where(directions == 0, 1e-9, directions)
    nearest, axis = distance.min(dim=-1, keepdim=True)
    points = eye + directions * nearest
    side = torch.sign(torch.gather(directions, -1, axis))
    normals = torch.zeros_like(directions).scatter_(-1, axis, -side)
    return points, normals, (axis * 2 + (side > 0)).squeeze(-1)


def _wall_colours(generator: Generator) -> Float[Tensor, "6 3"]:
    wall = random_uniform(generator, 0.3, 0.8) * random_colour(generator, 0.25)
    colours = [wall * random_uniform(generator, 0.8, 1.2) for _ in range(6)]
    colours[2] = random_uniform(generator, 0.1, 0.5) * random_colour(generator, 0.4)  # floor
    colours[3] = random_uniform(generator, 0.6, 0.9) * random_colour(generator, 0.05)  # ceiling
    return torch.stack(colours)


def _furnish(
    generator: Generator, directions: Directions, eye: Tensor, half: Tensor, surface: tuple[Tensor, Tensor, Tensor]
) -> tuple[Tensor, Tensor, Tensor]:
    """Put blocks on the floor in front of what the rays hit."""
    points, normals, albedo = surface
    inverse = 1 / torch.where(directions == 0, 1e-9, directions)
    for _ in range(int(random_uniform(generator, 0, 6))):
        size = torch.tensor(
            [
                random_uniform(generator, 0.2, 0.9),
                random_uniform(generator, 0.2, 0.8),
                random_uniform(generator, 0.2, 0.9),
            ]
        )
        centre = (torch.rand(3, generator=generator) * 2 - 1) * half
        centre[1] = -half[1] + size[1]
        if bool(((eye - centre).abs() < size + 0.15).all()):
            continue
        near = torch.minimum((centre - size - eye) * inverse, (centre + size - eye) * inverse)
        far = torch.maximum((centre - size - eye) * inverse, (centre + size - eye) * inverse)
        entry, axis = near.max(dim=-1, keepdim=True)
        reached = (points - eye).norm(dim=-1, keepdim=True)
        hit = (entry < far.min(dim=-1, keepdim=True).values) & (entry > 0) & (entry < reached)
        facing = torch.zeros_like(directions).scatter_(-1, axis, -torch.sign(torch.gather(directions, -1, axis)))
        points = torch.where(hit, eye + directions * entry, points)
        normals = torch.where(hit, facing, normals)
        albedo = torch.where(hit, random_uniform(generator, 0.1, 0.8) * random_colour(generator, 0.6), albedo)
    return points, normals, albedo


def _lamp(generator: Generator, half: Tensor, height: int) -> tuple[Tensor, Tensor, Tensor, Tensor, Tensor]:
    """A ceiling lamp or a window: corner, two edges, radiance (3,), and a picture it shows (per direction)."""
    picture = torch.ones(height, 2 * height, 1)
    if float(torch.rand((), generator=generator)) < 0.55:
        size = torch.tensor([random_log_uniform(generator, 0.1, 1.5), 0.0, random_log_uniform(generator, 0.1, 1.5)])
        corner = (torch.rand(3, generator=generator) * 2 - 1) * (half - size.clamp(max=1.4))
        corner[1] = half[1]
        warm = torch.tensor([1.0, random_uniform(generator, 0.55, 1.0), 0.0])
        warm[2] = warm[1] * random_uniform(generator, 0.4, 1.1)
        level = random_log_uniform(generator, 4, 60) / max(0.15, float(size[0] * size[2])) ** 0.5
        edges = torch.tensor([float(size[0]), 0, 0]), torch.tensor([0, 0, float(size[2])])
        return corner, *edges, warm * level, picture
    across = random_uniform(generator, 0.6, 2.5)
    bottom = random_uniform(generator, -0.4, 0.2) * float(half[1])
    top = min(bottom + random_uniform(generator, 0.7, 1.6), float(half[1]))
    wall, along = (0, 2) if float(torch.rand((), generator=generator)) < 0.5 else (2, 0)
    corner, edge = torch.zeros(3), torch.zeros(3)
    corner[wall] = half[wall] * (1.0 if float(torch.rand((), generator=generator)) < 0.5 else -1.0)
    corner[along] = half[along] * random_uniform(generator, -1, 0.3)
    corner[1] = bottom
    edge[along] = across
    picture = (1 + 0.4 * _noise_map(generator, height, 4)[0]).clamp(min=0.2)
    daylight = torch.tensor([0.8, 0.95, 1.1]) * random_colour(generator, 0.2) * random_log_uniform(generator, 1, 25)
    return corner, edge, torch.tensor([0.0, top - bottom, 0.0]), daylight, picture


def _irradiance(
    points: Tensor, normals: Tensor, corner: Tensor, edge_u: Tensor, edge_v: Tensor
) -> Float[Tensor, "h w 1"]:
    """Irradiance / π at surface points from a rectangle of unit radiance, by a 4 x 4 grid of its points."""
    area_normal = torch.linalg.cross(edge_u, edge_v)
    total = torch.zeros_like(points[..., :1])
    for u in (0.125, 0.375, 0.625, 0.875):
        for v in (0.125, 0.375, 0.625, 0.875):
            towards = corner + u * edge_u + v * edge_v - points
            squared = (towards * towards).sum(-1, keepdim=True).clamp(min=0.02)
            received = (towards * normals).sum(-1, keepdim=True).clamp(min=0)
            sent = (towards * area_normal).sum(-1, keepdim=True).abs()
            total = total + received * sent / squared**2
    return total / (16 * math.pi)


def _inside(points: Tensor, corner: Tensor, edge_u: Tensor, edge_v: Tensor) -> Float[Tensor, "h w 1"]:
    """1 where a surface point lies on the rectangle."""
    local = points - corner
    off_plane = (local * torch.linalg.cross(edge_u, edge_v)).sum(-1, keepdim=True).abs()
    u = (local * edge_u).sum(-1, keepdim=True) / (edge_u * edge_u).sum()
    v = (local * edge_v).sum(-1, keepdim=True) / (edge_v * edge_v).sum()
    return ((off_plane < 1e-3) & (u >= 0) & (u <= 1) & (v >= 0) & (v <= 1)).float()


def draw_panorama(seed: int, height: int = 128) -> Latlong:
    """The procedural panorama of a seed: a sky for even seeds, a room for odd ones.

    It is drawn twice as fine and averaged down, so that lamps and the sun have clean edges.

    Args:
        seed: decides the scene.
        height: rows of the map.

    Returns:
        (1, height, 2 height, 3) linear radiance scaled to a median luminance of `MEDIAN`.
    """
    generator = torch.Generator().manual_seed(seed)
    fine = (draw_sky if seed % 2 == 0 else draw_room)(generator, 2 * height)
    panorama = F.avg_pool2d(fine.permute(0, 3, 1, 2), 2).permute(0, 2, 3, 1)
    return panorama * (MEDIAN / panorama.mean(dim=-1).median().clamp(min=1e-3))
