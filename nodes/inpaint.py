"""ChromeBallInpaint and IterativeMedian: balls painted into the photograph.

Both run once per exposure: connect the lists of EVPromptInterp.
"""

from __future__ import annotations

from dataclasses import fields
from time import perf_counter
from typing import Any

import torch
from comfy_api.latest import io

from ..dl_core.ball import Ball, paste_ball, require_canvas
from ..dl_core.depth import DepthModel
from ..dl_core.errors import ImageError
from ..dl_core.iterative import Rounds, iterative_inpaint, rounds_evaluations
from ..dl_core.painter import PaintRequest
from .doubts import doubts
from .painter import ComfyPainter, Networks
from .painting import (
    CUSTOM,
    comfy_painter,
    depth_model_input,
    exposure_lines,
    guidance_of,
    light_balls_input,
    model_input,
    network_inputs,
    one_picture,
    reject_input,
    rounds_inputs,
    rounds_of,
    sampling_inputs,
    seed_input,
    settling_inputs,
)
from .progress import BarObserver
from .sockets import CATEGORY, BallSocket, named_output

__all__ = ["ChromeBallInpaint", "IterativeMedian"]


def _shared_inputs() -> list[Any]:
    """Sockets of every node that paints."""
    return [
        model_input(),
        io.Conditioning.Input("positive", tooltip="The ball's prompt at the exposure to paint."),
        io.Conditioning.Input("negative", tooltip="What to move away from: matte, diffuse, flat, dull."),
        *network_inputs(),
        io.Image.Input("image", tooltip="The canvas image of Depth Ball Mask."),
        io.Image.Input("depth", tooltip="The control depth of Depth Ball Mask."),
        BallSocket.Input("ball", tooltip="Where the ball sits."),
        io.Mask.Input(
            "mask", optional=True, tooltip="Where to paint; without one the ball's disc, grown by its dilation."
        ),
        io.Float.Input(
            "ev",
            optional=True,
            force_input=True,
            tooltip="The exposure value, for the report; it changes nothing else.",
        ),
        seed_input(),
    ]


def _painter(observer: BarObserver, ball: Ball, mask: torch.Tensor | None, options: dict[str, Any]) -> ComfyPainter:
    """The painter of a node's inputs, showing its balls on the observer's bar.

    Raises:
        ImageError: a mask of another size than the canvas.
        ModelError: a model of another architecture; the socket is named.
    """
    if mask is not None and mask.shape[-2:] != (ball.canvas, ball.canvas):
        raise ImageError("mask", f"has shape {tuple(mask.shape)}; the ball's canvas is {ball.canvas} x {ball.canvas}")
    networks = Networks(**{field.name: options[field.name] for field in fields(Networks)})
    return comfy_painter(observer, networks, guidance_of(options), mask)


def _request(
    image: torch.Tensor, depth: torch.Tensor, ball: Ball, ev: float, seeds: tuple[int, ...], **schedule: Any
) -> PaintRequest:
    """A request from a node's inputs.

    Raises:
        ImageError: pictures of another size than the ball's canvas, more than one, or not finite.
    """
    pictures = {"image": one_picture(image, "image"), "depth": one_picture(depth, "depth")}
    for picture in pictures.values():
        require_canvas(picture, ball)
    return PaintRequest(pictures["image"], pictures["depth"], ball, ev, seeds, **schedule)


