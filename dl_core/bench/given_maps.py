"""`lightprobe bench protocol NAME --maps DIR --truth DIR`: score given environment maps.

A map is paired with the true one of the same name. A run with `--out` appends its rows to `rows.jsonl` image by image.
The same command goes on where a run was stopped; one with other options, or on other folders, is refused and leaves
the rows as they are.
"""

from __future__ import annotations

import argparse
import hashlib
import json
import os
import time
from collections import Counter
from collections.abc import Iterator
from pathlib import Path
from typing import Final

from ..errors import ImageError, OptionError, OutputError
from ..imageio import read_envmap
from .pairs import ERROR_COLUMNS, protocol
from .report import Column, Report, Row, panorama_files, prepare_output, publish
from .scoring import PROTOCOLS, score_maps, summarize_errors

__all__ = ["add_arguments", "pair_maps", "run"]


def add_arguments(parser: argparse.ArgumentParser) -> None:
    """Declare the options of a run on given maps."""
    add = parser.add_argument_group("to score given maps").add_argument
    add("--maps", type=Path, metavar="DIR", help="folder of predicted maps, EXR or HDR")
    add("--truth", type=Path, metavar="DIR", help="folder of true maps of the same names")


# --- files -------------------------------------------------------------------------------------------------------


def pair_maps(maps: Path, truth: Path) -> list[tuple[Path, Path]]:
    """Files of two folders that have one name, whatever their suffixes.

    Raises:
        OptionError: a folder without maps, or with two of one name.
        ImageError: a map without its partner.
    """
    predicted, true = _by_name("--maps", maps), _by_name("--truth", truth)
    for option, missing in (("--truth", predicted.keys() - true.keys()), ("--maps", true.keys() - predicted.keys())):
        if missing:
            first = ", ".join(sorted(missing)[:5]) + (", ..." if len(missing) > 5 else "")
            raise ImageError(option, f"has no partner for {len(missing)} maps of the other folder: {first}")
    return [(predicted[name], true[name]) for name in sorted(predicted)]


def _by_name(option: str, folder: Path) -> dict[str, Path]:
    try:
        files = panorama_files(folder)
    except OptionError as error:
        raise OptionError(option, error.value, error.accepted) from error
    found = {path.stem: path for path in files}
    if len(found) < len(files):
        twice = next(path.name for path in files if found[path.stem] != path)
        raise OptionError(option, str(folder), f"one map of a name; {twice} is there in another format too")
    return found


class _Journal:
    """`rows.jsonl`: a line that says what the run is, then a line for each row; a stopped run goes on from it."""

    def __init__(self, folder: Path | None, identity: Row, each: int) -> None:
        self.path = None if folder is None else folder / "rows.jsonl"
        self.rows: list[Row] = []
        if self.path is not None:
            self.rows = _whole(_resume(self.path, identity), each)
            lines = [identity, *self.rows]
            # Lines of an image that was being written when the run was stopped go.
            self.path.write_text("".join(json.dumps(line) + "\n" for line in lines), encoding="utf-8")

    def add(self, rows: list[Row]) -> None:
        """Keep the rows of an image; they are on the disk when this returns."""
        self.rows += rows
        if self.path is None:
            return
        with self.path.open("a", encoding="utf-8") as file:
            file.write("".join(json.dumps(row) + "\n" for row in rows))
            file.flush()
            os.fsync(file.fileno())


def _resume(path: Path, identity: Row) -> list[Row]:
    """Rows of an earlier run of the same command; none if there was none."""
    lines = list(_json_lines(path)) if path.exists() else []
    if lines and lines[0] != identity:
        begun = ", ".join(f"{key} {lines[0].get(key)!r}" for key in identity if lines[0].get(key) != identity[key])
        raise OutputError(path, f"was begun with other options ({begun}); give another --out or remove it")
    return lines[1:]


def _json_lines(path: Path) -> Iterator[Row]:
    """The lines of a file up to the first that is cut short."""
    for line in path.read_text(encoding="utf-8", errors="replace").splitlines():
        try:
            yield dict(json.loads(line))
        except (ValueError, TypeError):
            return


def _whole(rows: list[Row], each: int) -> list[Row]:
    """Rows of the images that have all of theirs."""
    counts = Counter(row["panorama"] for row in rows)
    return [row for row in rows if counts[row["panorama"]] == each]


def run(args: argparse.Namespace) -> int:
    """Score every pair of maps, or those that an earlier run left."""
    pairs = pair_maps(args.maps, args.truth)
    prepare_output(args)
    started = time.perf_counter()
    journal = _Journal(args.out, _identity(args), len(PROTOCOLS[args.protocol].parts))
    done = {row["panorama"] for row in journal.rows}
    for predicted, truth in pairs:
        if predicted.stem not in done:
            rows = score_maps(read_envmap(predicted), read_envmap(truth), args.protocol, args.convention)
            journal.add([{"panorama": predicted.stem, **row} for row in rows])
    summary = _summarize(journal.rows, PROTOCOLS[args.protocol].parts)
    report = Report("protocol", _description(args), journal.rows, summary, time.perf_counter() - started)
    publish(report, args, rows=_ROWS, summary=_SUMMARY)
    return 0


def _identity(args: argparse.Namespace) -> Row:
    """What has to be the same for a run to be gone on with; folders only as a fingerprint."""
    folders = f"{args.maps.resolve()}\n{args.truth.resolve()}"
    fingerprint = hashlib.sha256(folders.encode()).hexdigest()[:16]
    parts = list(PROTOCOLS[args.protocol].parts)
    return {"protocol": args.protocol, "convention": args.convention, "spheres": parts, "folders": fingerprint}


def _description(args: argparse.Namespace) -> Row:
    return {"name": args.protocol, **protocol(args.convention), **PROTOCOLS[args.protocol].conditions}


def _summarize(rows: list[Row], parts: tuple[str, ...]) -> list[Row]:
    """Errors over the maps, a record for each sphere."""
    summary = []
    for sphere in parts:
        of_sphere = [row for row in rows if row["sphere"] == sphere]
        summary.append({"sphere": sphere, "panoramas": len(of_sphere), **summarize_errors(of_sphere)})
    return summary


_ROWS: Final = (Column("panorama", "panorama"), Column("sphere", "sphere"), *ERROR_COLUMNS)
_SUMMARY: Final = (
    Column("sphere", "sphere"),
    Column("maps", "panoramas"),
    *(Column(f"mean {column.title}", column.key, column.form) for column in ERROR_COLUMNS),
)
