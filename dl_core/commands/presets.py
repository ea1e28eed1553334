"""`lightprobe presets`: what each preset paints, costs and reaches; with `--seconds`, how long it takes here."""

from __future__ import annotations

import argparse
import json
import sys
from typing import Any

__all__ = ["add_arguments", "run"]


def add_arguments(parser: argparse.ArgumentParser) -> None:
    """Declare the options."""
    add = parser.add_argument
    add("--seconds", action="store_true", help="paint a few balls first, to tell how long each preset takes here")
    add("--backend", default="mini", help="with --seconds: mini or diffusers (default: mini)")
    add("--model", metavar="PATH", help="diffusers: SDXL checkpoint; mini: another folder than its own")
    add("--controlnet", metavar="PATH", help="diffusers: depth ControlNet for SDXL")
    add("--lora", metavar="PATH", help="diffusers: exposure LoRA")
    add("--turbo-lora", metavar="PATH", help="diffusers: Turbo LoRA")
    add("--precision", metavar="TYPE", help="what the networks compute in, as for estimate")
    add("--json", action="store_true", help="print as JSON")


def run(args: argparse.Namespace) -> None:
    """Print the table.

    Raises:
        ProbeError: with `--seconds`, a model that does not serve.
    """
    from ..presets import PRESETS

    rows = [preset.row(name) for name, preset in PRESETS.items()]
    if args.seconds:
        rows = [row | {"seconds": seconds} for row, seconds in zip(rows, _seconds(args), strict=True)]
    sys.stdout.write((json.dumps(rows, indent=2) if args.json else _table(rows)) + "\n")


def _table(rows: list[dict[str, Any]]) -> str:
    from ..bench.report import Column, table

    forms = {"until": "g", "guided_steps": ",", "error_deg": ".2f", "seconds": ".1f"}
    return table(rows, [Column(key.replace("_", " "), key, forms.get(key, "")) for key in rows[0]])


def _seconds(args: argparse.Namespace) -> list[float]:
    from ..backends.loading import ModelFiles, choose_backend
    from ..budget import calibrate
    from ..presets import PRESETS

    loaded = choose_backend(args.backend).load(ModelFiles.of(args), "initial")
    pace = calibrate(loaded.painter, loaded.canvas, loaded.diameter)
    return [pace.seconds(loaded.painter, preset) for preset in PRESETS.values()]
