"""Directions, latlong maps and mirror balls, and resampling between them.

World: +X is right of the photograph, +Y up, and the camera looks along -Z (the viewer sits at +Z).

Latlong (height H, width 2H): pixel (i, j) has its centre at v = (i + 0.5) / H, u = (j + 0.5) / (2H). Row 0 is up,
the centre of the map looks along -Z, and what is right of the photograph is right of the centre.

Mirror ball, orthographic: the disc point (x, y) has the normal n = (x, y, sqrt(1 - x² - y²)) and reflects
r = 2 (n·v) n - v with v = +Z. The map is equal-area: dω = 4 dx dy, so every pixel of a ball of radius R pixels
covers 4 / R² sr. The centre reflects what is behind the camera; the whole rim is one direction, straight ahead.

Resampling averages several bilinear samples spread over each output pixel, weighted by solid angle, which is what
keeps energy: a single sample aliases wherever the footprint of an output pixel is long and thin (near the rim).
Bilinear samples are a partition of unity, so the interior of a ball keeps its energy by itself; at the rim, where the
outer 5% of the radius hold a tenth of the sphere, unwrapping balances its weights to that end (`footprints`).

Values are interpolated as they are. Measured on round trips of panoramas (`lightprobe bench geometry`), linear radiance
keeps energy and irradiance best, and display-encoded values what a display shows; maps are lights first.

Sources: DiffusionLight, Sec. 4 and Fig. 3; the equal-area property follows from dω = 4 cos θ dA for a unit sphere.
"""

from __future__ import annotations

import math
from collections.abc import Callable

import torch
import torch.nn.functional as F
from jaxtyping import Float, Int
from torch import Tensor

from .errors import OptionError
from .footprints import Footprints, coverage, spherical, unwrap
from .projection import ORTHOGRAPHIC, Lens, Projection, disc_directions
from .shapes import BallImage, Directions, Image, Latlong, Mask

__all__ = [
    "ball_coverage",
    "ball_directions",
    "ball_solid_angle",
    "ball_to_latlong",
    "camera_rotation",
    "latlong_coordinates",
    "latlong_coverage",
    "latlong_directions",
    "latlong_energy",
    "latlong_neighbours",
    "latlong_solid_angles",
    "latlong_to_ball",
    "latlong_to_perspective",
    "perspective_to_latlong",
    "require_latlong",
    "rotate_latlong",
    "sample_latlong",
]


def require_latlong(latlong: Tensor) -> None:
    """Raise OptionError unless a tensor is a batch of maps, (B, H, 2H, C)."""
    if latlong.ndim != 4 or latlong.shape[2] != 2 * latlong.shape[1]:
        raise OptionError("latlong", tuple(latlong.shape), "shape (batch, height, 2 x height, channels)")


def _require_samples(samples: int) -> None:
    if not 1 <= samples <= 64:
        raise OptionError("samples", samples, "1 to 64 samples along each side of a pixel")


def _require_height(height: int) -> None:
    if height < 1:
        raise OptionError("height", height, "1 or more rows")


def _require_radius(radius: float) -> None:
    if not radius > 0:
        raise OptionError("radius", radius, "a radius above 0 pixels")


def _subpixels(count: int, samples: int, device: torch.device | None = None) -> Float[Tensor, "n"]:
    """Positions, in pixels, of `samples` evenly spread samples in each of `count` pixels."""
    return (torch.arange(count * samples, device=device, dtype=torch.float32) + 0.5) / samples


# --- latlong -----------------------------------------------------------------------------------------------------


def latlong_directions(height: int, *, device: torch.device | None = None) -> Float[Tensor, "h w 3"]:
    """Directions of the pixel centres of a latlong map.

    Args:
        height: rows of the map, at least 1; its width is twice that.
        device: where to build the tensor.

    Returns:
        (height, 2 height, 3) unit vectors.

    Raises:
        OptionError: height below 1.
    """
    _require_height(height)
    v = _subpixels(height, 1, device) / height
    u = _subpixels(2 * height, 1, device) / (2 * height)
    return spherical(u[None, :].expand(height, -1), v[:, None].expand(-1, 2 * height))


