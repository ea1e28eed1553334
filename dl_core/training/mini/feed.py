"""How training is fed: pictures a step, how often each is shown, and processes that draw ahead of a GPU."""

from __future__ import annotations

from collections.abc import Callable, Iterator
from dataclasses import dataclass
from itertools import count
from typing import Final, Generic, TypeVar

from accelerate import PartialState
from torch.utils.data import DataLoader, Dataset

from ...errors import OptionError

__all__ = ["Ahead", "Feed"]

Drawn = TypeVar("Drawn")

DRAWN_AHEAD: Final = 4
"""Batches that wait for the training, for each process that draws."""


@dataclass(frozen=True)
class Feed:
    """What a step is given.

    Attributes:
        batch: examples a step and process.
        noises: examples made of each picture, every one at another level of noise. Drawing a picture costs a processor
            as much as some 50 training examples cost a large GPU.
        loaders: processes that draw batches ahead; 0 to draw them in turn with the training.

    Raises:
        OptionError: a count out of range, or a batch that is no multiple of the noises.
    """

    batch: int
    noises: int = 1
    loaders: int = 0

    def __post_init__(self) -> None:
        if self.batch < 1:
            raise OptionError("batch", self.batch, "1 or more")
        if self.noises < 1 or self.batch % self.noises:
            raise OptionError("noises", self.noises, f"a divisor of the batch of {self.batch}")
        if self.loaders < 0:
            raise OptionError("loaders", self.loaders, "0 or more")


class Ahead(Generic[Drawn]):
    """Batches by number, drawn ahead by other processes in the order in which a training process asks for them.

    What a batch holds follows from its number alone, so it is the same with any number of processes.

    Args:
        draw: makes the batch of a number; called in the other processes, which must not touch a GPU.
        loaders: how many there are; 0 to draw when asked.
    """

    def __init__(self, draw: Callable[[int], Drawn], loaders: int) -> None:
        self._draw = draw
        self._loaders = loaders
        self._waiting: Iterator[Drawn] | None = None
        self._next = -1
        # Processes that share every step take turns with the numbers (`loop.train`).
        self._stride = PartialState().num_processes if PartialState._shared_state else 1

    def __call__(self, number: int) -> Drawn:
        """The batch of a number."""
        if not self._loaders:
            return self._draw(number)
        if self._waiting is None or number != self._next:
            self._waiting = self._start(number)
        self._next = number + self._stride
        return next(self._waiting)

    def _start(self, number: int) -> Iterator[Drawn]:
        return iter(
            DataLoader(
                _Numbered(self._draw),
                batch_size=None,
                sampler=count(number, self._stride),  # type: ignore[arg-type]  # any iterable of indices serves
                num_workers=self._loaders,
                prefetch_factor=DRAWN_AHEAD,
                multiprocessing_context="fork",  # the panoramas are shared, not copied
            )
        )


class _Numbered(Dataset[Drawn]):
    def __init__(self, draw: Callable[[int], Drawn]) -> None:
        self._draw = draw

    def __getitem__(self, number: int) -> Drawn:
        return self._draw(number)
