"""A server under load: clients that queue at once, interrupts at random, restarts; and what must hold afterwards.

Every client runs its jobs one after another through `dl_core.queueing`, each with a seed of its own so that nothing
comes from a cache, and tries a job again that somebody interrupted. Meanwhile whatever runs is interrupted and whatever
waits is taken out of the queue at random times, and the server is ended or killed and started again. The workings are
seeded; how they fall upon the jobs is up to the machine.
"""

from __future__ import annotations

import json
import random
import re
import signal
import threading
import time
from collections.abc import Iterator, Sequence
from contextlib import contextmanager
from dataclasses import asdict, dataclass, field
from pathlib import Path
from statistics import median
from typing import Any, Final

import psutil  # comes with ComfyUI
from comfy_host import COMFYUI, PHOTO, REPOSITORY, Server, free_port, launch, prepare
from PIL import Image

from dl_core.errors import ProbeError, ServerError
from dl_core.imageio import read_envmap, read_exr_header
from dl_core.queueing.client import UPLOAD_FOLDER, ComfyClient
from dl_core.queueing.jobs import Servers, plan_job, run_jobs
from dl_core.queueing.ledger import Ledger
from dl_core.queueing.pool import Job, Outcome, SilentWatcher
from dl_core.queueing.workflow import Workflow, read_workflow

__all__ = ["GROWTH", "SMOOTH", "WARM", "Trial", "Verdict", "judge", "listed", "put_to_trial", "warm_and_end"]

WARM: Final = 20
"""Jobs after which a server has loaded and allocated what it needs."""
SMOOTH: Final = 5
"""Readings whose median counts: garbage is collected every few jobs."""
GROWTH: Final = 0.10
"""By how much memory may grow after that."""
INTERRUPTED: Final = "interrupted on the server"
TEMPORARY: Final = re.compile(r"\..+\.[0-9a-f]{8}\.[a-z]+")
"""Names of `imageio.atomic` for files that are being written."""
HOSTS_OWN: Final = ("temp", "user", "server.log", "comfyui.db", f"input/{UPLOAD_FOLDER}", "models", "custom_nodes.log")
"""What ComfyUI itself writes below its base folder, and the photographs that clients upload."""


@dataclass(frozen=True)
class Trial:
    """How a server is tried.

    Attributes:
        seconds: for which clients queue new jobs; those begun are then finished.
        clients: at once.
        restarts: of the server, spread over the time; every second one kills it.
        pause: seconds between interrupts, on average.
        seed: of the workings.
    """

    seconds: float
    clients: int = 8
    restarts: int = 3
    pause: float = 6.0
    seed: int = 0


@dataclass
class Verdict:
    """What came of a trial.

    Attributes:
        jobs: begun.
        done: ended with their map.
        interrupts: sent.
        removals: jobs taken out of the queue.
        restarts: of the server, `kills` of them without warning.
        kills: see `restarts`.
        tried_again: jobs that their clients queued again after an interrupt, each time counted.
        resident: bytes of the last server after each job.
        leftovers: files cut short while being written; a kill may leave one, nothing else may.
        faults: what is not as it has to be.
    """

    jobs: int = 0
    done: int = 0
    interrupts: int = 0
    removals: int = 0
    restarts: int = 0
    kills: int = 0
    tried_again: int = 0
    resident: list[int] = field(default_factory=list)
    leftovers: list[str] = field(default_factory=list)
    faults: list[str] = field(default_factory=list)

    @property
    def growth(self) -> float | None:
        """By how much memory grew after the first jobs of the last server; None where it had too few."""
        levels = warm_and_end(self.resident)
        return None if levels is None else levels[1] / levels[0] - 1

    def document(self) -> dict[str, Any]:
        """As JSON has it."""
        return asdict(self) | {"growth": self.growth}


def warm_and_end(resident: Sequence[int]) -> tuple[float, float] | None:
    """Bytes once a server is warm and at the end, each a median of a few readings; None where there are too few."""
    if len(resident) < WARM + SMOOTH:
        return None
    return median(resident[WARM - SMOOTH : WARM]), median(resident[-SMOOTH:])


