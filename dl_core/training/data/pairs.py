"""Training pairs, and reading them from the shards that `lightprobe train data` writes.

Any pair is read by itself: of a shard its table of contents, once, and then the pair's own bytes.
"""

from __future__ import annotations

import io
import tarfile
from bisect import bisect_right
from dataclasses import dataclass
from itertools import accumulate
from pathlib import Path
from typing import Any, Final

import numpy as np
import torch
from PIL import Image as PILImage

from ...ball import Ball
from ...errors import ImageError, OptionError
from ...json_text import parse_json, read_json
from ...shapes import Image

__all__ = ["FORMAT", "INDEX", "Pair", "PairShards", "pair_key"]

FORMAT: Final = 1
"""Of the shards; another number is another layout."""
INDEX: Final = "index.json"
"""The list of shards, written when all are there."""


@dataclass(frozen=True)
class Pair:
    """A training pair.

    Attributes:
        image: (1, S, S, 3) float32 in [0, 1], display-encoded: a photograph at EV 0 with a mirror ball in it.
        ball: where the ball is.
        ev: exposure of the ball; its radiance is scaled by 2^ev before encoding.
        panorama: name of the map that both show.
    """

    image: Image
    ball: Ball
    ev: float
    panorama: str


def pair_key(number: int) -> str:
    """Name of a pair's members before their first dot."""
    return f"{number:08d}"


class PairShards:
    """The pairs of a folder, in the order in which they were drawn.

    Args:
        folder: as `lightprobe train data` leaves it.
        split: `training`, or `validation` for pairs of panoramas held out.

    Raises:
        OptionError: the folder is not finished or not of this kind, or has no pairs of that split.
        ImageError: a shard is missing or has another length than it was written with.
    """

    def __init__(self, folder: Path, split: str = "training") -> None:
        self._shards = [shard for shard in _read_index(folder)["shards"] if shard["split"] == split]
        if not self._shards:
            raise OptionError("split", split, f"one that {folder} has pairs of")
        self._folder = folder
        for shard in self._shards:
            _require_whole(folder / shard["file"], shard["bytes"])
        self._ends = list(accumulate(shard["pairs"] for shard in self._shards))
        self._contents: dict[int, dict[str, tuple[int, int]]] = {}

    def __len__(self) -> int:
        return int(self._ends[-1])

    def __getitem__(self, index: int) -> Pair:
        """The pair of an index from 0, or from the end if below.

        Raises:
            IndexError: there is none.
            ImageError: its shard is damaged.
        """
        number = index + len(self) if index < 0 else index
        if not 0 <= number < len(self):
            raise IndexError(f"pair {index} of {len(self)}")
        place = bisect_right(self._ends, number)
        path, key = self._folder / self._shards[place]["file"], pair_key(number)
        try:
            if place not in self._contents:
                self._contents[place] = _table_of_contents(path)
            picture, record = (_member(path, self._contents[place][f"{key}.{kind}"]) for kind in ("image.png", "json"))
            return _pair(picture, parse_json(record))
        except (OSError, tarfile.TarError, KeyError, TypeError, ValueError, SyntaxError) as error:
            raise ImageError(path, f"is damaged at pair {key} ({error}); delete it and make the pairs again") from error


def _read_index(folder: Path) -> dict[str, Any]:
    accepted = "a folder that `lightprobe train data` has finished; run the same command again to go on"
    try:
        index = dict(read_json(folder / INDEX))
        known = index["format"] == FORMAT
        readable = not known or all(map(_is_entry, index["shards"]))
    except (OSError, ValueError, KeyError, TypeError) as error:
        raise OptionError("pairs", str(folder), accepted) from error
    if not known:
        raise OptionError("pairs", str(folder), f"shards of format {FORMAT}; these have {index['format']}")
    if not readable:
        raise OptionError("pairs", str(folder), f"an {INDEX} that lists shards by file, split, pairs and bytes")
    return index


def _is_entry(entry: Any) -> bool:
    """Whether an entry of the index says of a shard what has to be known."""
    kinds = {"file": str, "split": str, "pairs": int, "bytes": int}
    if not isinstance(entry, dict) or not all(type(entry.get(name)) is kind for name, kind in kinds.items()):
        return False
    return Path(entry["file"]).name == entry["file"] and entry["pairs"] > 0


def _require_whole(path: Path, size: int) -> None:
    found = path.stat().st_size if path.is_file() else None
    if found != size:
        said = "is missing" if found is None else f"has {found:,} bytes, {INDEX} says {size:,}"
        raise ImageError(path, f"{said}; delete {INDEX} and make the pairs again, whole shards are kept")


def _table_of_contents(path: Path) -> dict[str, tuple[int, int]]:
    """Where each member begins and how long it is."""
    with tarfile.open(path, "r:") as tar:
        return {member.name: (member.offset_data, member.size) for member in tar}


def _member(path: Path, place: tuple[int, int]) -> bytes:
    # Opened anew each time: processes that load data side by side must not share a position in a file.
    with path.open("rb") as file:
        file.seek(place[0])
        return file.read(place[1])


def _pair(picture: bytes, record: dict[str, Any]) -> Pair:
    with PILImage.open(io.BytesIO(picture)) as image:
        codes = torch.from_numpy(np.array(image.convert("RGB")))
    ball, ev, panorama = Ball(**record["ball"]), record["ev"], record["panorama"]
    lengths = (ball.left, ball.top, ball.diameter, ball.canvas, ball.dilation)
    if not all(type(length) is int for length in lengths) or codes.shape[:2] != (ball.canvas, ball.canvas):
        raise ValueError(f"the ball is {record['ball']} on a picture of {codes.shape[1]} x {codes.shape[0]}")
    if type(ev) not in (int, float) or not isinstance(panorama, str):
        raise ValueError(f"EV {ev!r}, panorama {panorama!r}")
    return Pair(codes[None].float() / 255, ball, ev, panorama)
