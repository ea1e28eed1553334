"""The panoramas training draws from: the training split of a folder of HDR maps, and procedural scenes."""

from __future__ import annotations

import json
from collections.abc import Callable
from pathlib import Path
from typing import Final

import torch
import torch.nn.functional as F
from jaxtyping import Float
from torch import Tensor

from ..errors import ImageError, OptionError, OutputError
from ..imageio import read_envmap, require_writable, write_exr
from ..shapes import Latlong
from .procedural import draw_panorama

__all__ = ["KINDS", "draw_scenes", "load_panoramas", "panorama_files", "reduce_panorama"]


def _render(seed: int, height: int) -> Latlong:
    # Mitsuba is asked for only where something is to be rendered.
    from .rendered import render_panorama

    return render_panorama(seed, height)


KINDS: Final[dict[str, Callable[[int, int], Latlong]]] = {"drawn": draw_panorama, "rendered": _render}
"""Procedural scenes by kind: from a seed and a number of rows."""


def panorama_files(folder: Path, split: str) -> list[Path]:
    """Files of one split of a folder whose `manifest.json` lists {"file", "split"}, in the manifest's order.

    Raises:
        OptionError: no manifest, or nothing in it of that split.
    """
    try:
        entries = json.loads((folder / "manifest.json").read_text())
    except OSError as error:
        raise OptionError("panoramas", str(folder), "a folder of HDR maps with a manifest.json") from error
    files = [folder / entry["file"] for entry in entries if entry["split"] == split]
    if not files:
        splits = sorted({entry["split"] for entry in entries})
        raise OptionError("split", split, "one the manifest has: " + ", ".join(splits))
    return files


def reduce_panorama(latlong: Latlong, height: int) -> Float[Tensor, "b rows cols c"]:
    """Average a map down to `height` rows, a divisor of its own.

    Raises:
        ImageError: the map has fewer rows, or not a multiple.
    """
    factor, rest = divmod(latlong.shape[1], height)
    if factor < 1 or rest:
        raise ImageError("panorama", f"has {latlong.shape[1]} rows, a multiple of {height} is accepted")
    return F.avg_pool2d(latlong.permute(0, 3, 1, 2), factor).permute(0, 2, 3, 1)


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


def load_panoramas(folder: Path | None, scenes: Path | None, *, height: int) -> Latlong:
    """The training bank: the training split of `folder` and the procedural scenes in `scenes`.

    Real maps are repeated until they are about as many as the others, so that a uniform draw sees both equally.

    Args:
        folder: HDR maps with a manifest; None for procedural scenes only.
        scenes: folder of `draw_scenes`; None for real maps only.
        height: rows of every map of the bank.

    Returns:
        (N, height, 2 height, 3) linear radiance.

    Raises:
        OptionError: neither is given, or a folder holds nothing of use.
        ImageError: a map that cannot be read.
    """
    drawn_files = sorted(path for kind in KINDS for path in scenes.glob(f"{kind}_*.exr")) if scenes is not None else []
    real_files = panorama_files(folder, "training") if folder is not None else []
    if not drawn_files and not real_files:
        raise OptionError("panoramas", str(folder), "a folder of HDR maps, or scenes made by `lightprobe train scenes`")
    repeats = max(1, len(drawn_files) // max(1, len(real_files)))
    real, drawn = (
        [reduce_panorama(read_envmap(path), height) for path in files] for files in (real_files, drawn_files)
    )
    return torch.cat(real * repeats + drawn)