class ChromeBallInpaint(io.ComfyNode):  # type: ignore[misc]
    """Paints balls once."""

    @classmethod
    def define_schema(cls) -> io.Schema:
        """Sockets of the node."""
        return io.Schema(
            node_id="ChromeBallInpaint",
            display_name="Chrome Ball Inpaint",
            category=CATEGORY,
            description="Paints chrome balls into the photograph, each from the noise of its own seed. One ball is the "
            "paper's base model; several show how far noise decides what a ball looks like.",
            inputs=[
                *_shared_inputs(),
                io.Int.Input("count", default=1, min=1, max=1000, tooltip="Balls to paint, with seeds counting up."),
                io.Float.Input(
                    "strength",
                    default=1.0,
                    min=0.01,
                    max=1.0,
                    step=0.01,
                    tooltip="1 paints from pure noise; below, from the noised image: 0.8 runs the last 24 of 30 steps.",
                ),
                *sampling_inputs(),
            ],
            outputs=[
                named_output(io.Image, "balls", "The balls, cut out, display-encoded, in the order of their seeds."),
                named_output(io.Image, "composite", "The canvas image with each ball pasted in."),
                named_output(io.Int, "evaluations", "Evaluations of the denoiser that this took."),
            ],
        )

    @classmethod
    def execute(
        cls,
        image: torch.Tensor,
        depth: torch.Tensor,
        ball: Ball,
        seed: int,
        count: int,
        strength: float,
        steps: int,
        mask: torch.Tensor | None = None,
        ev: float = 0.0,
        **options: Any,
    ) -> io.NodeOutput:
        """Paint the balls and paste them."""
        request = _request(image, depth, ball, ev, tuple(range(seed, seed + count)), strength=strength, steps=steps)
        observer = BarObserver()
        painter = _painter(observer, ball, mask, options)
        observer.expect(painter.evaluations(count, steps, strength))
        result = painter.paint(request, observer)
        composite = paste_ball(request.canvas.expand(count, -1, -1, -1), result.balls, ball)
        return io.NodeOutput(result.balls, composite, result.evaluations)


class IterativeMedian(io.ComfyNode):  # type: ignore[misc]
    """Iterative inpainting: balls, their median, and again from there."""

    @classmethod
    def define_schema(cls) -> io.Schema:
        """Sockets of the node."""
        return io.Schema(
            node_id="IterativeMedian",
            display_name="Iterative Median",
            category=CATEGORY,
            description="Paints many balls, takes their pixelwise median, pastes it into the photograph and paints "
            "again from there. The median keeps what the scene decides of the ball and drops what the noise decides.",
            inputs=[
                *_shared_inputs(),
                *rounds_inputs(CUSTOM),
                *sampling_inputs(),
                # Last, so that saved workflows keep the order of their widgets.
                depth_model_input("Without one all rounds use depth."),
                *settling_inputs(),
                reject_input(),
                light_balls_input(),
            ],
            hidden=[io.Hidden.prompt, io.Hidden.unique_id],
            outputs=[
                named_output(io.Image, "ball", "The answer, cut out, display-encoded."),
                named_output(io.Image, "median", "The last median."),
                named_output(io.Image, "spread", "How far the last round's balls lie from it: their median deviation."),
                named_output(io.Image, "composite", "The canvas image with the answer pasted in."),
                named_output(io.String, "report", "What was run and what it cost."),
                named_output(io.Image, "balls", "The balls of the last median, cut out, for Confidence Map."),
                named_output(
                    io.Image, "light_balls", "Balls painted to the end, for HDR Merge; without any the answer itself."
                ),
            ],
        )

    @classmethod
    def execute(
        cls,
        image: torch.Tensor,
        depth: torch.Tensor,
        ball: Ball,
        seed: int,
        preset: str,
        balls: int,
        rounds: int,
        strength: float,
        final: bool,
        steps: int,
        mask: torch.Tensor | None = None,
        ev: float = 0.0,
        depth_model: DepthModel | None = None,
        tolerance: float = 0.0,
        min_balls: int = Rounds.min_balls,
        until: float = 1.0,
        reject: bool = False,
        light_balls: int = 0,
        **options: Any,
    ) -> io.NodeOutput:
        """Run Algorithm 1."""
        rest = (tolerance, min_balls, until, reject, light_balls)
        schedule = rounds_of(preset, balls, rounds, strength, final, steps, *rest)
        request = _request(image, depth, ball, ev, (seed,))
        observer = BarObserver()
        painter = _painter(observer, ball, mask, options)
        observer.expect(rounds_evaluations(painter, schedule))
        started = perf_counter()
        result = iterative_inpaint(painter, request, schedule, observer, depth_of=depth_model)
        lines = [exposure_lines(ev, seed, schedule, result, perf_counter() - started)]
        if ev == 0:  # once a bracket
            lines += doubts(cls.hidden, preset, options["model"])
        composite, report = paste_ball(request.canvas, result.ball, ball), "\n".join(lines)
        pictures = (result.ball, result.median, result.spread, composite)
        return io.NodeOutput(*pictures, report, result.balls, result.whole_balls)