def latlong_coordinates(directions: Directions) -> tuple[Float[Tensor, "*n"], Float[Tensor, "*n"]]:
    """Map coordinates (u, v) in [0, 1] of directions: the inverse of the latlong convention.

    Straight up and straight down have no azimuth; they get that of straight ahead.

    Args:
        directions: (..., 3), of any length above zero.
    """
    x, y, z = directions.unbind(-1)
    u = torch.atan2(x, 0.0 - z) / (2 * math.pi) + 0.5  # 0 - z: the azimuth of -0.0 is half a turn
    v = torch.atan2(torch.hypot(x, z), y) / math.pi
    return u, v


def latlong_solid_angles(height: int, *, device: torch.device | None = None) -> Float[Tensor, "h 1"]:
    """Exact solid angle of a pixel in each row, in steradians; all pixels together cover 4π.

    Returns:
        (height, 1): a column that broadcasts over the row.
    """
    edges = torch.arange(height + 1, device=device, dtype=torch.float64) * (math.pi / height)
    bands = torch.cos(edges[:-1]) - torch.cos(edges[1:])
    return (bands * (math.pi / height)).float()[:, None]


def latlong_energy(latlong: Latlong) -> Float[Tensor, "b c"]:
    """Radiance integrated over the sphere, per image and channel (radiance x sr)."""
    require_latlong(latlong)
    weights = latlong_solid_angles(latlong.shape[1], device=latlong.device)
    return (latlong.double() * weights[None, :, :, None]).sum(dim=(1, 2)).to(latlong.dtype)


def _pad_sphere(latlong: Latlong) -> Float[Tensor, "b h+2 w+2 c"]:
    """Add one pixel on each side: around the seam, and over the poles (half a turn away)."""
    half = latlong.shape[2] // 2
    over_north = torch.roll(latlong[:, :1], half, dims=2)
    over_south = torch.roll(latlong[:, -1:], half, dims=2)
    tall = torch.cat((over_north, latlong, over_south), dim=1)
    return torch.cat((tall[:, :, -1:], tall, tall[:, :, :1]), dim=2)


def _bilinear(image: Image, columns: Tensor, rows: Tensor) -> Float[Tensor, "b *n c"]:
    """Sample at continuous pixel positions (0.5 is the centre of the first pixel); edges are held."""
    height, width = image.shape[1:3]
    grid = torch.stack((columns * (2 / width) - 1, rows * (2 / height) - 1), dim=-1)
    flat = grid.reshape(1, 1, -1, 2).expand(image.shape[0], -1, -1, -1)
    values = F.grid_sample(
        image.permute(0, 3, 1, 2), flat.to(image.dtype), mode="bilinear", padding_mode="border", align_corners=False
    )
    return values[:, :, 0].permute(0, 2, 1).reshape(image.shape[0], *columns.shape, image.shape[3])


def sample_latlong(latlong: Latlong, directions: Float[Tensor, "*n 3"]) -> Float[Tensor, "b *n c"]:
    """Bilinear values of a map in given directions, without a line at the seam or the poles.

    Args:
        latlong: (B, H, 2H, C), display-encoded or linear: values are interpolated as they are.
        directions: (..., 3), the same for every map of the batch.
    """
    require_latlong(latlong)
    u, v = latlong_coordinates(directions)
    height, width = latlong.shape[1:3]
    return _bilinear(_pad_sphere(latlong), u * width + 1, v * height + 1)


def latlong_neighbours(
    directions: Float[Tensor, "*n 3"], height: int
) -> tuple[Int[Tensor, "*n 4"], Float[Tensor, "*n 4"]]:
    """Pixels that `sample_latlong` reads in given directions, row by row, and their shares, which add up to 1.

    Args:
        directions: (..., 3), of any length above zero.
        height: rows of the map, 1 or more.

    Raises:
        OptionError: a height below 1.
    """
    _require_height(height)
    u, v = latlong_coordinates(directions)
    column, row = u * (2 * height) + 0.5, v * height + 0.5
    left, top = column.floor().clamp(0, 2 * height), row.floor().clamp(0, height)
    pixels = torch.arange(2.0 * height * height, dtype=torch.float64, device=directions.device).view(1, height, -1, 1)
    padded = _pad_sphere(pixels)[0, ..., 0]
    rows = torch.stack((top, top, top + 1, top + 1), dim=-1).long()
    columns = torch.stack((left, left + 1, left, left + 1), dim=-1).long()
    across, down = column - left, row - top
    shares = ((1 - across) * (1 - down), across * (1 - down), (1 - across) * down, across * down)
    return padded[rows, columns].long(), torch.stack(shares, dim=-1)


