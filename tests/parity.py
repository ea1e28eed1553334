"""Stage by stage: one set of weights in ComfyUI and in diffusers, from the prompt to the painted ball.

Both sides paint the same request while what goes into their UNets and comes out is recorded. A stage is one thing that
both compute, the most they may differ by, and why they differ at all.
"""

from __future__ import annotations

from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import dataclass, replace
from typing import Any, Final

import torch
from comfy_host import leading_euler, pack_module
from reference_pipeline import pipeline_canvases
from torch import Tensor
from toy_sdxl import build_pipeline, comfy_networks

EV: Final = -2.5
SEEDS: Final = (5, 6)


@dataclass(frozen=True)
class Pair:
    """A model on both sides.

    Attributes:
        pipeline: diffusers' StableDiffusionXLControlNetInpaintPipeline.
        sockets: ComfyUI's model, clip, vae and control_net.
        defaults: canvas, ball, prompts and scales.
    """

    pipeline: Any
    sockets: dict[str, Any]
    defaults: Any


@dataclass(frozen=True)
class Stage:
    """What one stage differs by.

    Attributes:
        name: of the stage.
        difference: largest absolute difference, or as `measure` says.
        tolerance: the most it may be.
        measure: how the difference is counted.
        reason: for whatever difference remains.
    """

    name: str
    difference: float
    tolerance: float
    measure: str
    reason: str


@dataclass
class Recording:
    """Evaluations of a UNet, in order: everything by field name, the first rows of a guided batch."""

    latents: list[Tensor]
    timesteps: list[float]
    contexts: list[Tensor]
    vectors: list[Tensor]
    residuals: list[list[Tensor]]
    outputs: list[Tensor]


def _recording() -> Recording:
    return Recording([], [], [], [], [], [])


@contextmanager
def _diffusers_recorded(pipeline: Any) -> Iterator[Recording]:
    recording, vectors = _recording(), []

    def unet(module: Any, arguments: Any, options: Any, output: Any) -> None:
        recording.latents.append(arguments[0].clone())
        recording.timesteps.append(float(arguments[1]))
        recording.contexts.append(options["encoder_hidden_states"].clone())
        recording.residuals.append(
            [*options["down_block_additional_residuals"], options["mid_block_additional_residual"]]
        )
        recording.outputs.append(output[0].clone())

    hooks = [
        pipeline.unet.register_forward_hook(unet, with_kwargs=True),
        pipeline.unet.add_embedding.register_forward_pre_hook(lambda module, arguments: vectors.append(arguments[0])),
    ]
    try:
        yield recording
    finally:
        recording.vectors = vectors
        for hook in hooks:
            hook.remove()


@contextmanager
def _comfy_recorded(model: Any) -> Iterator[Recording]:
    recording, network = _recording(), model.model.diffusion_model

    def before(module: Any, arguments: Any, options: Any) -> None:
        control = options["control"]
        recording.latents.append(arguments[0].clone())
        recording.timesteps.append(float(arguments[1][0]))
        recording.contexts.append(options["context"].clone())
        recording.vectors.append(options["y"].clone())
        # The network takes these off their lists.
        recording.residuals.append([*control["output"], *control["middle"]])

    hooks = [
        network.register_forward_pre_hook(before, with_kwargs=True),
        network.register_forward_hook(lambda module, arguments, output: recording.outputs.append(output.clone())),
    ]
    try:
        yield recording
    finally:
        for hook in hooks:
            hook.remove()


# --- models ------------------------------------------------------------------------------------------------------


def toy_pair() -> Pair:
    """SDXL at a tenth of its width, on a canvas of 16 x 16 latents."""
    pipeline = build_pipeline()
    defaults = pack_module("dl_core.backends.diffusers_painter").PAPER_DEFAULTS
    return Pair(pipeline, comfy_networks(pipeline), replace(defaults, canvas=128, diameter=48))


def mini_pair(mini: Any) -> Pair:
    """The mini model without its LoRA."""
    convert = pack_module("nodes.mini")
    painter = pack_module("dl_core.backends.diffusers_painter").DiffusersPainter.from_mini(replace(mini, lora=None))
    sockets = {
        "model": convert.to_model(mini, 0),
        "clip": convert.to_clip(mini),
        "vae": convert.to_vae(mini),
        "control_net": convert.to_controlnet(mini),
    }
    return Pair(painter.pipeline, sockets, mini.defaults)


# --- both sides --------------------------------------------------------------------------------------------------


