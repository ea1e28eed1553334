"""`lightprobe bench early`: what is saved, and lost, where less is denoised, decoded or drawn at random.

A command measures one section; each has a folder of its own to go on in.
"""

from __future__ import annotations

import argparse
import time
from dataclasses import asdict
from typing import Final

from ...backends.loading import ModelFiles
from ...errors import OptionError
from ...iterative import Rounds
from ..journal import Journal
from ..painters import PAINTERS, add_files, identity, open_studio
from ..report import Report, add_output, add_panoramas, panorama_files, prepare_output, publish
from .decoding import DecodingSection
from .latents import LatentsSection
from .noise import NoiseSection
from .section import Options, Section
from .until import UntilSection

__all__ = ["SECTIONS", "add_arguments", "run"]

SECTIONS: Final[dict[str, type[Section]]] = {
    "until": UntilSection,
    "latents": LatentsSection,
    "decoding": DecodingSection,
    "noise": NoiseSection,
}
"""What can be measured, by name."""


def add_arguments(parser: argparse.ArgumentParser) -> None:
    """Declare the options."""
    add_panoramas(parser)
    add = parser.add_argument
    sections = "; ".join(f"{name}: {section.summary}" for name, section in SECTIONS.items())
    add("--section", default="until", help=f"{sections} (default: until)")
    add("--painter", default="mini", help=f"{', '.join(PAINTERS)} (default: mini)")
    add("--balls", type=int, default=5, help="of a median (default: 5)")
    add("--rounds", type=int, default=1, help="medians taken (default: 1)")
    add("--steps", type=int, default=20, help="of a full schedule (default: 20)")
    add("--strength", type=float, default=0.8, help="of later rounds and the last ball (default: 0.8)")
    add("--untils", default="0.3,0.5,0.7,0.85,1", help="shares to stop after (default: 0.3,0.5,0.7,0.85,1)")
    add("--seeds", type=int, default=16, help="noises that the section noise compares (default: 16)")
    add("--seed", type=int, default=0, help="of the first ball (default: 0)")
    add_files(parser)
    add_output(parser)


def run(args: argparse.Namespace) -> None:
    """Measure, write and print.

    Raises:
        ProbeError: an option out of range, a folder without maps or of another run, files of the painter that do not
            serve, or a report that cannot be written.
    """
    started = time.perf_counter()
    if args.section not in SECTIONS:
        raise OptionError("--section", args.section, ", ".join(SECTIONS))
    files, options = panorama_files(args.panoramas), _options(args)
    prepare_output(args)
    models = ModelFiles.of(args)
    section = SECTIONS[args.section](open_studio(args.painter, models), options)
    run_identity = {
        "bench": "early",
        "section": args.section,
        "panoramas": [path.stem for path in files],
        "painter": identity(args.painter, models),
        **{name: value for name, value in asdict(options).items() if name != "out"},
        "untils": list(options.untils),
    }
    journal = Journal(args.out, run_identity, section.each)
    for path in files:
        if not journal.has(path.stem):
            journal.add(section.measure(path))
    report = Report(
        f"early, {args.section}",
        {"painter": args.painter, **section.protocol()},
        journal.rows,
        section.summarize(journal.rows),
        time.perf_counter() - started,
        seeds=(args.seed,),
        evaluations=sum(row.get("evaluations", 0) for row in journal.rows),
    )
    publish(report, args, rows=section.rows, summary=section.columns)


def _options(args: argparse.Namespace) -> Options:
    """What to paint.

    Raises:
        OptionError: shares that are none, or schedules that run no step.
    """
    try:
        untils = tuple(float(value) for value in args.untils.split(","))
    except ValueError as error:
        raise OptionError("--untils", args.untils, "numbers and commas") from error
    for until in untils:
        Rounds(args.balls, args.rounds, args.strength, args.steps, until=until)
    return Options(args.balls, args.rounds, args.steps, args.strength, untils, args.seeds, args.seed, args.out)
