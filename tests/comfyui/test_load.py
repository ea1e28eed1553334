"""A minute of what `bench_load.py` does for a quarter of an hour."""

from __future__ import annotations

from pathlib import Path

import pytest
from comfy_host import COMFYUI
from load_trial import SMOOTH, WARM, Trial, Verdict, judge, listed, put_to_trial


@pytest.mark.parametrize(
    ("stray", "word"),
    [
        ("server/input/notes.txt", "outside the output folder: input/notes.txt"),
        ("server/probe.exr", "outside the output folder: probe.exr"),
        ("scratch/torch_x", "temporary files: torch_x"),
        ("server/output/lightprobe/.probe_00001_.0a1b2c3d.exr", "half-written files left by 0 kills"),
    ],
)
def test_what_is_left_behind_is_named(tmp_path: Path, stray: str, word: str) -> None:
    (tmp_path / "server" / "output").mkdir(parents=True)
    verdict = Verdict()
    judge(verdict, tmp_path, tmp_path / "server", set(), listed(COMFYUI))
    assert verdict.faults == []
    (tmp_path / stray).parent.mkdir(parents=True, exist_ok=True)
    (tmp_path / stray).touch()
    judge(verdict, tmp_path, tmp_path / "server", set(), listed(COMFYUI))
    (fault,) = verdict.faults
    assert word in fault


def test_lost_jobs_lost_files_and_lost_memory_are_named(tmp_path: Path) -> None:
    verdict = Verdict(jobs=3, done=2, resident=[100] * WARM + [111] * SMOOTH)
    judge(verdict, tmp_path, tmp_path / "server", {"input/coffee.jpg"}, listed(COMFYUI))
    assert [fault.split()[0] for fault in verdict.faults] == ["3", "gone:", "memory"]


def test_a_server_under_load_loses_nothing_and_leaves_nothing_behind(tmp_path: Path) -> None:
    verdict = put_to_trial(Trial(seconds=60, clients=8, restarts=2, pause=5.0), tmp_path / "trial")
    assert verdict.faults == []
    assert verdict.done == verdict.jobs >= 8
    assert verdict.restarts == 2
    assert verdict.interrupts > 0
