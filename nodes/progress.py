"""Progress of long nodes: the bar counts denoiser evaluations, its picture is the current median ball."""

from __future__ import annotations

import comfy.utils
import torch
from PIL import Image as PILImage

from ..dl_core.median import pixelwise_median
from ..dl_core.shapes import BallImage

__all__ = ["BarObserver"]

PREVIEW_SIDE = 512


class BarObserver:
    """An observer (`dl_core.painter.Observer`) that moves ComfyUI's progress bar.

    ComfyUI's bar raises its own exception when the user has interrupted, which stops the run there.
    """

    def __init__(self) -> None:
        """Take the bar of the node that is running."""
        self._bar = comfy.utils.ProgressBar(1)
        self._done = self._total = 0

    def expect(self, evaluations: int) -> None:
        """Say how many denoiser evaluations fill the bar."""
        self._total = evaluations
        self._bar.update_absolute(0, evaluations)

    def evaluated(self, count: int) -> None:
        """Move the bar."""
        self._done += count
        self._bar.update_absolute(self._done)

    def spared(self, count: int) -> None:
        """Bring the bar's end nearer (`dl_core.iterative.SparingObserver`)."""
        self._total -= count
        self._bar.update_absolute(self._done, self._total)

    def painted(self, ev: float, round_index: int, balls: BallImage) -> None:
        """Show the median of a finished round."""
        self.preview(balls)

    def preview(self, balls: BallImage) -> None:
        """Show the median of the balls so far."""
        codes = (pixelwise_median(balls)[0].cpu() * 255).round().to(torch.uint8).numpy()
        self._bar.update_absolute(self._done, preview=("JPEG", PILImage.fromarray(codes), PREVIEW_SIDE))
