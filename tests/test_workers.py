"""Work over processes: all results come, errors too, and nothing goes on after one."""

from __future__ import annotations

import os
import pickle
import time
from collections.abc import Iterator
from concurrent.futures.process import BrokenProcessPool
from functools import partial
from pathlib import Path

import pytest

from dl_core.bench.workers import check_workers, results_of
from dl_core.errors import ImageError, Interrupted, ModelError, OptionError, ProbeError


def powers(base: int, most: int) -> Iterator[tuple[int, int, int]]:
    for exponent in range(most):
        yield base, base**exponent, os.getpid()


def one_fails(item: int) -> Iterator[int]:
    if item == 0:
        raise OptionError("item", item, "1 or more")
    while True:  # until nobody wants more
        yield item
        time.sleep(0.01)


def one_dies(item: int) -> Iterator[int]:
    if item == 0:
        os._exit(9)
    yield item


@pytest.mark.parametrize("workers", [1, 2])
def test_every_result_comes_once_and_an_items_own_in_order(workers: int) -> None:
    found = list(results_of(partial(powers, most=4), [2, 3, 5], workers))
    assert sorted((base, power) for base, power, _ in found) == [(b, b**e) for b in (2, 3, 5) for e in range(4)]
    for base in (2, 3, 5):
        own = [power for of, power, _ in found if of == base]
        assert own == sorted(own)
    assert (os.getpid() in {pid for *_, pid in found}) == (workers == 1)


def test_an_error_in_a_worker_arrives_and_ends_the_others() -> None:
    with pytest.raises(OptionError, match="1 or more"):
        list(results_of(one_fails, [1, 0], 2))


def test_a_killed_worker_is_told_of() -> None:
    with pytest.raises(BrokenProcessPool):
        list(results_of(one_dies, [0, 1], 2))


@pytest.mark.parametrize(
    "error",
    [
        OptionError("balls", 0, "1 or more"),
        ImageError(Path("a.exr"), "is empty"),
        ModelError("lora", "is missing"),
        Interrupted("stopped"),
    ],
)
def test_errors_come_through_whole(error: ProbeError) -> None:
    again = pickle.loads(pickle.dumps(error))
    assert type(again) is type(error)
    assert str(again) == str(error)
    assert vars(again) == vars(error)


@pytest.mark.parametrize("count", [0, -1, (os.cpu_count() or 1) + 1])
def test_numbers_of_workers_are_checked(count: int) -> None:
    with pytest.raises(OptionError, match="--workers"):
        check_workers(count)
