"""Spheres under maps, harmonics and lights, as sums: what is rendered once serves every model of a map.

Rendering is linear in the light, so a model's sphere is the sum of nine rendered harmonics and of its lights, each
times its colour. The sum is signed, as the harmonics are; a pixel of the sphere that falls below 0 is shown as 0.

The error of a model on a material is the root mean square of its sphere's difference from the full map's, over the
sphere's pixels (weighted by how much of each the sphere covers) and the channels, divided by the root mean square of
the full map's sphere.

Source: Ramamoorthi and Hanrahan, An efficient representation for irradiance environment maps (SIGGRAPH 2001), for the
closed form of diffuse spheres under harmonics.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from functools import lru_cache
from typing import Final

import torch
from jaxtyping import Float
from torch import Tensor

from ..errors import ImageError, OptionError
from ..geometry import ball_coverage
from ..harmonics import sh_basis, sh_map
from ..metrics import irradiance
from ..microfacet import Surface
from ..shapes import BallImage, Latlong
from ..sphere_scene import View, render_sphere
from ..spheres import ALBEDO, MATERIALS, gathered_irradiance, render_spheres, sphere_normals
from .discs import disc_maps
from .model import CHANNELS, Light, LightModel

__all__ = [
    "BAND",
    "COSINE_LOBE",
    "ROWS",
    "Spheres",
    "check_materials",
    "errors_of",
    "model_pictures",
    "shade_harmonics",
    "shade_lights",
    "shade_map",
    "shade_model",
]

ROWS: Final = 128
"""Rows of the maps that light the spheres; twice as many columns."""
BAND: Final = 2
"""Highest band of a model's harmonics."""
COSINE_LOBE: Final = (math.pi, 2 * math.pi / 3, math.pi / 4)
"""Irradiance of each band for a radiance of 1: the cosine lobe (Ramamoorthi and Hanrahan 2001, Eq. 8)."""

Spheres = dict[str, Float[Tensor, "..."]]
"""Radiance of the pixels a sphere covers, (n, pixels, channels) by material; materials differ in their pixels."""

_CHROME: Final = Surface(base=1.0, metallic=True, roughness=0.0)


def check_materials(names: Sequence[str]) -> tuple[str, ...]:
    """Materials as asked for, each once.

    Raises:
        OptionError: none, or one that is unknown.
    """
    for name in names:
        if name not in MATERIALS:
            raise OptionError("materials", name, ", ".join(MATERIALS))
    if not names:
        raise OptionError("materials", "", f"one or more of {', '.join(MATERIALS)}")
    return tuple(dict.fromkeys(names))


# --- one material ------------------------------------------------------------------------------------------------


@dataclass(frozen=True)
class _Material:
    """How a material's sphere is rendered.

    Attributes:
        size: side of its picture for measuring, pixels.
        render: (maps, size) -> pictures; linear in maps that are 0 or above.
        quick: the same to 0.2%, for small lights and for pictures to look at.
        shows_directional: whether a light without extent is seen in it.
    """

    size: int
    render: Callable[[Latlong, int], BallImage]
    quick: Callable[[Latlong, int], BallImage]
    shows_directional: bool = True


def _matte(latlong: Latlong, size: int) -> BallImage:
    return render_spheres(latlong, size, ("matte",))["matte"]


def _diffuse(latlong: Latlong, size: int) -> BallImage:
    """Summed over every pixel: patches, 0.12% low under even light, would be most of an even map's error."""
    received = irradiance(latlong, sphere_normals(size).flatten(0, 1)) * (ALBEDO / math.pi)
    return received.unflatten(1, (size, size))


def _quick_diffuse(latlong: Latlong, size: int) -> BallImage:
    return gathered_irradiance(latlong, sphere_normals(size)) * (ALBEDO / math.pi)


def _mirror(latlong: Latlong, size: int) -> BallImage:
    """A mirror by the scene's renderer, which keeps what each pixel sees: 400 times as fast as the ball's own."""
    return render_sphere(latlong, _CHROME, View.square(size))


_MATERIALS: Final[dict[str, _Material]] = {
    "diffuse": _Material(24, _diffuse, _quick_diffuse),  # nothing on it is smaller than tens of degrees
    "matte": _Material(64, _matte, _matte),
    "mirror": _Material(64, _mirror, _mirror, shows_directional=False),
}


@lru_cache(maxsize=8)
@torch.inference_mode(mode=False)  # a cached inference tensor could never take part in a gradient
def _covered(size: int) -> tuple[Tensor, Tensor]:
    """Pixels of a picture that the sphere covers, and how much of each."""
    coverage = ball_coverage(size).flatten()
    pixels = torch.nonzero(coverage > 0).squeeze(1)
    return pixels, coverage[pixels]


