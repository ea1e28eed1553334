"""Balls painted a few at a time, and fewer once memory does not suffice."""

from __future__ import annotations

from collections.abc import Callable, Iterator
from typing import Final

from .errors import OptionError
from .shapes import BallImage

__all__ = ["Batches", "is_out_of_memory"]

_SHORTAGES: Final = ("out of memory", "can't allocate memory", "not enough memory")
"""How torch words a shortage: accelerators, then the CPU's allocator on Unix and on Windows."""


def is_out_of_memory(error: BaseException) -> bool:
    """Whether an error is torch's word for a shortage of memory, on any device."""
    return isinstance(error, RuntimeError) and any(phrase in str(error).lower() for phrase in _SHORTAGES)


class Batches:
    """Cuts the balls of requests into batches, halving these for good where one does not fit in memory.

    Attributes:
        size: balls of a batch, 1 or more.
    """

    def __init__(self, size: int, make_room: Callable[[], None]) -> None:
        """Start with a size.

        Args:
            size: balls of a batch.
            make_room: called after a shortage; frees what the device's allocator keeps aside.

        Raises:
            OptionError: a size below 1.
        """
        if size < 1:
            raise OptionError("batch_size", size, "1 or more")
        self.size = size
        self._make_room = make_room

    def paint(
        self,
        seeds: tuple[int, ...],
        paint: Callable[[tuple[int, ...]], BallImage],
        note: Callable[[str], None],
    ) -> Iterator[tuple[tuple[int, ...], BallImage]]:
        """Yield seeds and their balls, batch by batch, in order.

        Args:
            seeds: of the balls wanted.
            paint: paints the balls of a batch, (n, D, D, 3).
            note: hears of each halving, one sentence.

        Raises:
            RuntimeError: torch's own, where a single ball does not fit.
        """
        start = 0
        while start < len(seeds):
            batch = seeds[start : start + self.size]
            try:
                balls = paint(batch)
            except RuntimeError as error:
                if len(batch) == 1 or not is_out_of_memory(error):
                    raise
                balls = None
            # Outside the handler, where the error no longer keeps the failed batch's tensors alive.
            if balls is None:
                self.size = len(batch) // 2
                self._make_room()
                note(f"out of memory with {len(batch)} balls at once: went on with {self.size}")
                continue
            yield batch, balls
            start += len(batch)