def binary_ball(canvas: int, diameter: int) -> Any:
    """A ball near a diameter whose latent mask is binary: diffusers' pipeline rounds masks, ours keep soft edges."""
    balls = pack_module("dl_core.ball")
    mask_of = pack_module("dl_core.backends.diffusers_painter").ball_latent_mask
    for size in range(diameter, diameter + 48, 2):
        for dilation in range(8):
            ball = balls.place_ball(canvas, size, dilation=dilation)
            mask = mask_of(ball)
            if bool(((mask == 0) | (mask == 1)).all()):
                return ball
    raise AssertionError("no ball of a binary latent mask")


def comfy_balls(pair: Pair, request: Any, sampler: str = "euler") -> Tensor:
    """What ComfyPainter paints, conditioned by EVPromptInterp."""
    painting, defaults = pack_module("nodes.painter"), pair.defaults
    interpolate = pack_module("nodes.exposure").interpolate_conditioning
    clip = pair.sockets["clip"]
    own, dark, negative = (
        clip.encode_from_tokens_scheduled(clip.tokenize(text))
        for text in (defaults.prompt, defaults.dark_prompt, defaults.negative_prompt)
    )
    positive = interpolate(own, dark, request.ev / defaults.ev_min)
    networks = {name: pair.sockets[name] for name in ("model", "vae", "control_net")}
    guidance = painting.Guidance(
        cfg=defaults.guidance, sampler=sampler, control_strength=defaults.control_scale, batch_size=len(request.seeds)
    )
    painter = painting.ComfyPainter(painting.Networks(**networks, positive=positive, negative=negative), guidance)
    return painter.paint(request, pack_module("dl_core.painter").SilentObserver()).balls


def pipeline_balls(pair: Pair, request: Any, scheduler: Any) -> Tensor:
    """What diffusers' own pipeline paints, with embeddings on the line between the two prompts."""
    backend = pack_module("dl_core.backends.diffusers_painter")
    guidance = backend.DiffusersPainter(pair.pipeline, pair.defaults).guidance_at(request.ev)
    mask = backend.ball_latent_mask(request.ball)
    canvases = pipeline_canvases(pair.pipeline, scheduler, request, guidance, pair.defaults, mask)
    return pack_module("dl_core.ball").crop_ball(canvases, request.ball)


