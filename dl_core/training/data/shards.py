"""Shards of training pairs: plain tar files in WebDataset's layout, the same bytes for the same pairs.

A pair is four members that share the number before the first dot: `00000012.image.png` (photograph and ball),
`.mask.png` (the disc to inpaint, white), `.depth.png` (the ball white on black; depth of the scene is not known) and
`.json` (EV, ball, camera, panorama, exposure).
"""

from __future__ import annotations

import io
import json
import tarfile
from collections.abc import Iterable, Iterator, Mapping
from dataclasses import asdict, dataclass
from pathlib import Path
from typing import Any, Final

import numpy as np
from jaxtyping import Float
from PIL import Image as PILImage
from torch import Tensor

from ...ball import disc_mask, paint_depth
from ...errors import OutputError
from ...imageio import atomic
from .pair_sampler import PairSampler, Take
from .pairs import pair_key

__all__ = [
    "Shard",
    "clear_leftovers",
    "is_whole",
    "pair_members",
    "planned_shards",
    "png_bytes",
    "write_pairs",
    "write_shard",
]

SPLITS: Final = ("training", "validation")
KINDS: Final = ("image.png", "mask.png", "depth.png", "json")
"""Ends of a pair's members' names, in their order."""
COMPRESSION: Final = 3
"""Of PNG: 5% longer than at the default, in 40% of the time."""


@dataclass(frozen=True)
class Shard:
    """A shard to write.

    Attributes:
        split: training or validation.
        number: among the shards of the split.
        first: index of its first pair.
        pairs: how many it holds.
    """

    split: str
    number: int
    first: int
    pairs: int

    @property
    def file(self) -> str:
        """Its file name."""
        return f"{self.split}-{self.number:06d}.tar"

    @property
    def indices(self) -> range:
        """Of its pairs."""
        return range(self.first, self.first + self.pairs)


def planned_shards(split: str, pairs: int, size: int) -> list[Shard]:
    """Shards of up to `size` pairs that hold the pairs of a split."""
    return [Shard(split, i, first, min(size, pairs - first)) for i, first in enumerate(range(0, pairs, size))]


def pair_members(take: Take) -> dict[str, bytes]:
    """A pair's members by the end of their names."""
    ball = take.pair.ball
    contents = (
        png_bytes(take.pair.image[0]),
        png_bytes(disc_mask(ball, grow=ball.dilation)[0]),
        png_bytes(paint_depth(None, ball)[0, ..., 0]),
        json.dumps(_record(take), sort_keys=True).encode(),
    )
    return dict(zip(KINDS, contents, strict=True))


def _record(take: Take) -> dict[str, Any]:
    return {
        "panorama": take.pair.panorama,
        "ev": take.pair.ev,
        "ball": asdict(take.pair.ball),
        "camera": asdict(take.camera),
        "photograph": asdict(take.frame),
        "scale": take.scale,
        "tint": take.tint,
    }


def png_bytes(values: Float[Tensor, "h w *c"]) -> bytes:
    """Display values in [0, 1] as 8 bits, grey or RGB."""
    file = io.BytesIO()
    PILImage.fromarray((values * 255).round().numpy().astype(np.uint8)).save(
        file, format="PNG", compress_level=COMPRESSION
    )
    return file.getvalue()


def write_shard(folder: Path, shard: Shard, sampler: PairSampler) -> Path:
    """Draw the pairs of a shard and write them; a shard that cannot be finished leaves nothing behind.

    Raises:
        OutputError: it cannot be written, such as on a full disk.
        ImageError: a panorama cannot be read any more.
    """
    drawn = ((index, pair_members(sampler.take(index))) for index in shard.indices)
    return write_pairs(folder / shard.file, drawn)


def write_pairs(path: Path, pairs: Iterable[tuple[int, Mapping[str, bytes]]]) -> Path:
    """Write pairs, each an index and its members by the ends of their names, as a tar file; whole or not there.

    Raises:
        OutputError: it cannot be written, such as on a full disk.
    """
    try:
        with atomic(path) as temporary, tarfile.open(temporary, "w", format=tarfile.USTAR_FORMAT) as tar:
            for index, members in pairs:
                for kind, content in members.items():
                    # Owner, rights and time are those of a fresh TarInfo: 0, rw-r--r-- and 1970.
                    member = tarfile.TarInfo(f"{pair_key(index)}.{kind}")
                    member.size = len(content)
                    tar.addfile(member, io.BytesIO(content))
    except OutputError as error:
        kept = "shards that are finished stay: make room and run the same command again, it goes on from there"
        raise OutputError(path, f"{error.reason}; {kept}") from error
    return path


def is_whole(folder: Path, shard: Shard) -> bool:
    """Whether a shard is there with all the members it should have, to the last byte."""
    path = folder / shard.file
    try:
        with tarfile.open(path, "r:") as tar:
            members = tar.getmembers()
        size = path.stat().st_size
    except (OSError, tarfile.TarError):
        return False
    expected = [f"{pair_key(index)}.{kind}" for index in shard.indices for kind in KINDS]
    return [member.name for member in members] == expected and members[-1].offset_data + members[-1].size <= size


def clear_leftovers(folder: Path) -> Iterator[Path]:
    """Remove what killed runs have left of shards they were writing, and name it."""
    for split in SPLITS:
        for path in sorted(folder.glob(f".{split}-??????.????????.tar")):
            path.unlink(missing_ok=True)
            yield path
