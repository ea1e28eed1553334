"""Score an environment map against the true one by what it lights, as the paper scores its own.

Three spheres: both maps are reduced to 128 x 256, compressed if the convention says so, spheres of each material are
rendered under both, and the pictures are compared. LDR maps: both are reduced to 256 x 512, tone-mapped each by itself,
and compared as they are.

Sources: DiffusionLight, Sec. 5.1 (three spheres), 5.2 (random camera) and 5.3 (LDR panoramas); Wang et al., StyleLight
(ECCV 2022), for size and compression of the maps, whose public code takes the median over values above 0.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import asdict, dataclass, fields
from statistics import fmean
from typing import Final

import numpy as np
import torch
from jaxtyping import Bool, Float
from torch import Tensor

from ..exposure import GAMMA, auto_exposure, expose
from ..picture_errors import CONVENTIONS, Convention, PictureErrors, picture_errors
from ..resize import resize_latlong
from ..shapes import Latlong
from ..sphere_scene import AUTHORS_SPHERES, AUTHORS_VIEW, render_sphere, view_coverage
from .report import Row, median_and_worst

__all__ = [
    "MAP_ROWS",
    "PROTOCOLS",
    "SPHERES",
    "VIEW",
    "Lit",
    "Protocol",
    "compress",
    "prepare_map",
    "render_three",
    "score_maps",
    "show_map",
    "summarize_errors",
    "tone_map",
]

MAP_ROWS: Final = 128
"""Rows that maps are reduced to before anything is lit by them."""
LDR_ROWS: Final = 256
"""Rows of the maps that are compared as pictures."""
SPHERES: Final = tuple(AUTHORS_SPHERES)
"""Spheres that are scored, by name."""
VIEW: Final = AUTHORS_VIEW
"""How they are seen."""


# --- maps --------------------------------------------------------------------------------------------------------


def compress(latlong_hdr: Latlong) -> Latlong:
    """Gamma-compress a map as the public evaluation does: γ-2.4, then the median of what is above 0 to 0.5, no clip.

    A map without light stays black.
    """
    encoded = latlong_hdr.clamp(min=0) ** (1 / GAMMA)
    lit = encoded[encoded > 0]
    return encoded * (0.5 / float(np.median(lit.numpy()))) if lit.numel() else encoded


def prepare_map(latlong_hdr: Latlong, convention: Convention) -> Float[Tensor, "b rows columns c"]:
    """A map as spheres are lit by it under a convention: (1, 128, 256, 3)."""
    reduced = resize_latlong(latlong_hdr, MAP_ROWS, solid_angle=not convention.compressed)
    return compress(reduced) if convention.compressed else reduced


# --- spheres -----------------------------------------------------------------------------------------------------


@dataclass(frozen=True)
class Lit:
    """A sphere under the maps of a batch.

    Attributes:
        pictures: (B, h, w, 3) linear values, black around the sphere.
        mask: (h, w), True on the sphere.
    """

    pictures: Float[Tensor, "b h w 3"]
    mask: Bool[Tensor, "h w"]


def render_three(latlong: Latlong) -> dict[str, Lit]:
    """The authors' spheres under a batch of maps, by name, as their camera sees them, over black."""
    coverage = view_coverage(VIEW)[..., None]
    return {
        name: Lit(render_sphere(latlong, surface, VIEW) * coverage, coverage[..., 0] > 0)
        for name, surface in AUTHORS_SPHERES.items()
    }


def tone_map(latlong_hdr: Latlong, convention: Convention) -> Float[Tensor, "b rows columns c"]:
    """A map as a picture of 256 x 512: its own 99th percentile at 0.9, γ-2.4, clipped."""
    reduced = resize_latlong(latlong_hdr, LDR_ROWS, solid_angle=False)
    return expose(reduced * auto_exposure(reduced), 0.0)


def show_map(latlong: Latlong) -> dict[str, Lit]:
    """The maps themselves, every pixel of them."""
    return {"map": Lit(latlong, torch.ones(latlong.shape[1:3], dtype=torch.bool))}


@dataclass(frozen=True)
class Protocol:
    """What is compared of a pair of maps.

    Attributes:
        summary: one line for people.
        parts: names of what is compared.
        conditions: facts to report beside the convention's.
        prepare: (a map, convention) -> the map as it is rendered.
        render: prepared maps -> what is compared, by name.
        conventions: keys of `CONVENTIONS` it is scored by.
    """

    summary: str
    parts: tuple[str, ...]
    conditions: Row
    prepare: Callable[[Latlong, Convention], Latlong]
    render: Callable[[Latlong], dict[str, Lit]]
    conventions: tuple[str, ...] = ("published", "radiance")


_SPHERES_SEEN: Final[Row] = {
    "map_rows": MAP_ROWS,
    "maps": "linear, or as published compressed: gamma 2.4, median of what is above 0 to 0.5",
    "surfaces": {name: asdict(surface) for name, surface in AUTHORS_SPHERES.items()},
    "view": asdict(VIEW),
}
_MAPS_SEEN: Final[Row] = {"map_rows": LDR_ROWS, "maps": "tone-mapped: own 99th percentile to 0.9, gamma 2.4"}
_THREE: Final = f"spheres ({', '.join(SPHERES)}) under the predicted and the true map"

PROTOCOLS: Final[dict[str, Protocol]] = {
    "three-spheres": Protocol(_THREE, SPHERES, _SPHERES_SEEN, prepare_map, render_three),
    "random-camera": Protocol(
        _THREE + ", photographed by any camera", SPHERES, _SPHERES_SEEN, prepare_map, render_three
    ),
    "ldr": Protocol("the maps themselves, each tone-mapped", ("map",), _MAPS_SEEN, tone_map, show_map),
}
"""Protocols by name."""


def score_maps(
    predicted_hdr: Latlong, truth_hdr: Float[Tensor, "b rows columns c"], name: str, convention: str
) -> list[Row]:
    """Errors of a map: one row for each sphere.

    Args:
        predicted_hdr: (1, H, 2H, 3) linear radiance.
        truth_hdr: (1, H', 2H', 3) linear radiance; sizes may differ.
        name: key of `PROTOCOLS`.
        convention: one that the protocol takes.
    """
    protocol = PROTOCOLS[name]
    maps = [protocol.prepare(latlong, CONVENTIONS[convention]) for latlong in (predicted_hdr, truth_hdr)]
    rendered = protocol.render(torch.cat(maps))
    return [
        {"sphere": sphere, **asdict(picture_errors(lit.pictures[0], lit.pictures[1], lit.mask, convention))}
        for sphere, lit in rendered.items()
    ]


def summarize_errors(rows: list[Row]) -> Row:
    """Mean, median and worst of each error over rows; the paper prints means."""
    line: Row = {}
    for key in (field.name for field in fields(PictureErrors)):
        line[key] = fmean(row[key] for row in rows)
        line |= median_and_worst(rows, key)
    return line
