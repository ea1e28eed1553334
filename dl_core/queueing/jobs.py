"""The whole run: photographs become jobs, servers share them, Ctrl-C ends it in good order."""

from __future__ import annotations

import threading
from collections.abc import Iterable, Sequence
from dataclasses import dataclass
from pathlib import Path

from ..errors import OptionError
from .client import ComfyClient, Fault
from .ledger import Ledger, Record, job_key
from .pool import Job, Outcome, Pool, SilentWatcher, Watcher
from .worker import Worker
from .workflow import Workflow

__all__ = ["Run", "Servers", "plan_job", "run_jobs"]

STOP_PATIENCE = 20.0
"""Seconds that servers get to cancel what they run."""
GLANCE = 0.2
"""Seconds between looks at whether threads have ended: on Windows a longer wait is deaf to Ctrl-C."""


@dataclass(frozen=True)
class Servers:
    """Where jobs may run.

    Attributes:
        urls: addresses, each once.
        timeout: seconds after which a server that stays away is given up.
        retries: how often a job that a server lost while it ran is queued again.
    """

    urls: tuple[str, ...]
    timeout: float = 300.0
    retries: int = 2

    def clients(self) -> list[ComfyClient]:
        """A client of each.

        Raises:
            OptionError: no address, one that is none, or one twice; a timeout or retries below 0.
        """
        if not self.timeout >= 0:
            raise OptionError("timeout", self.timeout, "0 or more seconds")
        if self.retries < 0:
            raise OptionError("retries", self.retries, "0 or more")
        clients = [ComfyClient(url) for url in self.urls]
        addresses = [client.url for client in clients]
        if not addresses or len(set(addresses)) < len(addresses):
            raise OptionError("server", ", ".join(addresses), "one or more addresses, each once")
        return clients


@dataclass(frozen=True)
class Run:
    """What came of a run: outcomes in the order of the jobs, and whether the user stopped it."""

    outcomes: tuple[Outcome, ...]
    interrupted: bool = False


def plan_job(photo: Path, workflow: Workflow, ledger: Ledger) -> Job | Outcome:
    """The job of a photograph, or what is already known of it: its files are there, or it cannot be read.

    Raises:
        OutputError: the folder of results cannot be written.
    """
    try:
        key = job_key(photo.read_bytes(), workflow)
    except OSError as error:
        nameless = Job(photo, workflow, Record("", photo.stem, photo.name))
        fault = Fault(f"{photo} cannot be read ({error.strerror or error})")
        return Outcome(nameless, "failed", faults=(fault,))
    job = Job(photo, workflow, ledger.record(key, photo))
    if ledger.finished(job.record):
        return Outcome(job, "skipped", files=tuple(ledger.folder / name for name in job.record.files))
    return job


def run_jobs(jobs: Iterable[Job], servers: Servers, ledger: Ledger, watcher: Watcher | None = None) -> Run:
    """Run jobs on servers and collect their files into the ledger's folder.

    A job's fault is its outcome and stops no other. Two jobs of the same content are run once. On Ctrl-C what is
    queued or running of ours is cancelled, and what was collected stays.

    Args:
        jobs: to run.
        servers: where.
        ledger: the folder of results.
        watcher: is told what happens.

    Raises:
        OptionError: servers that are not accepted.
    """
    jobs = list(jobs)
    watcher = watcher or SilentWatcher()
    clients = servers.clients()
    distinct: dict[str, Job] = {}
    for job in jobs:
        distinct.setdefault(job.record.key, job)
    pool = Pool(distinct.values(), len(clients), servers.retries, watcher)
    crew = _Crew([Worker(client, pool, ledger, watcher, servers.timeout) for client in clients], pool)
    interrupted = crew.work()
    pool.cancel_rest()
    return Run(tuple(pool.outcomes[job.record.key] for job in jobs), interrupted)


class _Crew:
    """A thread for each server."""

    def __init__(self, workers: Sequence[Worker], pool: Pool) -> None:
        self._workers, self._pool = workers, pool
        self._failures: list[BaseException] = []
        # Threads say so themselves when they end: a join that Ctrl-C interrupts takes its thread for ended.
        self._ended = [threading.Event() for _ in workers]

    def work(self) -> bool:
        """Until all are done; whether the user stopped them. A mistake in a thread is raised here."""
        interrupted = False
        try:
            for worker, ended in zip(self._workers, self._ended, strict=True):
                threading.Thread(target=self._guarded, args=(worker, ended), daemon=True).start()
            for ended in self._ended:
                while not ended.wait(GLANCE):
                    pass
        except KeyboardInterrupt:
            interrupted = True
            self._pool.stop()
            for ended in self._ended:
                ended.wait(STOP_PATIENCE)
        if self._failures:
            raise self._failures[0]
        return interrupted

    def _guarded(self, worker: Worker, ended: threading.Event) -> None:
        try:
            worker.run()
        except BaseException as failure:
            self._failures.append(failure)
            self._pool.stop()
        finally:
            ended.set()
