"""Work of a bench spread over processes, its results heard as they come."""

from __future__ import annotations

import os
from collections.abc import Callable, Iterable, Iterator, Sequence
from concurrent.futures import FIRST_COMPLETED, Future, ProcessPoolExecutor, wait
from multiprocessing import get_context, parent_process
from queue import Empty
from threading import Thread
from typing import Any, Final, TypeVar

import torch

from ..errors import OptionError

__all__ = ["check_workers", "results_of"]

Item = TypeVar("Item")
Result = TypeVar("Result")

PATIENCE: Final = 0.2
"""Seconds between looks at what has come."""


def check_workers(count: int) -> int:
    """A number of processes.

    Raises:
        OptionError: below 1, or more than a machine has use for.
    """
    most = max(1, os.cpu_count() or 1)
    if not 1 <= count <= most:
        raise OptionError("--workers", count, f"1 to {most}, as many as there are processors")
    return count


def results_of(task: Callable[[Item], Iterable[Result]], items: Sequence[Item], workers: int) -> Iterator[Result]:
    """Results of all items, each as soon as it is there.

    Args:
        task: gives an item's results one by one. For more than one worker it has to be a function of a module, or a
            `functools.partial` of one, with arguments that can be pickled, as have items and results.
        items: what to work on.
        workers: processes; with one the work is done here. Several share the processors evenly, so that each
            computes with fewer threads.

    Raises:
        Exception: what the task raised; the other workers stop after the result they are at.
        BrokenProcessPool: a worker was killed.
    """
    if workers == 1 or len(items) < 2:
        for item in items:
            yield from task(item)
        return
    context = get_context("spawn")  # a fork would copy torch's threads in whatever state they are
    results, stop = context.Queue(), context.Event()
    setup = (workers, results, stop)
    with ProcessPoolExecutor(workers, context, initializer=_set_up, initargs=setup) as pool:
        running = {pool.submit(_send, task, item) for item in items}
        try:
            yield from _heard(running, results)
        finally:
            stop.set()
            pool.shutdown(cancel_futures=True)


def _heard(running: set[Future[int]], results: Any) -> Iterator[Any]:
    """What comes through a queue until all work is done, and as much has come as was sent."""
    sent, come = 0, 0
    while running or come < sent:
        done, running = wait(running, timeout=0 if come < sent else PATIENCE, return_when=FIRST_COMPLETED)
        sent += sum(future.result() for future in done)
        try:
            while True:
                yield results.get(timeout=PATIENCE if come < sent else 0.001)
                come += 1
        except Empty:
            continue


_mailbox: Any = None
"""In a worker: where results go, and whether anybody still wants them."""


def _send(task: Callable[[Item], Iterable[Any]], item: Item) -> int:
    """In a worker: send an item's results on, until there are no more or nobody wants them; how many there were."""
    results, stop = _mailbox
    count = 0
    if stop.is_set():
        return count
    for result in task(item):
        results.put(result)
        count += 1
        if stop.is_set():
            break
    return count


def _set_up(workers: int, results: Any, stop: Any) -> None:
    """In a worker, before its first item: take a share of the processors, and end when the parent is killed."""
    global _mailbox
    _mailbox = (results, stop)
    torch.set_num_threads(max(1, torch.get_num_threads() // workers))
    Thread(target=_end_with_parent, daemon=True).start()


def _end_with_parent() -> None:
    parent = parent_process()
    if parent is not None:
        parent.join()
        os._exit(1)
