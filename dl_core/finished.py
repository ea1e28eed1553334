"""Balls that are finished, kept for a run that goes on where another was interrupted.

A ball follows from its seed and from what it was painted with, so one found here under the same key is the ball that
painting would give again.
"""

from __future__ import annotations

import hashlib
import mmap
import threading
import uuid
from collections import Counter, OrderedDict
from collections.abc import Mapping
from dataclasses import fields, is_dataclass
from typing import Any, Final
from weakref import WeakKeyDictionary

import torch
from torch import Tensor

from .errors import OptionError
from .shapes import BallImage

__all__ = ["FinishedBalls", "content_key"]


class FinishedBalls:
    """A store of balls, bounded in bytes and in keys; the one longest unused goes first.

    Threads may share it.
    """

    def __init__(self, limit: int, keys: int | None = None) -> None:
        """Keep up to `limit` bytes, and balls of up to `keys` keys where that is given.

        Raises:
            OptionError: a negative limit, or less than one key.
        """
        if limit < 0:
            raise OptionError("limit", limit, "0 or more bytes")
        if keys is not None and keys < 1:
            raise OptionError("keys", keys, "1 or more")
        self._limit, self._held, self._keys = limit, 0, keys
        self._balls_of: Counter[str] = Counter()
        self._balls: OrderedDict[tuple[str, int], _Kept] = OrderedDict()
        self._lock = threading.Lock()

    @property
    def bytes_held(self) -> int:
        """What the balls take."""
        return self._held

    def find(self, key: str, seeds: tuple[int, ...]) -> dict[int, BallImage]:
        """Those balls of a key that are there, (1, D, D, 3) each, by seed."""
        with self._lock:
            found = {seed: self._balls[key, seed].tensor() for seed in seeds if (key, seed) in self._balls}
            for seed in found:
                self._balls.move_to_end((key, seed))
        return found

    def keep(self, key: str, seeds: tuple[int, ...], balls: BallImage) -> None:
        """Keep the balls of seeds, (n, D, D, 3), as copies of their own in main memory."""
        with self._lock:
            for seed, ball in zip(seeds, balls.detach().split(1), strict=True):
                self._drop((key, seed))
                self._balls[key, seed] = _Kept(ball)
                self._held += ball.nbytes
                self._balls_of[key] += 1
            while self._held > self._limit or (self._keys is not None and len(self._balls_of) > self._keys):
                self._drop(next(iter(self._balls)))

    def clear(self) -> None:
        """Forget all."""
        with self._lock:
            self._balls.clear()
            self._balls_of.clear()
            self._held = 0

    def _drop(self, name: tuple[str, int]) -> None:
        dropped = self._balls.pop(name, None)
        if dropped is None:
            return
        self._held -= dropped.size
        self._balls_of[name[0]] -= 1
        if not self._balls_of[name[0]]:
            del self._balls_of[name[0]]


class _Kept:
    """A ball in pages of its own, which go back to the system with it.

    Not a tensor, since even the head of one is a piece of the heap: in glibc before 2.38 a piece that stays where a
    painting's large buffers were keeps the next ones from being put there again, and a server's memory grows by all of
    them with every run.
    """

    __slots__ = ("_dtype", "_pages", "_shape", "size")

    def __init__(self, ball: Tensor) -> None:
        self._shape, self._dtype, self.size = tuple(ball.shape), ball.dtype, ball.nbytes
        self._pages = mmap.mmap(-1, ball.nbytes)
        self.tensor().copy_(ball)

    def tensor(self) -> Tensor:
        """The ball, in main memory; it holds the pages as long as it is used."""
        return torch.frombuffer(self._pages, dtype=self._dtype).view(self._shape)


def content_key(*values: Any) -> str:
    """A key that is equal for equal content.

    Tensors, numbers, texts, mappings, sequences and dataclasses count by their content, any other object by its
    identity: two loaded networks have different keys, even where their weights are the same.
    """
    digest = hashlib.sha256()
    for value in values:
        _digest(value, digest.update)
    return digest.hexdigest()


def _digest(value: Any, update: Any) -> None:
    """Feed a value's content to a hash, each part behind its kind and length, so that no two contents run together."""
    if isinstance(value, Tensor):
        plain = value.detach().cpu().contiguous()
        update(f"tensor {plain.dtype} {tuple(plain.shape)}:".encode())
        # As bytes, since numpy knows no bfloat16.
        update(plain.reshape(-1).view(torch.uint8).numpy().tobytes())
    elif isinstance(value, Mapping):
        update(f"mapping {len(value)}:".encode())
        for name in sorted(value, key=repr):
            _digest(name, update)
            _digest(value[name], update)
    elif isinstance(value, list | tuple):
        update(f"sequence {len(value)}:".encode())
        for item in value:
            _digest(item, update)
    elif is_dataclass(value) and not isinstance(value, type):
        _digest({field.name: getattr(value, field.name) for field in fields(value)}, update)
    else:
        text = repr(value) if isinstance(value, _PLAIN) else _identity(value)
        update(f"{type(value).__name__} {len(text)}:{text}".encode())


_PLAIN: Final = (str, bytes, int, float, bool, type(None))
_IDENTITIES: WeakKeyDictionary[Any, str] = WeakKeyDictionary()


def _identity(value: Any) -> str:
    """A name of an object that no other object gets, even after this one is gone.

    What cannot be referred to weakly gets a new name every time: nothing painted with it is ever found again.
    """
    try:
        return _IDENTITIES.setdefault(value, uuid.uuid4().hex)
    except TypeError:
        return uuid.uuid4().hex
