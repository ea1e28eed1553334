"""Charts of benches, as PNG and SVG. matplotlib is an extra (`pip install comfyui-lightprobe[bench]`)."""

from __future__ import annotations

import warnings
from collections.abc import Sequence
from pathlib import Path
from typing import Any, Final

from ..imageio import atomic
from .front import on_front
from .report import Row

__all__ = ["bar_chart", "cost_chart"]

_MARKS: Final = {"preset": ("o", 60.0), "paper": ("s", 36.0), "swept": (".", 24.0)}
"""Marker and size by kind of schedule."""


def bar_chart(path: Path, bars: Sequence[tuple[str, Row]], key: str, title: str) -> list[Path]:
    """Draw the median of a figure as bars, with the worst case as a mark.

    Args:
        path: of the chart, without a suffix.
        bars: a label and a line of a summary for each, which holds `key_median` and `key_worst`.
        key: of the figure; values above 0, drawn on a logarithmic axis.
        title: of the axis.

    Returns:
        The files written; none, and a `UserWarning`, without matplotlib.

    Raises:
        OutputError: a file cannot be written.
    """
    figure = _figure(figsize=(9, 1 + 0.25 * len(bars)), layout="constrained")
    if figure is None:
        return []
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
    columns = min(2, len(figures))
    lines = -(-len(figures) // columns)
    figure = _figure(figsize=(6.5 * columns, 4.5 * lines), layout="constrained")
    if figure is None:
        return []
    figure.suptitle(title)
    panels = figure.subplots(lines, columns, squeeze=False).flat
    for axes, (key, label) in zip(panels, figures, strict=False):
        _draw_panel(axes, [row for row in rows if row[key] is not None], key, label)
    return _save(figure, path)


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
    axes.legend(fontsize=7)


def _figure(**options: Any) -> Any:
    """A figure; None, and a warning, without matplotlib."""
    try:
        from matplotlib.figure import Figure
    except ImportError:
        warnings.warn("matplotlib is not installed (extra: bench), so no chart is drawn", stacklevel=3)
        return None
    return Figure(**options)


def _save(figure: Any, path: Path) -> list[Path]:
    written = [path.with_suffix(suffix) for suffix in (".png", ".svg")]
    for file in written:
        with atomic(file) as temporary:
            figure.savefig(temporary, format=file.suffix[1:], dpi=120)
    return written