def _seen(pictures: BallImage) -> Float[Tensor, "b pixels c"]:
    """The pixels that the sphere covers."""
    return pictures.flatten(1, 2)[:, _covered(pictures.shape[1])[0]]


@lru_cache(maxsize=8)
@torch.inference_mode(mode=False)
def _harmonic_spheres(name: str, size: int) -> Float[Tensor, "k pixels"]:
    """A material's sphere under each harmonic."""
    if name == "diffuse":
        normals = sphere_normals(size).reshape(-1, 3)[_covered(size)[0]]
        lobes = torch.tensor([COSINE_LOBE[math.isqrt(k)] for k in range((BAND + 1) ** 2)], dtype=torch.float64)
        return (sh_basis(normals, BAND) * lobes * (ALBEDO / math.pi)).T.float()
    # Harmonics raised until they are light everywhere: renderers take no less than 0.
    raised = sh_map(torch.eye((BAND + 1) ** 2, dtype=torch.float64)[..., None], ROWS) + 2
    even = torch.full_like(raised[:1], 2)
    render = _MATERIALS[name].render
    return (_seen(render(raised, size)) - _seen(render(even, size)))[..., 0]


# --- spheres -----------------------------------------------------------------------------------------------------


def _size(name: str, size: int | None) -> int:
    return _MATERIALS[name].size if size is None else size


def shade_map(latlong_hdr: Latlong, materials: Sequence[str], size: int | None = None) -> Spheres:
    """Spheres under a map of `ROWS` rows: (1, pixels, 3) by material; of a given size, or that for measuring."""
    if size is None:
        return {name: _seen(_MATERIALS[name].render(latlong_hdr, _MATERIALS[name].size)) for name in materials}
    return {name: _seen(_MATERIALS[name].quick(latlong_hdr, size)) for name in materials}


def shade_harmonics(coefficients: Float[Tensor, "n k 3"], materials: Sequence[str], size: int | None = None) -> Spheres:
    """Spheres under harmonics of band 0 to 2, signed: (n, pixels, 3) by material."""
    count = coefficients.shape[1]
    return {
        name: torch.einsum("kp,nkc->npc", _harmonic_spheres(name, _size(name, size))[:count], coefficients.float())
        for name in materials
    }


def shade_lights(lights: Sequence[Light], materials: Sequence[str], size: int | None = None) -> Spheres:
    """Spheres under lights, each alone: (n, pixels, 3) by material."""
    radii = torch.tensor([math.radians(light.angular_radius or 0.0) for light in lights])
    maps = disc_maps(torch.tensor([light.direction for light in lights]), radii, ROWS)
    colours = torch.tensor([light.irradiance for light in lights])[:, None, :]
    extended = torch.tensor([float(light.angular_radius is not None) for light in lights])[:, None, None]
    spheres = {name: _seen(_MATERIALS[name].quick(maps, _size(name, size))) * colours for name in materials}
    return {
        name: sphere if _MATERIALS[name].shows_directional else sphere * extended for name, sphere in spheres.items()
    }


def shade_model(model: LightModel, materials: Sequence[str], size: int | None = None) -> Spheres:
    """Spheres under a model, signed: (1, pixels, 3) by material."""
    spheres = shade_harmonics(model.coefficients[None], materials, size)
    if model.lights:
        lit = shade_lights(model.lights, materials, size)
        spheres = {name: sphere + lit[name].sum(0) for name, sphere in spheres.items()}
    return spheres


def errors_of(spheres: Mapping[str, Tensor], truth: Mapping[str, Tensor]) -> dict[str, Float[Tensor, "n"]]:
    """Relative error of spheres for measuring, by material; see the module for what it is.

    Args:
        spheres: (n, pixels, 3) by material, signed.
        truth: (1, pixels, 3) by material.

    Raises:
        ImageError: a true sphere without light.
    """
    found = {}
    for name, sphere in spheres.items():
        weights = _covered(_MATERIALS[name].size)[1][:, None]
        power = float((truth[name].double().square() * weights).sum())
        if power <= 0:
            raise ImageError("latlong", f"lights no part of the {name} sphere")
        wrong = ((sphere.clamp(min=0) - truth[name]).double().square() * weights).sum(dim=(1, 2))
        found[name] = (wrong / power).sqrt()
    return found


def model_pictures(spheres: Mapping[str, Float[Tensor, "1 pixels 3"]], size: int) -> dict[str, BallImage]:
    """Spheres as pictures: (1, size, size, 3) radiance, 0 or above, black around the sphere."""
    pixels, _ = _covered(size)
    pictures = {}
    for name, sphere in spheres.items():
        picture = sphere.new_zeros(1, size * size, CHANNELS)
        picture[:, pixels] = sphere.clamp(min=0)
        pictures[name] = picture.unflatten(1, (size, size))
    return pictures
