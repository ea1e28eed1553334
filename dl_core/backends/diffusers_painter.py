"""A Painter on diffusers: SDXL from local files, or the embedded mini model, with a depth ControlNet.

Source: DiffusionLight, Algorithm 0 (INPAINT). The authors' code departs from the listing, and so does the default
here: what lies outside the mask is noised again with the ball's own initial noise (`impute="initial"`), where the
listing takes the noise just predicted (`impute="predicted"`).
"""

from __future__ import annotations

from collections.abc import Callable
from contextlib import AbstractContextManager
from copy import deepcopy
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any, Final

import torch
import torch.nn.functional as F
from diffusers import (
    DDIMScheduler,
    DDPMScheduler,
    EulerDiscreteScheduler,
    StableDiffusionXLControlNetInpaintPipeline,
    UniPCMultistepScheduler,
)
from jaxtyping import Float
from torch import Tensor

from ..ball import Ball, disc_mask, require_canvas
from ..batches import Batches, is_out_of_memory
from ..decoding import decode_ball, decode_margin
from ..errors import ModelError, OptionError
from ..exposure_prompts import embedding_at
from ..lora import EXPOSURE_SCALE, LoraSwap
from ..painter import IMPUTINGS, Imputing, Observer, PaintRequest, PaintResult, steps_run
from ..shapes import BallImage, Image
from .depth_hint import seen_once
from .diffusers_lora import EXPOSURE, TURBO, add_lora
from .mini import SCHEDULER_CONFIG, MiniModel, ModelDefaults, read_weights
from .sdxl_files import load_base, load_controlnet

__all__ = ["SAMPLERS", "STOCHASTIC", "DiffusersPainter", "Guidance", "ball_latent_mask"]

SAMPLERS: Final[dict[str, Callable[..., Any]]] = {
    "unipc": lambda config: UniPCMultistepScheduler.from_config(config),
    "ddim": lambda config: DDIMScheduler.from_config(config, clip_sample=False, set_alpha_to_one=False),
    "euler": lambda config: EulerDiscreteScheduler.from_config(config),
    "ddpm": lambda config: DDPMScheduler.from_config(config, clip_sample=False),
}
"""Samplers by name, the paper's first."""

STOCHASTIC: Final = ("ddpm",)
"""Samplers that draw noise at every step: each ball's from its own generator, so that a ball is its seed's still. What
kind of ball a seed's initial noise makes is bound to it more loosely (the paper's appendix on stochastic sampling)."""

PAPER_DEFAULTS: Final = ModelDefaults(
    canvas=1024, diameter=256, guidance=5.0, control_scale=0.5, lora_scale=EXPOSURE_SCALE, ev_min=-5.0
)
"""The paper's, and its authors' code's where the paper is silent."""


@dataclass(frozen=True)
class Guidance:
    """Text conditioning of one exposure: token and pooled embeddings, wanted and unwanted.

    Attributes:
        tokens: (1, 77, C).
        pooled: (1, P).
        negative_tokens: (1, 77, C).
        negative_pooled: (1, P).
    """

    tokens: Tensor
    pooled: Tensor
    negative_tokens: Tensor
    negative_pooled: Tensor


def ball_latent_mask(ball: Ball, factor: int = 8) -> Float[Tensor, "1 1 m m"]:
    """The inpaint disc at latent size, reduced bilinearly as the authors' code does (nearly binary)."""
    side = ball.canvas // factor
    return F.interpolate(disc_mask(ball, grow=ball.dilation)[None], size=(side, side), mode="bilinear")


