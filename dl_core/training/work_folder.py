"""The folder a training keeps its checkpoint and log in."""

from __future__ import annotations

from pathlib import Path

from ..errors import OptionError, OutputError
from ..imageio import require_writable

__all__ = ["require_work_folder"]


def require_work_folder(folder: Path) -> None:
    """Make the work folder, if it is not there, and see that it can be written to.

    Raises:
        OptionError: it cannot.
    """
    try:
        folder.mkdir(parents=True, exist_ok=True)
        require_writable(folder / "checkpoint")
    except (OSError, OutputError) as error:
        raise OptionError("--work", str(folder), f"a folder that can be made and written to ({error})") from error
