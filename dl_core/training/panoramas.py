"""The panoramas training draws from: the training split of a folder of HDR maps, and procedural scenes."""

from __future__ import annotations

import math
from collections import Counter
from collections.abc import Callable, Sequence
from pathlib import Path
from typing import Final

import torch
from jaxtyping import Float
from torch import Tensor

from ..errors import ImageError, OptionError, OutputError
from ..imageio import read_envmap, require_writable, write_exr
from ..json_text import read_json
from ..shapes import Latlong
from .scenes.procedural import draw_panorama

__all__ = ["KINDS", "draw_scenes", "find_panoramas", "load_panoramas", "panorama_files", "reduce_panorama"]

SUFFIXES: Final = (".exr", ".hdr")


def _render(seed: int, height: int) -> Latlong:
    # Mitsuba is asked for only where something is to be rendered.
    from .scenes.rendered import render_panorama

    return render_panorama(seed, height)


KINDS: Final[dict[str, Callable[[int, int], Latlong]]] = {"drawn": draw_panorama, "rendered": _render}
"""Procedural scenes by kind: from a seed and a number of rows."""


def panorama_files(folder: Path, split: str) -> list[Path]:
    """Files of one split of a folder whose `manifest.json` lists {"file", "split"}, in the manifest's order.

    Raises:
        OptionError: no manifest, one that is none, or nothing in it of that split.
    """
    manifest = folder / "manifest.json"
    try:
        entries = [(str(entry["file"]), str(entry["split"])) for entry in read_json(manifest)]
    except OSError as error:
        raise OptionError("panoramas", str(folder), "a folder of HDR maps with a manifest.json") from error
    except (ValueError, TypeError, KeyError) as error:
        raise OptionError("manifest", str(manifest), 'a JSON list of {"file": ..., "split": ...}') from error
    files = [folder / file for file, of in entries if of == split]
    if not files:
        raise OptionError("split", split, "one the manifest has: " + ", ".join(sorted({of for _, of in entries})))
    return files


def find_panoramas(folders: Sequence[Path], split: str | None) -> dict[str, Path]:
    """HDR maps of folders by name, sorted by it.

    Args:
        folders: with a `manifest.json` of splits, or any other folders of .exr and .hdr files.
        split: of the manifests. When not given, `training` where there is a manifest, and all files elsewhere.

    Returns:
        Files by their name; where two have the same one, by as much of the path as tells them apart.

    Raises:
        OptionError: a folder without maps, or without a manifest though a split is asked for.
    """
    files = {path.resolve(): None for folder in folders for path in _maps_in(folder, split)}
    return dict(sorted(zip(_distinct_names(list(files)), files, strict=True)))


def _maps_in(folder: Path, split: str | None) -> list[Path]:
    if split is not None or (folder / "manifest.json").is_file():
        return panorama_files(folder, split or "training")
    try:
        files = [path for path in folder.iterdir() if path.suffix.lower() in SUFFIXES]
    except OSError as error:
        raise OptionError("panoramas", str(folder), "a folder of .exr or .hdr maps") from error
    if not files:
        raise OptionError("panoramas", str(folder), "a folder of .exr or .hdr maps; this one holds none")
    return files


def _distinct_names(paths: list[Path]) -> list[str]:
    tails = [path.name for path in paths]
    for parts in range(2, 1 + max(len(path.parts) for path in paths)):
        shared = {tail for tail, count in Counter(tails).items() if count > 1}
        tails = [
            "/".join(path.parts[-parts:]) if tail in shared else tail for path, tail in zip(paths, tails, strict=True)
        ]
    return tails


def reduce_panorama(latlong: Latlong, rows: int, columns: int | None = None) -> Float[Tensor, "b rows cols c"]:
    """Average a map down to fewer pixels, each new one over the solid angle it covers: energy stays as it is.

    Args:
        latlong: (B, H, 2H, C).
        rows: of the result, up to H.
        columns: of the result, up to 2H; twice the rows when not given.

    Raises:
        ImageError: the map has fewer rows or columns.
    """
    height, width = latlong.shape[1:3]
    columns = 2 * rows if columns is None else columns
    if not (1 <= rows <= height and 1 <= columns <= width):
        raise ImageError("panorama", f"is {width} x {height} pixels, {columns} x {rows} or more are accepted")
    down, across = _shares(*(_heights(count) for count in (height, rows))), _shares(_steps(width), _steps(columns))
    return torch.einsum("rh,bhwc,kw->brkc", down.to(latlong), latlong, across.to(latlong))


def _steps(count: int) -> Float[Tensor, "n"]:
    return torch.arange(count + 1, dtype=torch.float64) / count


def _heights(rows: int) -> Float[Tensor, "n"]:
    """Edges of a map's rows, as heights on the unit sphere from its north pole: solid angle is even in these."""
    return 1 - torch.cos(_steps(rows) * math.pi)


def _shares(old: Float[Tensor, "n"], new: Float[Tensor, "m"]) -> Float[Tensor, "rows columns"]:
    """How much of each interval between new edges lies in each between old ones; rows add up to 1."""
    low, high = torch.maximum(new[:-1, None], old[:-1]), torch.minimum(new[1:, None], old[1:])
    common = (high - low).clamp(min=0)
    return common / common.sum(dim=1, keepdim=True)


def draw_scenes(folder: Path, kind: str, count: int, height: int, *, report: Callable[[str], None]) -> None:
    """Make procedural scenes of a kind (seeds 0 to count - 1) in a folder; those that are there already are kept.

    Raises:
        OptionError: what makes the kind is not installed.
        OutputError: the folder cannot be made or written.
    """
    try:
        folder.mkdir(parents=True, exist_ok=True)
    except OSError as error:
        raise OutputError(folder, f"cannot be made ({error})") from error
    require_writable(folder / f"{kind}.exr")
    for seed in range(count):
        path = folder / f"{kind}_{seed:05d}.exr"
        if not path.is_file():
            write_exr(path, KINDS[kind](seed, height)[0], metadata={"seed": str(seed)})
            report(f"{path.name}: {seed + 1}/{count}")


def load_panoramas(folder: Path | None, scenes: Path | None, *, height: int, real_share: float = 0.5) -> Latlong:
    """The training bank: the training split of `folder` and the procedural scenes in `scenes`.

    Real maps are repeated until they are about their share of all, so that a uniform draw sees that share of them.

    Args:
        folder: HDR maps with a manifest; None for procedural scenes only.
        scenes: folder of `draw_scenes`; None for real maps only.
        height: rows of every map of the bank.
        real_share: of draws, between 0 and 1.

    Returns:
        (N, height, 2 height, 3) linear radiance.

    Raises:
        OptionError: neither is given, a folder holds nothing of use, or a share out of range.
        ImageError: a map that cannot be read.
    """
    drawn_files = sorted(path for kind in KINDS for path in scenes.glob(f"{kind}_*.exr")) if scenes is not None else []
    real_files = panorama_files(folder, "training") if folder is not None else []
    if not drawn_files and not real_files:
        raise OptionError("panoramas", str(folder), "a folder of HDR maps, or scenes made by `lightprobe train scenes`")
    if not 0 < real_share < 1:
        raise OptionError("real share", real_share, "between 0 and 1")
    wanted = len(drawn_files) * real_share / (1 - real_share)
    repeats = max(1, round(wanted / max(1, len(real_files))))
    real, drawn = (
        [reduce_panorama(read_envmap(path), height) for path in files] for files in (real_files, drawn_files)
    )
    return torch.cat(real * repeats + drawn)
