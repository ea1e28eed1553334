"""Exposure steering measured on painters whose exposures are known."""

from __future__ import annotations

import json
import math
from dataclasses import replace
from pathlib import Path

import pytest
import torch

from dl_core.bench import steering
from dl_core.bench.painters import PAINTERS, Studio
from dl_core.bench.perfect import PerfectPainter
from dl_core.cli import main
from dl_core.exposure import expose
from dl_core.geometry import latlong_directions
from dl_core.imageio import write_exr
from dl_core.iterative import Rounds
from dl_core.painter import Observer, PaintRequest, PaintResult

EVS = (0.0, -1.0, -2.5, -5.0)
ROUNDS = Rounds(balls=1, rounds=0, steps=2, final=False)


def light() -> torch.Tensor:
    """Brighter upwards and to one side, up to three times white."""
    directions = latlong_directions(64)
    return (0.15 + 0.4 * (directions[..., 1:2] + 1) ** 2 * (1.2 + directions[..., :1])).expand(-1, -1, 3)[None]


@pytest.fixture
def panorama(tmp_path: Path) -> Path:
    folder = tmp_path / "maps"
    folder.mkdir()
    return write_exr(folder / "side.exr", light()[0], metadata={})


def perfect(files: object) -> Studio:
    return Studio(lambda variant, shot: PerfectPainter(shot.truth_hdr), 256, 128)


class Weak(PerfectPainter):
    """Darkens half as much as it is asked to, and turns the ball upside down below EV 0."""

    def paint(self, request: PaintRequest, observer: Observer) -> PaintResult:
        result = super().paint(replace(request, ev=request.ev / 2), observer)
        return replace(result, balls=result.balls.flip(1)) if request.ev < 0 else result


def weak(files: object) -> Studio:
    return Studio(lambda variant, shot: Weak(shot.truth_hdr), 256, 128)


def test_a_true_bracket_is_on_the_mark(panorama: Path) -> None:
    rows = steering.bench_steering([panorama], perfect(None), EVS, ROUNDS, -2.5)
    assert [row["ev"] for row in rows] == list(EVS)
    for row in rows:
        assert abs(row["error_stops"]) < 0.05  # 8 bits
    assert rows[2]["structure"] > 0.95
    summary = steering.summarize(rows)
    assert all(row["within_half_a_stop"] == 1 and row["monotone"] == 1 for row in summary)


def test_a_weak_bracket_that_moves_its_light_is_found_out(panorama: Path) -> None:
    rows = steering.bench_steering([panorama], weak(None), EVS, ROUNDS, -2.5)
    assert rows[1]["error_stops"] > 0.2
    assert rows[3]["error_stops"] > 1.5
    assert rows[2]["structure"] < 0.3
    summary = steering.summarize(rows)
    assert summary[3]["within_half_a_stop"] == 0
    assert summary[2]["structure_worst"] == rows[2]["structure"]


def test_stops_are_measured_where_nothing_is_clipped() -> None:
    radiance = torch.full((1, 64, 64, 3), 0.2)
    radiance[:, :32] = 40.0
    bright, dark = expose(radiance, 0.0), expose(radiance, -3.0)
    assert steering.steering(bright, dark) == pytest.approx(-3, abs=1e-4)
    assert steering.steering(bright, torch.zeros_like(dark)) == -math.inf
    assert math.isnan(steering.steering(torch.ones_like(bright), dark))


def test_luminance_that_rises_again_is_not_monotone() -> None:
    rows = [
        {"panorama": "a", "ev": ev, "stops": stops, "error_stops": stops - ev, "structure": None}
        for ev, stops in ((0.0, 0.0), (-1.0, -2.0), (-2.0, -1.5))
    ]
    assert {row["monotone"] for row in steering.summarize(rows)} == {0}


def test_the_command_prints_and_goes_on(
    panorama: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    monkeypatch.setitem(PAINTERS, "weak", weak)
    command = ["bench", "steering", "--panoramas", str(panorama.parent), "--painter", "weak", "--out"]
    command += [str(tmp_path / "out"), "--json"]
    assert main(command) == 0
    first = json.loads(capsys.readouterr().out)
    assert len(first["rows"]) == 7
    monkeypatch.setattr(steering, "iterative_inpaint", None)  # all is there
    assert main(command) == 0
    assert json.loads(capsys.readouterr().out)["rows"] == first["rows"]
    assert main([*command, "--structure-ev", "-7"]) == 2
    assert "--structure-ev is -7.0; accepted: one of --evs" in capsys.readouterr().err
