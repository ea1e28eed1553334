"""`lightprobe bench protocol NAME --maps DIR --truth DIR`: score given environment maps.

A map is paired with the true one of the same name. A run with `--out` appends its rows to `rows.jsonl` image by image.
The same command goes on where a run was stopped; one with other options, or on other folders, is refused and leaves
the rows as they are.
"""

from __future__ import annotations

import argparse
import time
from pathlib import Path
from typing import Final

from ...errors import ImageError, OptionError
from ...imageio import read_envmap
from ..journal import Journal, fingerprint
from ..pairs import ERROR_COLUMNS, protocol
from ..report import Column, Report, Row, median_and_worst, panorama_files, prepare_output, publish
from ..scoring import PROTOCOLS, score_maps, summarize_errors, summary_columns

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


def run(args: argparse.Namespace) -> int:
    """Score every pair of maps, or those that an earlier run left."""
    pairs = pair_maps(args.maps, args.truth)
    prepare_output(args)
    started = time.perf_counter()
    journal = Journal(args.out, _identity(args), len(PROTOCOLS[args.protocol].parts))
    for predicted, truth in pairs:
        if not journal.has(predicted.stem):
            maps = read_envmap(predicted), read_envmap(truth)
            begun = time.perf_counter()
            rows = score_maps(*maps, args.protocol, args.convention)
            spent = {"score_seconds": time.perf_counter() - begun}
            journal.add([{"panorama": predicted.stem, **row, **spent} for row in rows])
    summary = _summarize(journal.rows, PROTOCOLS[args.protocol].parts)
    report = Report("protocol", _description(args), journal.rows, summary, time.perf_counter() - started)
    publish(report, args, rows=_ROWS, summary=(*_HEAD, *summary_columns(args.protocol, ERROR_COLUMNS), _TIME))
    return 0


def _identity(args: argparse.Namespace) -> Row:
    """What has to be the same for a run to be gone on with; folders only as a fingerprint."""
    return {
        "protocol": args.protocol,
        "convention": args.convention,
        "spheres": list(PROTOCOLS[args.protocol].parts),
        "folders": fingerprint(args.maps, args.truth),
    }


def _description(args: argparse.Namespace) -> Row:
    return {"name": args.protocol, **protocol(args.convention), **PROTOCOLS[args.protocol].conditions}


def _summarize(rows: list[Row], parts: tuple[str, ...]) -> list[Row]:
    """Errors over the maps, a record for each sphere."""
    summary = []
    for sphere in parts:
        of_sphere = [row for row in rows if row["sphere"] == sphere]
        spent = median_and_worst(of_sphere, "score_seconds")
        summary.append({"sphere": sphere, "panoramas": len(of_sphere), **summarize_errors(of_sphere), **spent})
    return summary


_ROWS: Final = (Column("panorama", "panorama"), Column("sphere", "sphere"), *ERROR_COLUMNS)
_HEAD: Final = (Column("sphere", "sphere"), Column("maps", "panoramas"))
_TIME: Final = Column("s an image, all spheres", "score_seconds", ".3f")