def request_of(pair: Pair, steps: int, strength: float = 1.0) -> Any:
    """Two balls at EV -2.5 in a canvas of 8-bit noise, smoothed."""
    balls = pack_module("dl_core.ball")
    side = pair.defaults.canvas
    ball = binary_ball(side, pair.defaults.diameter)
    coarse = torch.rand(1, 3, side // 8, side // 8, generator=torch.Generator().manual_seed(9))
    canvas = torch.nn.functional.interpolate(coarse, (side, side), mode="bicubic").clamp(0, 1).permute(0, 2, 3, 1)
    kind = pack_module("dl_core.painter").PaintRequest
    canvas = (canvas * 255).round() / 255
    return kind(canvas, balls.paint_depth(None, ball), ball, EV, SEEDS, strength=strength, steps=steps)


# --- stages ------------------------------------------------------------------------------------------------------

ORDER: Final = "order of float32 sums"


def _worst(ours: Tensor, theirs: Tensor) -> float:
    return float((ours - theirs).abs().max())


def _relative(ours: Tensor, theirs: Tensor) -> float:
    return float((ours - theirs).norm() / theirs.norm())


@torch.no_grad()
def stages(pair: Pair, steps: int = 30) -> list[Stage]:
    """Every stage of a model, prompt to ball.

    Args:
        pair: the model on both sides.
        steps: of the full trajectories.
    """
    plain = replace(pair, defaults=replace(pair.defaults, guidance=1.0))
    found = [*_network_stages(plain, request_of(plain, 2)), *_autoencoder_stages(pair)]
    found.append(_sdedit_stage(plain, request_of(plain, 2, 0.5)))
    found += _guided_stages(pair, request_of(pair, 2))
    for strength in (1.0, 0.8):
        asked = request_of(pair, steps, strength)
        theirs = pipeline_balls(pair, asked, leading_euler(pair.pipeline.scheduler.config))
        mean = float((comfy_balls(pair, asked) - theirs).abs().mean())
        reason = f"{ORDER}, over {steps} steps; 8-bit depth and mask of the pipeline"
        found.append(Stage(f"ball, Euler, strength {strength:g}", mean, 1e-2, "mean absolute", reason))
    return found


def _recorded(pair: Pair, request: Any) -> tuple[Recording, Recording]:
    """UNets on both sides, as ComfyPainter and diffusers' pipeline drive them."""
    with _comfy_recorded(pair.sockets["model"]) as ours:
        comfy_balls(pair, request)
    with _diffusers_recorded(pair.pipeline) as theirs:
        pipeline_balls(pair, request, leading_euler(pair.pipeline.scheduler.config))
    return ours, theirs


def _network_stages(pair: Pair, request: Any) -> Iterator[Stage]:
    """One evaluation without guidance."""
    ours, theirs = _recorded(pair, request)
    times = max(abs(a - b) for a, b in zip(ours.timesteps, theirs.timesteps, strict=True))
    text, vector = _worst(ours.contexts[0], theirs.contexts[0]), _worst(ours.vectors[0], theirs.vectors[0])
    yield Stage("text embeddings at EV -2.5", text, 1e-5, "largest", ORDER)
    yield Stage("pooled embedding and time ids", vector, 1e-5, "largest", ORDER)
    # ComfyUI goes from timestep to noise level and back through a table.
    yield Stage("timesteps visited", times, 1e-3, "largest", "ComfyUI looks the timestep up by its noise level")
    yield Stage("noise the first step sees", _relative(ours.latents[0], theirs.latents[0]), 1e-5, "relative", ORDER)
    control = max(_relative(a, b) for a, b in zip(ours.residuals[0], theirs.residuals[0], strict=True))
    yield Stage("ControlNet residuals", control, 1e-4, "relative, worst of all", ORDER)
    yield Stage("UNet", _relative(ours.outputs[0], theirs.outputs[0]), 1e-4, "relative", ORDER)
    mask = pack_module("dl_core.backends.diffusers_painter").ball_latent_mask(request.ball)
    known, painted = (mask == 0).expand_as(ours.latents[1]), (mask == 1).expand_as(ours.latents[1])
    imputed = _relative(ours.latents[1][known], theirs.latents[1][known])
    yield Stage("imputed latents after a step", imputed, 1e-4, "relative", ORDER)
    step = _relative(ours.latents[1][painted], theirs.latents[1][painted])
    yield Stage("one denoising step", step, 1e-4, "relative", ORDER)


def _sdedit_stage(pair: Pair, request: Any) -> Stage:
    ours, theirs = _recorded(pair, request)
    difference = _relative(ours.latents[0], theirs.latents[0])
    return Stage("SDEdit start, strength 0.5", difference, 1e-4, "relative", ORDER)


def _guided_stages(pair: Pair, request: Any) -> Iterator[Stage]:
    ours, theirs = _recorded(pair, request)
    rows, mask = len(SEEDS), pack_module("dl_core.backends.diffusers_painter").ball_latent_mask(request.ball)
    painted = (mask == 1).expand_as(ours.latents[1][:rows])
    difference = _relative(ours.latents[1][:rows][painted], theirs.latents[1][:rows][painted])
    reason = f"{ORDER}, multiplied by the guidance scale"
    yield Stage("one guided step", difference, 1e-4, "relative", reason)
    calls = sum(map(len, ours.latents))
    painter = pack_module("dl_core.backends.diffusers_painter").DiffusersPainter(pair.pipeline, pair.defaults)
    foretold = painter.evaluations(rows, request.steps, request.strength)
    counts = max(abs(calls - foretold), abs(sum(map(len, theirs.latents)) - foretold))
    yield Stage("evaluations, counted and foretold", float(counts), 0.0, "largest", "none")


def _autoencoder_stages(pair: Pair) -> Iterator[Stage]:
    vae, comfy_vae = pair.pipeline.vae, pair.sockets["vae"]
    picture = request_of(pair, 4).canvas
    encoded = vae.encode(picture.permute(0, 3, 1, 2) * 2 - 1)
    latents = encoded.latent_dist.mode() if hasattr(encoded, "latent_dist") else encoded.latents
    found = comfy_vae.encode(picture)
    yield Stage("autoencoder, encoded", _relative(found, latents), 1e-4, "relative", f"{ORDER}; both give the mode")
    decoded = (vae.decode(latents).sample / 2 + 0.5).clamp(0, 1).permute(0, 2, 3, 1)
    yield Stage("autoencoder, decoded", _worst(comfy_vae.decode(latents), decoded), 1e-4, "largest", ORDER)
