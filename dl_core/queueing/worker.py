"""What happens on one server: jobs are sent, followed, collected, and found again after it was away."""

from __future__ import annotations

import re
import time
import uuid
from collections.abc import Mapping
from contextlib import suppress
from dataclasses import dataclass, replace
from http import HTTPStatus
from typing import Any, Final

from ..errors import ProbeError, ServerError
from .client import ComfyClient, Events, Fault, Refused, ServerAway, run_faults
from .ledger import Ledger
from .pool import Job, Outcome, Pool, Watcher

__all__ = ["Worker"]

AHEAD: Final = 2
"""Jobs a server has at a time: one that runs and one that waits, so that collecting files costs the server no time."""
TICK: Final = 0.5
"""Seconds between looks at whether the user stops the run or another server gave a job back."""
LOOK: Final = 5.0
"""Seconds between looks into queue and history, should a message be missed."""
LAST_WORDS: Final = 1.0
"""Seconds without a message after which a server that went away has nothing more to say."""
FIRST_WAIT: Final = 0.5
LONGEST_WAIT: Final = 10.0
"""Seconds between attempts to reach a server that is away: doubled from the first to the longest."""


@dataclass
class _Flight:
    """A job on the server, since when, and whether it was seen to run."""

    job: Job
    running: bool = False


