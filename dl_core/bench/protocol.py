"""`lightprobe bench protocol NAME`: score given environment maps as the paper scores its own.

Three spheres: both maps are reduced to 128 x 256, compressed if the convention says so, spheres of each material are
rendered under both, and the pictures are compared. A map is paired with the true one of the same name.

A run with `--out` appends its rows to `rows.jsonl` image by image. The same command goes on where a run was stopped;
one with other options, or on other folders, is refused and leaves the rows as they are.

Sources: DiffusionLight, Sec. 5 (three spheres); Wang et al., StyleLight (ECCV 2022), for size and compression of the
maps, whose public code takes the median over values above 0.
"""

from __future__ import annotations

import argparse
import hashlib
import json
import math
import os
import time
from collections import Counter
from collections.abc import Callable, Iterator
from dataclasses import asdict, dataclass
from functools import lru_cache
from pathlib import Path
from statistics import fmean
from typing import Final

import numpy as np
import torch
import torch.nn.functional as F
from jaxtyping import Bool, Float
from torch import Tensor

from ..errors import ImageError, OptionError, OutputError
from ..exposure import GAMMA
from ..geometry import ball_coverage
from ..imageio import read_envmap
from ..picture_errors import CONVENTIONS, Convention, picture_errors
from ..shapes import Latlong
from ..spheres import MATERIALS, render_spheres
from .pairs import ERROR_COLUMNS, add_convention, protocol
from .report import Column, Report, Row, add_output, median_and_worst, panorama_files, prepare_output, publish

__all__ = [
    "PROTOCOLS",
    "Lit",
    "Protocol",
    "add_arguments",
    "compress",
    "pair_maps",
    "prepare_map",
    "reduce_map",
    "render_three",
    "run",
    "score_maps",
]

MAP_ROWS: Final = 128
"""Rows that maps are reduced to before anything is lit by them."""
SPHERE: Final = 128
"""Diameter of a rendered sphere in pixels."""
FRAME: Final = (247, 439)
"""Rows and columns of the frame a sphere is centred in: it covers the share it has in the public renders, 280 pixels in
540 x 960, which is what the percentiles of the published normalized RMSE are taken over."""
SPHERES: Final = tuple(name for name in ("diffuse", "matte", "mirror") if name in MATERIALS)
"""Spheres that are scored, as far as `spheres` can render them."""

_ERRORS: Final = ("rmse", "si_rmse", "angular_error_deg", "normalized_rmse")


# --- maps --------------------------------------------------------------------------------------------------------


@lru_cache(maxsize=16)
def _shares(source: int, target: int, *, solid_angle: bool) -> Float[Tensor, "target source"]:
    """How much of each target row (or column) each source row makes up; every line sums to 1."""
    edges = [torch.linspace(0, math.pi, count + 1, dtype=torch.float64) for count in (source, target)]
    low, high = (-torch.cos(edge) if solid_angle else edge for edge in edges)
    overlap = torch.minimum(low[None, 1:], high[1:, None]) - torch.maximum(low[None, :-1], high[:-1, None])
    return (overlap.clamp(min=0) / high.diff()[:, None]).float()


def reduce_map(latlong: Latlong, height: int, *, solid_angle: bool) -> Float[Tensor, "b rows columns c"]:
    """Average a map over the pixels of one of another size, exactly, whatever the two sizes are.

    Args:
        latlong: (B, H, 2H, C).
        height: rows of the result.
        solid_angle: weigh by solid angle, which keeps the energy of radiance; otherwise by area of the picture, as
            tools for pictures do.
    """
    rows = _shares(latlong.shape[1], height, solid_angle=solid_angle)
    columns = _shares(latlong.shape[2], 2 * height, solid_angle=False)
    # One axis after the other: both at once would be a matrix of all pixels by all pixels.
    return torch.einsum("sj,brjc->brsc", columns, torch.einsum("ri,bijc->brjc", rows, latlong))


def compress(latlong_hdr: Latlong) -> Latlong:
    """Gamma-compress a map as the public evaluation does: γ-2.4, then the median of what is above 0 to 0.5, no clip.

    A map without light stays black.
    """
    encoded = latlong_hdr.clamp(min=0) ** (1 / GAMMA)
    lit = encoded[encoded > 0]
    return encoded * (0.5 / float(np.median(lit.numpy()))) if lit.numel() else encoded


