"""A long night for one server: `python tests/comfyui/bench_soak.py [--jobs 200 --bad 3 --out DIR]`.

Starts a real server and queues one workflow again and again through `dl_core.queueing`, every job with a crop and a
seed of its own so that nothing comes from a cache, a few of them bad on purpose. Then checks that every good job has
its map, that every bad one failed with the words expected of it, and that the server's resident memory at the end is
at most a tenth above what it was after job 20. Prints memory over jobs and writes `soak.json`.

A bench that was stopped goes on from what lies in DIR when it is started again; its server is a new one by then, so
memory is compared over the jobs of that server alone.
"""

from __future__ import annotations

import argparse
import copy
import json
import platform
import shutil
import signal
import sys
import tempfile
import threading
import time
from collections.abc import Callable
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

sys.path[:0] = [str(Path(__file__).resolve().parents[2]), str(Path(__file__).resolve().parents[1])]

import psutil  # noqa: E402  comes with ComfyUI
import torch  # noqa: E402
from comfy_host import PHOTO, REPOSITORY, free_port, launch, prepare  # noqa: E402
from load_trial import GROWTH, SMOOTH, WARM, warm_and_end  # noqa: E402
from PIL import Image  # noqa: E402

from dl_core.imageio import atomic  # noqa: E402
from dl_core.queueing.jobs import Run, Servers, plan_job, run_jobs  # noqa: E402
from dl_core.queueing.ledger import Ledger  # noqa: E402
from dl_core.queueing.pool import Job, Outcome, SilentWatcher  # noqa: E402
from dl_core.queueing.workflow import Prompt, Workflow, read_workflow  # noqa: E402

EVERY = 10


def _set(kind: str, **values: Any) -> Callable[[Prompt], None]:
    def change(prompt: Prompt) -> None:
        for node in prompt.values():
            if node["class_type"] == kind:
                node["inputs"] |= values

    return change


def _relink(kind: str, socket: str, other: str) -> Callable[[Prompt], None]:
    def change(prompt: Prompt) -> None:
        for node in prompt.values():
            if node["class_type"] == kind:
                node["inputs"][socket] = node["inputs"][other]

    return change


@dataclass(frozen=True)
class Bad:
    """A fault made on purpose, and the node and words that have to come back."""

    name: str
    node_type: str
    words: str
    change: Callable[[Prompt], None] | None = None
    photo: bytes | None = None


BAD = (
    Bad("a photograph that is no picture", "LoadImage", "cannot identify image file", photo=b"no picture\n"),
    Bad(
        "a model where a ControlNet belongs",
        "IterativeMedian",
        "control_net",
        change=_relink("IterativeMedian", "control_net", "model"),
    ),
    Bad("exposures out of range", "EVPromptInterp", "evs", change=_set("EVPromptInterp", evs="0, 3")),
)


class Readings(SilentWatcher):
    """Reads the server's memory after every job, and says so every few."""

    def __init__(self, process: psutil.Process) -> None:
        self.rows: list[dict[str, Any]] = []
        self._process, self._start, self._lock = process, time.perf_counter(), threading.Lock()

    def note(self, text: str) -> None:
        print(text, flush=True)  # noqa: T201

    def finished(self, outcome: Outcome) -> None:
        if outcome.status == "cancelled":
            return
        with self._lock:
            resident = self._process.memory_info().rss
            row = {"job": len(self.rows) + 1, "resident_bytes": resident, "status": outcome.status}
            row |= {"photo": outcome.job.photo.name, "seconds": outcome.seconds}
            self.rows.append(row | {"at": round(time.perf_counter() - self._start, 2)})
            if outcome.faults:
                print(f"{outcome.job.photo.name}: {'; '.join(map(str, outcome.faults))}", flush=True)  # noqa: T201
            if row["job"] % EVERY == 0 or row["job"] == 1:
                print(f"{row['job']:5}  {resident / 2**20:7.1f} MiB  {self.rows[-1]['at']:7.0f} s", flush=True)  # noqa: T201


def crop(folder: Path, number: int) -> Path:
    """The package's photograph, a different crop for every number."""
    path = folder / f"crop_{number:04}.png"
    if not path.exists():
        with Image.open(PHOTO) as picture, atomic(path) as temporary:
            width, height = picture.size
            left, top = number % 40, number // 40
            picture.crop((left, top, width - 40 + left, height - 40 + top)).save(temporary)
    return path


