"""What `lightprobe queue` does; its options are in `queue.py`."""

from __future__ import annotations

import argparse
import json
import sys
import threading
import time
from pathlib import Path
from typing import Any, Final

from tqdm import tqdm

from .. import __version__
from ..errors import Interrupted
from ..queueing.jobs import Run, Servers, plan_job, run_jobs
from ..queueing.ledger import Ledger
from ..queueing.pool import Job, Outcome
from ..queueing.workflow import Workflow, read_workflow

__all__ = ["run"]

DEFAULT_SERVER: Final = "http://127.0.0.1:8188"


class _Line:
    """A bar that counts photographs and says what each server is at; faults and notes are printed above it."""

    def __init__(self, bar: tqdm[Any]) -> None:
        self._bar = bar
        self._at: dict[str, str] = {}
        self._lock = threading.Lock()

    def progress(self, server: str, job: Job, node: str, value: float, total: float) -> None:
        """Show it."""
        with self._lock:
            self._at[server] = f"{job.photo.name} {node} {value:g}/{total:g}"
            self._bar.set_postfix_str("; ".join(self._at.values()))

    def note(self, text: str) -> None:
        """Print it."""
        with self._lock:
            self._bar.write(text, file=sys.stderr)

    def finished(self, outcome: Outcome) -> None:
        """Count it, and print why it failed."""
        if outcome.faults:
            self.note(f"{outcome.job.photo.name}: {_reason(outcome)}")
        with self._lock:
            self._at.pop(outcome.server or "", None)
            self._bar.update()


def run(args: argparse.Namespace) -> int:
    """Queue, follow, collect, report; the exit code: 1 if a photograph failed.

    Raises:
        OptionError: a workflow, server or option that is not accepted.
        OutputError: the folder of results cannot be written.
        Interrupted: the user stopped the run, after the report.
    """
    start = time.perf_counter()
    workflow = read_workflow(args.workflow, args.photo_node)
    if args.seed is not None:
        workflow = workflow.with_seed(args.seed)
    servers = Servers(tuple(args.server or [DEFAULT_SERVER]), args.timeout, args.retries)
    servers.clients()  # refuse options before the folder is made
    result = _work([Path(name) for name in args.photos], workflow, servers, Ledger(Path(args.out)))
    _report(args, servers, result, time.perf_counter() - start)
    if result.interrupted:
        raise Interrupted("interrupted; jobs of this run are cancelled, maps that were collected stay")
    return int(any(outcome.status == "failed" for outcome in result.outcomes))


def _work(photos: list[Path], workflow: Workflow, servers: Servers, ledger: Ledger) -> Run:
    """Outcomes in the order of the photographs."""
    plans = [plan_job(photo, workflow, ledger) for photo in photos]
    jobs = [plan for plan in plans if isinstance(plan, Job)]
    known = [plan for plan in plans if isinstance(plan, Outcome)]
    with tqdm(total=len({job.record.key for job in jobs}) + len(known), unit="photo", file=sys.stderr) as bar:
        line = _Line(bar)
        for outcome in known:
            line.finished(outcome)
        result = run_jobs(jobs, servers, ledger, line)
    came = iter(result.outcomes)
    return Run(tuple(next(came) if isinstance(plan, Job) else plan for plan in plans), result.interrupted)


def _reason(outcome: Outcome) -> str:
    return "; ".join(map(str, outcome.faults))


def _report(args: argparse.Namespace, servers: Servers, result: Run, seconds: float) -> None:
    rows = [_row(name, outcome) for name, outcome in zip(args.photos, result.outcomes, strict=True)]
    counts = {status: sum(row["status"] == status for row in rows) for status in ("done", "skipped", "failed")}
    counts["cancelled"] = len(rows) - sum(counts.values())
    if args.json:
        report = {
            "photos": rows,
            "counts": counts,
            "seconds": round(seconds, 3),
            "servers": list(servers.urls),
            "out": args.out,
            "interrupted": result.interrupted,
            "version": __version__,
        }
        print(json.dumps(report, indent=2))
        return
    for row in rows:
        took = "" if row["seconds"] is None else f", {row['seconds']:.1f} s on {row['server']}"
        print(f"{row['photo']}: {row['status']}{took}")
        for line in row["files"] or [fault["message"] for fault in row["errors"]]:
            print(f"  {line}")
    print(", ".join(f"{count} {status}" for status, count in counts.items() if count) + f" in {seconds:.1f} s")


def _row(name: str, outcome: Outcome) -> dict[str, Any]:
    return {
        "photo": name,
        "status": outcome.status,
        "files": [str(path) for path in outcome.files],
        "seconds": outcome.seconds,
        "server": outcome.server,
        "errors": [
            {"message": str(fault), "node": fault.node, "node_type": fault.node_type} for fault in outcome.faults
        ],
    }
