"""`lightprobe bench NAME`: the benches as a table, their output as a table of text and as JSON."""

from __future__ import annotations

import argparse
import json
import platform
import subprocess
import sys
import time
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any, Final

import torch

from .. import __version__
from ..errors import OptionError
from ..imageio import atomic
from ..presets import PAPER_EVS
from . import geometry, merge

__all__ = ["BENCHES", "Bench", "Column", "add_arguments", "environment", "panorama_files", "report", "run", "table"]

SUFFIXES: Final = (".exr", ".hdr")


@dataclass(frozen=True)
class Column:
    """A column of a printed table.

    Attributes:
        title: its heading.
        key: of the record.
        form: format of a number; of median and worst, where a record holds both.
    """

    title: str
    key: str
    form: str = ""


@dataclass(frozen=True)
class Bench:
    """A measurement over a folder of panoramas.

    Attributes:
        summary: one line for people.
        protocol: what was measured how, as it goes into the JSON.
        measure: (files, parsed options) -> records.
        summarize: records -> a record for each line of the table.
        columns: of the table of summaries.
        details: of the table of records.
        add_arguments: declares options of this bench alone.
    """

    summary: str
    protocol: dict[str, Any]
    measure: Callable[[list[Path], argparse.Namespace], list[dict[str, Any]]]
    summarize: Callable[[list[dict[str, Any]]], list[dict[str, Any]]]
    columns: tuple[Column, ...]
    details: tuple[Column, ...]
    add_arguments: Callable[[argparse.ArgumentParser], None] = lambda parser: None


def _merge_arguments(parser: argparse.ArgumentParser) -> None:
    parser.add_argument(
        "--exposure",
        choices=tuple(merge.EXPOSURES),
        default="map",
        help="what EV 0 is set on: the whole map, or the paper's 60 degree crop straight ahead (default: map)",
    )


def _geometry_arguments(parser: argparse.ArgumentParser) -> None:
    parser.add_argument(
        "--balls", nargs="+", type=int, default=[256, 1024], metavar="PX", help="diameters (default: 256 1024)"
    )


BENCHES: Final[dict[str, Bench]] = {
    "merge": Bench(
        summary="what unwrap and merge lose behind a perfect painter",
        protocol={
            "ball": merge.BALL,
            "normals": merge.NORMALS,
            "evs": PAPER_EVS,
            "long_evs": merge.LONG_EVS,
            "bits": 8,
            "gamma": 2.4,
            "exposure": "99th percentile of all channel values to 0.9 on display",
            "si_rmse": "one scale for all normals and channels, mean over both, relative to the mean irradiance",
            "angular_error": "mean over normals of the angle between RGB irradiances, degrees",
        },
        measure=lambda files, args: merge.bench_merge(files, args.exposure),
        summarize=merge.summarize,
        columns=(
            Column("way to the map", "label"),
            Column("energy kept", "energy_kept", ".3f"),
            Column("irradiance si-RMSE", "si_rmse", ".4f"),
            Column("irradiance angle (deg)", "angular_error", ".2f"),
        ),
        details=(
            Column("panorama", "panorama"),
            Column("row", "row"),
            Column("energy kept", "energy_kept", ".3f"),
            Column("irradiance si-RMSE", "si_rmse", ".4f"),
            Column("irradiance angle (deg)", "angular_error", ".2f"),
        ),
        add_arguments=_merge_arguments,
    ),
    "geometry": Bench(
        summary="what latlong -> ball -> latlong loses",
        protocol={
            "normals": 400,
            "si_rmse": "of irradiance; one scale for all normals and channels, relative to the mean",
            "display_rmse": "of the map, gamma 2.4, clipped at EV 0",
        },
        measure=lambda files, args: geometry.bench_geometry(files, args.balls),
        summarize=geometry.summarize,
        columns=(
            Column("ball (px)", "ball", "d"),
            Column("energy of the ball", "ball_energy", ".4f"),
            Column("energy of the map", "map_energy", ".4f"),
            Column("irradiance si-RMSE", "si_rmse", ".4f"),
            Column("display RMSE", "display_rmse", ".4f"),
        ),
        details=(
            Column("panorama", "panorama"),
            Column("ball (px)", "ball", "d"),
            Column("energy of the ball", "ball_energy", ".4f"),
            Column("energy of the map", "map_energy", ".4f"),
            Column("irradiance si-RMSE", "si_rmse", ".4f"),
            Column("display RMSE", "display_rmse", ".4f"),
        ),
        add_arguments=_geometry_arguments,
    ),
}
"""The benches by name; a new one is a new row."""


