"""Score an environment map against the true one by what it lights, as the paper scores its own.

Three spheres: both maps are reduced to 128 x 256, compressed if the convention says so, spheres of each material are
rendered under both, and the pictures are compared. Array of spheres: both maps are reduced to 128 x 256, the scene is
rendered under both, and whole pictures are compared; the paper prints medians. LDR maps: both are reduced to 256 x 512,
tone-mapped each by itself, and compared as they are.

Sources: DiffusionLight, Sec. 5.1 (three spheres, array of spheres), 5.2 (random camera) and 5.3 (LDR panoramas); Wang
et al., StyleLight (ECCV 2022), for size and compression of the maps, whose public code takes the median over values
above 0.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import asdict, dataclass, fields, replace
from statistics import fmean
from typing import Final

import numpy as np
import torch
from jaxtyping import Bool, Float
from torch import Tensor

from ..array_scene import ALBEDO, BOUNCES, CAMERA_HEIGHT, PLANE_HALF, SIZE, SPACING, render_array
from ..errors import OptionError
from ..exposure import GAMMA, auto_exposure, expose
from ..picture_errors import CONVENTIONS, Convention, PictureErrors, picture_errors
from ..resize import resize_latlong
from ..shapes import Latlong
from ..sphere_scene import AUTHORS_SPHERES, AUTHORS_VIEW, render_sphere, view_coverage
from .report import Column, Row, median_and_worst

__all__ = [
    "MAP_ROWS",
    "PROTOCOLS",
    "SPHERES",
    "VIEW",
    "Lit",
    "Protocol",
    "check_protocol",
    "compress",
    "prepare_map",
    "render_nine",
    "render_three",
    "score_maps",
    "show_map",
    "summarize_errors",
    "summary_columns",
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


def render_nine(latlong: Latlong) -> dict[str, Lit]:
    """The array of spheres on its plane under a batch of maps, every pixel of it."""
    return {"array": Lit(render_array(latlong), torch.ones(SIZE, SIZE, dtype=torch.bool))}


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
        printed: key of `_SUFFIXES`: what the paper prints over maps, and so do tables.
    """

    summary: str
    parts: tuple[str, ...]
    conditions: Row
    prepare: Callable[[Latlong, Convention], Latlong]
    render: Callable[[Latlong], dict[str, Lit]]
    conventions: tuple[str, ...] = ("published", "radiance")
    printed: str = "mean"


_SPHERES_SEEN: Final[Row] = {
    "map_rows": MAP_ROWS,
    "maps": "linear, or as published compressed: gamma 2.4, median of what is above 0 to 0.5",
    "surfaces": {name: asdict(surface) for name, surface in AUTHORS_SPHERES.items()},
    "view": asdict(VIEW),
}
_MAPS_SEEN: Final[Row] = {"map_rows": LDR_ROWS, "maps": "tone-mapped: own 99th percentile to 0.9, gamma 2.4"}
_ARRAY_SEEN: Final[Row] = {
    "map_rows": MAP_ROWS,
    "maps": "linear",
    "scene": "3 x 3 Lambertian spheres on a plane that fills the frame, seen from above; lengths in radii",
    "spacing": SPACING,
    "camera_height": CAMERA_HEIGHT,
    "plane_half_side": PLANE_HALF,
    "albedo": ALBEDO,
    "bounces": BOUNCES,
    "picture_px": SIZE,
}
_SUFFIXES: Final = {"mean": "", "median": "_median"}
"""Of the keys of a summary, by what they average."""
_THREE: Final = f"spheres ({', '.join(SPHERES)}) under the predicted and the true map"

PROTOCOLS: Final[dict[str, Protocol]] = {
    "three-spheres": Protocol(_THREE, SPHERES, _SPHERES_SEEN, prepare_map, render_three),
    "array": Protocol(
        "an array of diffuse spheres on a plane under the predicted and the true map",
        ("array",),
        _ARRAY_SEEN,
        prepare_map,
        render_nine,
        ("published-array", "radiance"),
        printed="median",
    ),
    "random-camera": Protocol(
        _THREE + ", photographed by any camera", SPHERES, _SPHERES_SEEN, prepare_map, render_three
    ),
    "ldr": Protocol("the maps themselves, each tone-mapped", ("map",), _MAPS_SEEN, tone_map, show_map),
}
"""Protocols by name."""


def check_protocol(name: str, convention: str) -> None:
    """Raise OptionError if a protocol is not scored by a convention."""
    accepted = PROTOCOLS[name].conventions
    if convention not in accepted:
        raise OptionError("--convention", convention, f"{', '.join(accepted)} with protocol {name}")


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


def summary_columns(name: str, columns: tuple[Column, ...]) -> tuple[Column, ...]:
    """Columns of errors as columns of a protocol's summary: what the paper prints over maps."""
    printed = PROTOCOLS[name].printed
    return tuple(
        replace(column, title=f"{printed} {column.title}", key=column.key + _SUFFIXES[printed]) for column in columns
    )
