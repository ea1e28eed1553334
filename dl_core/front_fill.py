"""The photograph itself as the front of the map.

The directions that the photograph shows are those the ball's rim resolves worst. They are filled with the photograph,
undistorted from its field of view, on the map's own scale: white at EV 0 is radiance 1 in both.

What the photograph clips it does not know. There the map keeps the radiance it holds, each channel by itself, as
exposures of a bracket complete each other (`exposure.merge_robust`). A lamp that the ball smears over its
surroundings would still lose the light that the photograph, which shows it sharp, has not beside it: within 9 degrees
of clipped pixels (`REACH`) that light is gathered in them, so that the sum stays the map's.

What it gains is measured by `lightprobe bench mend --options front`.

Sources: Phongthawee et al., DiffusionLight, Sec. 4 (what the ball's rim shows); Debevec and Malik, Recovering high
dynamic range radiance maps from photographs (SIGGRAPH 1997), for exposures that complete each other.
"""

from __future__ import annotations

import math
from typing import Final, NamedTuple

import torch
from jaxtyping import Float, Int
from torch import Tensor

from .errors import OptionError
from .exposure import clipping, decode_display
from .geometry import camera_rotation, latlong_directions, latlong_solid_angles, perspective_to_latlong, require_latlong
from .shapes import Latlong

__all__ = ["FEATHER", "FOV_RANGE", "FrontFilled", "check_fov", "check_tilt", "frame_distance", "front_fill"]

FOV_RANGE: Final = (5.0, 170.0)
"""Degrees across the longer side that a photograph may span."""
FEATHER: Final = 1.0
"""Degrees inside the photograph's borders over which it takes over from the map."""
REACH: Final = 9.0
"""Degrees around clipped pixels within which light of the map counts as theirs, smeared. Over 18 photographs of six
panoramas, behind the perfect painter and the mini model, 6 did as well; by 12 and more a lamp got light that was not
its own, and the map's RMSE rose in one."""
_COARSE_ROWS: Final = 128
"""Rows of the map on which light is gathered, at most."""


def check_fov(fov: float) -> float:
    """A photograph's field of view across its longer side, degrees.

    Raises:
        OptionError: outside 5 to 170, or not a number.
    """
    low, high = FOV_RANGE
    if not low <= fov <= high:
        raise OptionError("fov", fov, f"{low:g} to {high:g} degrees across the photograph's longer side")
    return fov


def check_tilt(pitch: float, roll: float) -> None:
    """Check how a camera was held.

    Raises:
        OptionError: a pitch outside -90 to 90 degrees or a roll outside -180 to 180.
    """
    for name, value, limit in (("pitch", pitch, 90), ("roll", roll, 180)):
        if not -limit <= value <= limit:
            raise OptionError(name, value, f"-{limit} to {limit} degrees")


def frame_distance(
    height: int, rows: int, columns: int, fov: float, rotation: Float[Tensor, "3 3"]
) -> Float[Tensor, "h w"]:
    """How far inside a photograph's frame each direction of a map is: degrees from the nearest border, below 0 outside.

    Args:
        height: rows of the map.
        rows: of the photograph.
        columns: of the photograph.
        fov: across its longer side, degrees.
        rotation: camera to world.
    """
    half = math.tan(math.radians(fov) / 2) / max(rows, columns)
    x, y, z = (latlong_directions(height) @ rotation).unbind(-1)
    # Each border lies in a plane through the camera; the distance from it is an angle.
    sides = [
        math.cos(angle) * sign * axis - math.sin(angle) * z
        for axis, angle in ((x, math.atan(half * columns)), (y, math.atan(half * rows)))
        for sign in (-1, 1)
    ]
    return torch.rad2deg(torch.asin(torch.stack(sides).amin(dim=0).clamp(-1, 1)))


class FrontFilled(NamedTuple):
    """A map with its front filled.

    Attributes:
        latlong_hdr: (B, H, 2H, 3) linear radiance.
        weight: (1, H, 2H) how much of each pixel is filled, 0 to 1; where it is 0 the map is as it was, bit for bit.
        known: (1, H, 2H) how much of each pixel is the photograph's own light: less than `weight` where that clips.
    """

    latlong_hdr: Latlong
    weight: Float[Tensor, "1 h w"]
    known: Float[Tensor, "1 h w"]


