"""The chart of speed against accuracy: its statistics, its bookkeeping, its files."""

from __future__ import annotations

import csv
import json
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import torch
from analytic_painter import AnalyticPainter, Flaws
from hypothesis import given
from hypothesis import strategies as st

from dl_core.ball import place_ball
from dl_core.bench.bootstrap import mean_interval
from dl_core.bench.front import on_front
from dl_core.bench.painters import PAINTERS, Studio
from dl_core.bench.pareto.schedules import GRIDS, Schedule
from dl_core.bench.shared_balls import SharedBalls
from dl_core.cli import main
from dl_core.errors import OptionError
from dl_core.geometry import latlong_directions
from dl_core.imageio import write_exr
from dl_core.iterative import Rounds, iterative_inpaint
from dl_core.painter import PaintRequest, SilentObserver
from dl_core.presets import PRESETS, Preset

LIGHT = torch.exp(latlong_directions(64))[None]
CANVAS, DIAMETER = 64, 32


def studio(flaws: Flaws, painted: list[int] | None = None) -> Studio:
    class Counted(AnalyticPainter):
        def paint(self, request: PaintRequest, observer: Any) -> Any:
            if painted is not None:
                painted.append(len(request.seeds))
            return super().paint(request, observer)

    return Studio(lambda variant, shot: Counted(shot.truth_hdr, flaws), CANVAS, DIAMETER)


@pytest.fixture
def maps(tmp_path: Path) -> Path:
    folder = tmp_path / "maps"
    folder.mkdir()
    for name, turned in (("one", LIGHT), ("two", LIGHT.flip(2))):
        write_exr(folder / f"{name}.exr", turned[0], metadata={})
    return folder


@pytest.fixture
def few(monkeypatch: pytest.MonkeyPatch) -> dict[str, Schedule]:
    """A grid of three schedules and a painter of noisy balls."""
    rounds = {"dear": Rounds(9, 1, 0.8, 4), "cheap": Rounds(1, 1, 0.8, 2, final=False), "mid": Rounds(3, 2, 0.8, 4)}
    schedules = [Schedule(name, "swept", Preset(r, (0.0, -2.5), name)) for name, r in rounds.items()]
    monkeypatch.setitem(GRIDS, "small", lambda: schedules)
    monkeypatch.setitem(PAINTERS, "noisy", lambda files: studio(Flaws(noise=0.1)))
    return {schedule.name: schedule for schedule in schedules}


# --- statistics --------------------------------------------------------------------------------------------------


def test_intervals_hold_the_true_mean_about_as_often_as_they_say() -> None:
    draw = np.random.default_rng(7)
    intervals = [mean_interval(draw.exponential(1.0, 40).tolist()) for _ in range(300)]
    held = np.mean([interval.low <= 1.0 <= interval.high for interval in intervals])
    assert 0.88 < held < 0.98
    again = mean_interval([1.0, 2.0, 4.0])
    assert again == mean_interval([1.0, 2.0, 4.0])
    assert again.mean == pytest.approx(7 / 3)
    assert again.low < again.mean < again.high


def test_one_scene_has_no_interval_and_none_has_no_mean() -> None:
    interval = mean_interval([2.5])
    assert (interval.mean, interval.low, interval.high) == (2.5, None, None)
    with pytest.raises(OptionError, match="values"):
        mean_interval([])


@given(st.lists(st.tuples(st.integers(1, 9), st.integers(1, 9)), min_size=1, max_size=30))
def test_whatever_is_not_on_the_front_is_beaten_by_something_that_is(points: list[tuple[int, int]]) -> None:
    marks = on_front(points)
    front = [point for point, mark in zip(points, marks, strict=True) if mark]
    assert front
    for point, mark in zip(points, marks, strict=True):
        beaten = any(a <= point[0] and b <= point[1] and (a, b) != point for a, b in front)
        assert beaten != mark


# --- bookkeeping -------------------------------------------------------------------------------------------------


