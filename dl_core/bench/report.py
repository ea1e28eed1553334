"""What every bench shares: where panoramas come from, where results go, and how they are written.

The contract: `--panoramas DIR` holds latlong maps; `--out DIR` receives `report.json`; `--json` prints the same
document instead of tables. Its `rows` hold one flat record for each panorama and variant, its `summary` one flat
record for each variant, with units in the key where there is one.
"""

from __future__ import annotations

import argparse
import json
import platform
import subprocess
import sys
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass, field
from pathlib import Path
from statistics import median
from typing import Any, Final

import torch

from .. import __version__
from ..errors import OptionError, OutputError
from ..imageio import atomic, require_writable

__all__ = [
    "SUFFIXES",
    "Column",
    "Report",
    "Row",
    "add_output",
    "add_panoramas",
    "document",
    "environment",
    "median_and_worst",
    "panorama_files",
    "prepare_output",
    "publish",
    "summarize_groups",
    "table",
]

Row = dict[str, Any]
"""A flat record: names to numbers, strings and None."""

SUFFIXES: Final = (".exr", ".hdr")


@dataclass(frozen=True)
class Report:
    """What a bench measured.

    Attributes:
        bench: its name.
        protocol: what was measured how.
        rows: one flat record for each panorama and variant.
        summary: one flat record for each variant; see `median_and_worst`.
        seconds: of wall time.
        seeds: of whatever was random.
        evaluations: of a denoiser.
        headline: figures that the document has on its top level too, for a bench that measures one thing.
    """

    bench: str
    protocol: Row
    rows: list[Row]
    summary: list[Row]
    seconds: float
    seeds: tuple[int, ...] = ()
    evaluations: int = 0
    headline: Row = field(default_factory=dict)


@dataclass(frozen=True)
class Column:
    """A column of a printed table.

    Attributes:
        title: its heading.
        key: of the record; where only `key_median` and `key_worst` are there, both are shown as "a / b".
        form: format of a number.
    """

    title: str
    key: str
    form: str = ""


# --- options -----------------------------------------------------------------------------------------------------


def add_panoramas(parser: argparse.ArgumentParser) -> None:
    """Declare `--panoramas` (read it with `panorama_files`)."""
    parser.add_argument("--panoramas", type=Path, required=True, metavar="DIR", help="folder of EXR or HDR maps")


def add_output(parser: argparse.ArgumentParser) -> None:
    """Declare `--out` and `--json`, as `prepare_output` and `publish` read them."""
    parser.add_argument("--out", type=Path, metavar="DIR", help="folder to write report.json to; made if missing")
    parser.add_argument("--json", action="store_true", help="print the report as JSON instead of tables")


def panorama_files(folder: Path, split: str | None = None) -> list[Path]:
    """The maps in a folder, by name.

    Args:
        folder: holds them.
        split: of the folder's manifest.json, to whose maps to keep; all maps of the folder when not given.

    Raises:
        OptionError: no such folder, or no map in it; no manifest, or no such split.
    """
    if split is not None:
        from ..training.panoramas import panorama_files as files_of_split

        return sorted(files_of_split(folder, split))
    there = folder.iterdir() if folder.is_dir() else ()
    files = sorted(path for path in there if path.suffix.lower() in SUFFIXES)
    if not files:
        raise OptionError("--panoramas", str(folder), "a folder with .exr or .hdr environment maps")
    return files


def prepare_output(args: argparse.Namespace) -> None:
    """Make the folder of `--out`, if one is asked for, before long work is done for it.

    Raises:
        OutputError: it cannot be made or written to.
    """
    if args.out is None:
        return
    try:
        args.out.mkdir(parents=True, exist_ok=True)
    except OSError as error:
        raise OutputError(args.out, f"cannot be made ({error.strerror})") from error
    require_writable(args.out / "report.json")


# --- results -----------------------------------------------------------------------------------------------------


def median_and_worst(rows: Sequence[Row], key: str, *, ideal: float = 0.0) -> Row:
    """Median of a figure over rows, and the one furthest from its ideal, as `key_median` and `key_worst`.

    Args:
        rows: at least one.
        key: of the figure.
        ideal: what it is without any error: 0 for a distance, 1 for a share of energy.
    """
    values = [row[key] for row in rows]
    return {f"{key}_median": median(values), f"{key}_worst": max(values, key=lambda value: abs(value - ideal))}


