"""Balls that are finished, kept for a run that goes on where another was interrupted.

A ball follows from its seed and from what it was painted with, so one found here under the same key is the ball that
painting would give again.
"""

from __future__ import annotations

import hashlib
import threading
import uuid
from collections import OrderedDict
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
    """A store of balls, bounded in bytes; the one longest unused goes first."""

    def __init__(self, limit: int) -> None:
        """Keep up to `limit` bytes.

        Raises:
            OptionError: a negative limit.
        """
        if limit < 0:
            raise OptionError("limit", limit, "0 or more bytes")
        self._limit, self._held = limit, 0
        self._balls: OrderedDict[tuple[str, int], Tensor] = OrderedDict()
        self._lock = threading.Lock()

    @property
    def bytes_held(self) -> int:
        """What the balls take."""
        return self._held

    def find(self, key: str, seeds: tuple[int, ...]) -> dict[int, BallImage]:
        """Those balls of a key that are there, (1, D, D, 3) each, by seed."""
        with self._lock:
            found = {seed: self._balls[key, seed] for seed in seeds if (key, seed) in self._balls}
            for seed in found:
                self._balls.move_to_end((key, seed))
        return found

    def keep(self, key: str, seeds: tuple[int, ...], balls: BallImage) -> None:
        """Keep the balls of seeds, (n, D, D, 3), as copies of their own in main memory."""
        with self._lock:
            for seed, ball in zip(seeds, balls.detach().split(1), strict=True):
                self._drop((key, seed))
                # A copy, since a slice would keep the whole batch alive.
                self._balls[key, seed] = ball.to("cpu", copy=True)
                self._held += ball.nbytes
            while self._held > self._limit:
                self._drop(next(iter(self._balls)))

    def clear(self) -> None:
        """Forget all."""
        with self._lock:
            self._balls.clear()
            self._held = 0

    def _drop(self, name: tuple[str, int]) -> None:
        dropped = self._balls.pop(name, None)
        self._held -= 0 if dropped is None else dropped.nbytes


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
