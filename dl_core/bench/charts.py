"""Charts of benches, as PNG and SVG, or as a picture to show."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any, Final

import numpy as np
from matplotlib.backends.backend_agg import FigureCanvasAgg
from matplotlib.figure import Figure

from ..imageio import atomic
from .front import on_front
from .report import Row

__all__ = ["Here", "bar_chart", "cost_chart", "cost_picture"]

_MARKS: Final = {"preset": ("o", 60.0), "paper": ("s", 36.0), "swept": (".", 24.0)}
"""Marker and size by kind of schedule."""
DPI: Final = 120


@dataclass(frozen=True)
class Here:
    """A schedule that is pointed at.

    Attributes:
        nfe: its denoiser evaluations.
        row: its figures, where it was measured.
    """

    nfe: float
    row: Row | None


def bar_chart(path: Path, bars: Sequence[tuple[str, Row]], key: str, title: str) -> list[Path]:
    """Draw the median of a figure as bars, with the worst case as a mark.

    Args:
        path: of the chart, without a suffix.
        bars: a label and a line of a summary for each, which holds `key_median` and `key_worst`.
        key: of the figure; values above 0, drawn on a logarithmic axis.
        title: of the axis.

    Returns:
        The files written.

    Raises:
        OutputError: a file cannot be written.
    """
    figure = Figure(figsize=(9, 1 + 0.25 * len(bars)), layout="constrained")
    axes = figure.subplots()
    places = range(len(bars))
    axes.barh(places, [line[f"{key}_median"] for _, line in bars], label="median")
    axes.plot([line[f"{key}_worst"] for _, line in bars], places, "kx", label="worst")
    axes.set_yticks(places, [label for label, _ in bars])
    axes.invert_yaxis()
    axes.set_xscale("log")
    axes.set_xlabel(title)
    axes.legend()
    return _save(figure, path)


def cost_chart(path: Path, rows: Sequence[Row], figures: Sequence[tuple[str, str]], title: str) -> list[Path]:
    """Draw errors against cost: a panel for each error, a point for each schedule, a line through the front.

    Args:
        path: of the chart, without a suffix.
        rows: with `schedule`, `kind`, `nfe` above 0, and for every figure its value and its interval's ends or None.
        figures: key and title of each panel's error.
        title: of the whole.

    Returns, Raises: as `bar_chart`.
    """
    return _save(_cost_figure(rows, figures, title, None), path)


def cost_picture(rows: Sequence[Row], figures: Sequence[tuple[str, str]], title: str, here: Here) -> np.ndarray:
    """The chart of `cost_chart` with a schedule pointed at, as 8-bit RGB, (height, width, 3)."""
    canvas = FigureCanvasAgg(_cost_figure(rows, figures, title, here))
    canvas.figure.set_dpi(DPI)
    canvas.draw()
    return np.asarray(canvas.buffer_rgba())[..., :3].copy()


def _cost_figure(rows: Sequence[Row], figures: Sequence[tuple[str, str]], title: str, here: Here | None) -> Figure:
    columns = min(2, len(figures))
    lines = -(-len(figures) // columns)
    figure = Figure(figsize=(6.5 * columns, 4.5 * lines), layout="constrained")
    figure.suptitle(title)
    panels = figure.subplots(lines, columns, squeeze=False).flat
    for axes, (key, label) in zip(panels, figures, strict=False):
        _draw_panel(axes, [row for row in rows if row[key] is not None], key, label)
        if here is not None:
            _point_at(axes, here, key)
        axes.legend(fontsize=7)
    return figure


def _draw_panel(axes: Any, rows: Sequence[Row], key: str, label: str) -> None:
    low, high = (f"{key.removesuffix('_deg')}_{end}" for end in ("low", "high"))
    for kind, (marker, size) in _MARKS.items():
        own = [row for row in rows if row["kind"] == kind]
        axes.scatter(
            [row["nfe"] for row in own], [row[key] for row in own], s=size, marker=marker, label=kind, zorder=3
        )
        for row in own if kind != "swept" else ():
            axes.annotate(row["schedule"], (row["nfe"], row[key]), (4, 4), textcoords="offset points", fontsize=7)
            if kind == "preset" and row[low] is not None:
                axes.vlines(row["nfe"], row[low], row[high], linewidth=1, alpha=0.4)
    marks = on_front([(row["nfe"], row[key]) for row in rows])
    front = sorted((row["nfe"], row[key]) for row, mark in zip(rows, marks, strict=True) if mark)
    if front:
        axes.plot(*zip(*front, strict=True), color="0.6", linewidth=1, zorder=1)
    axes.ticklabel_format(axis="y", useOffset=False)
    axes.set_xscale("log")
    axes.set_xlabel("denoiser evaluations (NFE)")
    axes.set_ylabel(label)


def _point_at(axes: Any, here: Here, key: str) -> None:
    """A star where the schedule was measured; else its cost alone is known, and a line shows that."""
    error = None if here.row is None else here.row[key]
    if error is None:
        axes.axvline(here.nfe, color="tab:red", linestyle="--", linewidth=1, label="these settings, not measured")
    else:
        axes.scatter([here.nfe], [error], s=200, marker="*", color="tab:red", zorder=4, label="these settings")


def _save(figure: Figure, path: Path) -> list[Path]:
    written = [path.with_suffix(suffix) for suffix in (".png", ".svg")]
    for file in written:
        with atomic(file) as temporary:
            figure.savefig(temporary, format=file.suffix[1:], dpi=DPI)
    return written
