"""Places in rows and columns: where they are to the pixel, and that every ball fits."""

from __future__ import annotations

from itertools import pairwise

import pytest
from hypothesis import assume, given
from hypothesis import strategies as st

from dl_core.ball import Frame, photograph_frame, place_ball
from dl_core.ball_grid import ball_grid
from dl_core.errors import OptionError


def test_nine_places_on_the_papers_canvas() -> None:
    """The ball is 256 pixels wide and its disc reaches 10 further: 138 pixels from an edge, and the middle."""
    places = ball_grid(1024, 256, 3, 3)
    assert [(place.x, place.y) for place in places] == [(x, y) for y in (138, 512, 886) for x in (138, 512, 886)]
    assert [place.name for place in places][:4] == ["row1_column1", "row1_column2", "row1_column3", "row2_column1"]
    # The middle one is where a ball goes that nobody places.
    assert place_ball(1024, 256, x=places[4].x, y=places[4].y) == place_ball(1024, 256)


def test_places_keep_off_the_bars_beside_a_photograph() -> None:
    """600 x 400 pixels are 1024 x 683 of the canvas, below a bar of 170."""
    places = ball_grid(1024, 256, 2, 1, frame=photograph_frame(400, 600, 1024))
    assert [(place.x, place.y) for place in places] == [(512, 170 + 138), (512, 853 - 138)]


@given(
    side=st.integers(8, 128),
    diameter=st.integers(16, 300),
    rows=st.integers(1, 7),
    columns=st.integers(1, 7),
    margin=st.none() | st.integers(0, 40),
    photo=st.none() | st.tuples(st.integers(1, 50), st.integers(1, 50)),
)
def test_every_ball_fits_with_its_margin(
    side: int, diameter: int, rows: int, columns: int, margin: int | None, photo: tuple[int, int] | None
) -> None:
    canvas = 8 * side
    assume(diameter <= canvas)
    frame = Frame(0, 0, canvas, canvas) if photo is None else photograph_frame(*photo, canvas)
    around = place_ball(canvas, diameter).dilation if margin is None else margin
    # Twice the radius rounded up: an odd ball has its centre between pixels.
    room = min(frame.width, frame.height) - 2 * (around + -(-diameter // 2))
    assume(room >= max(rows, columns))
    places = ball_grid(canvas, diameter, rows, columns, margin=margin, frame=None if photo is None else frame)
    assert len(set(places)) == len({(place.x, place.y) for place in places}) == rows * columns
    balls = [place_ball(canvas, diameter, x=place.x, y=place.y) for place in places]
    for ball in balls:
        assert ball.left - around >= frame.left
        assert ball.top - around >= frame.top
        assert ball.left + diameter + around <= frame.left + frame.width
        assert ball.top + diameter + around <= frame.top + frame.height
    if rows > 1 and columns > 1:
        # To a pixel they touch the edges, and are evenly apart.
        assert balls[0].left - around <= frame.left + 1
        assert balls[-1].top + diameter + around >= frame.top + frame.height - 1
    for steps in (
        [b.x - a.x for a, b in pairwise(places[:columns])],
        [b.y - a.y for a, b in pairwise(places[::columns])],
    ):
        assert not steps or max(steps) - min(steps) <= 1


@pytest.mark.parametrize(
    ("change", "name", "accepted"),
    [
        ({"canvas": 100}, "canvas", "a multiple of 8, at least 64 pixels"),
        ({"diameter": 8}, "diameter", "16 to 256"),
        ({"diameter": 256}, "diameter", "up to 252 pixels, so that a ball and 2 pixels around it fit into 256 x 256"),
        ({"margin": 97}, "diameter", "up to 62 pixels"),
        ({"margin": -2}, "margin", "0 or more pixels"),
        ({"frame": photograph_frame(1, 4, 256)}, "diameter", "up to 60 pixels.*into 256 x 64 pixels of the canvas"),
        ({"rows": 0}, "rows", "1 to 189"),
        ({"columns": -1}, "columns", "1 to 189"),
        ({"rows": 190}, "rows", "1 to 189, as the ball has 188 pixels to move in"),
    ],
)
def test_a_grid_that_does_not_fit_is_refused(change: dict[str, object], name: str, accepted: str) -> None:
    options = {"canvas": 256, "diameter": 64, "rows": 3, "columns": 3} | change
    with pytest.raises(OptionError, match=accepted) as raised:
        ball_grid(**options)  # type: ignore[arg-type]
    assert raised.value.name == name


def test_the_largest_ball_that_a_refusal_names_fits() -> None:
    (place,) = ball_grid(256, 252, 1, 1)
    assert (place.x, place.y) == (128, 128)