class _Running:
    """The server of the moment; clients know its address alone."""

    def __init__(self, base: Path, scratch: Path) -> None:
        self.base, self.port, self.scratch = base, free_port(), scratch
        self.url = f"http://127.0.0.1:{self.port}"
        self.process: psutil.Process | None = None

    @contextmanager
    def up(self) -> Iterator[Server]:
        with launch(self.base, self.port, {"TMPDIR": str(self.scratch)}) as server:
            self.process = psutil.Process(server.process.pid)
            yield server
            self.process = None


class _Readings(SilentWatcher):
    """Reads the server's memory when a job ends."""

    def __init__(self, running: _Running, verdict: Verdict, lock: threading.Lock) -> None:
        self._running, self._verdict, self._lock = running, verdict, lock

    def finished(self, outcome: Outcome) -> None:
        process = self._running.process
        if outcome.status != "done" or process is None:
            return
        try:
            resident = process.memory_info().rss
        except psutil.NoSuchProcess:
            return
        with self._lock:
            self._verdict.resident.append(resident)


def put_to_trial(trial: Trial, folder: Path) -> Verdict:
    """Run a trial in a new folder; the server's, the clients' and everything else's files lie below it."""
    verdict, lock, over = Verdict(), threading.Lock(), threading.Event()
    base, scratch, photos = folder / "server", folder / "scratch", folder / "photographs"
    for place in (scratch, photos):
        place.mkdir(parents=True)
    prepare(base)
    running = _Running(base, scratch)
    before, host_before = listed(base), listed(COMFYUI)
    crew: list[threading.Thread] = []
    for number in range(trial.clients):
        client = _Client(number, running, folder / f"client_{number}", photos, verdict, lock)
        crew.append(threading.Thread(target=client.work, args=(over,), daemon=True))
    draw = random.Random(trial.seed)
    spans = [trial.seconds / (trial.restarts + 1)] * (trial.restarts + 1)
    for span, seconds in enumerate(spans):
        with running.up() as server:
            for thread in crew:
                if thread.ident is None:
                    thread.start()
            _disturb(server, trial, seconds, draw, verdict)
            if span < trial.restarts:
                verdict.restarts += 1
                verdict.kills += span % 2
                server.process.send_signal(signal.SIGKILL if span % 2 else signal.SIGTERM)
                server.process.wait(30)
                with lock:
                    verdict.resident.clear()
            else:
                over.set()
                for thread in crew:
                    thread.join(300)
    verdict.faults += ["a client did not come to its end" for thread in crew if thread.is_alive()]
    judge(verdict, folder, base, before, host_before)
    return verdict


def _disturb(server: Server, trial: Trial, seconds: float, draw: random.Random, verdict: Verdict) -> None:
    """Interrupt what runs and remove what waits, at random times, for so many seconds."""
    client, end = ComfyClient(server.url), time.monotonic() + seconds
    while (now := time.monotonic()) < end:
        time.sleep(min(draw.expovariate(1 / trial.pause), end - now))
        try:
            state = client.queue()
            if state.pending and draw.random() < 0.3:
                server.post("/queue", {"delete": [draw.choice(sorted(state.pending))]})
                verdict.removals += 1
            elif state.running:
                server.post("/interrupt", {})
                verdict.interrupts += 1
        except (ServerError, OSError):  # it may be too busy to answer
            continue
    client.close()


