"""Training pairs as latents, encoded once and kept in files.

A file holds a few hundred pairs. Files that are there and whole are kept, so an encoding that was stopped goes on;
those of other data or another model are written anew.
"""

from __future__ import annotations

import hashlib
from collections.abc import Callable, Iterator, Mapping
from dataclasses import dataclass
from functools import lru_cache
from pathlib import Path
from typing import Any, Final, Protocol, runtime_checkable

import torch
from jaxtyping import Float
from safetensors import SafetensorError, safe_open
from torch import Tensor

from ...ball import Ball
from ...errors import ImageError
from ...shapes import Image
from ..mini.denoiser import latent_disc
from ..tensor_files import write_tensors

__all__ = ["LatentCache", "Pairs", "TrainingPair", "data_fingerprint", "encode_pairs"]

CHUNK: Final = 256
"""Pairs to a file; 64 MiB at 128 x 128 latents."""
SAMPLED: Final = 16
"""Pairs that the fingerprint of data looks at."""


@runtime_checkable
class TrainingPair(Protocol):
    """A picture with a ball in it, see `pairs.Pair`."""

    @property
    def image(self) -> Image:
        """(1, S, S, 3) display-encoded in [0, 1]."""

    @property
    def ball(self) -> Ball:
        """Where the ball is."""

    @property
    def ev(self) -> float:
        """Exposure of the ball."""

    @property
    def panorama(self) -> str:
        """Name of the map that lights it."""


@runtime_checkable
class Pairs(Protocol):
    """Pairs by index, as `pairs.PairShards` or a list."""

    def __len__(self) -> int:
        """How many there are."""

    def __getitem__(self, index: int, /) -> TrainingPair:
        """The pair of an index from 0."""


def data_fingerprint(pairs: Pairs) -> str:
    """Tells sets of pairs apart: their number, and all of sixteen pairs spread over them."""
    count = len(pairs)
    digest = hashlib.sha256(str(count).encode())
    for index in sorted({round(i * (count - 1) / (SAMPLED - 1)) for i in range(SAMPLED)}):
        pair = pairs[index]
        digest.update(f"{index} {pair.ball} {pair.ev!r} {pair.panorama}".encode())
        digest.update((pair.image * 255).round().to(torch.uint8).numpy().tobytes())
    return digest.hexdigest()[:16]


@dataclass(frozen=True)
class LatentCache:
    """Latents of pairs in files.

    Attributes:
        folder: of the files.
        count: number of pairs.
        canvas: side of the pictures, pixels.
        evs: (N,) exposures of all pairs.
    """

    folder: Path
    count: int
    canvas: int
    evs: Float[Tensor, " n"]

    def latents(self, indices: Tensor) -> Float[Tensor, "b c m m"]:
        """Clean latents of pairs (B,)."""
        return torch.stack([_open(self._file(i)).get_slice("latents")[i % CHUNK] for i in indices.tolist()])

    def balls(self, indices: Tensor) -> tuple[Ball, ...]:
        """Where the balls of pairs are."""
        rows = [_open(self._file(i)).get_slice("balls")[i % CHUNK].tolist() for i in indices.tolist()]
        return tuple(Ball(*row) for row in rows)

    def discs(self, indices: Tensor, side: int, *, dilated: bool = False) -> Float[Tensor, "b 1 m m"]:
        """Share of each of side x side latents that the ball of a pair covers, or its inpaint disc."""
        return torch.cat([_disc(ball, side, dilated) for ball in self.balls(indices)])

    def near(self, ev: float, tolerance: float) -> Tensor:
        """Indices of the pairs at an exposure."""
        return torch.nonzero((self.evs - ev).abs() <= tolerance).flatten()

    def _file(self, index: int) -> Path:
        return self.folder / _name(index // CHUNK)


@lru_cache(maxsize=64)
def _disc(ball: Ball, side: int, dilated: bool) -> Tensor:
    return latent_disc(ball, side, grow=ball.dilation if dilated else 0)


@lru_cache(maxsize=16)
def _open(path: Path) -> Any:
    """An open file; of its tensors only what is asked for is read."""
    return safe_open(path, framework="pt")


def _name(chunk: int) -> str:
    return f"latents-{chunk:05d}.safetensors"


def encode_pairs(
    pairs: Pairs,
    encode: Callable[[Image], Tensor],
    folder: Path,
    identity: Mapping[str, str],
    *,
    share: tuple[int, int] = (0, 1),
    together: Callable[[], None] = lambda: None,
    report: Callable[[str], None],
) -> LatentCache:
    """Encode all pairs that are not in the folder's files yet.

    Args:
        pairs: at one canvas size.
        encode: pictures -> scaled latents; called with one picture at a time, so that the latents do not depend on how
            often the encoding was stopped.
        folder: of the files.
        identity: of data and model, kept in the files.
        share: number of this process and how many there are; each encodes its own files.
        together: returns when all processes have called it.
        report: told of progress, file by file.

    Raises:
        ImageError: pairs of several sizes, or a pair that cannot be read.
        OutputError: a file cannot be written.
    """
    folder.mkdir(parents=True, exist_ok=True)
    _open.cache_clear()
    chunks = (len(pairs) + CHUNK - 1) // CHUNK
    for chunk in range(share[0], chunks, share[1]):
        numbers = range(chunk * CHUNK, min(len(pairs), (chunk + 1) * CHUNK))
        if _identity(folder / _name(chunk)) == {**identity, "pairs": str(len(numbers)), "format": "pt"}:
            continue
        _encode_chunk(folder / _name(chunk), (pairs[i] for i in numbers), encode, identity)
        report(f"encoded {numbers[-1] + 1} of {len(pairs)} pairs")
    together()
    files = [_open(folder / _name(chunk)) for chunk in range(chunks)]
    canvases = {int(side) for file in files for side in file.get_tensor("balls")[:, 3].unique()}
    if len(canvases) != 1:
        raise ImageError("pairs", f"are of several sizes ({sorted(canvases)} pixels); one is accepted")
    return LatentCache(folder, len(pairs), canvases.pop(), torch.cat([file.get_tensor("evs") for file in files]))


def _identity(path: Path) -> dict[str, str] | None:
    if not path.is_file():
        return None
    try:
        with safe_open(path, framework="pt") as file:
            return dict(file.metadata() or {})
    except (SafetensorError, OSError):
        return None


def _encode_chunk(
    path: Path, pairs: Iterator[TrainingPair], encode: Callable[[Image], Tensor], identity: Mapping[str, str]
) -> None:
    latents, evs, balls = list[Tensor](), list[float](), list[list[int]]()
    for pair in pairs:
        latents.append(encode(pair.image))
        evs.append(pair.ev)
        ball = pair.ball
        balls.append([ball.left, ball.top, ball.diameter, ball.canvas, ball.dilation])
    tensors = {"latents": torch.cat(latents), "evs": torch.tensor(evs), "balls": torch.tensor(balls)}
    write_tensors(path, tensors, {**identity, "pairs": str(len(evs))})
