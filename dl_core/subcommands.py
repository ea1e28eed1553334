"""Commands of a command as a table, each imported only when it is chosen, so that help on all is quick."""

from __future__ import annotations

import argparse
import importlib
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import Any, cast

from .cli import CommandModule

__all__ = ["Subcommand", "add_subcommands"]


@dataclass(frozen=True)
class Subcommand:
    """A row of such a table.

    Attributes:
        summary: one line for people.
        module: full name of the module; see `CommandModule` for what it provides.
    """

    summary: str
    module: str

    def load(self) -> CommandModule:
        """The module."""
        return cast("CommandModule", importlib.import_module(self.module))


class _LateParser(argparse.ArgumentParser):
    """Declares the options of its command once that is chosen."""

    def __init__(self, *, row: Subcommand, **options: Any) -> None:
        super().__init__(**options)
        self.row = row
        self.declared = False

    def parse_known_args(  # type: ignore[override]
        self, args: Sequence[str] | None = None, namespace: Any = None
    ) -> tuple[Any, list[str]]:
        if not self.declared:
            self.row.load().add_arguments(self)
            self.declared = True
        return super().parse_known_args(args, namespace)


def add_subcommands(parser: argparse.ArgumentParser, table: Mapping[str, Subcommand], name: str) -> None:
    """Declare the commands of a table; the chosen one's name is left in the namespace as `name`."""
    rows = parser.add_subparsers(dest=name, required=True, metavar=name.upper(), parser_class=_LateParser)
    for key, row in table.items():
        description = row.summary[:1].upper() + row.summary[1:] + "."
        rows.add_parser(key, help=row.summary, description=description, row=row)
