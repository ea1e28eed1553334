"""Spheres under a map: what a light probe does to a diffuse, a matte and a mirror ball.

The viewer is that of `geometry`: orthographic, at +Z, so that the sphere stands in the photograph like the painted
ball. A mirror sphere is the map on a ball. A diffuse (Lambertian) one has radiance albedo / π · E(n), with the
irradiance E(n) = ∫ L(l) max(0, n·l) dω. A matte one is rough silver (`microfacet`), as the authors evaluate with; their
own camera and their diffuse sphere, which has a coat, are in `sphere_scene`.

E is summed over light vectors, D = ∫ L l dω of a patch of the map: for a normal n that sees the whole patch,
n·D is the patch's irradiance exactly, however its radiance is spread. Patches that straddle the horizon of n are the
only error, and grazing light weighs little there.

Sources: DiffusionLight, Sec. 5 (three spheres); Gershun, "The light field" (1939), for the light vector; Lambert,
"Photometria" (1760).
"""

from __future__ import annotations

import math
from collections.abc import Callable, Iterable, Sequence
from dataclasses import dataclass
from typing import Final

import numpy as np
import torch
import torch.nn.functional as F
from jaxtyping import Float
from PIL import Image as PILImage
from PIL import ImageDraw, ImageFont
from torch import Tensor

from .errors import ImageError, OptionError
from .exposure import auto_exposure, encode_display
from .geometry import ball_coverage, latlong_to_ball
from .microfacet import Surface
from .shapes import BallImage, Image, Latlong
from .sphere_scene import AUTHORS_SPHERES, View, render_sphere

__all__ = ["ALBEDO", "MATERIALS", "gathered_irradiance", "render_spheres", "sphere_normals", "sphere_sheet"]

ALBEDO: Final = 0.8
"""Base colour of the spheres the authors evaluate with."""

_PATCH_ROWS: Final = 32
"""Rows of patches a map is gathered in; twice as many across."""
_CHUNK: Final = 1 << 20
"""Cosines held in memory at a time: few enough for the processor's cache."""


# --- light -------------------------------------------------------------------------------------------------------


def _pixel_vectors(height: int, device: torch.device) -> Float[Tensor, "h w 3"]:
    """∫ l dω over each pixel of a map, in closed form, steradians."""
    polar = torch.arange(height + 1, device=device, dtype=torch.float64) * (math.pi / height)
    azimuth = (torch.arange(2 * height + 1, device=device, dtype=torch.float64) / height - 1) * math.pi
    level = (polar / 2 - torch.sin(2 * polar) / 4).diff()[:, None]  # ∫ sin² θ dθ
    upright = (torch.sin(polar) ** 2 / 2).diff()[:, None] * (math.pi / height)  # ∫ cos θ sin θ dθ dφ
    x = level * -torch.cos(azimuth).diff()
    z = level * -torch.sin(azimuth).diff()
    return torch.stack((x, upright.expand_as(x), z), dim=-1).float()


def _gather(values: Tensor, axis: int, groups: int) -> Tensor:
    """Sum neighbours along an axis into `groups` groups of nearly equal size; fewer values stay as they are."""
    count = values.shape[axis]
    if count <= groups:
        return values
    index = torch.arange(count, device=values.device) * groups // count
    shape = [*values.shape]
    shape[axis] = groups
    return values.new_zeros(shape).index_add_(axis, index, values)


def _light_vectors(latlong_hdr: Latlong) -> Float[Tensor, "b c patches 3"]:
    """Light vectors of the patches of a map, one for each channel."""
    vectors = _pixel_vectors(latlong_hdr.shape[1], latlong_hdr.device).to(latlong_hdr.dtype)
    weighted = latlong_hdr[..., None] * vectors[None, :, :, None, :]
    patches = _gather(_gather(weighted, 1, _PATCH_ROWS), 2, 2 * _PATCH_ROWS)
    return patches.permute(0, 3, 1, 2, 4).flatten(2, 3)


