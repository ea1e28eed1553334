"""Work over processes: all results come, errors too, and nothing goes on after one."""

from __future__ import annotations

import os
import pickle
import subprocess
import sys
import time
from collections.abc import Callable, Iterator
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


def test_workers_end_with_a_killed_parent(tmp_path: Path) -> None:
    script = tmp_path / "parent.py"
    script.write_text(
        "from pathlib import Path\nimport os, time\nfrom dl_core.bench.workers import results_of\n"
        "def slow(item):\n    Path(f'{item}.pid').write_text(str(os.getpid()))\n    time.sleep(300)\n    yield item\n"
        "if __name__ == '__main__':\n    list(results_of(slow, ['a', 'b'], 2))\n"
    )
    root = Path(__file__).resolve().parent.parent
    parent = subprocess.Popen([sys.executable, script], cwd=tmp_path, env=os.environ | {"PYTHONPATH": str(root)})
    files = [tmp_path / f"{name}.pid" for name in "ab"]
    try:
        assert waited(lambda: all(file.exists() and file.read_text() for file in files), 120)
    finally:
        parent.kill()
        parent.wait()
    pids = [int(file.read_text()) for file in files]
    assert waited(lambda: not any(is_running(pid) for pid in pids), 20)


def waited(condition: Callable[[], bool], seconds: float) -> bool:
    end = time.monotonic() + seconds
    while time.monotonic() < end:
        if condition():
            return True
        time.sleep(0.1)
    return False


def is_running(pid: int) -> bool:
    try:
        os.kill(pid, 0)
    except OSError:
        return False
    # One that ended and that nobody has asked for its status is still listed.
    status = Path(f"/proc/{pid}/stat")
    return not status.exists() or status.read_text().rpartition(")")[2].split()[0] != "Z"


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
