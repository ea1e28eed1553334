"""The jobs that servers share: who takes what, how often one may be lost, what came of each."""

from __future__ import annotations

import threading
from collections import deque
from collections.abc import Iterable
from dataclasses import dataclass
from pathlib import Path
from typing import Final, Literal, Protocol, runtime_checkable

from .client import Fault
from .ledger import Record
from .workflow import Workflow

__all__ = ["Job", "Outcome", "Pool", "SilentWatcher", "Status", "Watcher"]

Status = Literal["done", "skipped", "failed", "cancelled"]

WAITING_LOSSES: Final = 20
"""How often a job may be lost before it began to run. That is no fault of its own, but has to end some day."""


@dataclass(frozen=True)
class Job:
    """A photograph under a workflow, and the record its files are kept under."""

    photo: Path
    workflow: Workflow
    record: Record


@dataclass(frozen=True)
class Outcome:
    """What came of a job.

    Attributes:
        job: which.
        status: done, failed, cancelled, or skipped since its files were there.
        files: what was collected.
        faults: why it failed, in the server's words.
        seconds: it ran on the server; None where that is not known.
        server: its address; None for a job that reached none.
    """

    job: Job
    status: Status
    files: tuple[Path, ...] = ()
    faults: tuple[Fault, ...] = ()
    seconds: float | None = None
    server: str | None = None


@runtime_checkable
class Watcher(Protocol):
    """Is told what happens, by several threads."""

    def progress(self, server: str, job: Job, node: str, value: float, total: float) -> None:
        """A node of the job is so far."""

    def note(self, text: str) -> None:
        """A server went away, came back, or was given up; a job is queued again."""

    def finished(self, outcome: Outcome) -> None:
        """A job has come to its end."""


class SilentWatcher:
    """A watcher that keeps it to itself; a base for those that want some of the calls."""

    def progress(self, server: str, job: Job, node: str, value: float, total: float) -> None:
        """Say nothing."""

    def note(self, text: str) -> None:
        """Say nothing."""

    def finished(self, outcome: Outcome) -> None:
        """Say nothing."""


class Pool:
    """Jobs waiting, jobs out, and outcomes. Threads share it."""

    def __init__(self, jobs: Iterable[Job], servers: int, retries: int, watcher: Watcher) -> None:
        """Hold jobs.

        Args:
            jobs: to run, each with a key of its own.
            servers: that will take from here.
            retries: how often a job that was running may be lost and queued again.
            watcher: is told.

        `over` is set once every job has an outcome or the user stops the run, `stopped` in the second case.
        """
        self._waiting = deque(jobs)
        self._open = {job.record.key: job for job in self._waiting}
        self._losses = {key: {True: 0, False: 0} for key in self._open}
        self._limits = {True: retries, False: WAITING_LOSSES}
        self._servers = servers
        self._absences: list[str] = []
        self._watcher = watcher
        self._lock = threading.RLock()
        self.stopped: Final = threading.Event()
        self.over: Final = threading.Event()
        if not self._open:
            self.over.set()
        self.outcomes: Final[dict[str, Outcome]] = {}

    def take(self) -> Job | None:
        """The next job; None if none waits."""
        with self._lock:
            return self._waiting.popleft() if self._waiting else None

    def finish(self, outcome: Outcome) -> None:
        """A job has come to its end; what a second server says of it later does not count."""
        key = outcome.job.record.key
        with self._lock:
            if self._open.pop(key, None) is None:
                return
            self.outcomes[key] = outcome
            if not self._open:
                self.over.set()
        self._watcher.finished(outcome)

    def lost(self, job: Job, server: str, was_running: bool) -> None:
        """A server no longer knows a job: it waits again, behind the others, unless that happened too often.

        What ran when a server went down may be why it went down, so it is tried less often than what only waited.
        """
        with self._lock:
            losses = self._losses[job.record.key]
            losses[was_running] += 1
            again = losses[was_running] <= self._limits[was_running]
            if again:
                self._waiting.append(job)
        if again:
            self._watcher.note(f"{job.photo.name}: {server} no longer knows this job, it is queued again")
            return
        doing = "while it ran" if was_running else "before it ran"
        fault = Fault(f"lost {losses[was_running]} times {doing}; see the server's log")
        self.finish(Outcome(job, "failed", faults=(fault,), server=server))

    def give_back(self, job: Job) -> None:
        """A job of a server that was given up: it waits for another."""
        with self._lock:
            self._waiting.append(job)

    def leave(self, reason: str) -> None:
        """A server takes no more jobs. With the last one, jobs that wait fail."""
        with self._lock:
            self._servers -= 1
            self._absences.append(reason)
            left = [] if self._servers else list(iter(self.take, None))
        for job in left:
            self.finish(Outcome(job, "failed", faults=(Fault("no server left: " + "; ".join(self._absences)),)))

    def stop(self) -> None:
        """The user stops the run: nothing new begins, and what runs is cancelled by the servers' threads."""
        self.stopped.set()
        self.over.set()

    def cancel_rest(self) -> None:
        """Give every job without an outcome one, once no thread works on any."""
        with self._lock:
            left = list(self._open.values())
            self._waiting.clear()
        for job in left:
            self.finish(Outcome(job, "cancelled"))