def summarize_groups(rows: Sequence[Row], names: Sequence[str], ideals: Mapping[str, float]) -> list[Row]:
    """A record for each combination of labels, in the order of the rows: how many panoramas, and their figures.

    Args:
        rows: of panoramas and variants.
        names: keys of the labels that tell variants apart.
        ideals: keys of figures, and what each is without any error. A figure that no row of a variant knows is None.
    """
    summary = []
    for labels in dict.fromkeys(tuple(row[name] for name in names) for row in rows):
        of_case = [row for row in rows if tuple(row[name] for name in names) == labels]
        line: Row = {**dict(zip(names, labels, strict=True)), "panoramas": len(of_case)}
        for key, ideal in ideals.items():
            known = [row for row in of_case if row[key] is not None]
            line |= median_and_worst(known, key, ideal=ideal) if known else {key: None}
        summary.append(line)
    return summary


def document(report: Report, args: argparse.Namespace) -> Row:
    """A report as it is written: what was measured how and on what, rows and summary.

    Options are kept, except files and folders: where they lie is nobody else's affair.
    """
    hidden = {"bench", "command", "json", "out", "panoramas"}
    kept = (bool, int, float, str, list, tuple)
    options = {key: value for key, value in vars(args).items() if key not in hidden and isinstance(value, kept)}
    return {
        **report.headline,
        "bench": report.bench,
        "protocol": report.protocol,
        "options": options,
        "environment": environment(),
        "seeds": list(report.seeds),
        "evaluations": report.evaluations,
        "seconds": report.seconds,
        "summary": report.summary,
        "rows": report.rows,
    }


def publish(
    report: Report, args: argparse.Namespace, *, rows: Sequence[Column] = (), summary: Sequence[Column] = ()
) -> None:
    """Write `report.json` to the folder of `--out`, and print the report: as JSON with `--json`, else as tables.

    Args:
        report: what was measured.
        args: parsed options, those of `add_output` among them.
        rows: columns of the table of rows; none for no such table.
        summary: columns of the table of the summary; none for no such table.

    Raises:
        OutputError: the file cannot be written.
    """
    text = json.dumps(document(report, args), indent=1, allow_nan=False) + "\n"
    if args.out is not None:
        with atomic(args.out / "report.json") as temporary:
            temporary.write_text(text, encoding="utf-8")
    sys.stdout.write(text if args.json else _tables(report, rows, summary))


def _tables(report: Report, rows: Sequence[Column], summary: Sequence[Column]) -> str:
    parts = [table(report.rows, rows)] if rows else []
    if summary:
        pairs = any(f"{column.key}_median" in record for record in report.summary for column in summary)
        parts.append(("summary, median / worst\n" if pairs else "summary\n") + table(report.summary, summary))
    spent = f"{report.evaluations} denoiser evaluations" if report.evaluations else "no denoiser evaluations"
    parts.append(f"{report.bench}: {len(report.rows)} rows, {report.seconds:.1f} s, {spent}")
    return "\n\n".join(parts) + "\n"


def table(records: Iterable[Row], columns: Sequence[Column]) -> str:
    """Records as aligned text: a heading, then a line for each record. Median and worst stand as "a / b"."""
    lines = [[column.title for column in columns]]
    lines += [[_cell(record, column) for column in columns] for record in records]
    widths = [max(len(line[i]) for line in lines) for i in range(len(columns))]
    return "\n".join("  ".join(cell.ljust(width) for cell, width in zip(line, widths, strict=True)) for line in lines)


def _cell(record: Row, column: Column) -> str:
    if column.key in record:
        return "-" if record[column.key] is None else format(record[column.key], column.form)
    return " / ".join(format(record[f"{column.key}_{part}"], column.form) for part in ("median", "worst"))


def environment() -> Row:
    """What a figure depends on beside the code's input: versions, machine, commit."""
    return {
        "lightprobe": __version__,
        "python": platform.python_version(),
        "torch": torch.__version__,
        "machine": platform.machine(),
        "system": platform.system(),
        "threads": torch.get_num_threads(),
        "commit": _commit(),
    }


def _commit() -> str | None:
    """Commit of the checkout this package runs from, with "+" if files in it differ; None when installed."""
    root = Path(__file__).parents[2]
    if not (root / ".git").exists():
        return None

    def git(*arguments: str) -> str:
        command = ["git", "-C", str(root), *arguments]
        return subprocess.run(command, capture_output=True, text=True, check=True).stdout.strip()

    try:
        return git("rev-parse", "HEAD") + ("+" if git("status", "--porcelain", "--untracked-files=no") else "")
    except (OSError, subprocess.CalledProcessError):
        return None