def test_shared_balls_are_the_painters_own_and_are_painted_once() -> None:
    own, shared = AnalyticPainter(LIGHT, Flaws(noise=0.2)), SharedBalls(AnalyticPainter(LIGHT, Flaws(noise=0.2)))
    request = PaintRequest(
        torch.zeros(1, CANVAS, CANVAS, 3), torch.zeros(1, CANVAS, CANVAS, 3), place_ball(CANVAS, DIAMETER), 0.0, (3,)
    )
    for rounds in (Rounds(3, 2, 0.8, 5), Rounds(5, 1, 0.8, 5), Rounds(5, 1, 0.8, 5), Rounds(3, 2, 0.8, 5)):
        mine, theirs = (iterative_inpaint(painter, request, rounds) for painter in (shared, own))
        assert torch.equal(mine.ball, theirs.ball)
        assert torch.equal(mine.balls, theirs.balls)
        assert mine.evaluations == theirs.evaluations
    inner = shared._painter
    # 3 + 3 + 1, then two more first balls and a last one from another median; the rest was there.
    assert sum(len(asked.seeds) for asked in inner.requests) == 7 + 2 + 1


def test_seconds_of_a_shared_ball_count_for_all_who_use_it() -> None:
    shared = SharedBalls(AnalyticPainter(LIGHT))
    canvas = torch.zeros(1, CANVAS, CANVAS, 3)
    request = PaintRequest(canvas, canvas, place_ball(CANVAS, DIAMETER), 0.0, (0, 1))
    shared.paint(request, SilentObserver())
    first = shared.seconds
    shared.paint(replace(request, seeds=(1, 0)), SilentObserver())
    assert first > 0
    assert shared.seconds == pytest.approx(2 * first)


@pytest.mark.parametrize("name", GRIDS)
def test_a_grid_holds_the_presets_and_the_papers_own_points_once(name: str) -> None:
    schedules = GRIDS[name]()
    names = [schedule.name for schedule in schedules]
    assert len(set(names)) == len(names)
    assert set(PRESETS) <= set(names)
    runs = [tuple(schedule.settings.values()) for schedule in schedules]
    assert len(set(runs)) == len(runs)
    papers = {(s.preset.rounds.balls, s.preset.rounds.rounds) for s in schedules if "paper" in (s.kind, s.name)}
    assert papers == {(balls, rounds) for balls in (5, 15, 30) for rounds in (1, 2)}


def report_of(capsys: pytest.CaptureFixture[str], *options: str) -> dict[str, Any]:
    assert main(["bench", "pareto", *options, "--json"]) == 0
    document: dict[str, Any] = json.loads(capsys.readouterr().out)
    return document