def add_arguments(parser: argparse.ArgumentParser) -> None:
    """Declare the benches and their options."""
    names = parser.add_subparsers(dest="bench", required=True, metavar="BENCH")
    for name, bench in BENCHES.items():
        own = names.add_parser(name, help=bench.summary, description=bench.summary)
        own.add_argument("--panoramas", type=Path, required=True, metavar="DIR", help="folder of EXR or HDR maps")
        own.add_argument(
            "--json",
            nargs="?",
            const="-",
            metavar="FILE",
            help="write the result as JSON to FILE; without FILE print it instead of the tables",
        )
        bench.add_arguments(own)


def run(args: argparse.Namespace) -> int:
    """Run a bench: print its tables and write its JSON."""
    bench = BENCHES[args.bench]
    started = time.perf_counter()
    records = bench.measure(panorama_files(args.panoramas), args)
    result = report(args.bench, records, args, time.perf_counter() - started)
    if args.json == "-":
        sys.stdout.write(json.dumps(result, indent=1) + "\n")
        return 0
    if args.json is not None:
        with atomic(args.json) as temporary:
            temporary.write_text(json.dumps(result, indent=1) + "\n", encoding="utf-8")
    sys.stdout.write(table(records, bench.details) + "\n\nmedian / worst\n" + table(result["summary"], bench.columns))
    sys.stdout.write(f"\n\n{bench.summary}: {len({record['panorama'] for record in records})} panoramas, ")
    sys.stdout.write(f"{result['seconds']:.0f} s, no denoiser evaluations\n")
    return 0


def panorama_files(folder: Path) -> list[Path]:
    """The maps in a folder, by name.

    Raises:
        OptionError: no such folder, or no map in it.
    """
    files = sorted(path for path in folder.iterdir() if path.suffix in SUFFIXES) if folder.is_dir() else []
    if not files:
        raise OptionError("--panoramas", str(folder), "a folder with .exr or .hdr environment maps")
    return files


def report(name: str, records: list[dict[str, Any]], args: argparse.Namespace, seconds: float) -> dict[str, Any]:
    """A bench's result as it is written: protocol, environment, cost, summary and every record."""
    bench = BENCHES[name]
    known = {"bench", "json", "panoramas", "command"}
    options = {
        key: value for key, value in vars(args).items() if key not in known and isinstance(value, str | int | list)
    }
    return {
        "bench": name,
        "protocol": bench.protocol,
        "options": options,
        "environment": environment(),
        # Nothing here is random, and nothing is painted.
        "seeds": [],
        "evaluations": 0,
        "seconds": seconds,
        "summary": bench.summarize(records),
        "records": records,
    }


def environment() -> dict[str, Any]:
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


def table(records: Sequence[dict[str, Any]], columns: Sequence[Column]) -> str:
    """Records as aligned text: a heading, then a line for each record. Median and worst stand as "a / b"."""
    lines = [[column.title for column in columns]]
    lines += [[_cell(record[column.key], column.form) for column in columns] for record in records]
    widths = [max(len(line[i]) for line in lines) for i in range(len(columns))]
    return "\n".join("  ".join(cell.ljust(width) for cell, width in zip(line, widths, strict=True)) for line in lines)


def _cell(value: object, form: str) -> str:
    if isinstance(value, dict):
        return " / ".join(format(value[key], form) for key in ("median", "worst"))
    return format(value, form)
