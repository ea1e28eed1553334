"""What the nodes that paint share: their widgets, their painter, and a report's lines."""

from __future__ import annotations

from dataclasses import fields, replace
from typing import Any, Final

import torch
from comfy_api.latest import io

from ..dl_core.errors import ImageError
from ..dl_core.finished import FinishedBalls
from ..dl_core.iterative import IterativeResult, Rounds, tally_lines
from ..dl_core.painter import IMPUTINGS
from ..dl_core.presets import PRESETS, preset
from ..dl_core.shapes import Image, Mask
from .painter import ComfyPainter, Guidance, Networks
from .progress import BarObserver
from .sampling import SAMPLERS, SCHEDULERS
from .sockets import DepthModelSocket, as_finite_rgb

__all__ = [
    "CUSTOM",
    "FINISHED",
    "comfy_painter",
    "depth_model_input",
    "exposure_lines",
    "guidance_of",
    "model_input",
    "network_inputs",
    "one_picture",
    "reject_input",
    "rounds_inputs",
    "rounds_of",
    "sampling_inputs",
    "seed_input",
    "settling_inputs",
]

CUSTOM: Final = "custom"
"""Preset that leaves the node's own values in force."""

FINISHED: Final = FinishedBalls(256 * 2**20, keys=64)
"""Balls of the runs before, so that a graph queued again after an interrupt goes on where it was: 256 MiB hold those of
five exposures of the paper's schedule, 61 balls each at 256 pixels. Each round of each exposure is a key: 64 hold the
last 21 runs of the quickstart or the last four of that schedule, so that a server which runs one photograph after
another does not fill up with balls that nobody asks for again."""


# --- widgets -----------------------------------------------------------------------------------------------------


def model_input() -> Any:
    """The denoiser."""
    return io.Model.Input("model", tooltip="The denoiser, of SDXL's architecture, with the exposure LoRA loaded.")


def network_inputs() -> list[Any]:
    """The networks beside the denoiser and the text encoders."""
    return [
        io.Vae.Input("vae", tooltip="The autoencoder of the model."),
        io.ControlNet.Input("control_net", tooltip="A depth ControlNet of SDXL's architecture."),
    ]


def seed_input() -> Any:
    """Seed of the first ball."""
    return io.Int.Input(
        "seed",
        default=0,
        min=0,
        max=2**53,
        control_after_generate=True,
        tooltip="Of the first ball; the next ones count up. The same seed starts from the same noise at every EV.",
    )