def gathered_irradiance(latlong_hdr: Latlong, normals: Float[Tensor, "*n 3"]) -> Float[Tensor, "b *n c"]:
    """Irradiance from a map, fast enough to shade pictures; `metrics.irradiance` sums every pixel.

    Args:
        latlong_hdr: (B, H, 2H, C) linear radiance.
        normals: (..., 3) unit vectors.

    Returns:
        (B, ..., C), radiance units x sr; π times the radiance under a uniform map.

    Raises:
        OptionError: a map that is not 2:1.

    Warnings:
        Maps of more than 32 rows are gathered in 32 x 64 patches. Each keeps its energy and direction, so a small light
        stays where it is; a patch on the horizon of a normal counts as if it were all in its direction. That is up to
        0.12% low under a uniform map, and 0.11% (RMS over normals) off on the panoramas in `data/hdri`.
    """
    if latlong_hdr.ndim != 4 or latlong_hdr.shape[2] != 2 * latlong_hdr.shape[1]:
        raise OptionError("latlong", tuple(latlong_hdr.shape), "shape (batch, height, 2 x height, channels)")
    vectors = _light_vectors(latlong_hdr)
    flat = normals.reshape(-1, 3).to(latlong_hdr)
    patches = vectors.shape[0] * vectors.shape[1] * vectors.shape[2]
    received = [
        torch.einsum("bcpk,nk->bcnp", vectors, chunk).clamp_(min=0).sum(-1)
        for chunk in flat.split(max(1, _CHUNK // patches))
    ]
    return torch.cat(received, dim=-1).permute(0, 2, 1).reshape(latlong_hdr.shape[0], *normals.shape[:-1], -1)


# --- spheres -----------------------------------------------------------------------------------------------------


def sphere_normals(size: int, *, device: torch.device | None = None) -> Float[Tensor, "d d 3"]:
    """Normals of a sphere that fills a square crop, at the pixel centres; off the sphere, those of its rim."""
    positions = ((torch.arange(size, device=device) + 0.5) / size) * 2 - 1
    x, y = positions[None, :].expand(size, -1), -positions[:, None].expand(-1, size)
    length = torch.hypot(x, y).clamp(min=1)
    x, y = x / length, y / length
    return torch.stack((x, y, torch.sqrt((1 - x * x - y * y).clamp(min=0))), dim=-1)


def _shade(latlong_hdr: Latlong, size: int, albedo: float) -> BallImage:
    """The diffuse sphere, continued beyond its rim by the rim's own radiance."""
    return gathered_irradiance(latlong_hdr, sphere_normals(size, device=latlong_hdr.device)) * (albedo / math.pi)


def _diffuse(latlong_hdr: Latlong, size: int, albedo: float) -> BallImage:
    visible = ball_coverage(size, device=latlong_hdr.device) > 0
    return _shade(latlong_hdr, size, albedo) * visible[..., None]


def _matte(latlong_hdr: Latlong, size: int, albedo: float) -> BallImage:
    silver = Surface(base=albedo, metallic=True, roughness=AUTHORS_SPHERES["matte"].roughness)
    return render_sphere(latlong_hdr, silver, View.square(size))


def _mirror(latlong_hdr: Latlong, size: int, albedo: float) -> BallImage:
    return latlong_to_ball(latlong_hdr, size)


MATERIALS: Final[dict[str, Callable[[Latlong, int, float], BallImage]]] = {
    "diffuse": _diffuse,
    "matte": _matte,
    "mirror": _mirror,
}
"""Spheres by material: (map, size, albedo) -> radiance. The albedo is a matte sphere's base colour, that is, what its
mirrors reflect at right angles; a mirror reflects everything, whatever the albedo.
"""


def _require_albedo(albedo: float) -> None:
    if not 0 <= albedo <= 1:
        raise OptionError("albedo", albedo, "0 to 1")


def render_spheres(
    latlong_hdr: Latlong, size: int, materials: Iterable[str] = tuple(MATERIALS), *, albedo: float = ALBEDO
) -> dict[str, BallImage]:
    """Render spheres in the light of a map.

    Args:
        latlong_hdr: (B, H, 2H, 3) linear radiance.
        size: side of each picture in pixels; the sphere fills it.
        materials: names of `MATERIALS`.
        albedo: of the diffuse and the matte sphere, 0 to 1; 1 is ideal white.

    Returns:
        By material, in the order asked for: (B, size, size, 3) linear radiance, zero off the sphere.

    Raises:
        OptionError: an unknown material, an albedo outside 0 to 1, a size below 1, or a map that is not 2:1.
    """
    names = tuple(materials)
    _require_albedo(albedo)
    if size < 1:
        raise OptionError("size", size, "1 or more pixels")
    for name in names:
        if name not in MATERIALS:
            raise OptionError("material", name, ", ".join(MATERIALS))
    return {name: MATERIALS[name](latlong_hdr, size, albedo) for name in names}


# --- the sheet ---------------------------------------------------------------------------------------------------

_BACKGROUND: Final = 0.13
_INK: Final = (200, 200, 200)
_GAP: Final = 16
_LABEL: Final = 24


@dataclass(frozen=True)
class _Tile:
    """A labelled picture: (1, h, w, 3), display-encoded."""

    label: str
    picture: Image


def sphere_sheet(
    latlong_hdr: Latlong,
    *,
    composite_ldr: Float[Tensor, "1 side side 3"] | None = None,
    balls_ldr: Sequence[BallImage] = (),
    evs: Sequence[float] = (),
    size: int = 256,
    albedo: float = ALBEDO,
    confidence: Float[Tensor, "1 h w 1"] | None = None,
) -> Float[Tensor, "rows columns 3"]:
    """One picture for people: the photograph with its ball, the ball at each exposure, the map, spheres under it.

    The map and the mirror sphere are shown at the exposure that puts the map's 99th percentile at 0.9; so is the
    diffuse sphere, unless it would be brighter than that itself: then it is shown darker, by the EV on its label.

    Args:
        latlong_hdr: (1, H, 2H, 3) linear radiance.
        composite_ldr: (1, S, S, 3) display-encoded photograph with the ball.
        balls_ldr: (1, D, D, 3) display-encoded ball for each EV.
        evs: their exposure values.
        size: side of a tile in pixels.
        albedo: of the diffuse sphere.
        confidence: (1, H, 2H, 1) in [0, 1], shown in a row of its own: white is sure.

    Returns:
        (rows, columns, 3) display-encoded in [0, 1].

    Raises:
        OptionError: not one ball per EV, or an albedo outside 0 to 1.
        ImageError: a batch of maps.
    """
    _require_albedo(albedo)
    if latlong_hdr.shape[0] != 1:
        raise ImageError("latlong", f"holds {latlong_hdr.shape[0]} maps; a sheet shows one")
    if len(balls_ldr) != len(evs):
        raise OptionError("balls", len(balls_ldr), f"one ball image per EV, that is {len(evs)}")
    painted = [] if composite_ldr is None else [_Tile("photograph and ball", _fit(composite_ldr, size, size))]
    painted += [
        _Tile(f"ball, EV {ev:g}", _on_background(_fit(ball, size, size)))
        for ball, ev in zip(balls_ldr, evs, strict=True)
    ]
    trusted = [] if confidence is None else [_confidence_tile(confidence, size)]
    return _lay_out([row for row in (painted, _light_tiles(latlong_hdr, size, albedo), trusted) if row], size)


def _confidence_tile(confidence: Float[Tensor, "1 h w 1"], size: int) -> _Tile:
    return _Tile("confidence: white sure, grey a stop off", _fit(confidence.expand(-1, -1, -1, 3), size, 2 * size))


def _light_tiles(latlong_hdr: Latlong, size: int, albedo: float) -> list[_Tile]:
    """The map and the spheres under it, drawn for the eye: shading is smooth, so half of its pixels are computed.

    The mirror takes fewer samples than `render_spheres`, whose lights keep their energy.
    """
    diffuse = _shade(latlong_hdr, (size + 1) // 2, albedo)
    mirror = latlong_to_ball(latlong_hdr, size, samples=2)
    scale = auto_exposure(latlong_hdr)
    own = min(scale, auto_exposure(diffuse))
    shift = f", EV {math.log2(own / scale):.1f}" if own < scale else ""
    return [
        _Tile("map, 99th percentile at 0.9", _fit(encode_display(latlong_hdr * scale), size, 2 * size)),
        _Tile(
            f"diffuse sphere, albedo {albedo:g}{shift}", _on_background(_fit(encode_display(diffuse * own), size, size))
        ),
        _Tile("mirror sphere", _on_background(encode_display(mirror * scale))),
    ]


def _fit(image: Image, height: int, width: int) -> Float[Tensor, "b rows columns c"]:
    resized = F.interpolate(image.permute(0, 3, 1, 2), (height, width), mode="bilinear", antialias=True)
    return resized.permute(0, 2, 3, 1).clamp(0, 1)


def _on_background(ball: BallImage) -> BallImage:
    coverage = ball_coverage(ball.shape[1]).to(ball)[..., None]
    return ball * coverage + _BACKGROUND * (1 - coverage)


def _lay_out(rows: Sequence[Sequence[_Tile]], size: int) -> Float[Tensor, "rows columns 3"]:
    """Tiles in rows of one height, each under its label."""
    step = size + _LABEL + _GAP
    width = max(sum(tile.picture.shape[-2] + _GAP for tile in row) for row in rows) + _GAP
    codes = np.full((step * len(rows) + _GAP, width, 3), round(_BACKGROUND * 255), np.uint8)
    places: list[tuple[int, int, str]] = []
    for index, row in enumerate(rows):
        left, top = _GAP, _GAP + step * index
        for tile in row:
            picture = (tile.picture[0].detach().cpu() * 255).round().to(torch.uint8).numpy()
            codes[top + _LABEL : top + _LABEL + size, left : left + picture.shape[1]] = picture
            places.append((left, top, tile.label))
            left += picture.shape[1] + _GAP
    return torch.from_numpy(_write_labels(codes, places).astype(np.float32) / 255)


def _write_labels(codes: np.ndarray, places: Sequence[tuple[int, int, str]]) -> np.ndarray:
    sheet = PILImage.fromarray(codes)
    draw = ImageDraw.Draw(sheet)
    font = ImageFont.load_default(14)
    for left, top, label in places:
        draw.text((left, top), label, fill=_INK, font=font)
    return np.asarray(sheet)
