"""The table of presets: one place, read by everything that shows it."""

from __future__ import annotations

import json
from pathlib import Path
from typing import Any

import pytest

from dl_core.cli import main
from dl_core.presets import PRESETS

README = Path(__file__).parents[1] / "README.md"


def markdown(name: str) -> str:
    row = PRESETS[name].row(name)
    error = "-" if row["error_deg"] is None else f"{row['error_deg']:.2f}"
    cells = (f"`{name}`", row["EVs"], row["balls"], row["rounds"], row["steps"], f"{row['guided_steps']:,}", error)
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