def rounds_inputs(default: str) -> list[Any]:
    """The schedule of iterative inpainting, but for its steps, which `sampling_inputs` has.

    Args:
        default: preset that a new node has.
    """
    return [
        io.Combo.Input(
            "preset",
            options=[CUSTOM, *PRESETS],
            default=default,
            tooltip="A point between speed and accuracy; it replaces balls, rounds, strength, final, steps and until "
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
    ]


def settling_inputs() -> list[Any]:
    """When a round ends before all balls are painted, and a ball before all steps are done."""
    return [
        io.Float.Input(
            "tolerance",
            default=0.0,
            min=0.0,
            max=0.5,
            step=0.005,
            optional=True,
            tooltip="Error that a median may have, in display values (0.02 is a good start): a round ends once its "
            "median is within, and leaves out balls unlike the others; balls is the most it paints. "
            "0 paints all of them.",
        ),
        io.Int.Input(
            "min_balls",
            default=Rounds.min_balls,
            min=3,
            max=1000,
            optional=True,
            tooltip="With a tolerance, the fewest balls of a round; never more than balls.",
        ),
        io.Float.Input(
            "until",
            default=1.0,
            min=0.01,
            max=1.0,
            step=0.01,
            optional=True,
            tooltip="Share of the schedule after which the balls of a median stop, with the clean image predicted "
            "there: cheaper and softer, and light is settled early. 1 denoises to the end, as the paper does.",
        ),
    ]


def reject_input() -> Any:
    """Whether balls unlike the others are left out of medians."""
    return io.Boolean.Input(
        "reject",
        default=False,
        optional=True,
        tooltip="Leave balls that are unlike the others (faceted, matte, another scene) out of every median, and paint "
        "others in their place, up to half as many again; the report names their seeds. With a tolerance they are left "
        "out in any case.",
    )


def light_balls_input() -> Any:
    """How many balls tell how bright lights are."""
    return io.Int.Input(
        "light_balls",
        default=0,
        min=0,
        max=1000,
        optional=True,
        tooltip="Balls to paint to the end besides, whose lights are given back to the median, which loses them; 5 are "
        "enough. For answers that are medians: final off, or the presets draft, fast, balanced and best. 0: none.",
    )


def sampling_inputs() -> list[Any]:
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


def depth_model_input(otherwise: str) -> Any:
    """The model that estimates depth again on every median.

    Args:
        otherwise: sentence on what is done without one.
    """
    return DepthModelSocket.Input(
        "depth_model",
        optional=True,
        tooltip="Of Estimate Depth: estimates depth again on every median, as the authors' code does. " + otherwise,
    )


# --- from widgets to the library ---------------------------------------------------------------------------------


def rounds_of(
    name: str,
    balls: int,
    rounds: int,
    strength: float,
    final: bool,
    steps: int,
    tolerance: float = 0.0,
    min_balls: int = Rounds.min_balls,
    until: float = 1.0,
    reject: bool = False,
    light_balls: int = 0,
) -> Rounds:
    """The schedule of a preset, or of the node's own values; with a tolerance above 0, until medians are settled.

    Raises:
        OptionError: an option out of range.
    """
    schedule = Rounds(balls, rounds, strength, steps, final, until) if name == CUSTOM else preset(name).rounds
    return replace(schedule, tolerance=tolerance or None, min_balls=min_balls, reject=reject, light_balls=light_balls)


def guidance_of(options: dict[str, Any]) -> Guidance:
    """How to sample, of the values of `sampling_inputs`; one that is not there has its default.

    Raises:
        OptionError: an option out of range.
    """
    return Guidance(**{field.name: options[field.name] for field in fields(Guidance) if field.name in options})


def one_picture(image: torch.Tensor, socket: str) -> Image:
    """An IMAGE of one picture as (1, H, W, 3).

    Raises:
        ImageError: another layout, more than one picture, or values that are not finite; the socket is named.
    """
    picture = as_finite_rgb(image, socket)
    if len(picture) != 1:
        raise ImageError(socket, f"holds {len(picture)} pictures; one is accepted")
    return picture


def comfy_painter(
    observer: BarObserver,
    networks: Networks,
    guidance: Guidance,
    mask: Mask | None = None,
    finished: FinishedBalls | None = FINISHED,
) -> ComfyPainter:
    """A painter that shows its balls on the observer's bar, and finds those of earlier runs.

    Args, Raises: as `ComfyPainter`.
    """
    return ComfyPainter(networks, guidance, mask=mask, on_balls=observer.preview, finished=finished)


def exposure_lines(ev: float, seed: int, schedule: Rounds, result: IterativeResult, seconds: float) -> str:
    """What was run at an exposure, what it cost, how far its balls agree; one line, and one for each note."""
    most = "" if schedule.tolerance is None else "up to "
    until = "" if schedule.until == 1 else f" until {schedule.until:g}"
    lights = f", {schedule.light_balls} light balls" if schedule.light_balls else ""
    line = (
        f"EV {ev:g}: {most}{schedule.balls} balls, {schedule.rounds} rounds, {schedule.steps} steps{until}, "
        f"strength {schedule.strength:g}{lights}, seed {seed}; {result.evaluations} denoiser evaluations "
        f"in {seconds:.1f} s; mean spread {float(result.spread.mean()):.3f}"
    )
    return "\n".join((line, *(f"EV {ev:g}: {note}" for note in (*result.notes, *tally_lines(result, schedule)))))
