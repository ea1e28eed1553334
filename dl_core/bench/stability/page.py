"""The report of stability as a page: a table for each family, with bars and pictures.

The page is opened from the disk and asks no server; its pictures lie beside it.
"""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from html import escape
from pathlib import Path
from typing import Final

from ...imageio import atomic
from ..report import Row
from .measure import picture_of

__all__ = ["write_page"]

LIMIT: Final = 2.0
"""Ratio from which a change does more than chance can be blamed for."""
WIDEST: Final = 4.0
"""Ratio at which a bar ends."""

_STYLE: Final = """
body { font: 15px/1.5 system-ui, sans-serif; margin: 2rem auto; max-width: 70rem; padding: 0 1rem;
  color: #1b1b1b; background: #fafafa }
table { border-collapse: collapse; width: 100% }
th, td { text-align: right; padding: .25rem .6rem; border-bottom: 1px solid #ddd; font-variant-numeric: tabular-nums }
th:first-child, td:first-child { text-align: left }
td.bar { width: 30%; text-align: left }
.bar div { height: .8rem; background: #4a7fb5 }
.bar div.over { background: #c4622d }
details { margin: .5rem 0 } summary { cursor: pointer }
figure { margin: .5rem 0 } img { max-width: 100%; display: block } figcaption { color: #666 }
@media (prefers-color-scheme: dark) {
  body { color: #ddd; background: #1c1c1c } th, td { border-color: #444 } figcaption { color: #999 } }
"""
_COLUMNS: Final = (
    ("distance", "distance", ".3g"),
    ("of seeds", "seed_distance", ".3f"),
    ("ratio", "ratio", ".2f"),
    ("error", "error", ".2f"),
    ("expected", "expected_error", ".2f"),
    ("ball", "ball_score", ".2f"),
)


def write_page(folder: Path, summary: Sequence[Row], rows: Sequence[Row], protocol: Row, pictures: Path) -> Path:
    """Write `stability.html`.

    Args:
        folder: that can be written to.
        summary: of `command.summarize`.
        rows: of panoramas, whose pictures are shown.
        protocol: what was measured how.
        pictures: folder of the strips, inside `folder`.

    Raises:
        OutputError: the page cannot be written.
    """
    path = folder / "stability.html"
    with atomic(path) as temporary:
        temporary.write_text("\n".join(_page(folder, summary, rows, protocol, pictures)), encoding="utf-8")
    return path


def _page(folder: Path, summary: Sequence[Row], rows: Sequence[Row], protocol: Row, pictures: Path) -> Iterator[str]:
    yield '<!doctype html><html lang="en"><head><meta charset="utf-8"><title>Stability</title>'
    yield f"<style>{_STYLE}</style></head><body><h1>Stability</h1>"
    told = "; ".join(f"{key.replace('_', ' ')}: {value}" for key, value in protocol.items())
    yield f"<p>{escape(told)}.</p>"
    yield f"<p>Bars show the ratio of both distances and end at {WIDEST:g}; above {LIMIT:g} they change colour."
    yield "Error is the distance to the true light, expected what the estimate says of itself,"
    yield "ball the score of its ball.</p>"
    for family in dict.fromkeys(line["family"] for line in summary):
        yield f"<h2>{escape(family)}</h2>"
        yield from _table([line for line in summary if line["family"] == family])
        yield from _pictures(folder, [row for row in rows if row["family"] == family], pictures)
    yield "</body></html>"


def _table(lines: Sequence[Row]) -> Iterator[str]:
    titles = "".join(f"<th>{escape(title)}</th>" for title, _, _ in _COLUMNS)
    yield f"<table><tr><th>variant</th>{titles}<th></th></tr>"
    for line in lines:
        cells = "".join(f"<td>{_number(line[key], form)}</td>" for _, key, form in _COLUMNS)
        yield f'<tr><td>{escape(line["variant"])}</td>{cells}<td class="bar">{_bar(line["ratio"])}</td></tr>'
    yield "</table>"
    if lines[0]["unit"] != "stops":
        yield f"<p>Distances here: {escape(lines[0]['unit'])}.</p>"


def _number(value: float | None, form: str) -> str:
    return "" if value is None else format(value, form)


def _bar(ratio: float | None) -> str:
    if ratio is None:
        return ""
    kind = ' class="over"' if ratio > LIMIT else ""
    return f'<div{kind} style="width: {100 * min(ratio, WIDEST) / WIDEST:.1f}%"></div>'


def _pictures(folder: Path, rows: Sequence[Row], pictures: Path) -> Iterator[str]:
    shown = [row for row in rows if row["panorama"] is not None and (pictures / picture_of(row)).is_file()]
    for name in dict.fromkeys(row["panorama"] for row in shown):
        yield f"<details><summary>pictures, {escape(name)}: photograph, ball, map, true map</summary>"
        for row in shown:
            if row["panorama"] == name:
                place = (pictures / picture_of(row)).relative_to(folder).as_posix()
                caption = f"{row['variant']}: {row['distance']:.2f} stops"
                yield f'<figure><img loading="lazy" src="{escape(place)}" alt="{escape(caption)}">'
                yield f"<figcaption>{escape(caption)}</figcaption></figure>"
        yield "</details>"
