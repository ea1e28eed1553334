"""Batches against a stand-in for a device of so much memory and no more."""

from __future__ import annotations

from itertools import pairwise

import pytest
import torch
from hypothesis import given
from hypothesis import strategies as st

from dl_core.batches import Batches, is_out_of_memory
from dl_core.errors import OptionError


class Device:
    """Paints balls that hold their seed; more than `capacity` of them at once are too many."""

    def __init__(self, capacity: int) -> None:
        self.capacity = capacity
        self.batches: list[int] = []

    def paint(self, seeds: tuple[int, ...]) -> torch.Tensor:
        self.batches.append(len(seeds))
        if len(seeds) > self.capacity:
            raise torch.cuda.OutOfMemoryError("CUDA out of memory. Tried to allocate 2.00 GiB.")
        return torch.tensor(seeds, dtype=torch.float32)[:, None, None, None].expand(-1, 2, 2, 3)


@given(st.integers(1, 40), st.integers(1, 20), st.integers(1, 20))
def test_every_ball_comes_once_in_order_within_memory(count: int, size: int, capacity: int) -> None:
    device, room, notes = Device(capacity), list[int](), list[str]()
    batches = Batches(size, lambda: room.append(1))
    seeds = tuple(range(5, 5 + count))
    painted = list(batches.paint(seeds, device.paint, notes.append))
    assert tuple(seed for batch, _ in painted for seed in batch) == seeds
    assert [float(value) for _, balls in painted for value in balls[:, 0, 0, 0]] == list(seeds)
    failed = [batch for batch in device.batches if batch > capacity]
    assert len(failed) == len(room) == len(notes)
    # Halving: each failure is at most half the one before it, and none comes after a success.
    assert all(after <= before // 2 for before, after in pairwise(failed))
    assert device.batches[: len(failed)] == failed
    again = Device(capacity)
    list(batches.paint(seeds, again.paint, notes.append))
    assert max(again.batches) <= capacity


def test_a_halving_is_noted_with_both_sizes() -> None:
    notes: list[str] = []
    list(Batches(8, lambda: None).paint(tuple(range(8)), Device(3).paint, notes.append))
    assert notes == [
        "out of memory with 8 balls at once: went on with 4",
        "out of memory with 4 balls at once: went on with 2",
    ]


def test_one_ball_that_does_not_fit_is_the_devices_own_error() -> None:
    with pytest.raises(torch.cuda.OutOfMemoryError):
        list(Batches(4, lambda: None).paint((1, 2), Device(0).paint, lambda note: None))


def test_other_faults_are_not_taken_for_a_shortage() -> None:
    device = Device(4)

    def broken(seeds: tuple[int, ...]) -> torch.Tensor:
        device.batches.append(len(seeds))
        raise RuntimeError("mat1 and mat2 shapes cannot be multiplied")

    with pytest.raises(RuntimeError, match="mat1"):
        list(Batches(4, lambda: None).paint((1, 2, 3), broken, lambda note: None))
    assert device.batches == [3]


def test_torch_on_the_cpu_words_a_shortage_as_known() -> None:
    with pytest.raises(RuntimeError) as raised:
        torch.empty(2**60, dtype=torch.uint8)
    assert is_out_of_memory(raised.value)


def test_a_size_below_one_is_refused() -> None:
    with pytest.raises(OptionError, match="batch_size is 0"):
        Batches(0, lambda: None)
