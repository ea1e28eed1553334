"""Placing, masking, pasting: positions to the pixel, against counts and areas worked out by hand."""

from __future__ import annotations

import math

import pytest
import torch
from hypothesis import given
from hypothesis import strategies as st
from tolerances import assert_close

from dl_core.ball import (
    Ball,
    crop_ball,
    disc_mask,
    fit_canvas,
    paint_depth,
    paste_ball,
    paste_on_photograph,
    photograph_disc,
    photograph_frame,
    place_ball,
    require_canvas,
    unfit_canvas,
)
from dl_core.errors import ImageError, OptionError


def test_the_papers_ball_sits_in_the_middle() -> None:
    ball = place_ball(1024, 256)
    assert ball == Ball(left=384, top=384, diameter=256, canvas=1024, dilation=10)
    assert ball.centre == (512.0, 512.0)


@given(st.integers(16, 128), st.floats(0, 1), st.floats(0, 1))
def test_any_place_that_fits_is_kept_to_half_a_pixel(diameter: int, across: float, down: float) -> None:
    room = 128 - diameter
    x, y = diameter / 2 + across * room, diameter / 2 + down * room
    ball = place_ball(128, diameter, x=x, y=y)
    assert 0 <= ball.left <= room
    assert 0 <= ball.top <= room
    assert ball.centre == pytest.approx((x, y), abs=0.5)


@pytest.mark.parametrize(
    ("options", "name"),
    [
        ({"canvas": 60}, "canvas"),
        ({"canvas": 100}, "canvas"),
        ({"diameter": 8}, "diameter"),
        ({"diameter": 200}, "diameter"),
        ({"x": 10.0}, "x"),
        ({"x": 125.0}, "x"),
        ({"y": -3.0}, "y"),
        ({"y": math.nan}, "y"),
        ({"x": math.inf}, "x"),
        ({"dilation": -1}, "dilation"),
        ({"dilation": 65}, "dilation"),
    ],
)
def test_a_ball_that_does_not_fit_is_named(options: dict[str, float], name: str) -> None:
    with pytest.raises(OptionError) as raised:
        place_ball(**({"canvas": 128, "diameter": 32} | options))  # type: ignore[arg-type]
    assert raised.value.name == name


@pytest.mark.parametrize(("diameter", "x"), [(32, None), (33, 40.5), (16, 100.0)])
def test_the_mask_is_a_disc(diameter: int, x: float | None) -> None:
    ball = place_ball(128, diameter, x=x)
    mask = disc_mask(ball)[0]
    assert set(mask.unique().tolist()) == {0.0, 1.0}
    # Gauss's circle problem: the count differs from the area by less than the perimeter.
    assert float(mask.sum()) == pytest.approx(math.pi * diameter**2 / 4, abs=math.pi * diameter / 4)
    rows, columns = torch.nonzero(mask, as_tuple=True)
    assert (float(columns.float().mean()) + 0.5, float(rows.float().mean()) + 0.5) == pytest.approx(ball.centre)
    assert int(columns.min()) == ball.left
    assert int(columns.max()) == ball.left + diameter - 1


def test_growing_the_mask_adds_pixels_on_every_side() -> None:
    ball = place_ball(128, 32, dilation=5)
    grown = disc_mask(ball, grow=ball.dilation)[0]
    columns = torch.nonzero(grown.any(dim=0)).squeeze(1)
    assert (int(columns.min()), int(columns.max())) == (ball.left - 5, ball.left + 32 + 4)
    assert bool((grown >= disc_mask(ball)[0]).all())


@pytest.mark.parametrize(("height", "width"), [(64, 64), (60, 90), (90, 60), (1, 1), (1, 300), (300, 1), (3, 2000)])
def test_the_photograph_keeps_its_aspect(height: int, width: int) -> None:
    fitted = fit_canvas(torch.ones(1, height, width, 3), 64)
    assert fitted.shape == (1, 64, 64, 3)
    lit = fitted[0, ..., 0] > 0
    rows, columns = int(lit.any(dim=1).sum()), int(lit.any(dim=0).sum())
    scale = 64 / max(height, width)
    assert (rows, columns) == (max(1, round(height * scale)), max(1, round(width * scale)))
    assert_close(fitted[0][lit], 1.0)
    # Bars of equal width, to a pixel.
    assert abs(int(lit.any(dim=1).int().argmax()) - (64 - rows) / 2) <= 0.5
    assert abs(int(lit.any(dim=0).int().argmax()) - (64 - columns) / 2) <= 0.5


def test_a_photograph_of_the_canvas_size_is_left_alone(generator: torch.Generator) -> None:
    photo = torch.rand(2, 64, 64, 3, generator=generator)
    assert_close(fit_canvas(photo, 64), photo)


