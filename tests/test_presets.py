"""The table of presets: one place, read by everything that shows it."""

from __future__ import annotations

import json
from dataclasses import replace
from pathlib import Path
from typing import Any

import pytest

from dl_core.bench.pareto.shipped_chart import chart_of, shipped_rows
from dl_core.cli import main
from dl_core.errors import OptionError
from dl_core.iterative import Rounds
from dl_core.presets import PRESETS, presets_taking

README = Path(__file__).parents[1] / "README.md"


def markdown(name: str) -> str:
    row = PRESETS[name].row(name)
    error = "-" if row["error_deg"] is None else f"{row['error_deg']:.2f}"
    cells = (f"`{name}`", row["EVs"], row["balls"], row["rounds"], row["steps"], f"{row['until']:g}")
    cells += (f"{row['guided_steps']:,}", error)
    return f"| {' | '.join(map(str, cells))} | {row['summary']} |"


def test_the_readme_has_the_table() -> None:
    lines = README.read_text().splitlines()
    head = next(i for i, line in enumerate(lines) if line.startswith("| preset | EVs"))
    rows = lines[head + 2 : lines.index("", head)]
    assert rows == [markdown(name) for name in PRESETS]


def test_the_command_prints_the_table(capsys: pytest.CaptureFixture[str]) -> None:
    assert main(["presets", "--json"]) == 0
    rows: list[dict[str, Any]] = json.loads(capsys.readouterr().out)
    assert rows == [preset.row(name) for name, preset in PRESETS.items()]
    assert main(["presets"]) == 0
    text = capsys.readouterr().out
    assert all(name in text for name in PRESETS)
    assert "4,932" in text


def test_errors_and_costs_are_those_of_the_chart_that_comes_along() -> None:
    rows = {row["schedule"]: row for row in shipped_rows()}
    for name, preset in PRESETS.items():
        assert rows[name]["nfe"] == 2 * preset.guided_steps
        if preset.error_deg is not None:
            assert preset.error_deg == pytest.approx(rows[name]["angular_error_deg"], abs=0.005)


def test_presets_keep_their_promises() -> None:
    """Within the paper's intervals at a tenth of its cost, and at a sixth; at a hundredth 1.3 times as far off."""
    rows = {row["schedule"]: row for row in shipped_rows()}
    paper, balanced, best, draft = (rows[name] for name in ("paper", "balanced", "best", "draft"))
    assert balanced["nfe"] <= paper["nfe"] / 10
    assert draft["nfe"] <= paper["nfe"] / 100
    assert best["nfe"] <= paper["nfe"] / 6
    for key in ("angular_error_deg", "normalized_rmse", "si_rmse"):
        high = paper[f"{key.removesuffix('_deg')}_high"]
        assert best[key] <= high
        assert draft[key] <= 1.3 * paper[key]
        assert balanced[key] <= high


def test_a_measured_schedule_is_a_star_and_another_one_a_line() -> None:
    best = PRESETS["best"]
    picture, told = chart_of(best.rounds, best.evs)
    assert picture.ndim == 4
    assert picture.shape[-1] == 3
    assert 0 <= picture.min() < picture.max() <= 1
    assert "1,440 denoiser evaluations" in told
    assert f"{shipped_error('best'):.3g}" in told
    other, said = chart_of(Rounds(7, 1, 0.8, 11), best.evs)
    assert "were not measured" in said
    assert (picture != other).any()
    dear, advice = chart_of(PRESETS["turbo"].rounds, PRESETS["turbo"].evs)
    assert dear.shape == picture.shape
    assert "has" in advice
    assert "degrees for" in advice


def shipped_error(name: str) -> float:
    return next(float(row["angular_error_deg"]) for row in shipped_rows() if row["schedule"] == name)


def test_light_balls_are_for_presets_that_end_in_a_median() -> None:
    assert presets_taking(0) == PRESETS
    taking = presets_taking(5)
    assert "paper" not in taking
    for name, row in PRESETS.items():
        if name in taking:
            assert replace(row.rounds, light_balls=5).light_balls == 5
        else:
            with pytest.raises(OptionError, match="light_balls"):
                replace(row.rounds, light_balls=5)
