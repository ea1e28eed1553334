"""Where the ball sits on the canvas: fitting the photograph, masks, the depth disc, crop and paste.

Canvas coordinates are continuous, in pixels from the top-left corner: the centre of the first pixel is (0.5, 0.5).

Source: DiffusionLight, Sec. 4 ("we paint a circle both at the depth map's center with the distance closest to the
camera (visualized as white) and in an inpaint mask").
"""

from __future__ import annotations

import math
from dataclasses import dataclass, replace
from typing import Final

import numpy as np
import torch
from jaxtyping import Float
from PIL import Image as PILImage
from torch import Tensor

from .errors import ImageError, OptionError
from .shapes import BallImage, Image, Mask

__all__ = [
    "DEPTH_DISCS",
    "Ball",
    "Frame",
    "crop_ball",
    "crop_disc",
    "disc_mask",
    "fit_canvas",
    "inscribed_disc",
    "paint_depth",
    "paste_ball",
    "paste_on_photograph",
    "photograph_disc",
    "photograph_frame",
    "place_ball",
    "require_canvas",
    "unfit_canvas",
]


DEPTH_DISCS: Final[dict[str, float]] = {"ball": 0.0, "authors": 0.5}
"""How far the disc on the depth map departs from the ball, pixels: its radius grows and its centre moves right and down
by as much. `ball` is the ball itself; the authors' code draws a disc of 257 pixels for a ball of 256, with one row and
one column more at the right and below."""


@dataclass(frozen=True)
class Ball:
    """A ball of whole-pixel size on a canvas.

    Attributes:
        left: column of the first pixel of its bounding square.
        top: row of the first pixel of its bounding square.
        diameter: side of that square, pixels.
        canvas: side of the square canvas, pixels.
        dilation: how far the inpaint disc reaches past the ball on each side, pixels (paper's code: 10 of 1024).
        depth_disc: of `DEPTH_DISCS`, what the depth map shows of the ball.
    """

    left: int
    top: int
    diameter: int
    canvas: int
    dilation: int
    depth_disc: str = "ball"

    @property
    def centre(self) -> tuple[float, float]:
        """(x, y) of the centre in canvas coordinates."""
        return self.left + self.diameter / 2, self.top + self.diameter / 2

    def enlarged(self, factor: int) -> Ball:
        """The same ball on a canvas so many times as large."""
        lengths = ("left", "top", "diameter", "canvas", "dilation")
        return replace(self, **{name: factor * getattr(self, name) for name in lengths})


def place_ball(
    canvas: int,
    diameter: int,
    *,
    x: float | None = None,
    y: float | None = None,
    dilation: int | None = None,
    depth_disc: str = "ball",
) -> Ball:
    """Place a ball on a square canvas.

    Args:
        canvas: side of the canvas in pixels, a multiple of 8.
        diameter: of the ball in pixels, at least 16.
        x: column of the centre in canvas coordinates; the middle when not given. Rounded to a whole-pixel square.
        y: row of the centre; the middle when not given.
        dilation: pixels the inpaint disc reaches past the ball; the paper's 10 per 1024 pixels when not given.
        depth_disc: of `DEPTH_DISCS`, what the depth map shows of the ball.

    Raises:
        OptionError: the canvas is not a multiple of 8, the ball does not fit on it, or no such disc.
    """
    if canvas < 64 or canvas % 8:
        raise OptionError("canvas", canvas, "a multiple of 8, at least 64 pixels")
    if not 16 <= diameter <= canvas:
        raise OptionError("diameter", diameter, f"16 to {canvas} pixels, the side of the canvas")
    left = _first_pixel("x", x, canvas, diameter)
    top = _first_pixel("y", y, canvas, diameter)
    if dilation is None:
        dilation = max(1, round(canvas * 10 / 1024))
    if not 0 <= dilation <= canvas // 2:
        raise OptionError("dilation", dilation, f"0 to {canvas // 2} pixels")
    if depth_disc not in DEPTH_DISCS:
        raise OptionError("depth_disc", depth_disc, ", ".join(DEPTH_DISCS))
    return Ball(left, top, diameter, canvas, dilation, depth_disc)


def _first_pixel(name: str, centre: float | None, canvas: int, diameter: int) -> int:
    """First row or column of a ball's square whose centre is asked for, nearest whole pixel."""
    start = (canvas / 2 if centre is None else centre) - diameter / 2
    if not math.isfinite(start) or not 0 <= round(start) <= canvas - diameter:
        accepted = f"{diameter / 2:g} to {canvas - diameter / 2:g}, so that the ball is on the canvas"
        raise OptionError(name, centre, accepted)
    return round(start)