def rotate_latlong(latlong: Latlong, rotation: Float[Tensor, "3 3"], *, samples: int | None = None) -> Latlong:
    """Turn the world: the light from direction d comes from `rotation @ d` afterwards.

    Args:
        latlong: (B, H, 2H, C).
        rotation: a rotation matrix.
        samples: samples along each side of a pixel; when not given, as many as find every pixel of the map, which
            are narrow at its poles.

    Raises:
        OptionError: a map that is not 2:1, or samples outside 1 to 64.
    """
    require_latlong(latlong)
    height = latlong.shape[1]
    turn = rotation.to(latlong)

    def cells(pixels: Tensor, count: int) -> tuple[Tensor, Tensor]:
        row = torch.div(pixels, 2 * height, rounding_mode="floor")
        step = _subpixels(1, count, latlong.device)
        v = ((row[:, None] + step) / height)[:, :, None].expand(-1, -1, count)
        u = (((pixels - row * 2 * height)[:, None] + step) / (2 * height))[:, None, :].expand(-1, count, -1)
        return spherical(u, v).flatten(1, 2) @ turn, torch.sin(v * math.pi).flatten(1)

    return _average(latlong, cells, 2 * height**2, math.pi / height, samples).unflatten(1, (height, 2 * height))


def _average(
    latlong: Latlong,
    cells: Callable[[Tensor, int], tuple[Tensor, Tensor]],
    pixels: int,
    angle: float,
    samples: int | None,
) -> Float[Tensor, "b n c"]:
    """Means of a map over the pixels of another picture.

    Args:
        latlong: the map.
        cells: of some pixels (n,) and a count: (n, count², 3) directions spread over each pixel, of any length, and
            (n, count²) weights.
        pixels: how many the picture has.
        angle: that a pixel of the picture spans, radians.
        samples: count for every pixel; when not given, by what the map holds there.
    """
    every = torch.arange(pixels, device=latlong.device)
    if samples is None:
        counts = _sample_counts(cells(every, 1)[0][:, 0], latlong.shape[1], angle)
    else:
        _require_samples(samples)
        counts = torch.full_like(every, samples)
    means = latlong.new_empty(latlong.shape[0], pixels, latlong.shape[3])
    for count in counts.unique().tolist():
        for some in every[counts == count].split(max(1, (1 << 20) // count**2)):
            directions, weights = cells(some, count)
            share = (weights / weights.sum(dim=1, keepdim=True)).to(latlong)
            means[:, some] = (sample_latlong(latlong, directions) * share[..., None]).sum(dim=2)
    return means


def _sample_counts(directions: Float[Tensor, "n 3"], height: int, angle: float) -> Int[Tensor, "n"]:
    """Samples along a side of pixels that look at a map in these directions, as a power of 2: two to a map pixel.

    What is narrowest counts: a map's pixel is sin(polar) as wide as it is high. At its own pole, where that goes to 0,
    half a pixel of the picture is as near as its mean looks.
    """
    sine = torch.nn.functional.normalize(directions, dim=-1)[:, [0, 2]].norm(dim=-1).clamp(min=angle / 4)
    wanted = 2 * angle * height / (math.pi * sine)
    return 2 ** torch.log2(wanted.clamp(2, 64)).ceil().int()


# --- mirror ball -------------------------------------------------------------------------------------------------


def ball_solid_angle(radius: float) -> float:
    """Solid angle, in steradians, that each pixel of a ball of `radius` pixels reflects."""
    return 4 / radius**2


def ball_directions(
    size: int, *, radius: float | None = None, device: torch.device | None = None
) -> Float[Tensor, "d d 3"]:
    """Directions reflected by the pixel centres of a square ball crop; pixels off the ball reflect as the rim does.

    Args:
        size: side of the crop in pixels; the ball is centred in it.
        radius: of the ball in pixels; half the crop when not given.
        device: where to build the tensor.
    """
    positions = _subpixels(size, 1, device)
    return disc_directions(
        _crop_disc(positions, positions, size / 2 if radius is None else radius, (size / 2, size / 2))
    )


def ball_coverage(
    size: int, *, radius: float | None = None, samples: int = 64, device: torch.device | None = None
) -> Float[Tensor, "d d"]:
    """How much of each pixel of a square crop the ball covers, 0 to 1.

    The energy of a ball image is the sum of radiance x coverage x `ball_solid_angle(radius)`.
    """
    _require_samples(samples)
    radius, centre = _placed(size, radius, None)
    return coverage(size, radius, centre, ORTHOGRAPHIC.lens(radius, centre, size), samples).to(device)


def _crop_disc(columns: Tensor, rows: Tensor, radius: float, centre: tuple[float, float]) -> Float[Tensor, "r c 2"]:
    """Disc coordinates of a grid of pixel positions in a crop; longer than 1 outside the ball."""
    _require_radius(radius)
    x = (columns - centre[0]) / radius
    y = (centre[1] - rows) / radius
    return torch.stack((x[None, :].expand(len(y), -1), y[:, None].expand(-1, len(x))), dim=-1)


def _ball_samples(height: int, radius: float) -> int:
    """Samples along a side of a ball pixel so that six fall on each map pixel at the ball's centre.

    Fewer lose up to half a percent of the energy of a sun one map pixel wide.
    """
    map_pixel, ball_pixel = math.pi / height, 2 / radius
    return min(64, max(2, math.ceil(6 * ball_pixel / map_pixel)))


def latlong_to_ball(
    latlong: Latlong,
    size: int,
    *,
    radius: float | None = None,
    centre: tuple[float, float] | None = None,
    projection: Projection = ORTHOGRAPHIC,
    rotation: Float[Tensor, "3 3"] | None = None,
    samples: int | None = None,
) -> BallImage:
    """The mirror ball that a camera sees in the light of a map.

    Args:
        latlong: (B, H, 2H, C), normally linear radiance.
        size: side of the square crop in pixels.
        radius: of the ball in pixels; half the crop when not given.
        centre: (x, y) of the ball in the crop, in pixels from its top-left corner; the middle when not given.
        projection: of the camera.
        rotation: camera to world, as from `camera_rotation`; straight ahead when not given.
        samples: samples along each side of a pixel at the centre, up to four times as many near the rim; when not
            given, as many as keep the energy of a light one map pixel wide within 0.3%. Those of a rim pixel that
            miss the ball do not count.

    Returns:
        (B, size, size, C); zero outside the ball.

    Raises:
        OptionError: a map that is not 2:1, or samples outside 1 to 64.

    Source: DiffusionLight, Sec. 4.2 (training pairs: a chrome ball rendered from a panorama).
    """
    require_latlong(latlong)
    radius, centre = _placed(size, radius, centre)
    samples = _ball_samples(latlong.shape[1], radius) if samples is None else samples
    _require_samples(samples)
    lens = projection.lens(radius, centre, size)
    camera = (torch.eye(3) if rotation is None else rotation).to(latlong)
    x, y = torch.meshgrid(*[torch.arange(size, device=latlong.device, dtype=torch.float32)] * 2, indexing="xy")
    corners = torch.stack((x - centre[0], centre[1] - y), dim=-1).reshape(-1, 2)
    length = torch.linalg.norm(corners + corners.new_tensor([0.5, -0.5]), dim=-1) / radius
    # The last channel counts samples.
    total = latlong.new_zeros(latlong.shape[0], size * size, latlong.shape[3] + 1)
    for inner, outer, detail in _RINGS:
        ring = torch.nonzero((length >= inner) & (length < outer)).squeeze(1)
        total[:, ring] = _sum_ball_pixels(
            latlong, corners[ring], radius, lens, camera, min(64, round(detail * samples))
        )
    if lens.equal_area:
        _add_rim(total, latlong, radius, centre, camera)
    return (total[..., :-1] / total[..., -1:].clamp(min=1e-9)).unflatten(1, (size, size))


_RINGS = ((0.0, 0.7, 1.0), (0.7, 0.92, 1.5), (0.92, 0.985, 2.5), (0.985, math.inf, 4.0))
"""Rings of a ball (from, to, in radii) and how much finer than the centre they are sampled along a pixel's side.

A radial step dr turns the reflection by 2 dr / sqrt(1 - r²): 1.4 times as far at 0.7 as at the centre, 2.6 at 0.92,
5.8 at 0.985.
"""

_RIM = math.radians(20)
"""Angle from straight ahead within which an orthographic ball is sampled by direction.

There the ball's pixels are wedges of up to 14 degrees, and no even grid in a pixel finds a sun one degree wide.
"""


def _sum_ball_pixels(
    latlong: Latlong,
    corners: Float[Tensor, "n 2"],
    radius: float,
    lens: Lens,
    camera: Float[Tensor, "3 3"],
    samples: int,
) -> Float[Tensor, "b n k"]:
    """Radiance summed over the part on the ball of each of n pixels, and the area of that part, in pixels.

    Args:
        latlong: the light.
        corners: upper left corners, in pixels from the ball's centre, y up.
        radius: of the ball in pixels.
        lens: of the camera; of an orthographic one the rim is left to `_add_rim`.
        camera: camera to world.
        samples: along each side of a pixel.
    """
    step = _subpixels(1, samples, latlong.device)
    right, down = torch.meshgrid(step, step, indexing="xy")
    offsets = torch.stack((right, -down), dim=-1).reshape(-1, 2)
    batches = []
    for batch in corners.split(max(1, (1 << 20) // samples**2)):
        disc = (batch[:, None] + offsets) / radius
        on_ball = disc.square().sum(-1) < math.cos(_RIM / 2) ** 2 if lens.equal_area else lens.on_ball(disc)
        share = (on_ball.to(latlong) / samples**2)[..., None]
        values = sample_latlong(latlong, lens.reflect(disc) @ camera.T)
        area = share.sum(dim=1).expand(len(values), -1, -1)
        batches.append(torch.cat(((values * share).sum(dim=2), area), dim=-1))
    return torch.cat(batches, dim=1)


def _add_rim(
    total: Float[Tensor, "b n k"],
    latlong: Latlong,
    radius: float,
    centre: tuple[float, float],
    camera: Float[Tensor, "3 3"],
) -> None:
    """Add the rim of an orthographic ball to sums over pixels: rings about straight ahead, three to a map pixel."""
    size = math.isqrt(total.shape[1])
    rings = max(16, math.ceil(3 * latlong.shape[1] * _RIM / math.pi), math.ceil(radius / 2))
    spokes = max(64, math.ceil(6 * math.pi * radius))
    edges = torch.arange(rings + 1, device=latlong.device, dtype=torch.float64) * (_RIM / rings)
    areas = (torch.sin(edges / 2).square().diff() * (math.pi * radius**2 / spokes)).to(latlong)
    angle = ((edges[:-1] + edges[1:]) / 2).float()
    for ring, ring_areas in zip(angle.split(64), areas.split(64), strict=True):
        # Each ring is turned by the golden ratio of a step, so that spokes do not line up with pixels.
        turn = torch.arange(len(ring), device=latlong.device)[:, None] * 0.618 + torch.arange(
            spokes, device=latlong.device
        )
        x, y = (wave(turn * (2 * math.pi / spokes)) for wave in (torch.cos, torch.sin))
        sine, cosine = torch.sin(ring)[:, None], torch.cos(ring)[:, None]
        directions = torch.stack((sine * x, sine * y, -cosine.expand_as(x)), dim=-1).flatten(0, 1)
        distance = radius * torch.cos(ring / 2)[:, None]
        column, row = (centre[0] + distance * x).floor().long(), (centre[1] - distance * y).floor().long()
        on_crop = ((column >= 0) & (column < size) & (row >= 0) & (row < size)).flatten()
        values = sample_latlong(latlong, directions[on_crop] @ camera.T)
        weight = ring_areas[:, None].expand_as(x).flatten()[on_crop, None]
        values = torch.cat((values * weight, weight.expand(len(values), -1, -1)), dim=-1)
        total.index_add_(1, (row * size + column).flatten()[on_crop], values)


def ball_to_latlong(
    ball: BallImage,
    height: int,
    *,
    radius: float | None = None,
    centre: tuple[float, float] | None = None,
    projection: Projection = ORTHOGRAPHIC,
    samples: int = 1,
    painted: bool = False,
) -> Latlong:
    """Unwrap a mirror ball to a latlong map, each pixel of the map averaged over its footprint on the ball.

    Args:
        ball: (B, D, D, C), linear or display-encoded: values are interpolated as they are.
        height: rows of the map; its width is twice that.
        radius: of the ball in pixels; D / 2 when not given. Half a pixel too much or too little moves a light that
            stands 20 degrees from straight ahead by 2.8 degrees (for D = 256).
        centre: (x, y) of the ball in the crop, in pixels from its top-left corner; the middle when not given.
        projection: of the camera; directions it cannot see get the values of the outline (see `latlong_coverage`).
        samples: samples to a ball pixel's side, at least one to a pixel of the map. More cost time and gain nothing
            measurable (`lightprobe bench geometry`).
        painted: leave out the rim's pixels whose centre is off the ball. A picture shows background there, which no
            exposure darkens, so that a merge would take it for a lamp. Of a rendered ball (`latlong_to_ball`) those
            pixels hold only the ball; leaving them out costs up to 0.6% of the energy of a scene bright ahead.

    Returns:
        (B, height, 2 height, C). Differentiable in the ball.

    Raises:
        OptionError: a crop that is not square, a height below 1, a radius not above 0, or samples outside 1 to 8.

    Source: DiffusionLight, Sec. 4 ("unwrapped to an environment map").
    """
    if ball.ndim != 4 or ball.shape[1] != ball.shape[2]:
        raise OptionError("ball", tuple(ball.shape), "shape (batch, side, side, channels)")
    _require_height(height)
    if not 1 <= samples <= 8:
        raise OptionError("samples", samples, "1 to 8 samples to a ball pixel's side")
    size = ball.shape[1]
    radius, centre = _placed(size, radius, centre)
    return unwrap(ball, Footprints(height, size, radius, centre, projection, samples, painted))


def latlong_coverage(
    height: int,
    size: int,
    *,
    radius: float | None = None,
    centre: tuple[float, float] | None = None,
    projection: Projection = ORTHOGRAPHIC,
    device: torch.device | None = None,
) -> Mask:
    """Directions of a map that a ball really shows: (1, height, 2 height), 1 where seen and 0 elsewhere.

    Not seen are the cone behind a ball in perspective, what lies off the crop, and what is reflected by the outer
    half pixel of the ball, where a picture mixes it with its background.

    Args: as `ball_to_latlong`.
    """
    radius, centre = _placed(size, radius, centre)
    lens = projection.lens(radius, centre, size)
    directions = latlong_directions(height, device=device)
    disc = lens.locate(directions)
    x, y = centre[0] + radius * disc[..., 0], centre[1] - radius * disc[..., 1]
    inside = lens.on_ball(disc * (1 + 0.5 / radius)) & lens.sees(directions)
    on_crop = (x >= 0) & (x <= size) & (y >= 0) & (y <= size)
    return (inside & on_crop).float()[None]


def _placed(size: int, radius: float | None, centre: tuple[float, float] | None) -> tuple[float, tuple[float, float]]:
    """Radius and centre of a ball in its crop, with what was not given filled in."""
    radius = size / 2 if radius is None else radius
    _require_radius(radius)
    centre = (size / 2, size / 2) if centre is None else centre
    return float(radius), (float(centre[0]), float(centre[1]))


# --- camera ------------------------------------------------------------------------------------------------------


def camera_rotation(yaw: float = 0.0, pitch: float = 0.0, roll: float = 0.0) -> Float[Tensor, "3 3"]:
    """Rotation from camera to world axes.

    Args:
        yaw: degrees to the right.
        pitch: degrees up.
        roll: degrees clockwise, as the photographer turns the camera.
    """
    y, p, r = (math.radians(angle) for angle in (-yaw, pitch, -roll))
    about_y = torch.tensor([[math.cos(y), 0, math.sin(y)], [0, 1, 0], [-math.sin(y), 0, math.cos(y)]])
    about_x = torch.tensor([[1, 0, 0], [0, math.cos(p), -math.sin(p)], [0, math.sin(p), math.cos(p)]])
    about_z = torch.tensor([[math.cos(r), -math.sin(r), 0], [math.sin(r), math.cos(r), 0], [0, 0, 1]])
    return about_y @ about_x @ about_z


def _require_fov(fov: float) -> None:
    if not 1 <= fov <= 179:
        raise OptionError("fov", fov, "1 to 179 degrees")


def latlong_to_perspective(
    latlong: Latlong,
    height: int,
    width: int,
    *,
    fov: float = 60.0,
    rotation: Float[Tensor, "3 3"] | None = None,
    samples: int | None = None,
) -> Float[Tensor, "b rows columns c"]:
    """What a pinhole camera sees of a map.

    Args:
        latlong: (B, H, 2H, C).
        height: rows of the picture.
        width: columns of the picture.
        fov: field of view across the longer side, degrees, 1 to 179.
        rotation: camera to world, as from `camera_rotation`; straight ahead when not given.
        samples: samples along each side of a pixel; when not given, as many as find every pixel of the map.

    Raises:
        OptionError: a map that is not 2:1, field of view or samples out of range.
    """
    _require_fov(fov)
    require_latlong(latlong)
    extent = math.tan(math.radians(fov) / 2) * 2 / max(height, width)
    turn = (torch.eye(3) if rotation is None else rotation).to(latlong)

    def cells(pixels: Tensor, count: int) -> tuple[Tensor, Tensor]:
        row = torch.div(pixels, width, rounding_mode="floor")
        step = _subpixels(1, count, latlong.device)
        x = ((pixels - row * width)[:, None, None] + step - width / 2).expand(-1, count, -1)
        y = (height / 2 - row[:, None, None] - step[:, None]).expand(-1, -1, count)
        rays = torch.stack((x * extent, y * extent, -torch.ones_like(x)), dim=-1).flatten(1, 2)
        return rays @ turn.T, torch.ones_like(rays[..., 0])

    return _average(latlong, cells, height * width, extent, samples).unflatten(1, (height, width))


_SEEN_SAMPLES = 4
"""Samples along each side of a map's pixel that a picture is looked up in; it is averaged to two of them a pixel."""


def perspective_to_latlong(
    picture: Image,
    height: int,
    *,
    fov: float = 60.0,
    rotation: Float[Tensor, "3 3"] | None = None,
) -> tuple[Float[Tensor, "b rows columns c"], Float[Tensor, "1 rows columns"]]:
    """The part of a map that a pinhole camera saw: the inverse of `latlong_to_perspective`.

    Args:
        picture: (B, h, w, C), linear if means are to be means of light.
        height: rows of the map; its width is twice that.
        fov: field of view across the picture's longer side, degrees, 1 to 179.
        rotation: camera to world, as from `camera_rotation`; straight ahead when not given.

    Returns:
        (B, height, 2 height, C), each pixel the mean of what the picture shows of it, 0 where that is nothing; and
        (1, height, 2 height), the share of each pixel that the picture shows, 0 to 1.

    Raises:
        OptionError: a height below 1, or a field of view out of range.
    """
    _require_fov(fov)
    _require_height(height)
    rows, columns = picture.shape[1:3]
    half = math.tan(math.radians(fov) / 2)
    across, up = half * columns / max(rows, columns), half * rows / max(rows, columns)
    angle = math.pi / height
    coarser = angle / (2 * half / max(rows, columns)) / (_SEEN_SAMPLES / 2)
    if coarser > 1:
        size = [max(1, math.ceil(side / coarser)) for side in (rows, columns)]
        picture = F.interpolate(picture.permute(0, 3, 1, 2), size=size, mode="area").permute(0, 2, 3, 1)
        rows, columns = picture.shape[1:3]
    turn = (torch.eye(3) if rotation is None else rotation).to(picture)
    ahead = -(latlong_directions(height, device=picture.device) @ turn)[..., 2].flatten()
    near = torch.nonzero(ahead > math.cos(min(math.pi / 2, math.atan(math.hypot(across, up)) + 1.5 * angle))).squeeze(1)
    means = picture.new_zeros(picture.shape[0], 2 * height**2, picture.shape[3])
    shares = picture.new_zeros(1, 2 * height**2)
    step = _subpixels(1, _SEEN_SAMPLES, picture.device)
    for some in near.split((1 << 20) // _SEEN_SAMPLES**2):
        row = torch.div(some, 2 * height, rounding_mode="floor")
        v = ((row[:, None] + step) / height)[:, :, None].expand(-1, -1, _SEEN_SAMPLES)
        u = (((some - row * 2 * height)[:, None] + step) / (2 * height))[:, None, :].expand(-1, _SEEN_SAMPLES, -1)
        x, y, z = (spherical(u, v).flatten(1, 2) @ turn).unbind(-1)
        depth = (-z).clamp(min=1e-6)
        x, y = x / depth / across, y / depth / up
        solid = torch.sin(v * math.pi).flatten(1)
        seen = solid * ((z < 0) & (x.abs() <= 1) & (y.abs() <= 1))
        values = _bilinear(picture, (x + 1) * (columns / 2), (1 - y) * (rows / 2))
        total = seen.sum(dim=1)
        means[:, some] = (values * seen[..., None]).sum(dim=2) / total.clamp(min=1e-12)[:, None]
        shares[:, some] = total / solid.sum(dim=1)
    return means.unflatten(1, (height, 2 * height)), shares.unflatten(1, (height, 2 * height))