class Worker:
    """Runs jobs of a pool on one server until the pool is empty, the user stops, or the server stays away."""

    def __init__(self, client: ComfyClient, pool: Pool, ledger: Ledger, watcher: Watcher, timeout: float) -> None:
        """Prepare.

        Args:
            client: of the server.
            pool: to take jobs from.
            ledger: keeps the files.
            watcher: is told.
            timeout: seconds after which a server that stays away is given up.
        """
        self._client, self._pool, self._ledger, self._watcher = client, pool, ledger, watcher
        self._timeout = timeout
        self._flights: dict[str, _Flight] = {}
        self._away_since: float | None = None
        self._wait = FIRST_WAIT

    def run(self) -> None:
        """Work; returns when nothing is left to do here."""
        try:
            while not self._pool.over.is_set():
                try:
                    self._client.queue()  # what is no ComfyUI server is found out here, and not waited for
                    with self._client.events() as events:
                        self._serve_and_listen(events)
                except ServerAway as away:
                    if not self._outlast(away):
                        return
            self._cancel()
        except ServerError as error:
            self._give_up(error.reason)
        finally:
            self._client.close()

    def _serve_and_listen(self, events: Events) -> None:
        """Serve; when the server goes away, hear what it still said: which job ran when it went."""
        try:
            self._serve(events)
        except ServerAway:
            with suppress(ServerAway):
                while (message := events.next(LAST_WORDS)) is not None:
                    self._hear(message["type"], message["data"])
            raise

    def _serve(self, events: Events) -> None:
        """Follow the server's messages while it is there.

        Raises:
            ServerError: it went away, or is no server to work with.
        """
        self._look()
        self._is_there()
        next_look = time.monotonic() + LOOK
        while not self._pool.over.is_set():
            self._fill()
            message = events.next(TICK)
            ended = message is not None and self._hear(message["type"], message["data"])
            if self._flights and (ended or time.monotonic() > next_look):
                self._look()
                next_look = time.monotonic() + LOOK

    # --- sending ---

    def _fill(self) -> None:
        while len(self._flights) < AHEAD and (job := self._pool.take()) is not None:
            self._send(job)

    def _send(self, job: Job) -> None:
        # In flight before it is sent: if the server goes away meanwhile, it is asked afterwards what it got.
        prompt_id = str(uuid.uuid4())
        self._flights[prompt_id] = _Flight(job)
        try:
            content = job.photo.read_bytes()
        except OSError as error:
            self._end(prompt_id, Outcome(job, "failed", faults=(Fault(f"{job.photo} cannot be read ({error})"),)))
            return
        try:
            name = self._client.upload(_upload_name(job), content)
            given = self._client.submit(job.workflow.with_photo(name), prompt_id)
            self._flights[given] = self._flights.pop(prompt_id)
        except Refused as refusal:
            self._end(prompt_id, Outcome(job, "failed", faults=refusal.faults, server=self._client.url))

    # --- following ---

    def _hear(self, kind: str, data: Mapping[str, Any]) -> bool:
        """Take notice of a message; whether a job of ours ended."""
        flight = self._flights.get(data.get("prompt_id", ""))
        if flight is None:
            return False
        flight.running = True
        if kind == "progress":
            node = flight.job.workflow.prompt.get(str(data.get("node")), {}).get("class_type", "")
            self._watcher.progress(self._client.url, flight.job, node, data.get("value", 0), data.get("max", 1))
        # The last message of a prompt, sent when its entry of the history is there.
        return kind == "executing" and data.get("node") is None

    def _look(self) -> None:
        """Find each job in queue or history: one is running, waiting, ended, or lost.

        The queue comes first: a job that ends between the two questions is then in the history.
        """
        state = self._client.queue()
        for prompt_id, flight in list(self._flights.items()):
            if prompt_id in state.running:
                flight.running = True
            elif prompt_id not in state.pending:
                self._settle(prompt_id, flight.job, self._client.history(prompt_id))

    def _settle(self, prompt_id: str, job: Job, entry: Mapping[str, Any] | None) -> None:
        outcome = None if entry is None else self._outcome(job, entry)
        if outcome is None:
            self._lose(prompt_id)
        else:
            self._end(prompt_id, outcome)

    def _outcome(self, job: Job, entry: Mapping[str, Any]) -> Outcome | None:
        """What came of a prompt that ended, its files collected; None if files are gone, as after a restart.

        Raises:
            ServerAway: while files were collected.
        """
        failed = Outcome(job, "failed", seconds=_seconds(entry), server=self._client.url)
        if faults := run_faults(entry):
            return replace(failed, faults=faults)
        outputs = [output for node, output in entry["outputs"].items() if node in job.workflow.savers]
        if not any(output.get("envmaps") for output in outputs):
            return replace(failed, faults=(Fault("the server reports no file of a Save Environment Map node"),))
        try:
            record = self._ledger.collect(job.record, outputs, self._client.fetch)
        except ServerAway:
            raise
        except Refused as refusal:
            return None if refusal.status == HTTPStatus.NOT_FOUND else replace(failed, faults=refusal.faults)
        except ProbeError as error:
            return replace(failed, faults=(Fault(str(error)),))
        return replace(failed, status="done", files=tuple(self._ledger.folder / name for name in record.files))

    def _end(self, prompt_id: str, outcome: Outcome) -> None:
        del self._flights[prompt_id]
        self._pool.finish(outcome)

    def _lose(self, prompt_id: str) -> None:
        flight = self._flights.pop(prompt_id)
        self._pool.lost(flight.job, self._client.url, flight.running)

    # --- away ---

    def _is_there(self) -> None:
        if self._away_since is not None:
            self._watcher.note(f"{self._client.url} is back")
        self._away_since, self._wait = None, FIRST_WAIT

    def _outlast(self, away: ServerAway) -> bool:
        """Wait before the next attempt; False if the server is given up."""
        now = time.monotonic()
        if self._away_since is None:
            self._away_since = now
            self._watcher.note(f"{away}; trying again for {self._timeout:g} s")
        left = self._away_since + self._timeout - now
        if left <= 0:
            self._give_up(f"stayed away for {self._timeout:g} s, {away.reason}")
            return False
        self._pool.over.wait(min(self._wait, left))
        self._wait = min(2 * self._wait, LONGEST_WAIT)
        return True

    def _give_up(self, reason: str) -> None:
        self._watcher.note(f"{self._client.url} is given up: {reason}")
        for flight in self._flights.values():
            self._pool.give_back(flight.job)
        self._flights.clear()
        self._pool.leave(f"{self._client.url} {reason}")

    def _cancel(self) -> None:
        """Take our jobs back from the server; one that is away keeps what it has."""
        if self._flights:
            try:
                self._client.cancel(self._flights)
            except ServerError as error:
                self._watcher.note(f"jobs may go on there: {error}")


def _upload_name(job: Job) -> str:
    """A name on the server that no other photograph has, and that holds nothing a server or file system minds."""
    stem = re.sub(r"[^A-Za-z0-9_-]+", "_", job.photo.stem)[:40]
    suffix = re.sub(r"[^A-Za-z0-9.]+", "", job.photo.suffix)
    return f"{stem}-{job.record.key[:16]}{suffix}"


def _seconds(entry: Mapping[str, Any]) -> float | None:
    """How long a prompt ran, by the server's clock."""
    stamps = [body["timestamp"] for _, body in entry.get("status", {}).get("messages", []) if "timestamp" in body]
    return (max(stamps) - min(stamps)) / 1000 if stamps else None
