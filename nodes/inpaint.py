"""ChromeBallInpaint and IterativeMedian: balls painted into the photograph.

Both run once per exposure: connect the lists of EVPromptInterp.
"""

from __future__ import annotations

from dataclasses import fields
from time import perf_counter
from typing import Any, Final

import torch
from comfy_api.latest import io

from ..dl_core.ball import Ball, paste_ball, require_canvas
from ..dl_core.depth import DepthModel
from ..dl_core.errors import ImageError
from ..dl_core.finished import FinishedBalls
from ..dl_core.iterative import IterativeResult, Rounds, iterative_inpaint, rounds_evaluations
from ..dl_core.painter import IMPUTINGS, PaintRequest
from ..dl_core.presets import PRESETS
from .painter import ComfyPainter, Guidance, Networks
from .progress import BarObserver
from .sampling import SAMPLERS, SCHEDULERS
from .sockets import CATEGORY, BallSocket, DepthModelSocket, as_rgb, named_output

__all__ = ["ChromeBallInpaint", "IterativeMedian"]

CUSTOM: Final = "custom"
"""Preset that leaves the node's own values in force."""

FINISHED: Final = FinishedBalls(256 * 2**20)
"""Balls of the runs before, so that a graph queued again after an interrupt goes on where it was: 256 MiB hold those of
five exposures of the paper's schedule, 61 balls each at 256 pixels."""


def _shared_inputs() -> list[Any]:
    """Sockets of every node that paints."""
    return [
        io.Model.Input("model", tooltip="The denoiser, of SDXL's architecture, with the exposure LoRA loaded."),
        io.Conditioning.Input("positive", tooltip="The ball's prompt at the exposure to paint."),
        io.Conditioning.Input("negative", tooltip="What to move away from: matte, diffuse, flat, dull."),
        io.Vae.Input("vae", tooltip="The autoencoder of the model."),
        io.ControlNet.Input("control_net", tooltip="A depth ControlNet of SDXL's architecture."),
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
        io.Int.Input(
            "seed",
            default=0,
            min=0,
            max=2**53,
            control_after_generate=True,
            tooltip="Of the first ball; the next ones count up. The same seed starts from the same noise at every EV.",
        ),
    ]


