"""`lightprobe bench NAME`: the benches as a table. A bench is imported only when it is chosen.

Options and output that benches share are in `report`: `--panoramas` by `add_panoramas`, `--out` and `--json` by
`add_output`; a run ends in `publish`.
"""

from __future__ import annotations

import argparse
import importlib
from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any, Final, cast

from ..cli import CommandModule

__all__ = ["BENCHES", "Bench", "add_arguments", "load", "run"]


@dataclass(frozen=True)
class Bench:
    """A measurement.

    Attributes:
        summary: one line for people.
        module: relative to this package; see `CommandModule` for what it provides.
    """

    summary: str
    module: str


BENCHES: Final[dict[str, Bench]] = {
    "oracle": Bench("what unwrap and merge lose behind a perfect painter", ".oracle"),
    "geometry": Bench("what latlong -> ball -> latlong loses", ".geometry"),
    "fit": Bench("how well radius and centre of a painted ball are found", ".fit"),
    "metrics": Bench("score a picture against the true one", ".pairs"),
    "protocol": Bench("score given maps by the paper's protocols", ".protocol"),
}
"""The benches by name; a new one is a new row."""


def load(name: str) -> CommandModule:
    """The module of a bench."""
    return cast("CommandModule", importlib.import_module(BENCHES[name].module, __package__))


class _BenchParser(argparse.ArgumentParser):
    """Declares the options of its bench once that is chosen, so that help on all imports none."""

    def __init__(self, *, bench: str, **options: Any) -> None:
        super().__init__(**options)
        self.bench = bench
        self.declared = False

    def parse_known_args(  # type: ignore[override]
        self, args: Sequence[str] | None = None, namespace: Any = None
    ) -> tuple[Any, list[str]]:
        if not self.declared:
            load(self.bench).add_arguments(self)
            self.declared = True
        return super().parse_known_args(args, namespace)


def add_arguments(parser: argparse.ArgumentParser) -> None:
    """Declare the benches; each declares its own options when it is chosen."""
    names = parser.add_subparsers(dest="bench", required=True, metavar="BENCH", parser_class=_BenchParser)
    for name, bench in BENCHES.items():
        description = bench.summary[:1].upper() + bench.summary[1:] + "."
        names.add_parser(name, help=bench.summary, description=description, bench=name)


def run(args: argparse.Namespace) -> int | None:
    """Run the chosen bench."""
    return load(args.bench).run(args)
