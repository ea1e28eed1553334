"""`lightprobe bench protocol NAME --panoramas DIR --painter NAME`: paint maps by a protocol and score them.

The paper's ablation rows are variants of one run; its printed figures stand below ours, with the data they are on.
"""

from __future__ import annotations

import argparse
import sys
import time
from collections.abc import Callable, Collection
from dataclasses import asdict, replace
from functools import partial
from pathlib import Path
from typing import Final

from ...backends.loading import ModelFiles
from ...errors import OptionError
from ...estimate import Settings
from ...exposure import MERGES, check_merge
from ...imageio import read_envmap, read_exr_header
from ...presets import Preset, preset
from ...progress_lines import say
from ..cameras import cameras_of
from ..painters import PAINTERS, Studio, add_files, identity, open_studio, studio_for_workers
from ..paintings import VARIANTS, PainterOf, Painting, paint_maps, planned
from ..report import Column, Report, Row, panorama_files, prepare_output, publish, table
from ..scoring import PROTOCOLS, score_maps, summarize_errors, summary_columns
from ..workers import check_workers
from .baselines import BASELINES, answer_maps, open_baselines
from .published import PUBLISHED

__all__ = ["add_arguments", "run"]


def add_arguments(parser: argparse.ArgumentParser) -> None:
    """Declare the options of a painted run."""
    group = parser.add_argument_group("to paint the maps first")
    add = group.add_argument
    add("--panoramas", type=Path, metavar="DIR", help="folder of true EXR or HDR maps, instead of --maps and --truth")
    add("--painter", default="mini", help=f"{', '.join(PAINTERS)} (default: mini)")
    add("--variants", default="both", help=f"rows of the ablation: {','.join(VARIANTS)}, or all (default: both)")
    add("--baselines", help=f"rows to compare with: {','.join(BASELINES)}, or all (default: none)")
    add("--regressor", type=Path, metavar="DIR", help="the regressor's files, of `lightprobe train mini regressor`")
    add("--preset", default="draft", help="schedule and bracket (default: draft)")
    add(
        "--last-ball",
        action="store_true",
        help="paint a last ball from the median, as the paper does, also where the preset ends in the median",
    )
    add(
        "--light-balls",
        type=int,
        default=0,
        help="balls painted to the end besides, whose lights are given back to medians (default: 0, none)",
    )
    merge = next(iter(MERGES))
    add("--merge", default=merge, help=f"{', '.join(MERGES)}: how exposures become radiance (default: {merge})")
    add(
        "--photographs",
        type=int,
        default=1,
        help="of each panorama: at equal azimuths, random cameras drawn anew (default: 1, as in the paper; not array)",
    )
    add("--seed", type=int, default=0, help="of random cameras, and of balls, for each photograph others (default: 0)")
    add("--workers", type=int, default=1, help="processes, each with a panorama at a time (default: 1)")
    add_files(group)


def run(args: argparse.Namespace) -> int:
    """Paint what the folder of `--out` does not hold yet, then score every map in it.

    Raises:
        OptionError: no `--out`, an unknown painter, variant or preset, no photographs or too many processes, an
            unknown merge, or a folder of another run.
    """
    if args.out is None:
        raise OptionError("--out", None, "a folder for the painted maps")
    check_workers(args.workers)
    check_merge(args.merge)
    variants = _names(args.variants, VARIANTS, "--variants")
    panoramas = panorama_files(args.panoramas)
    paintings = list(planned(panoramas, args.protocol, variants, args.seed, args.photographs))
    compared = _names(args.baselines, BASELINES, "--baselines") if args.baselines else []
    answers = list(planned(panoramas, args.protocol, compared, args.seed, args.photographs))
    chosen = preset(args.preset)
    final = args.last_ball or chosen.rounds.final
    chosen = replace(chosen, rounds=replace(chosen.rounds, final=final, light_balls=args.light_balls))
    prepare_output(args)
    started = time.perf_counter()
    files = ModelFiles.of(args)
    studio = open_studio(args.painter, files)
    settings = Settings(seed=args.seed, merge=args.merge, canvas=studio.canvas, diameter=studio.diameter)
    baselines = open_baselines(compared, args.regressor, replace(settings, evs=chosen.evs))
    paint_maps(
        paintings,
        partial(_painters, studio_for_workers(args.workers, studio, args.painter, files)),
        chosen,
        settings,
        args.out,
        painter=identity(args.painter, files),
        workers=args.workers,
        report=say,
    )
    answer_maps(answers, baselines, args.out, report=say)
    rows = [row for painting in (*paintings, *answers) for row in _score(painting, args)]
    report = Report(
        f"protocol {args.protocol}",
        _description(args, settings, chosen),
        rows,
        _summarize(rows),
        time.perf_counter() - started,
        seeds=(args.seed,),
        evaluations=sum({row["variant"] + row["shot"]: row["evaluations"] for row in rows}.values()),
    )
    publish(report, args, rows=_ROWS, summary=(*_HEAD, *summary_columns(args.protocol, _FIGURE_COLUMNS)))
    if not args.json:
        sys.stdout.write(
            "\nprinted in the paper, on its own data\n" + table(_published(args.protocol), _PUBLISHED) + "\n"
        )
    return 0