def _sampling_inputs() -> list[Any]:
    """How every node that paints samples."""
    return [
        io.Int.Input("steps", default=30, min=1, max=998, tooltip="Denoising steps of a full schedule. The paper: 30."),
        io.Float.Input(
            "cfg",
            default=5.0,
            min=1.0,
            max=30.0,
            step=0.1,
            tooltip="Guidance scale. The paper: 5. At 1 the negative prompt is left out, at half the cost.",
        ),
        io.Combo.Input(
            "sampler",
            options=list(SAMPLERS),
            tooltip="Samplers with one evaluation a step. The last four draw noise at every step (lcm for LCM LoRAs). "
            "The paper: uni_pc.",
        ),
        io.Combo.Input(
            "scheduler",
            options=list(SCHEDULERS),
            tooltip="leading (paper) visits the timesteps of the paper's schedule; the others are ComfyUI's.",
        ),
        io.Float.Input(
            "control_strength",
            default=0.5,
            min=0.0,
            max=2.0,
            step=0.05,
            tooltip="Of the depth ControlNet. The paper: 0.5.",
        ),
        io.Int.Input(
            "batch_size",
            default=0,
            min=0,
            max=64,
            tooltip="Balls painted at once; 0 lets free memory decide. It does not change the balls. Where a batch "
            "does not fit after all, it is halved, and the report says so.",
        ),
        io.Combo.Input(
            "impute",
            options=list(IMPUTINGS),
            default="initial",
            optional=True,
            tooltip="Noise put on the photograph outside the mask at every step. initial: what the ball started from, "
            "as in the authors' code. predicted: what the model just predicted, as in the paper's Algorithm 0.",
        ),
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
    guidance = Guidance(**{field.name: options[field.name] for field in fields(Guidance) if field.name in options})
    return ComfyPainter(networks, guidance, mask=mask, on_balls=observer.preview, finished=FINISHED)


def _request(
    image: torch.Tensor, depth: torch.Tensor, ball: Ball, ev: float, seeds: tuple[int, ...], **schedule: Any
) -> PaintRequest:
    """A request from a node's inputs.

    Raises:
        ImageError: pictures of another size than the ball's canvas, more than one, or not finite.
    """
    pictures = {"image": as_rgb(image, "image"), "depth": as_rgb(depth, "depth")}
    for socket, picture in pictures.items():
        require_canvas(picture, ball)
        if len(picture) != 1:
            raise ImageError(socket, f"holds {len(picture)} pictures; one is accepted")
        if not torch.isfinite(picture).all():
            raise ImageError(socket, "holds NaN or infinite values")
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
                *_sampling_inputs(),
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
                io.Combo.Input(
                    "preset",
                    options=[CUSTOM, *PRESETS],
                    tooltip="A point between speed and accuracy; it replaces balls, rounds, strength, final and steps "
                    "below. custom uses the values below.",
                ),
                io.Int.Input("balls", default=30, min=1, max=1000, tooltip="N, the balls of a median. The paper: 30."),
                io.Int.Input(
                    "rounds",
                    default=2,
                    min=0,
                    max=100,
                    tooltip="k, medians taken. The paper: 2. At 0 one ball is painted, and that is all.",
                ),
                io.Float.Input(
                    "strength",
                    default=0.8,
                    min=0.01,
                    max=1.0,
                    step=0.01,
                    tooltip="Share of the schedule that later rounds and the last ball run. The paper: 0.8.",
                ),
                io.Boolean.Input(
                    "final",
                    default=True,
                    tooltip="Paint one more ball from the last median, as the paper does; otherwise the median itself "
                    "is the answer: cheaper and softer.",
                ),
                *_sampling_inputs(),
                # Last, so that saved workflows keep the order of their widgets.
                DepthModelSocket.Input(
                    "depth_model",
                    optional=True,
                    tooltip="Of Estimate Depth: estimates depth again on every median, as the authors' code does. "
                    "Without one all rounds use depth.",
                ),
            ],
            outputs=[
                named_output(io.Image, "ball", "The answer, cut out, display-encoded."),
                named_output(io.Image, "median", "The last median."),
                named_output(io.Image, "spread", "How far the last round's balls lie from it: their median deviation."),
                named_output(io.Image, "composite", "The canvas image with the answer pasted in."),
                named_output(io.String, "report", "What was run and what it cost."),
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
        **options: Any,
    ) -> io.NodeOutput:
        """Run Algorithm 1."""
        schedule = Rounds(balls, rounds, strength, steps, final) if preset == CUSTOM else PRESETS[preset].rounds
        request = _request(image, depth, ball, ev, (seed,))
        observer = BarObserver()
        painter = _painter(observer, ball, mask, options)
        observer.expect(rounds_evaluations(painter, schedule))
        started = perf_counter()
        result = iterative_inpaint(painter, request, schedule, observer, depth_of=depth_model)
        report = _report(request, schedule, result, perf_counter() - started)
        composite = paste_ball(request.canvas, result.ball, ball)
        return io.NodeOutput(result.ball, result.median, result.spread, composite, report)


def _report(request: PaintRequest, schedule: Rounds, result: IterativeResult, seconds: float) -> str:
    """What was run at an exposure, what it cost, how far its balls agree; one line, and one for each note."""
    line = (
        f"EV {request.ev:g}: {schedule.balls} balls, {schedule.rounds} rounds, {schedule.steps} steps, "
        f"strength {schedule.strength:g}, seed {request.seeds[0]}; {result.evaluations} denoiser evaluations "
        f"in {seconds:.1f} s; mean spread {float(result.spread.mean()):.3f}"
    )
    return "\n".join((line, *(f"EV {request.ev:g}: {note}" for note in result.notes)))