def test_fitting_keeps_a_ramp_a_ramp() -> None:
    ramp = ((torch.arange(128) + 0.5) / 128).expand(1, 128, -1)[..., None].expand(-1, -1, -1, 3)
    fitted = fit_canvas(ramp, 64)
    expected = (torch.arange(64) + 0.5) / 64
    # Lanczos reproduces linear functions inside; within its 6 source pixels of an edge the window is cut.
    assert_close(fitted[0, 32, 4:-4, 0], expected[4:-4], dtype=torch.float16)


def test_an_empty_photograph_is_refused() -> None:
    with pytest.raises(ImageError, match="empty"):
        fit_canvas(torch.ones(1, 0, 4, 3), 64)


def test_depth_paints_the_ball_nearest() -> None:
    ball = place_ball(64, 16, x=20, y=40)
    far_left = torch.linspace(0.2, 0.4, 64).expand(1, 64, -1)[..., None]
    control = paint_depth(far_left, ball)
    disc = disc_mask(ball)[0] == 1
    assert control.shape == (1, 64, 64, 3)
    assert_close(control[0][disc], 1.0)
    # The rest is stretched to the full range.
    assert float(control[0, 0, 0, 0]) == pytest.approx(0, abs=1e-6)
    assert float(control[0, 0, -1, 0]) == pytest.approx(1, abs=1e-6)
    assert_close(control[..., 0], control[..., 2])


def test_the_authors_depth_disc_is_a_pixel_wider_to_the_right_and_below() -> None:
    """Their code: 257 pixels across around pixel 512 for the ball of 256 that begins at pixel 384."""
    ball = place_ball(1024, 256, depth_disc="authors")
    disc = paint_depth(None, ball)[0, :, :, 0] == 1
    for lines in (disc.any(dim=0), disc.any(dim=1)):
        assert lines.nonzero().flatten().tolist() == list(range(384, 641))
    assert torch.equal(disc[384:641, 384:641], disc[384:641, 384:641].flip(0, 1))
    assert int(disc.sum()) > int(disc_mask(ball).sum())


def test_unknown_depth_disc_is_refused() -> None:
    with pytest.raises(OptionError, match="depth_disc is 'mine'; accepted: ball, authors"):
        place_ball(64, 16, depth_disc="mine")


def test_without_depth_the_scene_is_far() -> None:
    ball = place_ball(64, 16)
    assert_close(paint_depth(None, ball)[..., 0], disc_mask(ball))


def test_flat_depth_is_far_not_nan() -> None:
    control = paint_depth(torch.full((1, 8, 8, 1), 3.0), place_ball(64, 16))
    assert_close(control[0, 0], 0.0)


def test_depth_that_is_not_finite_is_refused() -> None:
    with pytest.raises(ImageError, match="depth"):
        paint_depth(torch.full((1, 8, 8, 1), math.nan), place_ball(64, 16))


def test_paste_touches_the_disc_and_nothing_else(generator: torch.Generator) -> None:
    ball = place_ball(64, 16, x=20, y=40)
    photo, painted = torch.rand(2, 64, 64, 3, generator=generator), torch.rand(1, 16, 16, 3, generator=generator)
    before = photo.clone()
    result = paste_ball(photo, painted, ball)
    assert torch.equal(photo, before)
    disc = disc_mask(ball)[0] == 1
    assert torch.equal(result[:, ~disc], photo[:, ~disc])
    inside = crop_ball(disc_mask(ball)[..., None], ball)[0, ..., 0] == 1
    assert torch.equal(crop_ball(result, ball)[:, inside], painted.expand(2, -1, -1, -1)[:, inside])


def test_pasting_a_crop_back_changes_nothing(generator: torch.Generator) -> None:
    ball = place_ball(64, 24, x=30)
    photo = torch.rand(1, 64, 64, 3, generator=generator)
    assert torch.equal(paste_ball(photo, crop_ball(photo, ball), ball), photo)


def test_another_canvas_is_refused_with_both_sizes() -> None:
    with pytest.raises(ImageError, match=r"40 x 48.*64 x 64"):
        require_canvas(torch.ones(1, 48, 40, 3), place_ball(64, 16))
    with pytest.raises(ImageError, match="holds no picture"):
        require_canvas(torch.ones(0, 64, 64, 3), place_ball(64, 16))


# --- from the canvas back to the photograph ----------------------------------------------------------------------

sides = st.integers(1, 300)


@given(sides, sides)
def test_fitting_is_undone_for_any_size(height: int, width: int) -> None:
    """A flat photograph comes back flat: no bar bleeds into it, at any size and aspect."""
    photo = torch.tensor([0.25, 0.5, 0.75]).expand(1, height, width, 3)
    again = unfit_canvas(fit_canvas(photo, 64), height, width)
    assert again.shape == photo.shape
    assert_close(again, photo)


