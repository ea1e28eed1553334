"""Lines of progress, for whoever waits."""

from __future__ import annotations

import sys

__all__ = ["say"]


def say(line: str) -> None:
    """Tell of progress at once, where it does not mix with what a command prints as its result."""
    sys.stderr.write(line + "\n")
    sys.stderr.flush()
