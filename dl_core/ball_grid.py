"""Places for balls in rows and columns, to see how light varies over a scene.

Source: DiffusionLight, Appendix, "Spatially-Varying Light Estimation": nine places, one ball painted at each.
"""

from __future__ import annotations

from dataclasses import dataclass

from .ball import Frame, place_ball
from .errors import OptionError

__all__ = ["GridPlace", "ball_grid"]


@dataclass(frozen=True)
class GridPlace:
    """One place of a grid.

    Attributes:
        row: counted from 1 at the top.
        column: counted from 1 at the left.
        x: column of the ball's centre on the canvas, whole pixels.
        y: row of the ball's centre.
    """

    row: int
    column: int
    x: int
    y: int

    @property
    def name(self) -> str:
        """For file names."""
        return f"row{self.row}_column{self.column}"


def ball_grid(
    canvas: int, diameter: int, rows: int, columns: int, *, margin: int | None = None, frame: Frame | None = None
) -> tuple[GridPlace, ...]:
    """Spread the places of a ball evenly over a canvas, or over the photograph's part of it.

    The outermost balls, grown by the margin, touch the edges; a single row or column lies in the middle. Balls of
    neighbouring places may overlap: each is painted into a photograph of its own.

    Args:
        canvas: side of the canvas in pixels, a multiple of 8.
        diameter: of the ball in pixels.
        rows: of places, 1 or more.
        columns: of places, 1 or more.
        margin: pixels around the ball that have to fit too; how far the inpaint disc reaches past the ball when not
            given.
        frame: where the photograph lies on the canvas (`ball.photograph_frame`); all of the canvas when not given.

    Returns:
        rows x columns places, row by row from the top left.

    Raises:
        OptionError: a canvas or diameter that `ball.place_ball` refuses, a ball that does not fit with its margin, or
            more rows or columns than pixels to tell them apart.
    """
    dilation = place_ball(canvas, diameter).dilation
    margin = dilation if margin is None else margin
    if margin < 0:
        raise OptionError("margin", margin, "0 or more pixels")
    frame = Frame(0, 0, canvas, canvas) if frame is None else frame
    reach = -(-diameter // 2) + margin
    if 2 * reach > min(frame.width, frame.height):
        room = min(frame.width, frame.height) - 2 * margin
        raise OptionError(
            "diameter",
            diameter,
            f"up to {room} pixels, so that a ball and {margin} pixels around it fit into "
            f"{frame.width} x {frame.height} pixels of the canvas",
        )
    across = _spread("columns", columns, frame.left + reach, frame.left + frame.width - reach)
    down = _spread("rows", rows, frame.top + reach, frame.top + frame.height - reach)
    return tuple(GridPlace(i, j, x, y) for i, y in enumerate(down, 1) for j, x in enumerate(across, 1))


def _spread(name: str, count: int, low: int, high: int) -> list[int]:
    """So many different whole numbers from low to high, evenly apart; the middle for one."""
    if not 1 <= count <= high - low + 1:
        raise OptionError(name, count, f"1 to {high - low + 1}, as the ball has {high - low} pixels to move in")
    if count == 1:
        return [(low + high + 1) // 2]
    return [low + (2 * i * (high - low) + count - 1) // (2 * (count - 1)) for i in range(count)]
