"""EVPromptInterp and HDRMerge: one prompt per exposure, and the exposures back into radiance."""

from __future__ import annotations

import math
from collections.abc import Sequence
from typing import Any, Final

import folder_paths
import torch
from comfy_api.latest import io

from ..dl_core.errors import ModelError, OptionError
from ..dl_core.exposure import GAMMA, MERGES, check_evs, merge_batches, merge_bracket
from ..dl_core.prompts import DARK_PROMPT, PROMPT
from ..dl_core.restored_lights import restore_lights
from .lora import read_lora_file, with_lora
from .sockets import CATEGORY, as_rgb, named_output, parse_evs, parse_numbers

__all__ = [
    "EVPromptInterp",
    "HDRMerge",
    "bracket_conditionings",
    "bracket_inputs",
    "encode_prompt",
    "interpolate_conditioning",
    "merge_input",
    "merge_summary",
    "prompt_inputs",
]

NO_LORA: Final = "none"


def interpolate_conditioning(original: Any, dark: Any, weight: float) -> Any:
    """Conditioning between two: original + weight x (dark - original), for token and pooled embeddings alike.

    Args:
        original: CONDITIONING of the prompt at EV 0, a list of [(1, n, width) embedding, options].
        dark: CONDITIONING of the dark prompt, as many items. Prompts over 77 tokens come in chunks of 77; of a pair of
            different lengths both are repeated to a common one, which changes nothing for cross attention.
        weight: 0 is the original, 1 the dark one.

    Raises:
        OptionError: conditionings of different numbers of items.
        ModelError: conditionings without pooled embeddings, or of text encoders of different widths.

    Source: DiffusionLight, Sec. 4.2 (exposure LoRA: interpolated text embeddings).
    """
    if len(original) != len(dark):
        raise OptionError("dark_prompt", f"{len(dark)} conditionings", f"as many as prompt has, {len(original)}")
    return [_between(a, b, weight) for a, b in zip(original, dark, strict=True)]


