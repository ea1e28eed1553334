"""One painter per exposure behind one port, for models that are steered to an exposure before they paint."""

from __future__ import annotations

from collections.abc import Mapping
from time import perf_counter

from .errors import OptionError
from .painter import Observer, Painter, PaintRequest, PaintResult

__all__ = ["BracketPainter"]


class BracketPainter:
    """Hands each request to the painter of its exposure, and keeps the time that each takes.

    Attributes:
        seconds: spent painting so far, by EV.
    """

    def __init__(self, painters: Mapping[float, Painter]) -> None:
        """Take the painters by EV; all cost the same.

        Raises:
            OptionError: no painters.
        """
        if not painters:
            raise OptionError("painters", {}, "one painter per EV")
        self._painters = dict(painters)
        self.seconds = dict.fromkeys(painters, 0.0)

    def paint(self, request: PaintRequest, observer: Observer) -> PaintResult:
        """Paint with the painter of the request's exposure.

        Raises:
            OptionError: an EV without a painter.
        """
        if request.ev not in self._painters:
            raise OptionError("ev", request.ev, ", ".join(f"{ev:g}" for ev in self._painters))
        started = perf_counter()
        try:
            return self._painters[request.ev].paint(request, observer)
        finally:
            self.seconds[request.ev] += perf_counter() - started

    def evaluations(self, balls: int, steps: int, strength: float, until: float = 1.0) -> int:
        """Denoiser evaluations that painting so many balls takes, exactly."""
        return next(iter(self._painters.values())).evaluations(balls, steps, strength, until)
