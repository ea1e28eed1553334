"""EstimateLight: the whole method in one node, on the library's own `estimate`."""

from __future__ import annotations

from dataclasses import replace
from typing import Any, Final

import torch
from comfy_api.latest import io

from ..dl_core.ball import DEPTH_DISCS
from ..dl_core.bracket import BRACKETS
from ..dl_core.bracket_painter import BracketPainter
from ..dl_core.budget import choose
from ..dl_core.depth import DepthModel
from ..dl_core.errors import ModelError
from ..dl_core.estimate import (
    Probe,
    Settings,
    bracket_remarks,
    check_photograph,
    confidence_remark,
    planned_evaluations,
    planned_evs,
)
from ..dl_core.exposure import check_evs
from ..dl_core.finished import FinishedBalls
from ..dl_core.iterative import Rounds
from ..dl_core.mending import estimate_mended, mending_remarks
from ..dl_core.presets import PRESETS, Preset, presets_taking
from ..dl_core.prompts import NEGATIVE_PROMPT
from .confidence import CONFIDENCE_TOOLTIP
from .depth_ball import depth_input, given, place_inputs
from .doubts import doubts
from .exposure import (
    bracket_conditionings,
    bracket_inputs,
    encode_prompt,
    merge_input,
    merge_summary,
    prompt_inputs,
)
from .mending import mending_inputs, mending_of
from .painter import ComfyPainter, Networks
from .painting import (
    FINISHED,
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
from .sockets import CATEGORY, BallSocket, named_output, parse_evs

__all__ = ["EstimateLight"]

BY_PRESET: Final = "by preset"
"""Choice that leaves the disc on the depth map to the preset."""

FROM_CLIP: Final = ("socket positive", "socket negative", "conditionings")
"""What errors call that which this node makes of its text encoders."""


class EstimateLight(io.ComfyNode):  # type: ignore[misc]
    """A photograph in, a light probe out."""

    @classmethod
    def define_schema(cls) -> io.Schema:
        """Sockets of the node."""
        return io.Schema(
            node_id="EstimateLight",
            display_name="Estimate Light",
            category=CATEGORY,
            description="The whole method in one node: places the ball, paints it at every exposure, merges the "
            "exposures and unwraps the ball. A list of photographs or of places gives a list of maps.",
            inputs=[
                model_input(),
                io.Clip.Input("clip", tooltip="Text encoders of the model."),
                *network_inputs(),
                io.Image.Input("image", tooltip="One photograph, any size."),
                depth_input("Without one depth_model finds it; without that too the scene counts as far away."),
                depth_model_input("Without one all rounds use depth."),
                *rounds_inputs("balanced"),
                *bracket_inputs(),
                *prompt_inputs(),
                io.String.Input(
                    "negative_prompt", default=NEGATIVE_PROMPT, multiline=True, tooltip="What to move away from."
                ),
                seed_input(),
                *place_inputs(),
                io.Int.Input("height", default=256, min=2, max=4096, tooltip="Rows of the map; it is twice as wide."),
                merge_input("merge"),
                *sampling_inputs(),
                io.Combo.Input(
                    "depth_disc",
                    options=[BY_PRESET, *DEPTH_DISCS],
                    default=BY_PRESET,
                    optional=True,
                    tooltip="What the depth map shows of the ball, as in Depth Ball Mask. by preset: authors with the "
                    "presets that reproduce their runs, paper and turbo, and ball with the others.",
                ),
                *settling_inputs(),
                io.Combo.Input(
                    "bracket",
                    options=list(BRACKETS),
                    default="fixed",
                    optional=True,
                    tooltip="fixed: every EV of evs. scene: EV 0, and the next darker one only while the last one "
                    "clips; after the last of evs it goes on at the same distance down to ev_min.",
                ),
                io.Float.Input(
                    "budget",
                    default=0.0,
                    min=0.0,
                    max=86400.0,
                    step=1.0,
                    optional=True,
                    tooltip="Seconds for painting: above 0 the best preset that is done in time takes the place of "
                    "the one above, by a short calibration that counts. 0: the preset above.",
                ),
                reject_input(),
                light_balls_input(),
                *mending_inputs(),
            ],
            hidden=[io.Hidden.prompt, io.Hidden.unique_id],
            outputs=[
                named_output(io.Image, "latlong", "The map in linear radiance; white at EV 0 is 1."),
                named_output(io.Image, "hdr", "The ball in linear radiance."),
                named_output(io.Image, "composite", "The photograph on its canvas with the ball of EV 0 pasted in."),
                named_output(io.Image, "balls", "The ball at each EV, display-encoded, as one batch."),
                named_output(BallSocket, "ball", "Where the ball sits."),
                named_output(io.String, "report", "What was run and what it cost."),
                named_output(io.Mask, "confidence", CONFIDENCE_TOOLTIP + " All 0 where there were too few balls."),
            ],
        )

    @classmethod
    def execute(
        cls,
        clip: Any,
        image: torch.Tensor,
        preset: str,
        balls: int,
        rounds: int,
        strength: float,
        final: bool,
        evs: str,
        ev_min: float,
        prompt: str,
        dark_prompt: str,
        negative_prompt: str,
        seed: int,
        canvas: int,
        diameter: int,
        x: int,
        y: int,
        height: int,
        merge: str,
        steps: int,
        depth: torch.Tensor | None = None,
        depth_model: DepthModel | None = None,
        depth_disc: str = BY_PRESET,
        tolerance: float = 0.0,
        min_balls: int = Rounds.min_balls,
        until: float = 1.0,
        bracket: str = "fixed",
        budget: float = 0.0,
        reject: bool = False,
        light_balls: int = 0,
        **options: Any,
    ) -> io.NodeOutput:
        """Steer one painter to each exposure, and estimate."""
        photo = check_photograph(one_picture(image, "image"), "image")
        mending = mending_of(options)
        values, prompts = check_evs(parse_evs(evs)), (prompt, dark_prompt, negative_prompt)
        told = []
        if budget:
            pace_of = _bracket_painter(BarObserver(), clip, prompts, (0.0,), ev_min, options, finished=None)
            choice = choose(
                budget, pace_of, canvas, diameter, _presets(values, tolerance, min_balls, reject, light_balls)
            )
            preset, told = choice.name, [choice.line(budget)]
        rest = (tolerance, min_balls, until, reject, light_balls)
        schedule = rounds_of(preset, balls, rounds, strength, final, steps, *rest)
        disc = _preset_disc(preset) if depth_disc == BY_PRESET else depth_disc
        place = (canvas, diameter, given(x), given(y), height, disc)
        settings = Settings(schedule, values, seed, merge, *place, bracket=bracket, darkest=ev_min)
        observer = BarObserver()
        painter = _bracket_painter(observer, clip, prompts, planned_evs(settings), ev_min, options)
        observer.expect(planned_evaluations(painter, settings))
        near = None if depth is None else one_picture(depth, "depth")
        probe = estimate_mended(photo, painter, settings, mending, depth=near, depth_of=depth_model, observer=observer)
        found = torch.cat([exposure.ball for exposure in probe.exposures])
        told += [_report(probe, painter.seconds), *mending_remarks(mending)]
        report = "\n".join([*told, *doubts(cls.hidden, preset, options["model"])])
        shown = (probe.latlong_hdr, probe.ball_hdr, probe.composite_ldr, found, probe.ball)
        return io.NodeOutput(*shown, report, _confidence(probe))


def _confidence(probe: Probe) -> torch.Tensor:
    if probe.confidence is None:
        return torch.zeros_like(probe.latlong_hdr[..., 0])
    return probe.confidence.map[..., 0]


def _presets(
    evs: tuple[float, ...], tolerance: float, min_balls: int, reject: bool, light_balls: int
) -> dict[str, Preset]:
    """The presets as this node would run them; with light balls those that take them."""
    return {
        name: replace(
            row,
            evs=evs,
            rounds=replace(
                row.rounds, tolerance=tolerance or None, min_balls=min_balls, reject=reject, light_balls=light_balls
            ),
        )
        for name, row in presets_taking(light_balls).items()
    }


def _preset_disc(name: str) -> str:
    """The disc of a preset; the ball itself for values of the node's own."""
    return PRESETS[name].depth_disc if name in PRESETS else "ball"


def _bracket_painter(
    observer: BarObserver,
    clip: Any,
    prompts: tuple[str, str, str],
    evs: tuple[float, ...],
    ev_min: float,
    options: dict[str, Any],
    finished: FinishedBalls | None = FINISHED,
) -> BracketPainter:
    """A painter steered to each EV: both prompts are encoded once, and every EV lies between these originals.

    Raises:
        OptionError: EVs below `ev_min`, or a way of sampling that is not on offer.
        ModelError: models that do not belong together; the socket is named.
    """
    guidance = guidance_of(options)
    networks = {socket: options[socket] for socket in ("model", "vae", "control_net")}
    prompt, dark_prompt, negative_prompt = prompts

    def steered(positive: Any) -> ComfyPainter:
        parts = Networks(positive=positive, negative=negative, **networks)
        return comfy_painter(observer, parts, guidance, finished=finished)

    try:
        original, dark, negative = (encode_prompt(clip, text) for text in (prompt, dark_prompt, negative_prompt))
        conditionings = bracket_conditionings(original, dark, evs, ev_min)
        return BracketPainter({ev: steered(positive) for ev, positive in zip(evs, conditionings, strict=True)})
    except ModelError as error:
        if error.model in FROM_CLIP:
            raise ModelError("socket clip", error.reason) from error
        raise


def _report(probe: Probe, seconds: dict[float, float]) -> str:
    """What was run at each exposure, which there were, and how they were merged."""
    settings = probe.settings
    lines = [
        exposure_lines(ev, settings.seed, settings.rounds, result, seconds[ev])
        for ev, result in zip(probe.evs, probe.exposures, strict=True)
    ]
    return "\n".join(
        [*lines, *bracket_remarks(probe), confidence_remark(probe), merge_summary(probe.evs, settings.merge)]
    )
