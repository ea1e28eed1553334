"""Charts of benches, as PNG and SVG. matplotlib is an extra (`pip install comfyui-lightprobe[bench]`)."""

from __future__ import annotations

import warnings
from collections.abc import Sequence
from pathlib import Path

from ..imageio import atomic
from .report import Row

__all__ = ["bar_chart"]


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
    try:
        from matplotlib.figure import Figure
    except ImportError:
        warnings.warn("matplotlib is not installed (extra: bench), so no chart is drawn", stacklevel=2)
        return []
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
    written = [path.with_suffix(suffix) for suffix in (".png", ".svg")]
    for file in written:
        with atomic(file) as temporary:
            figure.savefig(temporary, format=file.suffix[1:], dpi=120)
    return written
