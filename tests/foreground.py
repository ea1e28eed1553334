"""Children that hear Ctrl-C, however the tests were started."""

from __future__ import annotations

import signal

__all__ = ["hear_ctrl_c"]


def hear_ctrl_c() -> None:
    """For `preexec_fn`: a shell that runs the tests in the background has them ignore Ctrl-C, and a child would too."""
    signal.signal(signal.SIGINT, signal.SIG_DFL)
