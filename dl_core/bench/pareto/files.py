"""Files of the chart of speed against accuracy: pictures, a table, and a page to explore it in.

The page holds everything it needs; it is opened from the disk and asks no server.
"""

from __future__ import annotations

import csv
import json
from collections.abc import Sequence
from pathlib import Path
from typing import Final

from ...imageio import atomic
from ..charts import cost_chart
from ..report import Row

__all__ = ["FIGURES", "write_files"]

FIGURES: Final = (
    ("angular_error_deg", "angular error (degrees)"),
    ("normalized_rmse", "normalized RMSE"),
    ("si_rmse", "scale-invariant RMSE"),
    ("light_direction_error_deg", "direction of the strongest light (degrees)"),
)
"""Errors that are charted, with their titles."""

_PAGE: Final = Path(__file__).resolve().parents[2] / "data" / "pareto.html"
_PLACE: Final = "/*DATA*/null"
"""In the page, where the figures go."""


def write_files(folder: Path, rows: Sequence[Row], title: str) -> list[Path]:
    """Write `chart.png`, `chart.svg`, `rows.csv` and `chart.html`.

    Args:
        folder: that can be written to.
        rows: of `pareto.summarize`.
        title: what the figures are of.

    Returns:
        The files.

    Raises:
        OutputError: a file cannot be written.
    """
    written = cost_chart(folder / "chart", rows, FIGURES, title)
    table, page = folder / "rows.csv", folder / "chart.html"
    with atomic(table) as temporary, temporary.open("w", newline="", encoding="utf-8") as file:
        writer = csv.DictWriter(file, fieldnames=list(rows[0]) if rows else [])
        writer.writeheader()
        writer.writerows(rows)
    with atomic(page) as temporary:
        temporary.write_text(_page(rows, title), encoding="utf-8")
    return [*written, table, page]


def _page(rows: Sequence[Row], title: str) -> str:
    template = _PAGE.read_text(encoding="utf-8")
    data = json.dumps({"title": title, "figures": FIGURES, "rows": rows}, allow_nan=False)
    # "</" would end the script it stands in.
    return template.replace(_PLACE, data.replace("</", "<\\/"))
