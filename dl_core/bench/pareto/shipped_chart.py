"""The chart of speed against accuracy that comes with the package, and where a schedule stands on it.

It is the mini model's, over the maps in `data/hdri`:
`lightprobe bench pareto --panoramas dl_core/data/hdri --out DIR`, whose `report.json` is kept as `data/pareto.json`.
"""

from __future__ import annotations

import json
from functools import lru_cache
from pathlib import Path
from typing import Final

import torch

from ...iterative import Rounds
from ...presets import Preset
from ...shapes import Image
from ..charts import Here, cost_picture
from ..report import Row
from .files import FIGURES
from .schedules import Schedule

__all__ = ["CHART_FILE", "chart_of", "shipped_rows"]

CHART_FILE: Final = Path(__file__).resolve().parents[2] / "data" / "pareto.json"
GUIDED: Final = 2
"""Evaluations a guided step of the mini model; the chart counts these."""
TITLE: Final = "mini model, maps of data/hdri: error against cost"


@lru_cache(maxsize=1)
def shipped_rows() -> tuple[Row, ...]:
    """Rows of the chart, as `pareto.summarize` made them."""
    return tuple(json.loads(CHART_FILE.read_text(encoding="utf-8"))["rows"])


def chart_of(rounds: Rounds, evs: tuple[float, ...]) -> tuple[Image, str]:
    """The chart with a schedule pointed at, and a line that says where it stands.

    Args:
        rounds: of each exposure.
        evs: of the bracket.

    Returns:
        (1, height, width, 3) in [0, 1], and the line.
    """
    asked = Schedule("", "", Preset(rounds, evs, ""))
    row = next((row for row in shipped_rows() if all(row[key] == value for key, value in asked.settings.items())), None)
    nfe = GUIDED * asked.preset.guided_steps
    picture = cost_picture(shipped_rows(), FIGURES, TITLE, Here(nfe, row))
    return torch.from_numpy(picture).float().div(255)[None], _where(nfe, row)


def _where(nfe: int, row: Row | None) -> str:
    cost = f"{nfe:,} denoiser evaluations with guidance"
    if row is None:
        return f"{cost}; these settings were not measured. The dashed line shows what others reach at that cost."
    errors = "; ".join(f"{title} {row[key]:.3g}" for key, title in FIGURES if row[key] is not None)
    front = "No measured schedule is better for less." if row["on_front"] else _better(row)
    return f"{cost}; {errors} (mini model, {row['scenes']} scenes). {front}"


def _better(row: Row) -> str:
    better = [
        other
        for other in shipped_rows()
        if other["on_front"] and other["nfe"] <= row["nfe"] and other["angular_error_deg"] <= row["angular_error_deg"]
    ]
    best = min(better, key=lambda other: (other["angular_error_deg"], other["nfe"]))
    return f"{best['schedule']} has {best['angular_error_deg']:.3g} degrees for {best['nfe']:,.0f} evaluations."