class DiffusersPainter:
    """Paints chrome balls with a diffusers pipeline's networks.

    Args:
        pipeline: its networks, text encoders and scheduler configuration are used; its own call is not. Without a
            ControlNet the ball is painted by inpainting alone.
        defaults: prompts, guidance, scale of ControlNet and LoRA, and the EV of the dark prompt.
        sampler: a name of `SAMPLERS`.
        batch: balls denoised at once; less memory with less. Where a batch does not fit, it is halved from there on.
        impute: noise put on what lies outside the mask, see `painter.Imputing`.
        lora_swap: when the pipeline's adapters `diffusers_lora.TURBO` and `EXPOSURE` act, in every pass; without it
            the pipeline's adapters stay as they are.
        walk: another number has a sampler of `STOCHASTIC` draw other noise at its steps, from the same initial noise.
    """

    def __init__(
        self,
        pipeline: StableDiffusionXLControlNetInpaintPipeline,
        defaults: ModelDefaults,
        *,
        sampler: str = "unipc",
        batch: int = 4,
        impute: Imputing = "initial",
        lora_swap: LoraSwap | None = None,
        walk: int = 0,
    ) -> None:
        if sampler not in SAMPLERS:
            raise OptionError("sampler", sampler, ", ".join(SAMPLERS))
        if batch < 1:
            raise OptionError("batch", batch, "1 or more")
        if impute not in IMPUTINGS:
            raise OptionError("impute", impute, ", ".join(IMPUTINGS))
        if impute == "predicted" and sampler == "euler":
            raise OptionError("impute", impute, "initial, with the euler sampler")
        if walk and sampler not in STOCHASTIC:
            raise OptionError("walk", walk, f"0, with a sampler that draws no noise at its steps, as {sampler}")
        self.pipeline = pipeline
        self.defaults = defaults
        self.sampler = sampler
        self._batches = Batches(batch, _empty_cache)
        self.impute = impute
        self.lora_swap = lora_swap
        self.walk = walk
        self._acting: tuple[str, float] | None = None
        self._embeddings: dict[str, tuple[Tensor, Tensor, Tensor, Tensor]] = {}
        self._encoded: list[tuple[Image, Any]] = []

    def varied(
        self,
        *,
        sampler: str | None = None,
        guidance: float | None = None,
        batch: int | None = None,
        walk: int | None = None,
    ) -> DiffusersPainter:
        """The same networks with another sampler, scale of guidance, batch or walk."""
        return DiffusersPainter(
            self.pipeline,
            self.defaults if guidance is None else replace(self.defaults, guidance=guidance),
            sampler=sampler or self.sampler,
            batch=batch or self._batches.size,
            impute=self.impute,
            lora_swap=self.lora_swap,
            walk=self.walk if walk is None else walk,
        )

    def in_precision(self, dtype: torch.dtype) -> DiffusersPainter:
        """A painter like this one on a copy of the networks in another floating-point type."""
        painter = self.varied()
        painter.pipeline = deepcopy(self.pipeline).to(dtype)
        return painter

    @staticmethod
    def from_mini(model: MiniModel, **options: Any) -> DiffusersPainter:
        """A painter on the embedded mini model. `options` as the constructor's."""
        pipeline = StableDiffusionXLControlNetInpaintPipeline(
            vae=model.vae,
            text_encoder=model.text_encoder,
            text_encoder_2=model.text_encoder_2,
            tokenizer=model.tokenizer,
            tokenizer_2=model.tokenizer_2,
            unet=model.unet,
            controlnet=model.controlnet,
            scheduler=UniPCMultistepScheduler(**SCHEDULER_CONFIG, timestep_spacing="leading", steps_offset=1),
        )
        if model.lora is not None:
            add_lora(pipeline, model.lora, EXPOSURE, "mini model's exposure LoRA")
            pipeline.set_adapters(EXPOSURE, model.defaults.lora_scale)
        return DiffusersPainter(pipeline, model.defaults, **options)

    @staticmethod
    def from_files(
        model: Path,
        controlnet: Path,
        lora: Path | None = None,
        turbo_lora: Path | None = None,
        *,
        dtype: torch.dtype | None = None,
        **options: Any,
    ) -> DiffusersPainter:
        """A painter on SDXL from local files; nothing is downloaded.

        Args:
            model: an SDXL checkpoint (.safetensors) or a folder in diffusers' layout.
            controlnet: a depth ControlNet for SDXL, file or folder.
            lora: the exposure LoRA, a file; without it the dark exposures rest on the prompt alone.
            turbo_lora: the Turbo LoRA, a file; it takes the first timesteps of every pass, as `LoraSwap` says.
            dtype: what the networks compute in; half precision on a GPU and single elsewhere when not given.
            options: as the constructor's.

        Raises:
            OptionError: a Turbo LoRA without an exposure LoRA to follow it.
            ModelError: a file is missing, unreadable, or not of SDXL's architecture.
        """
        if turbo_lora is not None and lora is None:
            raise OptionError("turbo_lora", str(turbo_lora), "none without an exposure LoRA, which follows it")
        device = "cuda" if torch.cuda.is_available() else "cpu"
        dtype = dtype or (torch.float16 if device == "cuda" else torch.float32)
        base = load_base(model, dtype)
        control = load_controlnet(controlnet, base, dtype)
        pipeline = StableDiffusionXLControlNetInpaintPipeline(**base.components, controlnet=control)
        if lora is not None:
            add_lora(pipeline, read_weights(lora), EXPOSURE, lora)
            pipeline.set_adapters(EXPOSURE, PAPER_DEFAULTS.lora_scale)
        if turbo_lora is not None:
            add_lora(pipeline, read_weights(turbo_lora), TURBO, turbo_lora)
            options = {"lora_swap": LoraSwap(), **options}
        return DiffusersPainter(pipeline.to(device), PAPER_DEFAULTS, **options)

    def evaluations(self, balls: int, steps: int, strength: float, until: float = 1.0) -> int:
        """See `painter.Painter`: two a ball and step, one where guidance is 1 and the negative prompt has no say."""
        return balls * len(steps_run(steps, strength, until)) * (1 if self.defaults.guidance == 1 else 2)

    @torch.no_grad()
    def paint(self, request: PaintRequest, observer: Observer) -> PaintResult:
        """See `painter.Painter`.

        Raises:
            ImageError: the canvas has not the size the ball was placed on.
            ModelError: the model does not fit in memory even with one ball at once.
        """
        require_canvas(request.canvas, request.ball)
        spent, notes = list[int](), list[str]()
        encoded = self.encode(request.canvas)

        def counted(evaluations: int) -> None:
            spent.append(evaluations)
            observer.evaluated(evaluations)

        def paint(seeds: tuple[int, ...]) -> BallImage:
            return self.decode_ball(self._inpaint(request, encoded, hint, seeds, counted), request.ball)

        try:
            with self._hint(request.depth) as hint:
                balls = torch.cat([balls for _, balls in self._batches.paint(request.seeds, paint, notes.append)])
        except RuntimeError as error:
            if not is_out_of_memory(error):
                raise
            reason = (
                f"does not fit in the memory of {self._device} with one ball of {request.ball.canvas} pixels' canvas"
            )
            raise ModelError("model", f"{reason}: free memory there, or take a smaller canvas") from error
        return PaintResult(balls, sum(spent), tuple(notes))

    @torch.no_grad()
    def inpaint(self, request: PaintRequest, encoded: Any, counted: Callable[[int], None]) -> Tensor:
        """Latents of a request's balls, not decoded, (n, 4, h, w); all are painted at once.

        Args:
            request: what to paint.
            encoded: its canvas, as `encode` gives it, or anything else with `latents`, (1, 4, h, w).
            counted: hears of the denoiser evaluations of each step.
        """
        with self._hint(request.depth) as hint:
            return self._inpaint(request, encoded, hint, request.seeds, counted)

    def _inpaint(
        self, request: PaintRequest, encoded: Any, hint: Tensor, seeds: tuple[int, ...], counted: Callable[[int], None]
    ) -> Tensor:
        """Algorithm 0 for a batch of balls, up to the request's `until`; returns latents (n, 4, h, w).

        `hint` is what the ControlNet takes; `counted` hears of the denoiser evaluations of each step.
        """
        scheduler = SAMPLERS[self.sampler](self.pipeline.scheduler.config)
        scheduler.set_timesteps(request.steps, device=self._device)
        run = steps_run(request.steps, request.strength, request.until)
        timesteps = scheduler.timesteps[run.start :]
        if hasattr(scheduler, "set_begin_index"):  # those that count steps; DDIM reads the timestep it is given
            scheduler.set_begin_index(run.start)

        clean, noise, generators = self._start(encoded, seeds)
        drawing = {"generator": generators} if self.sampler in STOCHASTIC else {}
        mask = ball_latent_mask(request.ball).to(clean)
        latents = (
            noise * scheduler.init_noise_sigma
            if request.strength == 1
            else scheduler.add_noise(clean, noise, timesteps[:1].expand(len(seeds)))
        )
        per_step = self.evaluations(len(seeds), 1, 1.0)
        denoise = self._denoiser(request, hint, len(seeds))
        for i, timestep in enumerate(timesteps[: len(run)]):
            self._choose_lora(float(timestep))
            seen = scheduler.scale_model_input(latents, timestep)
            predicted = denoise(seen, timestep)
            counted(per_step)
            if i + 1 == len(run) < len(timesteps):
                latents = _predicted_clean(scheduler, predicted, seen, timestep)
            else:
                latents = scheduler.step(predicted, timestep, latents, return_dict=False, **drawing)[0]
            if i + 1 == len(run):
                known = clean
            else:
                known_noise = (
                    noise if self.impute == "initial" else _predicted_noise(scheduler, predicted, seen, timestep)
                )
                known = scheduler.add_noise(clean, known_noise, timesteps[i + 1].expand(len(seeds)))
            latents = (1 - mask) * known + mask * latents
        return latents

    def _hint(self, depth: Image) -> AbstractContextManager[Tensor]:
        network = self.pipeline.unet if self.pipeline.controlnet is None else self.pipeline.controlnet
        return seen_once(self.pipeline.controlnet, depth.permute(0, 3, 1, 2).to(self._device, network.dtype))

    @torch.no_grad()
    def encode(self, canvas: Image) -> Any:
        """What the autoencoder makes of the canvas: latents, or a distribution to sample them from.

        The photograph comes back at every exposure, with a composite in between, so the last two are kept.
        """
        for known, encoded in self._encoded:
            if torch.equal(known, canvas):
                self._encoded = [*((k, e) for k, e in self._encoded if k is not known), (known, encoded)]
                return encoded
        vae = self.pipeline.vae
        encoded = vae.encode((canvas.permute(0, 3, 1, 2) * 2 - 1).to(self._device, vae.dtype))
        self._encoded = [*self._encoded[-1:], (canvas.clone(), encoded)]
        return encoded

    def _start(self, encoded: Any, seeds: tuple[int, ...]) -> tuple[Tensor, Tensor, list[torch.Generator]]:
        """Clean latents of the canvas and initial noise of each ball, (n, 4, h, w) each, in single precision.

        A sampling autoencoder draws from the ball's generator before the noise does, as in the authors' code. The
        generators come along: noise of the steps is drawn from them, in a walk of its own from generators beside them.
        """
        scale = self.pipeline.vae.config.scaling_factor
        clean, noise, generators = [], [], []
        for seed in seeds:
            generator = torch.Generator().manual_seed(seed)
            sample = encoded.latent_dist.sample(generator) if hasattr(encoded, "latent_dist") else encoded.latents
            clean.append(sample.float() * scale)
            noise.append(torch.randn(sample.shape, generator=generator).to(clean[-1]))
            if self.walk:
                generator.manual_seed(int(torch.randint(2**62, (), generator=generator)) + self.walk)
            generators.append(generator)
        return torch.cat(clean), torch.cat(noise), generators

    def _denoiser(self, request: PaintRequest, hint: Tensor, count: int) -> Callable[[Tensor, Tensor], Tensor]:
        """The guided denoiser ε(z, t, C) of Algorithm 0 with text and depth bound."""
        guidance = self.guidance_at(request.ev)
        scale = self.defaults.guidance
        tokens, pooled = guidance.tokens, guidance.pooled
        if scale != 1:
            tokens = torch.cat((guidance.negative_tokens, tokens))
            pooled = torch.cat((guidance.negative_pooled, pooled))
        tokens, pooled = (part.repeat_interleave(count, dim=0) for part in (tokens, pooled))
        side = float(request.ball.canvas)
        ids = pooled.new_tensor([[side, side, 0, 0, side, side]]).expand(len(pooled), -1)
        added = {"text_embeds": pooled, "time_ids": ids}
        cond = hint.expand(len(tokens), -1, -1, -1)
        unet, controlnet = self.pipeline.unet, self.pipeline.controlnet

        def denoise(noisy: Tensor, timestep: Tensor) -> Tensor:
            latents = noisy.to(unet.dtype)
            doubled = latents if scale == 1 else torch.cat((latents, latents))
            down, middle = None, None
            if controlnet is not None:
                down, middle = controlnet(
                    doubled,
                    timestep,
                    encoder_hidden_states=tokens,
                    controlnet_cond=cond,
                    conditioning_scale=self.defaults.control_scale,
                    added_cond_kwargs=added,
                    return_dict=False,
                )
            predicted = unet(
                doubled,
                timestep,
                encoder_hidden_states=tokens,
                added_cond_kwargs=added,
                down_block_additional_residuals=down,
                mid_block_additional_residual=middle,
                return_dict=False,
            )[0].float()
            if scale == 1:
                return predicted
            unwanted, wanted = predicted.chunk(2)
            return unwanted + scale * (wanted - unwanted)

        return denoise

    def _choose_lora(self, timestep: float) -> None:
        """Let the LoRA act whose turn it is at a timestep."""
        swap = self.lora_swap
        if swap is None:
            return
        turn = (TURBO, swap.turbo_scale) if swap.turbo_at(timestep) else (EXPOSURE, swap.exposure_scale)
        if turn != self._acting:
            self.pipeline.set_adapters(*turn)
            self._acting = turn

    @property
    def darkest_ev(self) -> float:
        """EV of the dark prompt, the darkest it was trained on: see `bracket.ExposureLimited`. Below it `guidance_at`
        goes on along the line of both prompts, past the dark one."""
        return self.defaults.ev_min

    def guidance_at(self, ev: float) -> Guidance:
        """Embeddings at an EV, see `exposure_prompts`."""
        own, unwanted, own_pooled, unwanted_pooled = self._embed(self.defaults.prompt)
        dark, _, dark_pooled, _ = self._embed(self.defaults.dark_prompt)
        evs, ev_min = torch.tensor([ev]), self.defaults.ev_min
        tokens = embedding_at(own, dark, evs, ev_min)
        return Guidance(tokens, embedding_at(own_pooled, dark_pooled, evs, ev_min), unwanted, unwanted_pooled)

    @torch.no_grad()
    def _embed(self, prompt: str) -> tuple[Tensor, Tensor, Tensor, Tensor]:
        """Token embeddings of a prompt and of the negative one, then the pooled ones; encoded once."""
        if prompt not in self._embeddings:
            self._embeddings[prompt] = self.pipeline.encode_prompt(
                prompt,
                device=self._device,
                do_classifier_free_guidance=True,
                negative_prompt=self.defaults.negative_prompt,
            )
        return self._embeddings[prompt]

    @torch.no_grad()
    def decode_ball(self, latents: Tensor, ball: Ball) -> BallImage:
        """Balls cut out of painted latents, (n, 4, h, w) -> (n, D, D, 3) in [0, 1]."""
        return decode_ball(self.decode, latents, ball, decode_margin(self.pipeline.vae)).cpu().contiguous()

    @torch.no_grad()
    def decode(self, latents: Tensor) -> Image:
        """Latents of any size as pictures, (n, 4, h, w) -> (n, 8 h, 8 w, 3) display-encoded, not clipped."""
        vae = self.pipeline.vae
        pixels = vae.decode(latents.to(vae.dtype) / vae.config.scaling_factor).sample
        return (pixels.float() / 2 + 0.5).permute(0, 2, 3, 1)

    @property
    def _device(self) -> torch.device:
        return self.pipeline.unet.device


def _empty_cache() -> None:
    if torch.cuda.is_available():
        torch.cuda.empty_cache()


def _predicted_noise(scheduler: Any, predicted: Tensor, seen: Tensor, timestep: Tensor) -> Tensor:
    """The noise a prediction stands for, whether the model predicts noise or velocity.

    `seen` is what the denoiser saw: latents of signal and noise whose squares add up to 1.
    """
    if scheduler.config.prediction_type == "epsilon":
        return predicted
    kept = scheduler.alphas_cumprod[int(timestep)].to(seen)
    return kept.sqrt() * predicted + (1 - kept).sqrt() * seen


def _predicted_clean(scheduler: Any, predicted: Tensor, seen: Tensor, timestep: Tensor) -> Tensor:
    """The clean latents a prediction stands for; arguments as of `_predicted_noise`."""
    kept = scheduler.alphas_cumprod[int(timestep)].to(seen)
    if scheduler.config.prediction_type == "epsilon":
        return (seen - (1 - kept).sqrt() * predicted) / kept.sqrt()
    return kept.sqrt() * seen - (1 - kept).sqrt() * predicted
