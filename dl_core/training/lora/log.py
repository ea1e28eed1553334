"""What a training leaves to be looked at: lines of JSON, and TensorBoard's files where it is installed."""

from __future__ import annotations

import json
import time
from collections.abc import Callable
from contextlib import suppress
from pathlib import Path
from typing import Any

from torch import Tensor

__all__ = ["TrainingLog"]


class TrainingLog:
    """A line of `log.jsonl` a step, and the same for TensorBoard.

    Args:
        folder: of the log; TensorBoard's files come into `tensorboard` in it.
        step: from which this run goes on; what TensorBoard has beyond it is of a run that was stopped.
        report: told once if the log cannot be written. A training does not end for want of a log.
    """

    def __init__(self, folder: Path, step: int, report: Callable[[str], None]) -> None:
        self._path = folder / "log.jsonl"
        self._report = report
        self._silent = False
        self._started = time.monotonic()
        self._board = _board(folder / "tensorboard", step)

    def step(self, step: int, loss: float, rate: float) -> None:
        """Note a step.

        Args:
            step: how many are done.
            loss: mean squared error on the ball.
            rate: learning rate.
        """
        seconds = time.monotonic() - self._started
        line = {"step": step, "loss": loss, "learning rate": rate, "seconds": round(seconds, 2)}
        try:
            with self._path.open("a", encoding="utf-8") as log:
                log.write(json.dumps(line) + "\n")
            if self._board is not None:
                for name in ("loss", "learning rate", "seconds"):
                    self._board.add_scalar(f"train/{name}", line[name], step)
        except OSError as error:
            if not self._silent:
                self._report(f"{self._path} cannot be written ({error.strerror}); training goes on without a log")
            self._silent = True

    def picture(self, name: str, picture: Tensor, step: int) -> None:
        """Show a picture, (1, H, W, 3) display-encoded in [0, 1]."""
        if self._board is not None:
            with suppress(OSError):
                self._board.add_image(name, picture[0].permute(2, 0, 1), step)

    def close(self) -> None:
        """Write out what is waiting."""
        if self._board is not None:
            with suppress(OSError):
                self._board.close()


def _board(folder: Path, step: int) -> Any:
    try:
        from torch.utils.tensorboard import SummaryWriter
    except ImportError:
        return None
    return SummaryWriter(str(folder), purge_step=step + 1 if step else None)  # type: ignore[no-untyped-call]
