"""From folders of panoramas to a folder of shards: what `lightprobe train data` does."""

from __future__ import annotations

import time
from collections.abc import Callable, Mapping, Sequence
from dataclasses import asdict, dataclass
from pathlib import Path
from typing import Any

import torch

from ...errors import OptionError
from ..panoramas import find_panoramas
from .pair_sampler import PairOptions, PairSampler
from .pairs import FORMAT, INDEX
from .shard_plan import file_hash, fingerprint, make_plan, write_json
from .shards import Shard, clear_leftovers, is_whole, planned_shards, write_shard
from .views import rows_shown

__all__ = ["DataOptions", "hold_out", "make_pairs"]


@dataclass(frozen=True)
class DataOptions:
    """How many pairs and in which files.

    Attributes:
        count: pairs in all.
        shard_size: pairs of a shard.
        validation: share of panoramas, and of pairs, held out.
    """

    count: int
    shard_size: int
    validation: float

    def __post_init__(self) -> None:
        if self.count < 1:
            raise OptionError("count", self.count, "1 or more pairs")
        if self.shard_size < 1:
            raise OptionError("shard_size", self.shard_size, "1 or more pairs")
        if not 0 <= self.validation < 1:
            raise OptionError("validation", self.validation, "0 to below 1")

    @property
    def pairs(self) -> dict[str, int]:
        """Pairs by split."""
        held_out = min(self.count - 1, max(1, round(self.count * self.validation))) if self.validation else 0
        return {"training": self.count - held_out, "validation": held_out}


def hold_out(names: Sequence[str], share: float, seed: int) -> dict[str, list[str]]:
    """Divide panoramas: each is in one split, whatever pairs are drawn of it.

    Args:
        names: of the panoramas, at least two where a share is held out.
        share: held out, 0 to below 1; at least one panorama if above 0, and at least one stays.
        seed: decides which.

    Raises:
        OptionError: a share of a single panorama.
    """
    count = min(len(names) - 1, max(1, round(len(names) * share))) if share else 0
    if share and not count:
        raise OptionError("validation", share, "0, or two or more panoramas")
    order = torch.randperm(len(names), generator=torch.Generator().manual_seed(seed)).tolist()
    held_out = {names[place] for place in order[:count]}
    return {
        "training": [name for name in names if name not in held_out],
        "validation": [name for name in names if name in held_out],
    }


def make_pairs(
    folders: Sequence[Path],
    split: str | None,
    out: Path,
    options: PairOptions,
    data: DataOptions,
    report: Callable[[str], None],
) -> Path:
    """Write the shards that are not there yet, and then the index.

    Args:
        folders: of the panoramas.
        split: of their manifests, see `find_panoramas`.
        out: folder for the shards.
        options: of the pairs.
        data: of the shards.
        report: told of panoramas left out, and of every shard.

    Returns:
        The index.

    Raises:
        OptionError: options that do not fit, no panoramas, or a folder that holds other pairs.
        OutputError: a shard cannot be written; those before it stay.
    """
    files = find_panoramas(folders, split)
    plan = make_plan(out, asdict(options) | asdict(data), files, report)
    for path in clear_leftovers(out):
        report(f"removed {path.name}, left by a run that was killed")
    _warn_of_softness(plan["used"], options, report)
    divided = hold_out(list(plan["used"]), data.validation, options.seed)
    shards = []
    for name, pairs in data.pairs.items():
        planned = planned_shards(name, pairs, data.shard_size)
        if planned:
            sampler = PairSampler({key: files[key] for key in divided[name]}, options, name)
            shards += [_finished(out, shard, sampler, report) for shard in planned]
    index = {
        "format": FORMAT,
        "version": plan["version"],
        "options": plan["options"],
        "fingerprint": fingerprint(plan["contents"]),
        "panoramas": divided,
        "skipped": plan["skipped"],
        "duplicates": plan["duplicates"],
        "pairs": data.count,
        "shards": shards,
    }
    write_json(out / INDEX, index)
    return out / INDEX


def _warn_of_softness(rows: Mapping[str, int], options: PairOptions, report: Callable[[str], None]) -> None:
    shown = rows_shown(options.canvas, options.fov)
    soft = sum(2 * count < shown for count in rows.values())
    if soft:
        report(f"{soft} of {len(rows)} maps have less than half the {shown} rows that photographs show, and look soft")


def _finished(out: Path, shard: Shard, sampler: PairSampler, report: Callable[[str], None]) -> Mapping[str, Any]:
    """A shard's entry in the index; it is written unless it is there."""
    path = out / shard.file
    if is_whole(out, shard):
        report(f"{shard.file}: is there")
    else:
        started = time.monotonic()
        write_shard(out, shard, sampler)
        report(f"{shard.file}: {shard.pairs} pairs, {(time.monotonic() - started) / shard.pairs:.2f} s each")
    return {
        "file": shard.file,
        "split": shard.split,
        "pairs": shard.pairs,
        "bytes": path.stat().st_size,
        "sha256": file_hash(path),
    }
