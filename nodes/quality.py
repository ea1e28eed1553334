"""ProbeQuality: is this a good mirror ball, and if not, why and what to do."""

from __future__ import annotations

import json
from collections.abc import Sequence

import torch
from comfy_api.latest import io

from ..dl_core.ball import Ball
from ..dl_core.errors import OptionError
from ..dl_core.quality.features import ball_features
from ..dl_core.quality.judge import Check, shipped_judge
from ..dl_core.quality.surroundings import cue_check, exposures_check, horizon_check, rim_check
from .painting import one_picture
from .sockets import CATEGORY, BallSocket, as_rgb, named_output

__all__ = ["ProbeQuality"]


class ProbeQuality(io.ComfyNode):  # type: ignore[misc]
    """Judges painted balls."""

    @classmethod
    def define_schema(cls) -> io.Schema:
        """Sockets of the node."""
        return io.Schema(
            node_id="ProbeQuality",
            display_name="Probe Quality",
            category=CATEGORY,
            description="Says how good a mirror ball was painted: whether it is whole, in its place, polished and not "
            "faceted, whether it goes on into the picture around it, and whether its exposures agree.",
            is_input_list=True,
            inputs=[
                io.Image.Input("balls", tooltip="One ball per EV, cut out and display-encoded, as a list: EV 0 first."),
                io.Float.Input(
                    "ev", force_input=True, optional=True, tooltip="The EVs of the balls, as a list, to compare them."
                ),
                io.Image.Input(
                    "composite", optional=True, tooltip="The canvas with the ball of EV 0, to look at its surroundings."
                ),
                BallSocket.Input("ball", optional=True, tooltip="Where the ball sits on the canvas."),
                io.Image.Input(
                    "photograph", optional=True, tooltip="Whether it shows enough to tell its light by is judged too."
                ),
            ],
            outputs=[
                named_output(io.Float, "score", "0 to 1; 1 is a good mirror ball. The worst of its checks."),
                named_output(io.String, "report", "The checks, one a line: score, name, what was found, what to do."),
                named_output(io.String, "json", "The same for programs: score and checks."),
            ],
        )

    @classmethod
    def execute(
        cls,
        balls: Sequence[torch.Tensor],
        ev: Sequence[float] = (),
        composite: Sequence[torch.Tensor] = (),
        ball: Sequence[Ball] = (),
        photograph: Sequence[torch.Tensor] = (),
    ) -> io.NodeOutput:
        """Judge one bracket; every input is a list."""
        judge, exposures = shipped_judge(), [as_rgb(one, "balls") for one in balls]
        if bool(composite) != bool(ball):
            given, missing = ("composite", "ball") if composite else ("ball", "composite")
            raise OptionError(missing, "not connected", f"connected where {given} is")
        features = ball_features(exposures[0][:1].clamp(0, 1))
        checks: list[Check] = judge.ball_checks(features)
        if composite:
            checks.append(rim_check(one_picture(composite[0], "composite"), ball[0], judge))
        checks.append(horizon_check(features, judge))
        if len(exposures) > 1 and ev:
            checks.append(exposures_check([one[:1] for one in exposures], ev))
        if photograph:
            checks.append(cue_check(one_picture(photograph[0], "photograph"), judge))
        score = judge.score(features)
        lines = [f"score {score:.2f} of 1", *(check.line() for check in checks)]
        found = {"score": score, "checks": [check.document() for check in checks]}
        return io.NodeOutput(score, "\n".join(lines), json.dumps(found, indent=1))
