"""Footprints of latlong pixels on a mirror ball, as a sparse matrix.

A pixel of the map is split into cells of equal solid angle, as many as keep every cell's sides below a fraction of a
ball pixel: a few almost everywhere, hundreds straight ahead, where a pixel of the map is a long thin arc along the
rim. Each cell reads the ball bilinearly at its middle, and a row of the matrix is their mean. Rows sum to one, so
that a uniform ball gives a uniform map. Under an equal-area projection the columns are balanced (Sinkhorn's
iteration) until each ball pixel lights the map with the solid angle it reflects, so that any ball keeps its energy.

The matrix depends on sizes, place and projection only; it is cached, and unwrapping is one sparse product. A ball in
the middle of its crop and straight ahead of its camera looks the same in both mirrors, left and right, up and down:
then the matrix is that of a quarter of the map, and the quarters are read off the ball and its mirror images.

Source: Sinkhorn and Knopp, Concerning nonnegative matrices and doubly stochastic matrices (1967).
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

from .projection import Lens, Projection
from .shapes import BallImage, Directions, Latlong
from .sparse_rows import SparseRows

__all__ = ["Footprints", "coverage", "spherical", "unwrap"]

CELL_COUNTS: Final = (1, 2, 3, 4, 6, 8, 12, 16, 24, 32, 48, 64)
"""Cells along a side of a map pixel; the largest serves the pixels that meet straight ahead."""
BALANCE_SAMPLES: Final = 16
"""Samples along a side of a pixel on the outline, to tell how much of it the ball covers."""
SWEEPS: Final = 4
"""Of Sinkhorn's iteration: leaves the energy of a map within 0.1%."""
CACHED_PIXELS: Final = 1 << 20
"""Map pixels up to which a matrix stays in the cache (about 64 MB)."""
STRIP_PIXELS: Final = 1 << 18


def spherical(u: Tensor, v: Tensor) -> Directions:
    """Unit vectors for map coordinates u (across) and v (down), both in [0, 1]."""
    azimuth = (u - 0.5) * (2 * math.pi)
    polar = v * math.pi
    sin_polar = torch.sin(polar)
    return torch.stack((sin_polar * torch.sin(azimuth), torch.cos(polar), -sin_polar * torch.cos(azimuth)), dim=-1)


