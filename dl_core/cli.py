"""The command line: `lightprobe COMMAND ...`. Commands are rows of a table and are imported only when asked for.

Exit codes: 0 fine; 1 a fault of input, model or output; 2 an option that is not accepted; 130 interrupted, by Ctrl-C or
by the request to end (SIGTERM) that containers and job schedulers send.
"""

from __future__ import annotations

import argparse
import importlib
import importlib.util
import signal
import sys
import threading
from collections.abc import Iterator, Sequence
from contextlib import contextmanager
from dataclasses import dataclass
from typing import Any, Final, Protocol, cast, runtime_checkable

from . import __version__
from .errors import Interrupted, OptionError, ProbeError

__all__ = ["COMMANDS", "Command", "CommandModule", "main"]

FINE: Final = 0
FAULT: Final = 1
USAGE: Final = 2
INTERRUPTED: Final = 130
"""128 + SIGINT, as shells report it."""


@dataclass(frozen=True)
class Command:
    """A sub-command.

    Attributes:
        summary: one line for the list of commands.
        module: relative to this package; see `CommandModule` for what it provides.
    """

    summary: str
    module: str

    @property
    def description(self) -> str:
        """The summary as a sentence."""
        return self.summary[:1].upper() + self.summary[1:] + "."


@runtime_checkable
class CommandModule(Protocol):
    """What a command's module provides."""

    def add_arguments(self, parser: argparse.ArgumentParser) -> None:
        """Declare the options."""

    def run(self, args: argparse.Namespace) -> int | None:
        """Do it; the exit code, or None for 0. Faults are raised as `ProbeError`."""


COMMANDS: Final[dict[str, Command]] = {
    "estimate": Command("estimate the light of a photograph and write it as an EXR", ".commands.estimate"),
    "queue": Command("run a workflow over photographs on ComfyUI servers and collect the maps", ".commands.queue"),
    "presets": Command("what each preset paints, costs and reaches", ".commands.presets"),
    "spheres": Command("show diffuse and mirror spheres under an environment map", ".commands.spheres"),
    "lights": Command("find the smallest light that stands for an environment map", ".commands.lights"),
    "inspect": Command(
        "what an environment map or a ball holds, and how good a mirror ball it is", ".commands.inspect"
    ),
    "bench": Command("measure stages of the method against the truth", ".bench.cli"),
    "train": Command("make training data and train the mini model or the exposure LoRA", ".training.cli"),
}


def main(argv: Sequence[str] | None = None) -> int:
    """Run a command line; the exit code."""
    try:
        with _ending_as_by_ctrl_c():
            return _dispatch(list(sys.argv[1:] if argv is None else argv)) or FINE
    except OptionError as error:
        return _complain(error, USAGE)
    except (KeyboardInterrupt, Interrupted):
        return _complain("interrupted; no file is half-written", INTERRUPTED)
    except ProbeError as error:
        return _complain(error, FAULT)


@contextmanager
def _ending_as_by_ctrl_c() -> Iterator[None]:
    """Take a request to end for Ctrl-C: it, too, leaves checkpoints and no half-written file or orphaned job."""
    if threading.current_thread() is not threading.main_thread():  # signals do not arrive elsewhere
        yield
        return

    def end(number: int, frame: Any) -> None:
        if signal.getsignal(signal.SIGINT) in (signal.SIG_IGN, None):  # as shells have it for jobs in the background
            raise KeyboardInterrupt
        signal.raise_signal(signal.SIGINT)

    before = signal.signal(signal.SIGTERM, end)
    try:
        yield
    finally:
        signal.signal(signal.SIGTERM, before)


def _dispatch(arguments: list[str]) -> int | None:
    chosen = next((argument for argument in arguments if argument in COMMANDS), None)
    module = _load(COMMANDS[chosen]) if chosen and _is_there(COMMANDS[chosen]) else None
    args = _parser(chosen, module).parse_args(arguments)
    # argparse ends the program itself unless the command is one that is there.
    return module.run(args) if module else None


def _is_there(command: Command) -> bool:
    return importlib.util.find_spec(command.module, __package__) is not None


def _load(command: Command) -> CommandModule:
    return cast("CommandModule", importlib.import_module(command.module, __package__))


def _parser(chosen: str | None, module: CommandModule | None) -> argparse.ArgumentParser:
    """All commands by name, and the options of the chosen one: the others need not be imported."""
    parser = argparse.ArgumentParser(prog="lightprobe", description="HDR environment maps from one photograph.")
    parser.add_argument("--version", action="version", version=f"lightprobe {__version__}")
    commands = parser.add_subparsers(metavar="COMMAND", required=True)
    for name, command in COMMANDS.items():
        if _is_there(command):
            sub = commands.add_parser(name, help=command.summary, description=command.description)
            if name == chosen and module is not None:
                module.add_arguments(sub)
    return parser


def _complain(fault: object, code: int) -> int:
    print(f"lightprobe: {fault}", file=sys.stderr)
    return code


if __name__ == "__main__":
    sys.exit(main())
