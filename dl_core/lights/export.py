"""Decisions as files: JSON, glTF, USD. The suffix says which."""

from __future__ import annotations

import json
import math
import os
from collections.abc import Callable
from pathlib import Path
from typing import Final

from ..errors import OptionError
from ..imageio import atomic, require_writable, write_exr
from .choose import Decision
from .describe import describe
from .gltf import gltf_scene
from .model import LightModel
from .search import Candidate
from .usd import usd_stage

__all__ = ["EXPORTS", "check_export", "write_lights"]

_DOME_ROWS: Final = 64
"""Rows of the texture of harmonics: band 2 turns over in 90 degrees."""


def _write_json(path: Path, decision: Decision, source: Path) -> list[Path]:
    return [_write_text(path, json.dumps(describe(decision), indent=1) + "\n")]


def _write_gltf(path: Path, decision: Decision, source: Path) -> list[Path]:
    model = decision.chosen.model
    if model is None:
        raise OptionError("export", path.name, _no_model(decision))
    return [_write_text(path, json.dumps(gltf_scene(model), indent=1) + "\n")]


def _no_model(decision: Decision) -> str:
    """What to do where a format cannot hold the full map that was chosen."""
    closest: Candidate = min(decision.candidates[:-1], key=lambda one: one.relative_error)
    return (
        f".usda or .json: within {decision.tolerance:g} this map needs the full map, which glTF does not hold; "
        f"the closest model is {closest.name} with an error of {closest.relative_error:.3g}"
    )


def _write_usd(path: Path, decision: Decision, source: Path) -> list[Path]:
    model = decision.chosen.model
    if model is None:
        return [_write_text(path, usd_stage((), texture=_beside(source, path)))]
    if len(model.coefficients) == 1:
        ambient = (model.coefficients[0] / math.sqrt(4 * math.pi)).tolist()
        return [_write_text(path, usd_stage(model.lights, ambient=ambient))]
    texture = _write_dome(path.with_suffix(".dome.exr"), model)
    return [_write_text(path, usd_stage(model.lights, texture=f"./{texture.name}")), texture]


def _write_dome(path: Path, model: LightModel) -> Path:
    metadata = {"lightprobe": f"harmonics of {model.name}, raised to 0 where negative"}
    return write_exr(path, model.background_map(_DOME_ROWS)[0], metadata=metadata, half=False)


def _beside(source: Path, path: Path) -> str:
    """A file as a stage in another folder names it."""
    try:
        relative = Path(os.path.relpath(source.resolve(), path.resolve().parent)).as_posix()
    except ValueError:  # another drive
        return source.resolve().as_posix()
    return relative if relative.startswith("../") else f"./{relative}"


def _write_text(path: Path, text: str) -> Path:
    with atomic(path) as temporary:
        temporary.write_text(text, encoding="utf-8")
    return path


EXPORTS: Final[dict[str, Callable[[Path, Decision, Path], list[Path]]]] = {
    ".json": _write_json,
    ".gltf": _write_gltf,
    ".usda": _write_usd,
}
"""Writers by suffix: (path, decision, file of the map) -> files written."""


def check_export(path: Path) -> None:
    """Make sure, before long work, that a file can be written and that its format is known.

    Raises:
        OptionError: another suffix than those of `EXPORTS`.
        OutputError: the file cannot be written.
    """
    if path.suffix.lower() not in EXPORTS:
        raise OptionError("export", path.name, f"a file named {', '.join(EXPORTS)}")
    require_writable(path)


def write_lights(path: Path, decision: Decision, source: Path) -> list[Path]:
    """Write what was chosen; each file whole or not at all.

    Args:
        path: of the file; its suffix is one of `EXPORTS`.
        decision: whose choice is written.
        source: the map's file, to which a USD stage refers where the full map was chosen.

    Returns:
        The files written: `path`, and for USD a texture beside it where there are harmonics.

    Raises:
        OptionError: another suffix, or a full map where the format has no place for one.
        OutputError: a file cannot be written.
    """
    check_export(path)
    return EXPORTS[path.suffix.lower()](path, decision, source)