def _between(original: Any, dark: Any, weight: float) -> Any:
    (tokens, options), (dark_tokens, dark_options) = original, dark
    if options.get("pooled_output") is None or dark_options.get("pooled_output") is None:
        raise ModelError("conditionings", "hold no pooled embeddings; those of SDXL's text encoders are accepted")
    if tokens.shape[-1] != dark_tokens.shape[-1]:
        raise ModelError(
            "conditionings",
            f"are {tokens.shape[-1]} and {dark_tokens.shape[-1]} wide; two of the same text encoders are accepted",
        )
    length = math.lcm(tokens.shape[1], dark_tokens.shape[1])
    tokens, dark_tokens = (item.repeat(1, length // item.shape[1], 1) for item in (tokens, dark_tokens))
    pooled = torch.lerp(options["pooled_output"], dark_options["pooled_output"], weight)
    return [torch.lerp(tokens, dark_tokens, weight), {**options, "pooled_output": pooled}]


def _shares(evs: Sequence[float], ev_min: float, weights: str) -> list[float]:
    """How far each EV lies from the prompt to the dark prompt: EV / EV min, or as written in `weights`.

    Raises:
        OptionError: an EV below `ev_min`, as no weights say what to do with it; weights that are no numbers from 0 to
            1, or not one per EV.
    """
    if not weights.strip():
        if evs[-1] < ev_min:
            raise OptionError("evs", evs, f"EVs down to ev_min, {ev_min:g}, where the dark prompt stands alone")
        return [ev / ev_min for ev in evs]
    shares = parse_numbers(weights, "weights", "0, 0.5, 1")
    if len(shares) != len(evs) or not all(0 <= share <= 1 for share in shares):
        raise OptionError("weights", weights, f"one number from 0 to 1 per EV, that is {len(evs)}, or nothing")
    return list(shares)


def bracket_conditionings(
    original: Any, dark: Any, evs: Sequence[float], ev_min: float, weights: str = ""
) -> list[Any]:
    """One conditioning per EV, each interpolated between the two originals.

    Args:
        original: CONDITIONING of the prompt, at EV 0.
        dark: CONDITIONING of the dark prompt, at `ev_min`.
        evs: exposure values, descending from 0.
        ev_min: exposure value of the dark prompt, below 0.
        weights: share of the dark prompt at each EV, written between commas; EV / EV min when empty.

    Raises:
        OptionError: EVs below `ev_min` or weights that do not fit the EVs, and as `interpolate_conditioning`.
        ModelError: as `interpolate_conditioning`.
    """
    return [interpolate_conditioning(original, dark, share) for share in _shares(evs, ev_min, weights)]


def encode_prompt(clip: Any, prompt: str) -> Any:
    """CONDITIONING of a text, as ComfyUI's own node makes it.

    Raises:
        ModelError: no text encoders.
    """
    if clip is None:
        raise ModelError("socket clip", "holds no text encoders; those of the model are accepted")
    return clip.encode_from_tokens_scheduled(clip.tokenize(prompt))


def prompt_inputs() -> list[Any]:
    """The two prompts that exposures lie between."""
    return [
        io.String.Input("prompt", default=PROMPT, multiline=True, tooltip="A mirror ball at EV 0."),
        io.String.Input("dark_prompt", default=DARK_PROMPT, multiline=True, tooltip="A mirror ball at EV min."),
    ]


def bracket_inputs() -> list[Any]:
    """The exposures, and where the dark prompt stands among them."""
    return [
        io.String.Input(
            "evs",
            default="0, -2.5, -5",
            tooltip="Exposure values between commas: they start at 0 and descend. The paper's are 0, -2.5, -5.",
        ),
        io.Float.Input(
            "ev_min",
            default=-5.0,
            min=-20.0,
            max=-0.1,
            step=0.1,
            tooltip="The exposure value of the dark prompt, as the exposure LoRA was trained: -5.",
        ),
    ]


def merge_input(name: str) -> Any:
    """How exposures become radiance."""
    return io.Combo.Input(
        name,
        options=list(MERGES),
        tooltip="robust: each colour by itself, errors of exposure undone, no colours from exposures that differ. "
        "channel: each colour by itself always. paper: luminance only, with the chroma of EV 0.",
    )


def merge_summary(evs: Sequence[float], method: str, gamma: float = GAMMA) -> str:
    """The line of a report on how exposures were merged."""
    return f"Merged EV {', '.join(f'{value:g}' for value in evs)} by the method {method}, gamma {gamma:g}."


class EVPromptInterp(io.ComfyNode):  # type: ignore[misc]
    """Conditionings that steer the exposure of a ball."""

    @classmethod
    def define_schema(cls) -> io.Schema:
        """Sockets of the node."""
        return io.Schema(
            node_id="EVPromptInterp",
            display_name="EV Prompt Interpolation",
            category=CATEGORY,
            description="Makes one conditioning per exposure value, on the line from the prompt (EV 0) to the dark "
            "prompt (EV min). Nodes that follow run once per EV; HDR Merge gathers them again.",
            inputs=[
                io.Clip.Input("clip", optional=True, tooltip="Text encoders of the model, for the prompts below."),
                io.Model.Input(
                    "model", optional=True, tooltip="The denoiser, if this node is to load the LoRA into it."
                ),
                io.Conditioning.Input(
                    "original", optional=True, tooltip="A conditioning for EV 0, in place of the prompt below."
                ),
                io.Conditioning.Input(
                    "dark", optional=True, tooltip="A conditioning for EV min, in place of the dark prompt below."
                ),
                *prompt_inputs(),
                *bracket_inputs(),
                io.Combo.Input(
                    "lora",
                    options=[NO_LORA, *folder_paths.get_filename_list("loras")],
                    default=NO_LORA,
                    tooltip="Exposure LoRA to load into the model. Choose none where a loader has done so already.",
                ),
                io.Float.Input(
                    "lora_scale",
                    default=0.75,
                    min=0.0,
                    max=2.0,
                    step=0.05,
                    tooltip="How strongly the LoRA acts. The paper uses 0.75.",
                ),
                io.String.Input(
                    "weights",
                    default="",
                    optional=True,
                    tooltip="Share of the dark prompt at each EV, 0 to 1, between commas: 0, 0.5, 1. "
                    "Nothing: EV / EV min, as in the paper.",
                ),
            ],
            outputs=[
                named_output(io.Model, "model", "The model, with the LoRA if one was chosen."),
                named_output(io.Conditioning, "positive", "One conditioning per EV.", is_list=True),
                named_output(io.Float, "ev", "The EVs, in the same order.", is_list=True),
            ],
        )

    @classmethod
    def execute(
        cls,
        prompt: str,
        dark_prompt: str,
        evs: str,
        ev_min: float,
        lora: str,
        lora_scale: float,
        weights: str = "",
        clip: Any = None,
        model: Any = None,
        original: Any = None,
        dark: Any = None,
    ) -> io.NodeOutput:
        """Encode both prompts once and interpolate between these originals for every EV."""
        values = check_evs(parse_evs(evs))
        bright, black = _encoded(clip, prompt, original), _encoded(clip, dark_prompt, dark)
        positive = bracket_conditionings(bright, black, values, ev_min, weights)
        return io.NodeOutput(_with_lora(model, lora, lora_scale), positive, list(values))


def _encoded(clip: Any, prompt: str, conditioning: Any) -> Any:
    """The conditioning given in a prompt's place, or the prompt encoded.

    Raises:
        ModelError: neither a conditioning nor text encoders.
    """
    if conditioning is not None:
        return conditioning
    if clip is None:
        raise ModelError("socket clip", "is not connected; connect it, or both original and dark in its place")
    return encode_prompt(clip, prompt)


def _with_lora(model: Any, lora: str, scale: float) -> Any:
    """The model with a LoRA file of ComfyUI's folder, or as it is.

    Raises:
        ModelError: a LoRA without a model, or one that does not fit it.
    """
    if lora == NO_LORA:
        return model
    if model is None:
        raise ModelError("socket model", "is not connected; it has to be for a LoRA to be loaded")
    return with_lora(model, read_lora_file(lora), scale, f"lora {lora}")


class HDRMerge(io.ComfyNode):  # type: ignore[misc]
    """Merges the balls of a bracket."""

    @classmethod
    def define_schema(cls) -> io.Schema:
        """Sockets of the node."""
        return io.Schema(
            node_id="HDRMerge",
            display_name="HDR Merge",
            category=CATEGORY,
            description="Gathers one ball per exposure value and merges them into linear radiance; white at EV 0 is 1.",
            is_input_list=True,
            inputs=[
                io.Image.Input("balls", tooltip="One display-encoded ball per EV, as a list."),
                io.Float.Input("ev", force_input=True, tooltip="The EVs of the balls, as a list: 0 first, descending."),
                merge_input("method"),
                io.Float.Input(
                    "gamma",
                    default=GAMMA,
                    min=1.0,
                    max=4.0,
                    step=0.05,
                    tooltip="Gamma of the display encoding that the balls were painted in: 2.4.",
                ),
                io.String.Input(
                    "report",
                    optional=True,
                    force_input=True,
                    tooltip="Reports of the nodes that painted the balls, to be passed on as one.",
                ),
                io.Image.Input(
                    "light_balls",
                    optional=True,
                    tooltip="light_balls of Iterative Median, one batch per EV: their lights are given back to the "
                    "merged ball, a median, which has lost them.",
                ),
            ],
            outputs=[
                named_output(io.Image, "hdr", "The ball in linear radiance, unbounded."),
                named_output(io.String, "report", "The reports, and how they were merged."),
            ],
        )

    @classmethod
    def execute(
        cls,
        balls: Sequence[torch.Tensor],
        ev: Sequence[float],
        method: Sequence[str],
        gamma: Sequence[float],
        report: Sequence[str] = (),
        light_balls: Sequence[torch.Tensor] = (),
    ) -> io.NodeOutput:
        """Merge; every input is a list, options have one item."""
        merged = merge_bracket([as_rgb(ball, "balls") for ball in balls], ev, method[0], gamma[0])
        if light_balls:
            batches = [as_rgb(batch, "light_balls") for batch in light_balls]
            merged = _with_lights(merged, batches, ev, method[0], gamma[0])
        return io.NodeOutput(merged, "\n".join([*report, merge_summary(ev, method[0], gamma[0])]))


def _with_lights(
    merged: torch.Tensor, batches: Sequence[torch.Tensor], evs: Sequence[float], method: str, gamma: float
) -> torch.Tensor:
    """A merged ball with the lights of others.

    Raises:
        OptionError: not one batch per EV, or batches of different sizes.
        ImageError: balls of another size.
    """
    counts = [len(batch) for batch in batches]
    if len(counts) != len(evs) or len(set(counts)) != 1 or not counts[0]:
        raise OptionError("light_balls", counts, f"as many balls at every EV, 1 or more in each of {len(evs)} batches")
    return restore_lights(merged, merge_batches(batches, evs, method, gamma))
