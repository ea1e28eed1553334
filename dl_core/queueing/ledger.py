"""The folder of results: which name a photograph's files have, and which photographs are finished.

A photograph under a workflow is known by the content of both. A record of each lies in a folder inside, so that a run
that is started again knows what is there, whatever the photographs are called by then.
"""

from __future__ import annotations

import hashlib
import json
import threading
from collections.abc import Callable, Iterator, Mapping
from dataclasses import asdict, dataclass, replace
from pathlib import Path
from typing import Any, Final

from ..errors import OutputError
from ..imageio import atomic
from ..json_text import read_json
from .client import RemoteFile
from .workflow import Workflow

__all__ = ["Ledger", "Record", "job_key", "local_names"]

RECORDS: Final = ".lightprobe"
MAP_SUFFIXES: Final = (".exr", ".hdr")
PREVIEW: Final = ".preview"


def job_key(photo: bytes, workflow: Workflow) -> str:
    """What a photograph under a workflow is known by: 64 hexadecimal digits, equal for equal content."""
    digest = hashlib.sha256(hashlib.sha256(photo).digest())
    digest.update(workflow.identity.encode())
    return digest.hexdigest()


def local_names(name: str, output: Mapping[str, Any], taken: set[str]) -> Iterator[tuple[str, RemoteFile]]:
    """How the files that a Save Environment Map node reports are called here, maps first.

    Args:
        name: what all of them begin with.
        output: the node's entry of a history: `envmaps` and `images`.
        taken: names given so far; the new ones are added.
    """
    for kind, mark in (("envmaps", ""), ("images", PREVIEW)):
        for item in output.get(kind, []):
            file = RemoteFile(item["filename"], item.get("subfolder", ""), item.get("type", "output"))
            suffix = Path(file.filename).suffix
            counts = ("", *(f".{count}" for count in range(2, len(taken) + 3)))
            local = next(new for count in counts if (new := f"{name}{count}{mark}{suffix}") not in taken)
            taken.add(local)
            yield local, file


@dataclass(frozen=True)
class Record:
    """What is known of a photograph under a workflow.

    Attributes:
        key: see `job_key`.
        name: what its files begin with; a point and more follow.
        photo: the photograph's file name when it was first seen.
        files: names of its files once all are there.
    """

    key: str
    name: str
    photo: str
    files: tuple[str, ...] = ()


class Ledger:
    """The records of a folder. Threads may share it."""

    def __init__(self, folder: Path) -> None:
        """Open or make the folder.

        Raises:
            OutputError: it cannot be made.
        """
        self.folder = folder
        self._lock = threading.Lock()
        try:
            (folder / RECORDS).mkdir(parents=True, exist_ok=True)
        except OSError as error:
            raise OutputError(folder, f"the folder cannot be made ({error.strerror or error})") from error
        records = (_read_record(path) for path in sorted((folder / RECORDS).glob("*.json")))
        self._records = {record.key: record for record in records if record is not None}

    def record(self, key: str, photo: Path) -> Record:
        """The record of a photograph; a new one gets a name that no other files have.

        Raises:
            OutputError: a new record cannot be written.
        """
        with self._lock:
            if key not in self._records:
                name = photo.stem if self._is_free(photo.stem) else f"{photo.stem}-{key[:12]}"
                self._keep(Record(key, name, photo.name))
            return self._records[key]

    def finished(self, record: Record) -> bool:
        """Whether all files of a photograph are there."""
        return bool(record.files) and all((self.folder / name).is_file() for name in record.files)

    def collect(
        self, record: Record, outputs: list[Mapping[str, Any]], fetch: Callable[[RemoteFile, Path], None]
    ) -> Record:
        """Write the files that a server reports, each under a temporary name first, and note that all are there.

        Args:
            record: of the photograph.
            outputs: of its Save Environment Map nodes.
            fetch: writes a file of the server to a path.

        Raises:
            OutputError: a file cannot be written.
        """
        taken: set[str] = set()
        for output in outputs:
            for name, file in local_names(record.name, output, taken):
                with atomic(self.folder / name) as temporary:
                    fetch(file, temporary)
        done = replace(record, files=tuple(sorted(taken)))
        with self._lock:
            self._keep(done)
        return done

    def _keep(self, record: Record) -> None:
        with atomic(self.folder / RECORDS / f"{record.key[:32]}.json") as temporary:
            temporary.write_text(json.dumps(asdict(record), indent=2), encoding="utf-8")
        self._records[record.key] = record

    def _is_free(self, name: str) -> bool:
        """Whether no other photograph's files, and no maps that are not ours, could have names that begin like this.

        Names are compared without case, as some file systems do.
        """
        wanted = name.casefold() + "."
        others = [record.name.casefold() + "." for record in self._records.values()]
        if any(wanted.startswith(other) or other.startswith(wanted) for other in others):
            return False
        found = [path.name.casefold() for path in self.folder.iterdir()]
        return not any(
            other.startswith(wanted) and (other.endswith(MAP_SUFFIXES) or PREVIEW + "." in other) for other in found
        )


def _read_record(path: Path) -> Record | None:
    """A record; None for a file that is none, or is damaged: its photograph is then run again."""
    try:
        content = read_json(path)
        record = Record(**{**content, "files": tuple(content["files"])})
    except (OSError, ValueError, TypeError, KeyError):
        return None
    texts = (record.key, record.name, record.photo, *record.files)
    return record if all(map(_is_plain, texts)) else None


def _is_plain(name: Any) -> bool:
    """Whether it is the name of a file, and leads nowhere else."""
    return isinstance(name, str) and bool(name) and "\0" not in name and Path(name).name == name