class _Client:
    """Queues a job, waits for its map, looks at it, queues the next."""

    def __init__(
        self, number: int, running: _Running, folder: Path, photos: Path, verdict: Verdict, lock: threading.Lock
    ) -> None:
        self._number, self._running, self._photos = number, running, photos
        self._verdict, self._lock = verdict, lock
        self._ledger = Ledger(folder)
        self._draw = random.Random(1000 + number)

    def work(self, over: threading.Event) -> None:
        turn = 0
        try:
            while not over.is_set():
                self._run(turn)
                turn += 1
        except Exception as failure:  # a thread has nobody to raise it to
            self._blame(f"client {self._number} ended: {failure!r}")

    def _run(self, turn: int) -> None:
        seed = 100_000 * self._number + turn
        photo, workflow = self._photo(turn), _workflow(seed, balls=self._draw.randint(1, 4))
        with self._lock:
            self._verdict.jobs += 1
        while True:
            job = plan_job(photo, workflow, self._ledger)
            if not isinstance(job, Job):
                self._blame(f"job {seed} is {job.status} before it ran")
                return
            servers = Servers((self._running.url,), timeout=120, retries=1000)
            (outcome,) = run_jobs(
                [job], servers, self._ledger, _Readings(self._running, self._verdict, self._lock)
            ).outcomes
            if outcome.status == "done":
                self._look_at(outcome, seed)
                return
            if not all(INTERRUPTED in fault.message for fault in outcome.faults):
                self._blame(f"job {seed}: {outcome.status}: {'; '.join(map(str, outcome.faults))}")
                return
            with self._lock:
                self._verdict.tried_again += 1

    def _photo(self, turn: int) -> Path:
        """The package's photograph, a crop of the client's own."""
        path = self._photos / f"client_{self._number}_{turn % 40}.png"
        if not path.exists():
            with Image.open(PHOTO) as picture:
                width, height = picture.size
                picture.crop((turn % 40, self._number, width - 40 + turn % 40, height - 40)).save(path)
        return path

    def _look_at(self, outcome: Outcome, seed: int) -> None:
        """The map is whole, and it is that of this job and of no other client's."""
        maps = [path for path in outcome.files if path.suffix == ".exr"]
        try:
            for path in maps:
                read_envmap(path)
                prompt = json.loads(read_exr_header(path)["prompt"])
                seeds = {node["inputs"]["seed"] for node in prompt.values() if "seed" in node["inputs"]}
                if seeds != {seed}:
                    self._blame(f"job {seed} was given the map of {seeds}")
        except (ProbeError, KeyError, ValueError) as error:
            self._blame(f"job {seed}: its map cannot be read: {error!r}")
        if len(maps) != 1:
            self._blame(f"job {seed}: {len(maps)} maps")
        with self._lock:
            self._verdict.done += 1

    def _blame(self, what: str) -> None:
        with self._lock:
            self._verdict.faults.append(what)


def _workflow(seed: int, balls: int) -> Workflow:
    """The quickstart on few balls and steps."""
    workflow = read_workflow(REPOSITORY / "workflows" / "mini_quickstart.api.json").with_seed(seed)
    for node in workflow.prompt.values():
        if node["class_type"] == "IterativeMedian":
            node["inputs"] |= {"preset": "custom", "balls": balls, "rounds": 1, "steps": 2, "final": False}
        if node["class_type"] == "BallToEquirect":
            node["inputs"]["height"] = 64
    return workflow


def listed(folder: Path) -> set[str]:
    """Names of all files below a folder."""
    return {path.relative_to(folder).as_posix() for path in folder.rglob("*") if path.is_file()}


def judge(verdict: Verdict, folder: Path, base: Path, before: set[str], host_before: set[str]) -> None:
    """Look at what lies on the disk, and at memory.

    Args:
        verdict: faults are added to it.
        folder: of the trial.
        base: of the server.
        before: files below it at the start.
        host_before: files of ComfyUI at the start.
    """
    if verdict.done != verdict.jobs:
        verdict.faults.append(f"{verdict.jobs} jobs were begun and {verdict.done} ended with a map")
    new = listed(base) - before
    strays = sorted(name for name in new if not name.startswith(("output/", *HOSTS_OWN)))
    verdict.faults += [f"written outside the output folder: {name}" for name in strays]
    verdict.faults += [f"written into ComfyUI's own folder: {name}" for name in sorted(listed(COMFYUI) - host_before)]
    verdict.faults += [f"gone: {name}" for name in sorted(before - listed(base))]
    verdict.faults += [f"left in the folder for temporary files: {name}" for name in sorted(listed(folder / "scratch"))]
    everywhere = (path for path in folder.rglob(".*") if TEMPORARY.fullmatch(path.name))
    verdict.leftovers = sorted(path.relative_to(folder).as_posix() for path in everywhere)
    if len(verdict.leftovers) > verdict.kills:
        verdict.faults.append(f"half-written files left by {verdict.kills} kills: {', '.join(verdict.leftovers)}")
    growth = verdict.growth
    if growth is not None and growth > GROWTH:
        verdict.faults.append(f"memory grew by {growth:.1%} over {len(verdict.resident)} jobs of the last server")