def prepare_map(latlong_hdr: Latlong, convention: Convention) -> Float[Tensor, "b rows columns c"]:
    """A map as spheres are lit by it under a convention: (1, 128, 256, 3)."""
    reduced = reduce_map(latlong_hdr, MAP_ROWS, solid_angle=not convention.compressed)
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
    """The spheres under a batch of maps, by name, seen from the front and centred in `FRAME`."""
    mask = _in_frame((ball_coverage(SPHERE) > 0)[None, ..., None])[0, ..., 0]
    balls = render_spheres(latlong, SPHERE, SPHERES)
    return {name: Lit(_in_frame(ball), mask) for name, ball in balls.items()}


def _in_frame(ball: Tensor) -> Tensor:
    above, left = ((whole - SPHERE) // 2 for whole in FRAME)
    below, right = FRAME[0] - SPHERE - above, FRAME[1] - SPHERE - left
    return F.pad(ball, (0, 0, left, right, above, below))


@dataclass(frozen=True)
class Protocol:
    """What is rendered under a pair of maps.

    Attributes:
        summary: one line for people.
        render: maps -> what is compared, by name.
        conventions: keys of `CONVENTIONS` it is scored by.
    """

    summary: str
    render: Callable[[Latlong], dict[str, Lit]]
    conventions: tuple[str, ...]


PROTOCOLS: Final[dict[str, Protocol]] = {
    "three-spheres": Protocol(
        f"spheres ({', '.join(SPHERES)}) under the predicted and the true map", render_three, ("published", "radiance")
    ),
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
    maps = [prepare_map(latlong, CONVENTIONS[convention]) for latlong in (predicted_hdr, truth_hdr)]
    rendered = PROTOCOLS[name].render(torch.cat(maps))
    return [
        {"sphere": sphere, **asdict(picture_errors(lit.pictures[0], lit.pictures[1], lit.mask, convention))}
        for sphere, lit in rendered.items()
    ]


# --- files -------------------------------------------------------------------------------------------------------


def pair_maps(maps: Path, truth: Path) -> list[tuple[Path, Path]]:
    """Files of two folders that have one name, whatever their suffixes.

    Raises:
        OptionError: a folder without maps, or with two of one name.
        ImageError: a map without its partner.
    """
    predicted, true = _by_name("--maps", maps), _by_name("--truth", truth)
    for option, missing in (("--truth", predicted.keys() - true.keys()), ("--maps", true.keys() - predicted.keys())):
        if missing:
            first = ", ".join(sorted(missing)[:5]) + (", ..." if len(missing) > 5 else "")
            raise ImageError(option, f"has no partner for {len(missing)} maps of the other folder: {first}")
    return [(predicted[name], true[name]) for name in sorted(predicted)]


def _by_name(option: str, folder: Path) -> dict[str, Path]:
    try:
        files = panorama_files(folder)
    except OptionError as error:
        raise OptionError(option, error.value, error.accepted) from error
    found = {path.stem: path for path in files}
    if len(found) < len(files):
        twice = next(path.name for path in files if found[path.stem] != path)
        raise OptionError(option, str(folder), f"one map of a name; {twice} is there in another format too")
    return found


class _Journal:
    """`rows.jsonl`: a line that says what the run is, then a line for each row; a stopped run goes on from it."""

    def __init__(self, folder: Path | None, identity: Row, each: int) -> None:
        self.path = None if folder is None else folder / "rows.jsonl"
        self.rows: list[Row] = []
        if self.path is not None:
            self.rows = _whole(_resume(self.path, identity), each)
            lines = [identity, *self.rows]
            # Lines of an image that was being written when the run was stopped go.
            self.path.write_text("".join(json.dumps(line) + "\n" for line in lines), encoding="utf-8")

    def add(self, rows: list[Row]) -> None:
        """Keep the rows of an image; they are on the disk when this returns."""
        self.rows += rows
        if self.path is None:
            return
        with self.path.open("a", encoding="utf-8") as file:
            file.write("".join(json.dumps(row) + "\n" for row in rows))
            file.flush()
            os.fsync(file.fileno())


def _resume(path: Path, identity: Row) -> list[Row]:
    """Rows of an earlier run of the same command; none if there was none."""
    lines = list(_json_lines(path)) if path.exists() else []
    if lines and lines[0] != identity:
        begun = ", ".join(f"{key} {lines[0].get(key)!r}" for key in identity if lines[0].get(key) != identity[key])
        raise OutputError(path, f"was begun with other options ({begun}); give another --out or remove it")
    return lines[1:]


def _json_lines(path: Path) -> Iterator[Row]:
    """The lines of a file up to the first that is cut short."""
    for line in path.read_text(encoding="utf-8", errors="replace").splitlines():
        try:
            yield dict(json.loads(line))
        except (ValueError, TypeError):
            return


def _whole(rows: list[Row], each: int) -> list[Row]:
    """Rows of the images that have all of theirs."""
    counts = Counter(row["panorama"] for row in rows)
    return [row for row in rows if counts[row["panorama"]] == each]


# --- the command -------------------------------------------------------------------------------------------------


def add_arguments(parser: argparse.ArgumentParser) -> None:
    """Declare the options."""
    names = "; ".join(f"{name}: {entry.summary}" for name, entry in PROTOCOLS.items())
    parser.add_argument("protocol", choices=tuple(PROTOCOLS), metavar="NAME", help=names)
    parser.add_argument("--maps", type=Path, required=True, metavar="DIR", help="folder of predicted maps, EXR or HDR")
    parser.add_argument(
        "--truth", type=Path, required=True, metavar="DIR", help="folder of true maps of the same names"
    )
    add_convention(parser, sorted({key for entry in PROTOCOLS.values() for key in entry.conventions}))
    add_output(parser)


def run(args: argparse.Namespace) -> int | None:
    """Score every pair of maps, or those that an earlier run left."""
    pairs = pair_maps(args.maps, args.truth)
    prepare_output(args)
    started = time.perf_counter()
    journal = _Journal(args.out, _identity(args), len(SPHERES))
    done = {row["panorama"] for row in journal.rows}
    for predicted, truth in pairs:
        if predicted.stem not in done:
            rows = score_maps(read_envmap(predicted), read_envmap(truth), args.protocol, args.convention)
            journal.add([{"panorama": predicted.stem, **row} for row in rows])
    report = Report(
        "protocol", _description(args), journal.rows, _summarize(journal.rows), time.perf_counter() - started
    )
    publish(report, args, rows=_ROWS, summary=_SUMMARY)
    return 0


def _identity(args: argparse.Namespace) -> Row:
    """What has to be the same for a run to be gone on with; folders only as a fingerprint."""
    folders = f"{args.maps.resolve()}\n{args.truth.resolve()}"
    fingerprint = hashlib.sha256(folders.encode()).hexdigest()[:16]
    return {"protocol": args.protocol, "convention": args.convention, "spheres": list(SPHERES), "folders": fingerprint}


def _description(args: argparse.Namespace) -> Row:
    compressed = CONVENTIONS[args.convention].compressed
    kept = "compressed: gamma 2.4, median of what is above 0 to 0.5" if compressed else "linear"
    return {
        "name": args.protocol,
        **protocol(args.convention),
        "maps": f"reduced to {MAP_ROWS} x {2 * MAP_ROWS}, {kept}",
        "sphere_px": SPHERE,
        "frame_px": list(FRAME),
        "camera": "orthographic, from the front",
    }


def _summarize(rows: list[Row]) -> list[Row]:
    """Mean, median and worst over the maps for each sphere; the paper prints means."""
    summary = []
    for sphere in SPHERES:
        of_sphere = [row for row in rows if row["sphere"] == sphere]
        line: Row = {"sphere": sphere, "panoramas": len(of_sphere)}
        for key in _ERRORS:
            line[key] = fmean(row[key] for row in of_sphere)
            line |= median_and_worst(of_sphere, key)
        summary.append(line)
    return summary


_ROWS: Final = (Column("panorama", "panorama"), Column("sphere", "sphere"), *ERROR_COLUMNS)
_SUMMARY: Final = (
    Column("sphere", "sphere"),
    Column("maps", "panoramas"),
    *(Column(f"mean {column.title}", column.key, column.form) for column in ERROR_COLUMNS),
)