def plan(args: argparse.Namespace, ledger: Ledger) -> tuple[list[Job | Outcome], dict[str, Bad]]:
    """All jobs, and what is wrong with those that are bad, by the photograph's name."""
    workflow = read_workflow(args.workflow)
    photos = args.out / "photographs"
    photos.mkdir(parents=True, exist_ok=True)
    places = {(index + 1) * args.jobs // (args.bad + 1): BAD[index % len(BAD)] for index in range(args.bad)}
    plans: list[Job | Outcome] = []
    bad: dict[str, Bad] = {}
    for number in range(args.jobs):
        photo, flow = crop(photos, number), workflow.with_seed(number)
        if fault := places.get(number):
            photo, flow = spoil(photo, flow, fault)
            bad[photo.name] = fault
        plans.append(plan_job(photo, flow, ledger))
    return plans, bad


def spoil(photo: Path, workflow: Workflow, fault: Bad) -> tuple[Path, Workflow]:
    """A photograph and a workflow with a fault."""
    path = photo.with_name(f"bad_{photo.name}")
    path.write_bytes(fault.photo or photo.read_bytes())
    prompt = copy.deepcopy(workflow.prompt)
    if fault.change:
        fault.change(prompt)
    return path, replace(workflow, prompt=prompt)


def growth(rows: list[dict[str, Any]]) -> dict[str, Any]:
    """Memory after job 20 and at the end: medians of the last five readings by then."""
    resident = [row["resident_bytes"] for row in rows]
    levels = warm_and_end(resident)
    if levels is None:
        return {"growth": None}
    warm, end = levels
    return {"warm_bytes": warm, "end_bytes": end, "highest_bytes": max(resident), "growth": end / warm - 1}


def faults(run: Run, known: list[Outcome], bad: dict[str, Bad], memory: dict[str, Any]) -> list[str]:
    """What is not as it has to be."""
    found = ["it was stopped before the end"] if run.interrupted else []
    for outcome in (*run.outcomes, *known):
        if outcome.status == "cancelled":
            continue
        photo = outcome.job.photo.name
        wanted = bad.get(photo)
        if wanted is None and outcome.status not in ("done", "skipped"):
            found.append(f"{photo}: {outcome.status}: {'; '.join(map(str, outcome.faults))}")
        if wanted is None and outcome.status == "done" and not any(file.suffix == ".exr" for file in outcome.files):
            found.append(f"{photo}: no EXR among {outcome.files}")
        if wanted is not None:
            said = [fault for fault in outcome.faults if fault.node_type == wanted.node_type]
            if outcome.status != "failed" or not any(wanted.words in fault.message for fault in said):
                found.append(f"{photo}: {wanted.name} gave {outcome.status}: {outcome.faults}")
    if memory["growth"] is None:
        found.append(f"memory was not measured: this server ran fewer than {WARM + SMOOTH} jobs")
    elif memory["growth"] > GROWTH:
        found.append(f"memory grew by {memory['growth']:.1%}")
    return found


def environment() -> dict[str, str]:
    """What memory depends on: how glibc gives it back differs between versions."""
    libc = " ".join(platform.libc_ver())
    return {"python": platform.python_version(), "torch": torch.__version__, "libc": libc, "system": platform.system()}


def main() -> int:
    """Run it; 1 if something is not as it has to be."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--jobs", type=int, default=200)
    parser.add_argument("--bad", type=int, default=3, help="of them")
    parser.add_argument("--workflow", type=Path, default=REPOSITORY / "workflows" / "mini_quickstart.api.json")
    parser.add_argument("--out", type=Path, default=Path("soak"), help="folder for maps and soak.json (default: soak)")
    parser.add_argument("--minutes", type=float, default=150, help="after which it stops in good order (default: 150)")
    args = parser.parse_args()
    # Shells start background jobs with SIGINT ignored.
    signal.signal(signal.SIGINT, signal.default_int_handler)
    ledger = Ledger(args.out / "maps")
    plans, bad = plan(args, ledger)
    jobs = [item for item in plans if isinstance(item, Job)]
    known = [item for item in plans if isinstance(item, Outcome)]
    with tempfile.TemporaryDirectory() as folder:
        base = Path(folder) / "server"
        prepare(base)
        with launch(base, free_port()) as server:
            readings = Readings(psutil.Process(server.process.pid))
            alarm = threading.Timer(60 * args.minutes, signal.raise_signal, [signal.SIGINT])
            alarm.daemon = True
            alarm.start()
            run = run_jobs(jobs, Servers((server.url,)), ledger, readings)
            alarm.cancel()
        shutil.copy(base / "server.log", args.out)
    memory = growth(readings.rows)
    found = faults(run, known, bad, memory)
    outcomes = [*run.outcomes, *known]
    maps = sum(file.suffix == ".exr" and file.is_file() for outcome in outcomes for file in outcome.files)
    report = {"jobs": args.jobs, "bad": args.bad, "maps": maps, "faults": found, **memory}
    report |= {"environment": environment(), "rows": readings.rows}
    with atomic(args.out / "soak.json") as temporary:
        temporary.write_text(json.dumps(report, indent=2), encoding="utf-8")
    failed = sum(outcome.status == "failed" for outcome in outcomes)
    print(f"{maps} maps, {failed} failed, {len(bad)} of them on purpose")  # noqa: T201
    if memory["growth"] is not None:
        print(  # noqa: T201
            f"resident after job {WARM} {memory['warm_bytes'] / 2**20:.1f} MiB, at the end "
            f"{memory['end_bytes'] / 2**20:.1f} MiB ({memory['growth']:+.1%}), at most "
            f"{memory['highest_bytes'] / 2**20:.1f} MiB"
        )
    print("\n".join(found) or "all as it has to be")  # noqa: T201
    return int(bool(found))


if __name__ == "__main__":
    sys.exit(main())