def front_fill(
    latlong_hdr: Latlong,
    photo_ldr: Float[Tensor, "1 rows columns 3"],
    fov: float,
    *,
    pitch: float = 0.0,
    roll: float = 0.0,
    feather: float = FEATHER,
) -> FrontFilled:
    """Fill the directions of a map that the photograph shows with the photograph.

    Args:
        latlong_hdr: (B, H, 2H, 3) linear radiance on the scale of the photograph's EV 0.
        photo_ldr: (1, rows, columns, 3) display-encoded in [0, 1].
        fov: field of view across the photograph's longer side, degrees, 5 to 170.
        pitch: degrees up that the camera looks on the map; 0 for a map as it was estimated, in the camera's own axes.
        roll: degrees clockwise that the camera is turned on the map.
        feather: degrees inside the photograph's borders over which it takes over, 0 to 45; at most half the way to the
            photograph's middle.

    Raises:
        OptionError: a map that is not 2:1, or an angle out of range.
    """
    require_latlong(latlong_hdr)
    check_fov(fov)
    check_tilt(pitch, roll)
    if not 0 <= feather <= 45:
        raise OptionError("feather", feather, "0 to 45 degrees")
    height = latlong_hdr.shape[1]
    rotation = camera_rotation(0.0, pitch, roll)
    linear = decode_display(photo_ldr).to(latlong_hdr)
    known = torch.cat((linear, clipping(linear)), dim=-1)
    shown, share = perspective_to_latlong(known, height, fov=fov, rotation=rotation)
    weight = share * _rise(
        frame_distance(height, photo_ldr.shape[1], photo_ldr.shape[2], fov, rotation).to(share), feather
    )
    radiance, clipped = shown.split(3, dim=-1)
    filled = radiance + clipped * (latlong_hdr - radiance).clamp(min=0)
    mixed = torch.lerp(latlong_hdr, filled, weight[..., None])
    mixed = mixed + _gathered(latlong_hdr - mixed, clipped * weight[..., None])
    known = weight * (1 - clipped.mean(dim=-1))
    return FrontFilled(torch.where(weight[..., None] > 0, mixed, latlong_hdr), weight, known)


def _gathered(lost: Float[Tensor, "b h w 3"], clipped: Float[Tensor, "1 h w 3"]) -> Float[Tensor, "b h w 3"]:
    """Radiance to add to clipped pixels so that they hold the light lost around them.

    Differences of both signs within reach are summed, so that a map that is too bright here and too dark there gives
    nothing; what a clipped pixel gets is never below 0.

    Args:
        lost: radiance of the map less that of the filled one.
        clipped: share of each pixel and channel that is filled and clipped.
    """
    if not bool((clipped > 0).any()):
        return torch.zeros_like(lost)
    height = lost.shape[1]
    coarse = min(height, _COARSE_ROWS)
    solid = latlong_solid_angles(height).to(lost)[None, ..., None]
    directions = latlong_directions(coarse).to(lost).flatten(0, 1)
    light, room = (_sum_cells(picture * solid, coarse).flatten(1, 2) for picture in (lost, clipped))
    added = torch.zeros_like(light)
    for channel in range(light.shape[-1]):
        takers = torch.nonzero(room[0, :, channel] > 0).squeeze(1)
        givers = torch.nonzero((light[..., channel] != 0).any(dim=0)).squeeze(1)
        taken = light.new_zeros(len(light), len(takers))
        for some in givers.split(max(1, (1 << 23) // max(1, len(takers)))):
            near = directions[some] @ directions[takers].T > math.cos(math.radians(REACH))
            shares = near * room[0, takers, channel]
            shares = shares / shares.sum(dim=1, keepdim=True).clamp(min=torch.finfo(shares.dtype).tiny)
            taken += light[:, some, channel] @ shares
        added[:, takers, channel] = taken.clamp(min=0) / room[0, takers, channel]
    return _spread_cells(added.unflatten(1, (coarse, 2 * coarse)), height) * clipped


def _cells(height: int, coarse: int) -> Int[Tensor, "n"]:
    """Coarse row (or column) that each row (or column) of a map belongs to."""
    return torch.div(torch.arange(height) * coarse, height, rounding_mode="floor")


def _sum_cells(picture: Float[Tensor, "b h w c"], coarse: int) -> Float[Tensor, "b rows columns c"]:
    height, width = picture.shape[1:3]
    rows = picture.new_zeros(len(picture), coarse, width, picture.shape[3])
    rows.index_add_(1, _cells(height, coarse).to(picture.device), picture)
    sums = picture.new_zeros(len(picture), coarse, 2 * coarse, picture.shape[3])
    return sums.index_add_(2, _cells(width, 2 * coarse).to(picture.device), rows)


def _spread_cells(cells: Float[Tensor, "b rows columns c"], height: int) -> Float[Tensor, "b h w c"]:
    coarse = cells.shape[1]
    return cells[:, _cells(height, coarse)][:, :, _cells(2 * height, 2 * coarse)]


def _rise(distance: Float[Tensor, "h w"], feather: float) -> Float[Tensor, "h w"]:
    """From 0 at the border to 1, smoothly, over so many degrees."""
    within = min(feather, float(distance.max()) / 2)
    if within <= 0:
        return torch.ones_like(distance)
    step = (distance / within).clamp(0, 1)
    return step * step * (3 - 2 * step)
