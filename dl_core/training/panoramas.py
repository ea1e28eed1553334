"""The panoramas training draws from: the training split of a folder of HDR maps, and procedural scenes."""

from __future__ import annotations

import json
from pathlib import Path

import torch
import torch.nn.functional as F

from ..errors import ImageError, OptionError
from ..imageio import read_envmap
from ..shapes import Latlong
from .procedural import draw_panorama

__all__ = ["load_panoramas", "panorama_files", "reduce_panorama"]


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


def reduce_panorama(latlong: Latlong, height: int) -> Latlong:
    """Average a map down to `height` rows, a divisor of its own.

    Raises:
        ImageError: the map has fewer rows, or not a multiple.
    """
    factor, rest = divmod(latlong.shape[1], height)
    if factor < 1 or rest:
        raise ImageError("panorama", f"has {latlong.shape[1]} rows, a multiple of {height} is accepted")
    return F.avg_pool2d(latlong.permute(0, 3, 1, 2), factor).permute(0, 2, 3, 1)


def load_panoramas(folder: Path | None, *, procedural: int, height: int, cache: Path | None = None) -> Latlong:
    """The training bank: the training split of `folder` and `procedural` drawn scenes.

    The real maps are repeated until they are as many as the drawn ones, so that a uniform draw sees both equally.

    Args:
        folder: HDR maps with a manifest; None for drawn scenes only.
        procedural: number of drawn scenes (seeds 0, 1, …).
        height: rows of every map of the bank.
        cache: file to keep drawn scenes in, since they take 0.2 s each at 128 rows.

    Returns:
        (N, height, 2 height, 3) linear radiance.
    """
    drawn = _draw(procedural, height, cache)
    if folder is None:
        return drawn
    real = torch.cat([reduce_panorama(read_envmap(path), height) for path in panorama_files(folder, "training")])
    return torch.cat((real.repeat(max(1, procedural // len(real)), 1, 1, 1), drawn))


def _draw(count: int, height: int, cache: Path | None) -> Latlong:
    if cache is not None and cache.is_file():
        kept = torch.load(cache, weights_only=True).float()
        if kept.shape[:2] == (count, height):
            return kept
    drawn = (
        torch.cat([draw_panorama(seed, height) for seed in range(count)])
        if count
        else torch.zeros(0, height, 2 * height, 3)
    )
    if cache is not None:
        torch.save(drawn.half(), cache)
    return drawn
