"""A folder of photographs: what is in it, in order, and what of it is no photograph."""

from __future__ import annotations

from collections import Counter
from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path

from .errors import ImageError
from .finished import content_key
from .imageio import KEPT_SIDE, read_photograph
from .shapes import Image

__all__ = ["PhotoFolder", "folder_files", "folder_fingerprint", "read_folder"]


@dataclass(frozen=True)
class PhotoFolder:
    """The photographs of a folder.

    Attributes:
        images: (1, H, W, 3) each, display-encoded in [0, 1].
        names: one each: that of the file without its suffix, or with it where two would be called the same.
        skipped: what could not be read as a photograph: file name and reason.
    """

    images: tuple[Image, ...]
    names: tuple[str, ...]
    skipped: tuple[tuple[str, str], ...]


def folder_files(folder: str | Path) -> tuple[Path, ...]:
    """The files of a folder by name, those of its subfolders left out.

    Raises:
        ImageError: no such folder, one that cannot be read, or one without files.
    """
    folder = Path(folder)
    try:
        if not folder.is_dir():
            raise ImageError(folder, "is no folder" if folder.exists() else "there is no such folder")
        files = [path for path in folder.iterdir() if path.is_file()]
    except OSError as error:
        raise ImageError(folder, f"cannot be read ({error.strerror or error})") from error
    if not files:
        raise ImageError(folder, "holds no files; a folder of photographs is accepted")
    return tuple(sorted(files, key=lambda path: (path.name.casefold(), path.name)))


def read_folder(
    folder: str | Path, *, kept_side: int = KEPT_SIDE, on_file: Callable[[], None] = lambda: None
) -> PhotoFolder:
    """Read the photographs of a folder, in the order of their names.

    Args:
        folder: whose files are read, those of its subfolders left out.
        kept_side: pixels that the longer side of a large picture keeps at least (`imageio.read_photograph`).
        on_file: called after each file; may stop the reading by raising.

    Raises:
        ImageError: a folder that `folder_files` refuses, or one without a photograph.
    """
    images: dict[Path, Image] = {}
    skipped: list[tuple[str, str]] = []
    for path in folder_files(folder):
        try:
            images[path] = read_photograph(path, kept_side=kept_side)
        except ImageError as error:
            skipped.append((path.name, error.reason))
        on_file()
    if not images:
        raise ImageError(Path(folder), f"holds no photograph; {skipped[0][0]} {skipped[0][1]}")
    return PhotoFolder(tuple(images.values()), _names(tuple(images)), tuple(skipped))


def _names(paths: tuple[Path, ...]) -> tuple[str, ...]:
    # Some file systems do not tell cases apart.
    count = Counter(path.stem.casefold() for path in paths)
    return tuple(path.stem if count[path.stem.casefold()] == 1 else path.name for path in paths)


def folder_fingerprint(folder: str | Path) -> str:
    """A text that changes with names, sizes and times of a folder's files.

    Raises:
        ImageError: a folder that `folder_files` refuses.
    """
    stats = [(path.name, path.stat()) for path in folder_files(folder)]
    return content_key([(name, stat.st_size, stat.st_mtime_ns) for name, stat in stats])