def test_a_photograph_of_the_canvas_size_is_not_resampled() -> None:
    photo = torch.rand(2, 40, 64, 3, generator=torch.Generator().manual_seed(0))
    canvas = fit_canvas(photo, 64)
    assert torch.equal(canvas[:, 12:52], photo)
    assert torch.equal(unfit_canvas(canvas, 40, 64), photo)


@pytest.mark.parametrize(("height", "width"), [(60, 96), (96, 60), (150, 240), (37, 240)])
def test_a_smooth_photograph_comes_back(height: int, width: int) -> None:
    """A wave of one period over the picture lies far below what the canvas of 128 pixels can carry."""
    rows, columns = torch.linspace(0, 2 * math.pi, height), torch.linspace(0, 2 * math.pi, width)
    wave = 0.5 + 0.2 * rows.sin()[:, None] + 0.2 * columns.cos()[None, :]
    photo = wave[None, ..., None].expand(-1, -1, -1, 3)
    again = unfit_canvas(fit_canvas(photo, 128), height, width)
    # At the border, three pixels of the canvas wide, a filter of six samples lacks some. Within, it does better than
    # lines between the canvas pixels would, of which the narrowest picture has 20: at most f'' / 8 away from the wave.
    border = math.ceil(3 * max(height, width) / 128)
    inner = (slice(None), slice(border, -border), slice(border, -border))
    assert (again - photo)[inner].abs().max() < 0.2 * (2 * math.pi / 20) ** 2 / 8


@pytest.mark.parametrize(("height", "width"), [(480, 640), (1000, 300), (256, 256), (100, 100)])
def test_the_disc_on_the_photograph_is_the_ball_at_its_scale(height: int, width: int) -> None:
    ball = place_ball(256, 48, x=130, y=120)
    disc, scale = photograph_disc(ball, height, width)[0], max(height, width) / 256
    area, perimeter = math.pi * (24 * scale) ** 2, 2 * math.pi * 24 * scale
    # A ramp across the edge leaves an error of order 1 / 12 a pixel of the perimeter; rounding of the frame's sides to
    # whole canvas pixels another half pixel of 76, the narrowest, in one direction.
    assert float(disc.sum()) == pytest.approx(area, abs=perimeter / 12 + area * 0.5 / 76)
    frame = photograph_frame(height, width, 256)
    centre = [
        float((disc.sum(dim=1 - axis) * (torch.arange(side) + 0.5)).sum() / disc.sum())
        for axis, side in enumerate((height, width))
    ]
    wanted = [(120 - frame.top) * height / frame.height, (130 - frame.left) * width / frame.width]
    assert centre == pytest.approx(wanted, abs=0.05)


def test_only_the_ball_comes_from_the_canvas() -> None:
    photo = torch.rand(1, 90, 160, 3, generator=torch.Generator().manual_seed(0))
    ball = place_ball(64, 20, x=40, y=30)
    red = torch.tensor([1.0, 0.0, 0.0])
    composite = paste_ball(fit_canvas(photo, 64), red.expand(1, 20, 20, 3), ball)
    pasted = paste_on_photograph(photo, composite.expand(2, -1, -1, -1), ball)
    disc = photograph_disc(ball, 90, 160)[0]
    assert pasted.shape == (2, 90, 160, 3)
    assert torch.equal(pasted[:, disc == 0], photo.expand(2, -1, -1, -1)[:, disc == 0])
    # Lanczos reaches three pixels of the canvas inwards from the hard disc, whose steps are up to 1.5 within the edge.
    rows, columns = torch.meshgrid(torch.arange(90) + 0.5, torch.arange(160) + 0.5, indexing="ij")
    deep = torch.hypot(columns - 40 * 2.5, rows - (30 - 14) * 2.5) < 25 - 4.5 * 2.5
    assert deep.sum() > 500
    assert_close(pasted[0, deep], red.expand(int(deep.sum()), 3))


def test_a_ball_on_the_bars_is_cut_off() -> None:
    """A canvas of 128 shows a photograph of half the height in its middle; the ball stands on its lower border."""
    ball = place_ball(128, 32, y=96)
    assert float(photograph_disc(ball, 64, 128).sum()) == pytest.approx(math.pi * 16**2 / 2, rel=0.02)


def test_a_canvas_that_is_not_the_balls_is_refused() -> None:
    photo = torch.rand(1, 8, 8, 3)
    with pytest.raises(ImageError, match=r"is 64 x 64 pixels.*128 x 128"):
        paste_on_photograph(photo, torch.rand(1, 64, 64, 3), place_ball(128, 32))
    with pytest.raises(ImageError, match=r"canvas: is 32 x 64 pixels; a square"):
        unfit_canvas(torch.rand(1, 64, 32, 3), 8, 8)
    with pytest.raises(ImageError, match=r"is empty \(0 x 4\)"):
        unfit_canvas(torch.rand(1, 64, 64, 3), 4, 0)