def _painters(studio_of: Callable[[], Studio]) -> PainterOf:
    return studio_of().painter_of


def _names(text: str, table: Collection[str], option: str) -> list[str]:
    names = list(table) if text == "all" else text.split(",")
    for name in names:
        if name not in table:
            raise OptionError(option, name, ", ".join((*table, "all")))
    return names


def _score(painting: Painting, args: argparse.Namespace) -> list[Row]:
    path, truth = painting.map_in(args.out), read_envmap(painting.truth_in(args.out))
    head = {
        "panorama": painting.panorama.stem,
        "shot": painting.shot,
        "variant": painting.variant,
        "evaluations": int(read_exr_header(path)["lightprobe:nfe"]),
    }
    return [{**head, **row} for row in score_maps(read_envmap(path), truth, args.protocol, args.convention)]


def _description(args: argparse.Namespace, settings: Settings, chosen: Preset) -> Row:
    return {
        "name": args.protocol,
        "convention": args.convention,
        "painter": args.painter,
        "preset": args.preset,
        "last_ball": chosen.rounds.final,
        "light_balls": chosen.rounds.light_balls,
        "merge": settings.merge,
        "evs": list(chosen.evs),
        "canvas_px": settings.canvas,
        "ball_px": settings.diameter,
        "cameras": [camera.name for camera in cameras_of(args.protocol, "", args.seed, args.photographs)]
        if args.protocol != "random-camera"
        else f"{args.photographs} drawn for each panorama: fov 30 to 150, elevation -45 to 45, any azimuth",
        "scored": PROTOCOLS[args.protocol].summary,
        **PROTOCOLS[args.protocol].conditions,
        "published": _published(args.protocol),
    }


def _summarize(rows: list[Row]) -> list[Row]:
    """Errors over the maps, a record for each variant or baseline and sphere."""
    summary = []
    labels = {name: variant.label for name, variant in VARIANTS.items()} | BASELINES
    for variant, label in labels.items():
        for sphere in dict.fromkeys(row["sphere"] for row in rows):
            own = [row for row in rows if row["variant"] == variant and row["sphere"] == sphere]
            if not own:
                continue
            head = {"method": label, "sphere": sphere, "maps": len(own)}
            summary.append({**head, **summarize_errors(own)})
    return summary


def _published(protocol: str) -> list[Row]:
    return [asdict(row) for row in PUBLISHED if row.protocol == protocol]


_FIGURE_COLUMNS: Final = (
    Column("si-RMSE", "si_rmse", ".3f"),
    Column("angle (deg)", "angular_error_deg", ".2f"),
    Column("normalized RMSE", "normalized_rmse", ".3f"),
)
_ROWS: Final = (Column("shot", "shot"), Column("variant", "variant"), Column("sphere", "sphere"), *_FIGURE_COLUMNS)
_HEAD: Final = (Column("method", "method"), Column("sphere", "sphere"), Column("maps", "maps"))
_PUBLISHED: Final = (Column("data", "data"), Column("method", "method"), Column("sphere", "sphere"), *_FIGURE_COLUMNS)
