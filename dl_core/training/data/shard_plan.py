"""What a folder of shards is made of: written before the first shard, and compared when a run goes on.

The plan names options, panoramas by the hash of their contents, and what became of each. A run that finds a plan of the
same options and contents goes on from it, without looking through the panoramas again; any other is refused.
"""

from __future__ import annotations

import hashlib
import json
from collections.abc import Callable, Iterator, Mapping
from pathlib import Path
from typing import Any, Final

from ... import __version__
from ...errors import OptionError, OutputError
from ...imageio import atomic
from ...json_text import read_json
from .pairs import FORMAT
from .screening import screen

__all__ = ["PLAN", "differences", "file_hash", "fingerprint", "make_plan", "write_json"]

PLAN: Final = "plan.json"
_MANY: Final = 5
"""Differences that a message names."""

Plan = dict[str, Any]


def file_hash(path: Path) -> str | None:
    """SHA-256 of a file; None where it cannot be read."""
    digest = hashlib.sha256()
    try:
        with path.open("rb") as file:
            while block := file.read(1 << 20):
                digest.update(block)
    except OSError:
        return None
    return digest.hexdigest()


def fingerprint(contents: Mapping[str, str | None]) -> str:
    """One hash of files by name and hash."""
    return hashlib.sha256(json.dumps(contents, sort_keys=True).encode()).hexdigest()


def write_json(path: Path, content: Mapping[str, Any]) -> None:
    """Write an object as JSON, keys sorted.

    Raises:
        OutputError: the file cannot be written.
    """
    with atomic(path) as temporary:
        temporary.write_text(json.dumps(content, sort_keys=True, indent=1) + "\n")


def make_plan(
    folder: Path, options: Mapping[str, Any], files: Mapping[str, Path], report: Callable[[str], None]
) -> Plan:
    """The plan of a folder: the one that is there, or a new one, which is written.

    Args:
        folder: of the shards; made if missing.
        options: all that the shards depend on beside the panoramas.
        files: of the panoramas, by name.
        report: told of panoramas left out.

    Returns:
        `options`, `contents` (hash by name), `used`, `skipped` and `duplicates` as in `Screening`.

    Raises:
        OptionError: the folder holds pairs of other options or panoramas, or no panorama is fit.
        OutputError: the folder cannot be made or written.
    """
    try:
        folder.mkdir(parents=True, exist_ok=True)
    except OSError as error:
        raise OutputError(folder, f"cannot be made ({error.strerror})") from error
    asked: Plan = {
        "format": FORMAT,
        "version": __version__,
        "options": dict(options),
        "contents": {name: file_hash(path) for name, path in files.items()},
    }
    there = _read_plan(folder)
    if there is not None:
        _require_same(folder, there, asked)
        return there
    found = screen(files, report)
    if not found.used:
        reasons = "; ".join(f"{name} {reason}" for name, reason in list(found.skipped.items())[:_MANY])
        raise OptionError("panoramas", f"{len(files)} files, none of them fit", f"HDR maps ({reasons})")
    plan = asked | {"used": dict(found.used), "skipped": dict(found.skipped), "duplicates": dict(found.duplicates)}
    write_json(folder / PLAN, plan)
    return plan


def _read_plan(folder: Path) -> Plan | None:
    path = folder / PLAN
    if not path.is_file():
        if any(folder.glob("*.tar")):
            raise OptionError("out", str(folder), f"an empty folder, or one with a {PLAN}; this one holds other shards")
        return None
    try:
        return dict(read_json(path))
    except (OSError, ValueError, TypeError) as error:
        raise OptionError("out", str(folder), f"a folder whose {PLAN} can be read") from error


def _require_same(folder: Path, there: Plan, asked: Plan) -> None:
    found = list(differences(there, asked))
    if found:
        more = f" and {len(found) - _MANY} more" if len(found) > _MANY else ""
        raise OptionError(
            "out", str(folder), f"another folder: the pairs there differ in {', '.join(found[:_MANY])}{more}"
        )


def differences(there: Plan, asked: Plan) -> Iterator[str]:
    """What two plans differ in, in words, options first."""
    for name in ("format", "version"):
        if there.get(name) != asked[name]:
            yield f"{name} ({there.get(name)} there, {asked[name]} now)"
    old, new = there.get("options", {}), asked["options"]
    for name in sorted(old.keys() | new.keys()):
        if old.get(name) != new.get(name):
            yield f"{name} ({old.get(name)} there, {new.get(name)} now)"
    old, new = there.get("contents", {}), asked["contents"]
    for name in sorted(old.keys() | new.keys()):
        if name not in new or name not in old:
            yield f"panorama {name} ({'only there' if name in old else 'only now'})"
        elif old[name] != new[name]:
            yield f"panorama {name} (other contents)"