def test_the_report_keeps_its_contract(
    maps: Path, few: dict[str, Schedule], tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    out = tmp_path / "out"
    options = ("--panoramas", str(maps), "--painter", "noisy", "--out", str(out), "--seconds-per-step", "0.5")
    report = report_of(capsys, *options)
    assert report == json.loads((out / "report.json").read_text())
    rows = {row["schedule"]: row for row in report["rows"]}
    assert set(rows) == set(few)
    assert [row["nfe"] for row in report["rows"]] == sorted(row["nfe"] for row in report["rows"])
    for name, row in rows.items():
        rounds = few[name].preset.rounds
        assert row["nfe"] == 4 * _steps(rounds)
        assert row["seconds_there"] == pytest.approx(0.5 * 2 * _steps(rounds))
        assert row["seconds"] > 0
        assert row["angular_error_low"] <= row["angular_error_deg"] <= row["angular_error_high"]
        assert row["angular_error_deg"] == pytest.approx(
            np.mean([row[f"angular_error_deg_{sphere}"] for sphere in ("diffuse", "matte", "mirror")])
        )
        assert {"preset", "painter", "normalized_rmse", "si_rmse", "light_direction_error_deg", "on_front"} <= set(row)
        assert row["scenes"] == 2
    assert rows["dear"]["angular_error_deg"] < rows["cheap"]["angular_error_deg"]
    assert rows["cheap"]["on_front"]
    assert report["summary"] == [row for row in report["rows"] if row["on_front"]]


def _steps(rounds: Rounds) -> int:
    later = int(rounds.steps * rounds.strength)
    return rounds.balls * (rounds.steps + later * (rounds.rounds - 1)) + later * rounds.final


def test_a_killed_run_goes_on_and_loses_one_estimate_at_most(
    maps: Path, few: dict[str, Schedule], tmp_path: Path, capsys: pytest.CaptureFixture[str], monkeypatch: Any
) -> None:
    painted: list[int] = []
    monkeypatch.setitem(PAINTERS, "noisy", lambda files: studio(Flaws(noise=0.1), painted))
    options = ("--panoramas", str(maps), "--painter", "noisy", "--out", str(tmp_path / "out"))
    whole = report_of(capsys, *options)
    journal = tmp_path / "out" / "rows.jsonl"
    lines = journal.read_text().splitlines(keepends=True)
    assert len(lines) == 1 + 2 * 3
    journal.write_text("".join(lines[:-1]) + lines[-1][:40])
    painted.clear()
    again = report_of(capsys, *options)
    # The cut estimate alone.
    cut = few[json.loads(lines[-1])["schedule"]].preset
    assert sum(painted) == len(cut.evs) * (cut.rounds.balls * cut.rounds.rounds + cut.rounds.final)
    timeless = [{key: value for key, value in row.items() if key != "seconds"} for row in again["rows"]]
    assert timeless == [{key: value for key, value in row.items() if key != "seconds"} for row in whole["rows"]]


def test_two_workers_measure_what_one_does(
    maps: Path, few: dict[str, Schedule], tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    options = ("--panoramas", str(maps), "--painter", "perfect", "--only", "cheap,mid")
    one = report_of(capsys, *options)
    two = report_of(capsys, *options, "--workers", "2", "--out", str(tmp_path / "out"))
    for mine, theirs in zip(two["rows"], one["rows"], strict=True):
        # Threads, of which a worker has fewer, change the order of sums.
        assert mine.keys() == theirs.keys()
        for key in mine.keys() - {"seconds"}:
            numeric = isinstance(mine[key], float)
            assert mine[key] == (pytest.approx(theirs[key], rel=1e-9) if numeric else theirs[key])
    assert len((tmp_path / "out" / "rows.jsonl").read_text().splitlines()) == 1 + 2 * 2


def test_a_schedule_that_changed_does_not_stand_beside_its_old_figures(
    maps: Path, few: dict[str, Schedule], tmp_path: Path, capsys: pytest.CaptureFixture[str], monkeypatch: Any
) -> None:
    options = ["bench", "pareto", "--panoramas", str(maps), "--painter", "noisy", "--out", str(tmp_path / "out")]
    assert main(options) == 0
    changed = replace(few["mid"], preset=replace(few["mid"].preset, rounds=Rounds(4, 2, 0.8, 4)))
    monkeypatch.setitem(GRIDS, "small", lambda: [changed])
    before = (tmp_path / "out" / "rows.jsonl").read_text()
    assert main(options) == 2
    assert "a new folder: mid was" in capsys.readouterr().err
    assert (tmp_path / "out" / "rows.jsonl").read_text() == before
    assert main([*options, "--seed", "5"]) == 1


def test_a_painter_is_varied_where_it_can_be_and_left_out_where_not(
    maps: Path, few: dict[str, Schedule], capsys: pytest.CaptureFixture[str], monkeypatch: Any
) -> None:
    class Louder(AnalyticPainter):
        def varied(self, *, sampler: str | None, guidance: float | None) -> AnalyticPainter:
            return Louder(self.latlong_hdr, Flaws(noise=guidance or 0.0))

    guided = replace(few["mid"], name="guided", guidance=0.4)
    monkeypatch.setitem(GRIDS, "small", lambda: [few["mid"], guided])
    options = ("--panoramas", str(maps), "--painter", "noisy")
    assert [row["schedule"] for row in report_of(capsys, *options)["rows"]] == ["mid"]
    able = Studio(lambda variant, shot: Louder(shot.truth_hdr), CANVAS, DIAMETER)
    monkeypatch.setitem(PAINTERS, "noisy", lambda files: able)
    rows = {row["schedule"]: row for row in report_of(capsys, *options)["rows"]}
    assert rows["guided"]["guidance"] == 0.4
    assert rows["guided"]["angular_error_deg"] > 2 * rows["mid"]["angular_error_deg"]


def test_a_scene_sized_bracket_is_charted_at_what_it_spent(
    maps: Path, few: dict[str, Schedule], capsys: pytest.CaptureFixture[str], monkeypatch: Any
) -> None:
    dim = torch.full((64, 128, 3), 0.2)
    for name in ("one", "two"):
        write_exr(maps / f"{name}.exr", dim, metadata={})
    sized = replace(few["mid"], name="sized", bracket="scene")
    monkeypatch.setitem(GRIDS, "small", lambda: [few["mid"], sized])
    monkeypatch.setitem(PAINTERS, "noisy", lambda files: studio(Flaws()))
    rows = {row["schedule"]: row for row in report_of(capsys, "--panoramas", str(maps), "--painter", "noisy")["rows"]}
    assert rows["sized"]["nfe"] == rows["mid"]["nfe"] / 2


def test_one_panorama_has_no_interval_and_says_so(
    maps: Path, few: dict[str, Schedule], capsys: pytest.CaptureFixture[str]
) -> None:
    (maps / "two.exr").unlink()
    report = report_of(capsys, "--panoramas", str(maps), "--painter", "noisy", "--only", "cheap")
    assert "one panorama" in report["protocol"]["interval"]
    assert [row["schedule"] for row in report["rows"]] == ["cheap"]
    assert report["rows"][0]["angular_error_low"] is None


def test_a_black_scene_is_measured_without_a_direction(
    maps: Path, few: dict[str, Schedule], capsys: pytest.CaptureFixture[str]
) -> None:
    write_exr(maps / "black.exr", torch.zeros(64, 128, 3), metadata={})
    report = report_of(capsys, "--panoramas", str(maps), "--painter", "perfect", "--only", "cheap")
    (row,) = report["rows"]
    assert row["scenes"] == 3
    assert row["light_direction_error_deg"] < 3
    (maps / "one.exr").unlink()
    (maps / "two.exr").unlink()
    (row,) = report_of(capsys, "--panoramas", str(maps), "--painter", "perfect", "--only", "cheap")["rows"]
    assert row["light_direction_error_deg"] is None


@pytest.mark.parametrize(
    ("options", "named"),
    [
        (("--grid", "huge"), "--grid"),
        (("--only", "cheap,none"), "--only"),
        (("--seconds-per-step", "0"), "--seconds-per-step"),
        (("--painter", "oil"), "--painter"),
    ],
)
def test_bad_options_are_named(
    maps: Path, few: dict[str, Schedule], options: tuple[str, ...], named: str, capsys: pytest.CaptureFixture[str]
) -> None:
    assert main(["bench", "pareto", "--panoramas", str(maps), *options]) == 2
    assert named in capsys.readouterr().err


# --- files -------------------------------------------------------------------------------------------------------


def test_the_files_hold_the_rows(
    maps: Path, few: dict[str, Schedule], tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    out = tmp_path / "out"
    report = report_of(capsys, "--panoramas", str(maps), "--painter", "noisy", "--out", str(out))
    with (out / "rows.csv").open(newline="") as file:
        table = list(csv.DictReader(file))
    assert [float(row["nfe"]) for row in table] == [row["nfe"] for row in report["rows"]]
    page = (out / "chart.html").read_text()
    start = page.index("const data = ") + len("const data = ")
    held = json.loads(page[start : page.index(";\n", start)].replace("<\\/", "</"))
    assert held["rows"] == report["rows"]
    assert "http" not in page.replace("http://www.w3.org/2000/svg", "")
    assert (out / "chart.png").stat().st_size > 10_000
    svg = (out / "chart.svg").read_text()
    assert "denoiser evaluations" in svg or "<path" in svg