@dataclass(frozen=True)
class Footprints:
    """What an unwrapping depends on beside the ball's values: the key of the cache.

    Attributes:
        height: rows of the map.
        size: side of the ball crop in pixels.
        radius: of the ball in pixels.
        centre: (x, y) of the ball in the crop.
        projection: of the camera.
        samples: cells to a ball pixel's side, at least.
        painted: leave out pixels whose centre is off the ball.
    """

    height: int
    size: int
    radius: float
    centre: tuple[float, float]
    projection: Projection
    samples: int
    painted: bool

    @property
    def lens(self) -> Lens:
        """The projection of this ball."""
        return self.projection.lens(self.radius, self.centre, self.size)

    @property
    def mirrors(self) -> tuple[tuple[int, ...], ...]:
        """Mirror images of the ball, as axes (0 rows, 1 columns) to flip, under which its map is mirrored alike.

        The first is the ball itself; what the matrix holds is the first part of the map, 1 / len(mirrors) of it.
        """
        ahead = self.lens.axis[:2] == (0.0, 0.0) and self.centre == (self.size / 2, self.size / 2)
        return ((), (1,), (0,), (0, 1)) if ahead and self.height % 2 == 0 else ((),)

    @property
    def part(self) -> tuple[int, int]:
        """Rows and columns of the map, from its upper left corner, that the matrix holds."""
        return (self.height // 2, self.height) if len(self.mirrors) > 1 else (self.height, 2 * self.height)

    def disc(self, columns: Tensor, rows: Tensor) -> Float[Tensor, "r c 2"]:
        """Disc points of a grid of pixel positions in the crop."""
        x = (columns - self.centre[0]) / self.radius
        y = (self.centre[1] - rows) / self.radius
        return torch.stack((x[None, :].expand(len(y), -1), y[:, None].expand(-1, len(x))), dim=-1)


def unwrap(ball: BallImage, key: Footprints) -> Latlong:
    """Average a ball over the footprints of a map's pixels; differentiable in the ball."""
    strips, used = (_cached_matrix if 2 * key.height**2 <= CACHED_PIXELS else _matrix)(key, ball.device)
    # Multiplied by 0, what is left out could still be NaN.
    used_only = torch.where(used[None, :, :, None], ball, torch.zeros_like(ball))
    images = torch.stack([used_only.flip([axis + 1 for axis in axes]) for axes in key.mirrors])
    # The sparse product has no half precision.
    dense = images.permute(2, 3, 0, 1, 4).flatten(0, 1).flatten(1).to(torch.promote_types(ball.dtype, torch.float32))
    rows = torch.cat([strip @ dense for strip in strips]).to(ball.dtype)
    parts = rows.unflatten(0, key.part).unflatten(2, (*images.shape[:2], -1)).permute(2, 3, 0, 1, 4)
    return _join(parts, key)


def _join(parts: Float[Tensor, "m b p q c"], key: Footprints) -> Latlong:
    """The map, of the parts that its mirror images gave."""
    if len(parts) == 1:
        return parts[0]
    turned = [part.flip([axis + 1 for axis in axes]) for part, axes in zip(parts, key.mirrors, strict=True)]
    upper, lower = torch.cat(turned[:2], dim=2), torch.cat(turned[2:], dim=2)
    return torch.cat((upper, lower), dim=1)


@torch.inference_mode(mode=False)  # a cached inference tensor could never take part in a gradient
@torch.no_grad()
def _matrix(key: Footprints, device: torch.device) -> tuple[tuple[SparseRows, ...], Tensor]:
    """The matrix of `key.part` of a map in strips of rows, and which ball pixels (size, size) it reads."""
    height, width = key.part
    rows = max(1, STRIP_PIXELS // (width * key.samples**2))
    raw = [_strip(key, first, min(rows, height - first)) for first in range(0, height, rows)]
    weights = _pixel_weights(key, raw)
    strips = []
    while raw:
        strip = raw.pop(0)
        strips.append(_balanced(key, strip, weights).to(device))
    return tuple(strips), (weights > 0).view(key.size, key.size).to(device)


def _balanced(key: Footprints, strip: SparseRows, weights: Float[Tensor, "k"]) -> SparseRows:
    """Rows scaled by the weights of what they read, and then to a sum of 1; the input is overwritten."""
    blind = torch.nonzero(strip.spread((strip @ weights[:, None])[:, 0]) <= 0).squeeze(1)
    # A point of the outline between pixels that are all left out: read 2.5 pixels further in.
    strip.columns[blind] = _pulled_in(key, strip.columns[blind])
    total = (strip @ weights[:, None])[:, 0].clamp(min=1e-12)
    strip.values.mul_(weights[strip.columns]).div_(strip.spread(total))
    return strip


def _pulled_in(key: Footprints, pixels: Int[Tensor, "n"]) -> Int[Tensor, "n"]:
    """The pixels 2.5 pixels nearer to the ball's centre."""
    row = torch.div(pixels, key.size, rounding_mode="floor")
    offset = torch.stack((pixels - row * key.size, row), dim=-1) + 0.5 - torch.tensor(key.centre)
    length = torch.linalg.norm(offset, dim=-1, keepdim=True)
    moved = torch.tensor(key.centre) + offset * ((length - 2.5).clamp(min=0) / length.clamp(min=1e-6))
    column, row = moved.floor().int().clamp(0, key.size - 1).unbind(-1)
    return row * key.size + column


_cached_matrix = lru_cache(maxsize=8)(_matrix)


def _pixel_weights(key: Footprints, strips: list[SparseRows]) -> Float[Tensor, "k"]:
    """Weights of the ball's pixels, 0 for those left out.

    Beside the rim a bilinear sample reaches past the ball, and rows leave those pixels out and share their weight
    among the rest; without balance that costs 1% of the energy of a scene bright straight ahead.
    """
    covered = coverage(key.size, key.radius, key.centre, key.lens, BALANCE_SAMPLES).flatten()
    weights = covered.clone()
    band = torch.arange(key.height + 1, dtype=torch.float64) * (math.pi / key.height)
    solid = (torch.cos(band).diff().neg() * (key.radius**2 / 4 * math.pi / key.height)).float()
    if key.lens.equal_area:
        for _ in range(SWEEPS):
            weights = _sweep(key, weights, covered, strips, solid)
    if key.painted:
        positions = torch.arange(key.size) + 0.5
        weights = weights * key.lens.on_ball(key.disc(positions, positions)).flatten()
    return weights


def _sweep(
    key: Footprints,
    weights: Float[Tensor, "k"],
    covered: Float[Tensor, "k"],
    strips: list[SparseRows],
    solid: Float[Tensor, "h"],
) -> Float[Tensor, "k"]:
    """One sweep of Sinkhorn's iteration: rows to 1, then columns to what the ball covers of each pixel."""
    share = torch.zeros_like(weights)
    height, width = key.part
    pixels = solid[:height].repeat_interleave(width).split([len(strip.starts) for strip in strips])
    for strip, areas in zip(strips, pixels, strict=True):
        per_row = areas / (strip @ weights[:, None])[:, 0].clamp(min=1e-12)
        share.index_add_(0, strip.columns, strip.values * strip.spread(per_row))
    square = share.view(key.size, key.size)
    share = sum((square.flip(axes) for axes in key.mirrors), torch.zeros_like(square)).flatten() * weights
    return torch.where(share > 0, weights * covered / share.clamp(min=1e-12), weights)


def coverage(
    size: int, radius: float, centre: tuple[float, float], lens: Lens, samples: int = 64
) -> Float[Tensor, "d d"]:
    """How much of each pixel of a crop the ball covers, 0 to 1: exact inside and outside, sampled on the outline."""

    def on_ball(columns: Tensor, rows: Tensor) -> Tensor:
        return lens.on_ball(torch.stack(((columns - centre[0]) / radius, (centre[1] - rows) / radius), dim=-1))

    edges = torch.arange(size + 1, dtype=torch.float32)
    corners = on_ball(*torch.meshgrid(edges, edges, indexing="xy")).float()[None, None]
    inside = -F.max_pool2d(-corners, 2, 1)[0, 0]
    near = F.max_pool2d(F.max_pool2d(corners, 2, 1), 3, 1, 1)[0, 0]
    rows, columns = torch.nonzero((inside == 0) & (near > 0), as_tuple=True)
    step = (torch.arange(samples) + 0.5) / samples
    x, y = columns[:, None, None] + step, rows[:, None, None] + step[:, None]
    inside[rows, columns] = on_ball(*torch.broadcast_tensors(x, y)).float().mean(dim=(1, 2))
    return inside


def _strip(key: Footprints, first: int, rows: int) -> SparseRows:
    """Unbalanced matrix of some rows of the map: bilinear weights of every cell."""
    across, down = _cell_counts(key, first, rows)
    starts = (4 * across * down).cumsum(0)
    columns = torch.empty(int(starts[-1]), dtype=torch.int32)
    values = torch.empty(int(starts[-1]))
    starts = F.pad(starts, (1, 0))[:-1]
    kinds = across * 128 + down
    for kind in kinds.unique().tolist():
        pixels = torch.nonzero(kinds == kind).squeeze(1)
        kind_columns, kind_values = _bilinear_entries(
            key, _cells(key, pixels + first * key.part[1], *divmod(kind, 128))
        )
        places = starts[pixels, None] + torch.arange(kind_columns.shape[1])
        columns[places], values[places] = kind_columns, kind_values
    return SparseRows(starts.int(), columns, values)


def _cell_counts(key: Footprints, first: int, rows: int) -> tuple[Int[Tensor, "n"], Int[Tensor, "n"]]:
    """Cells across and down each pixel of some rows: none longer on the ball than 1 / samples of its pixels.

    A step on the sphere at β from the ball's middle direction is cos(β/2) / 2 as long on the disc towards the axis,
    and 1 / (2 cos(β/2)) around it. (A ball seen in perspective differs by a few percent.)
    """
    angle = math.pi / key.height
    azimuth = (torch.arange(key.part[1]) + 0.5) * angle - math.pi
    polar = ((torch.arange(first, first + rows) + 0.5) * angle)[:, None]
    ax, ay, az = key.lens.axis
    ahead = ax * torch.sin(azimuth) - az * torch.cos(azimuth)
    aside = ax * torch.cos(azimuth) + az * torch.sin(azimuth)
    cosine = torch.sin(polar) * ahead + torch.cos(polar) * ay
    half = ((1 - cosine) / 2).clamp(min=angle**2 / 16)  # cos²(β/2)
    sine = (1 - cosine.square()).clamp(min=1e-12)

    def count(step: Tensor | float, radial: Tensor) -> Tensor:
        share = (radial.square() / sine).clamp(max=1)
        length = torch.sqrt(share * half + (1 - share) / half) / 2 * step * (key.radius * key.samples)
        return torch.bucketize(length, length.new_tensor(CELL_COUNTS[:-1])).flatten()

    counts = torch.tensor(CELL_COUNTS)
    upward = torch.cos(polar) * ahead - torch.sin(polar) * ay
    return counts[count(torch.sin(polar) * angle, aside)], counts[count(angle, upward)]


def _cells(key: Footprints, pixels: Int[Tensor, "n"], across: int, down: int) -> Float[Tensor, "n cells 3"]:
    """Middles of a pixel's cells. Down a pixel they divide the height cos(polar), so that all are equal in area."""
    row = torch.div(pixels, key.part[1], rounding_mode="floor")
    column = pixels - row * key.part[1]
    part = (torch.arange(down) + 0.5) / down
    # cos a - cos b = 2 sin((a + b) / 2) sin((b - a) / 2): the middles keep their digits at the poles.
    top, bottom = (row[:, None] + 0.0) / key.height, (row[:, None] + 1.0) / key.height
    low, high = torch.sin(top * (math.pi / 2)) ** 2, torch.sin(bottom * (math.pi / 2)) ** 2
    v = torch.asin(torch.sqrt(torch.lerp(low, high, part.expand(len(row), -1)))) * (2 / math.pi)
    u = (column[:, None] + (torch.arange(across) + 0.5) / across) / (2 * key.height)
    return spherical(u[:, None, :].expand(-1, down, -1), v[:, :, None].expand(-1, -1, across)).flatten(1, 2)


def _bilinear_entries(
    key: Footprints, directions: Float[Tensor, "n cells 3"]
) -> tuple[Int[Tensor, "n e"], Float[Tensor, "n e"]]:
    """Pixels of the ball that each cell reads, and their weights; what lies off the crop reads its edge."""
    disc = key.lens.locate(directions)
    columns, shares_x = _neighbours(key.centre[0] + key.radius * disc[..., 0], key.size)
    rows, shares_y = _neighbours(key.centre[1] - key.radius * disc[..., 1], key.size)
    pixels = rows[..., :, None] * key.size + columns[..., None, :]
    return pixels.flatten(1), (shares_y[..., :, None] * shares_x[..., None, :]).flatten(1) / directions.shape[1]


def _neighbours(positions: Tensor, size: int) -> tuple[Int[Tensor, "*n 2"], Float[Tensor, "*n 2"]]:
    """The two pixels along an axis between whose centres a position lies, and their shares; 0 off the crop."""
    # Off the crop by a pixel or more, the edge still has a share to be scaled up.
    position = (positions - 0.5).clamp(1e-3 - 1, size - 1e-3)
    first = torch.floor(position)
    share = position - first
    pair = torch.stack((first, first + 1), dim=-1)
    shares = torch.stack((1 - share, share), dim=-1)
    return pair.clamp(0, size - 1).int(), shares * ((pair >= 0) & (pair < size))
