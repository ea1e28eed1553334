"""Eight clients at one server for a quarter of an hour: `python tests/comfyui/bench_load.py [--minutes 15 --out DIR]`.

Starts a real server, has it interrupted at random and restarted, and checks that nothing is lost, that nothing is
written outside its output folder, and that neither memory nor temporary files are left behind: see `load_trial`.
Prints the counts and writes `load.json`.
"""

from __future__ import annotations

import argparse
import json
import sys
import tempfile
from pathlib import Path

sys.path[:0] = [str(Path(__file__).resolve().parents[2]), str(Path(__file__).resolve().parents[1])]

from load_trial import Trial, put_to_trial  # noqa: E402

from dl_core.imageio import atomic  # noqa: E402


def main() -> int:
    """Run it; 1 if something is not as it has to be."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--minutes", type=float, default=15, help="for which jobs are queued (default: 15)")
    parser.add_argument("--clients", type=int, default=8)
    parser.add_argument("--restarts", type=int, default=3, help="of the server (default: 3)")
    parser.add_argument("--pause", type=float, default=6, help="seconds between interrupts, on average (default: 6)")
    parser.add_argument("--seed", type=int, default=0, help="of interrupts (default: 0)")
    parser.add_argument("--out", type=Path, default=Path("load"), help="folder for load.json (default: load)")
    args = parser.parse_args()
    args.out.mkdir(parents=True, exist_ok=True)
    trial = Trial(60 * args.minutes, args.clients, args.restarts, args.pause, args.seed)
    with tempfile.TemporaryDirectory() as folder:
        verdict = put_to_trial(trial, Path(folder) / "trial")
        log = (Path(folder) / "trial" / "server" / "server.log").read_text(encoding="utf-8", errors="replace")
    (args.out / "server.log").write_text(log, encoding="utf-8")
    with atomic(args.out / "load.json") as temporary:
        temporary.write_text(json.dumps(verdict.document(), indent=2), encoding="utf-8")
    growth = "not judged, too few jobs" if verdict.growth is None else f"{verdict.growth:+.1%}"
    print(  # noqa: T201
        f"{verdict.done} of {verdict.jobs} jobs done; {verdict.interrupts} interrupts, {verdict.removals} removals, "
        f"{verdict.restarts} restarts ({verdict.kills} kills), {verdict.tried_again} tried again; memory of the last "
        f"server over {len(verdict.resident)} jobs {growth}; {len(verdict.leftovers)} half-written files"
    )
    print("\n".join(verdict.faults) or "all as it has to be")  # noqa: T201
    return int(bool(verdict.faults))


if __name__ == "__main__":
    sys.exit(main())