@dataclass(frozen=True)
class Frame:
    """Where a photograph lies on its canvas; the rest is black bars.

    Attributes:
        left: column of its first pixel.
        top: row of its first pixel.
        width: pixels of the canvas it covers.
        height: pixels of the canvas it covers.
    """

    left: int
    top: int
    width: int
    height: int

    def cut(self, canvas_image: Image) -> Float[Tensor, "b rows columns c"]:
        """The photograph's part of (B, canvas, canvas, C), as a view."""
        return canvas_image[:, self.top : self.top + self.height, self.left : self.left + self.width]


def photograph_frame(height: int, width: int, canvas: int) -> Frame:
    """Where `fit_canvas` puts a photograph of a size: as large as fits, in the middle.

    Raises:
        ImageError: an empty photograph.
    """
    if height < 1 or width < 1:
        raise ImageError("image", f"is empty ({width} x {height})")
    scale = canvas / max(height, width)
    fitted_height, fitted_width = (max(1, round(side * scale)) for side in (height, width))
    return Frame((canvas - fitted_width) // 2, (canvas - fitted_height) // 2, fitted_width, fitted_height)


def fit_canvas(image_ldr: Image, canvas: int) -> Float[Tensor, "b side side c"]:
    """Fit a photograph into a square canvas, keeping its aspect, with black bars (Lanczos, as the authors' code).

    Args:
        image_ldr: (B, H, W, 3) display-encoded in [0, 1].
        canvas: side of the canvas in pixels.

    Returns:
        (B, canvas, canvas, 3) in [0, 1].

    Raises:
        ImageError: an empty picture.
    """
    height, width = image_ldr.shape[1:3]
    frame = photograph_frame(height, width, canvas)
    result = torch.zeros(image_ldr.shape[0], canvas, canvas, image_ldr.shape[3])
    frame.cut(result).copy_(_lanczos(image_ldr, frame.height, frame.width).clamp(0, 1))
    return result.to(image_ldr.device)


def unfit_canvas(canvas_image: Image, height: int, width: int) -> Float[Tensor, "b height width c"]:
    """Undo `fit_canvas`: cut a photograph out of its canvas and give it its own size again (Lanczos).

    Args:
        canvas_image: (B, canvas, canvas, C) in [0, 1].
        height: of the photograph in pixels.
        width: of the photograph in pixels.

    Returns:
        (B, height, width, C) in [0, 1]. What the canvas had fewer pixels for stays lost; `paste_on_photograph` takes it
        from the photograph.

    Raises:
        ImageError: a canvas that is not square, or an empty photograph.
    """
    if canvas_image.shape[1] != canvas_image.shape[2]:
        raise ImageError("canvas", f"is {canvas_image.shape[2]} x {canvas_image.shape[1]} pixels; a square is accepted")
    frame = photograph_frame(height, width, canvas_image.shape[1])
    return _lanczos(frame.cut(canvas_image), height, width).clamp(0, 1).to(canvas_image.device)


def _lanczos(image: Image, height: int, width: int) -> Float[Tensor, "b rows columns c"]:
    """Resize in float: Pillow resamples one plane of 32-bit values at a time."""
    planes = image.permute(0, 3, 1, 2).detach().cpu().float().numpy()
    resized = [
        [np.asarray(PILImage.fromarray(plane).resize((width, height), PILImage.Resampling.LANCZOS)) for plane in item]
        for item in planes
    ]
    return torch.from_numpy(np.array(resized)).permute(0, 2, 3, 1)


def disc_mask(ball: Ball, *, grow: float = 0.0, shift: float = 0.0) -> Mask:
    """Hard disc on the canvas: 1 where a pixel's centre lies within the ball's radius plus `grow` pixels.

    Args:
        ball: where it sits.
        grow: pixels added to its radius.
        shift: pixels that the disc's centre lies right of and below the ball's.

    Returns:
        (1, canvas, canvas).
    """
    x, y = ball.centre
    positions = torch.arange(ball.canvas) + 0.5 - shift
    squared = (positions[None, :] - x) ** 2 + (positions[:, None] - y) ** 2
    return (squared <= (ball.diameter / 2 + grow) ** 2).float()[None]


def paint_depth(depth: Image | None, ball: Ball) -> Float[Tensor, "b side side 3"]:
    """Paint the ball nearest (white) on a depth map for a depth ControlNet.

    Args:
        depth: (B, H, W, 1 or 3), near is bright; it is fitted to the canvas and stretched to [0, 1] as the authors'
            code does. Without one the scene is taken as far away (black).
        ball: where the ball goes, and which disc stands for it.

    Returns:
        (B, canvas, canvas, 3) in [0, 1].

    Raises:
        ImageError: depth that is not finite.
    """
    if depth is None:
        fitted = torch.zeros(1, ball.canvas, ball.canvas, 1)
    else:
        if not torch.isfinite(depth).all():
            raise ImageError("depth", "holds NaN or infinite values")
        plane = depth.float().mean(dim=-1, keepdim=True)
        low, high = plane.amin(dim=(1, 2, 3), keepdim=True), plane.amax(dim=(1, 2, 3), keepdim=True)
        fitted = fit_canvas((plane - low) / (high - low).clamp(min=1e-8), ball.canvas)
    departs = DEPTH_DISCS[ball.depth_disc]
    disc = disc_mask(ball, grow=departs, shift=departs)[..., None].to(fitted)
    return (fitted * (1 - disc) + disc).expand(-1, -1, -1, 3).contiguous()


def crop_ball(image: Image, ball: Ball) -> BallImage:
    """Cut the ball's bounding square out of canvas images: (B, canvas, canvas, C) -> (B, diameter, diameter, C)."""
    return image[:, ball.top : ball.top + ball.diameter, ball.left : ball.left + ball.diameter]


def crop_disc(ball: Ball) -> Float[Tensor, "d d"]:
    """The ball's disc in its crop: (diameter, diameter), 1 where a pixel's centre lies on the ball, 0 outside."""
    return inscribed_disc(ball.diameter)


def inscribed_disc(diameter: int) -> Float[Tensor, "d d"]:
    """The disc of a ball that fills a square picture: (diameter, diameter), as `crop_disc` of any ball so large."""
    return disc_mask(Ball(0, 0, diameter, diameter, dilation=0))[0]


def paste_ball(image: Image, crop: Float[Tensor, "n d d c"], ball: Ball) -> Image:
    """Paste a ball crop on canvas images through the hard disc (paper, Algorithm 1, line 12).

    Args:
        image: (B, canvas, canvas, C).
        crop: (B or 1, diameter, diameter, C).
        ball: where it goes.

    Returns:
        A new (B, canvas, canvas, C); the input is left as it was.
    """
    disc = crop_disc(ball)[None, ..., None].to(image)
    result = image.clone()
    window = crop_ball(result, ball)
    window.copy_(window * (1 - disc) + crop.to(image) * disc)
    return result


def photograph_disc(ball: Ball, height: int, width: int) -> Mask:
    """The ball's disc in the frame of the photograph that was fitted on its canvas.

    Args:
        ball: on the canvas; what of it lies on the bars is cut off.
        height: of the photograph in pixels.
        width: of the photograph in pixels.

    Returns:
        (1, height, width): 1 inside, 0 outside, and a ramp one pixel of the photograph wide across the edge.

    Raises:
        ImageError: an empty photograph.
    """
    frame = photograph_frame(height, width, ball.canvas)
    x, y = ball.centre
    # In pixels of the photograph: rounding to whole pixels of the canvas scales rows and columns a little apart.
    across, down = width / frame.width, height / frame.height
    columns = (torch.arange(width) + 0.5) / across + frame.left - x
    rows = (torch.arange(height) + 0.5) / down + frame.top - y
    inside = ball.diameter / 2 - torch.hypot(columns[None, :], rows[:, None])
    return (inside * math.sqrt(across * down) + 0.5).clamp(0, 1)[None]


def paste_on_photograph(
    photo: Image, canvas_image: Float[Tensor, "n side side c"], ball: Ball
) -> Float[Tensor, "m h w c"]:
    """Paste the ball of a canvas image on the photograph, at the photograph's own size.

    Args:
        photo: (1 or B, H, W, C) in [0, 1], as it was before `fit_canvas`.
        canvas_image: (B or 1, canvas, canvas, C) in [0, 1] that shows the ball.
        ball: where it sits on the canvas.

    Returns:
        (B, H, W, C). Outside the ball's disc every pixel is the photograph's own.

    Raises:
        ImageError: a canvas of another size than the ball's, or an empty photograph.
    """
    height, width = photo.shape[1:3]
    framed = unfit_canvas(require_canvas(canvas_image, ball), height, width).to(photo)
    return torch.lerp(photo, framed, photograph_disc(ball, height, width)[..., None].to(photo))


def require_canvas(image: Image, ball: Ball) -> Float[Tensor, "b h w c"]:
    """The image, if it is a square canvas of the ball's size.

    Raises:
        ImageError: another size, or no picture.
    """
    if not len(image):
        raise ImageError("image", "holds no picture; one or more are accepted")
    if image.shape[1:3] != (ball.canvas, ball.canvas):
        raise ImageError(
            "image",
            f"is {image.shape[2]} x {image.shape[1]} pixels, the ball was placed on {ball.canvas} x {ball.canvas}; "
            "connect the canvas image that came with the ball",
        )
    return image
