"""One pass of ComfyUI's sampling over a batch of balls: samplers, schedules, noise, and what lies around the mask.

Relied on of ComfyUI: `comfy.sample.sample_custom`, `comfy.samplers` (sampler_object, KSAMPLER, KSampler's schedules), a
model's `model_sampling` and its hook after guidance.
"""

from __future__ import annotations

from typing import Any, Final

import comfy.sample
import comfy.samplers
import torch

from ..dl_core.errors import OptionError
from ..dl_core.painter import Imputing
from ..dl_core.shapes import Mask

__all__ = [
    "LEADING",
    "SAMPLERS",
    "SCHEDULERS",
    "STOCHASTIC",
    "BallNoise",
    "leading_timesteps",
    "sample",
    "sigmas_of",
]


def _offered(*names: str) -> tuple[str, ...]:
    return tuple(name for name in names if name in comfy.samplers.KSampler.SAMPLERS)


STOCHASTIC: Final = _offered("lcm", "euler_ancestral", "dpmpp_2m_sde", "ddpm")
"""Samplers that draw noise at every step; here each ball's from its own generator (`BallNoise`)."""

SAMPLERS: Final = (
    *_offered("uni_pc", "uni_pc_bh2", "euler", "dpmpp_2m", "deis", "ipndm", "ipndm_v", "lms", "res_multistep"),
    *STOCHASTIC,
)
"""ComfyUI's samplers that evaluate the model once a step and draw no noise that is not the ball's.

The others would break one of the method's rules: that a ball depends on its seed alone and not on who shares its
batch, that exposures share their noise, and that the cost of a run is known before it starts. ComfyUI's `ddim` is
`euler` with another noise around the mask.
"""

LEADING: Final = "leading (paper)"
SCHEDULERS: Final = (LEADING, *(name for name in comfy.samplers.KSampler.SCHEDULERS if name != "ddim_uniform"))
"""The paper's schedule, then ComfyUI's, except one that does not keep to the number of steps asked for."""


def leading_timesteps(steps: int, trained: int = 1000) -> list[int]:
    """Timesteps that UniPC visits with SDXL's scheduler settings (leading spacing, offset 1), first to last.

    30 steps visit 961, 929 … 33.

    Raises:
        OptionError: fewer timesteps than steps.
    """
    stride = trained // (steps + 1)
    if stride < 1:
        raise OptionError("steps", steps, f"1 to {trained - 1}")
    return [stride * (steps - i) + 1 for i in range(steps)]


def sigmas_of(model: Any, sampler: str, scheduler: str, steps: int) -> torch.Tensor:
    """Noise levels of a full schedule, (steps + 1,), the last one 0.

    Raises:
        OptionError: a schedule that cannot be cut into so many steps.
    """
    if scheduler == LEADING:
        sampling = model.get_model_object("model_sampling")
        levels = sampling.sigma(torch.tensor(leading_timesteps(steps), dtype=torch.float32))
        return torch.cat((levels.float().cpu(), torch.zeros(1)))
    schedule = comfy.samplers.KSampler(model, steps, "cpu", sampler, scheduler, denoise=1.0)
    # ComfyUI's kl_optimal divides by 0 for one step.
    if len(schedule.sigmas) != steps + 1 or not torch.isfinite(schedule.sigmas).all():
        raise OptionError("scheduler", scheduler, f"a schedule that can be cut into {steps} steps")
    return schedule.sigmas.float()


class BallNoise:
    """All noise of a batch of balls, each ball's from a generator of its own, on the CPU.

    So a ball depends neither on its batch nor on the device, and a stochastic sampler's draws are the ball's too.

    Args:
        seeds: of the balls.
        latent: (1, ...) of the canvas.
        after_posterior: whether a sample of the autoencoder's posterior is drawn first, as diffusers and the authors'
            code do, so that a seed means the same noise here. ComfyUI takes the mode, and the draw itself is dropped.
    """

    def __init__(self, seeds: tuple[int, ...], latent: torch.Tensor, *, after_posterior: bool) -> None:
        self._generators = [torch.Generator().manual_seed(seed) for seed in seeds]
        self._shape = (1, *latent.shape[1:])
        if after_posterior:
            self._draw()
        self.initial = self._draw()
        """(n, ...) the noise that the balls start from."""
        self._device = latent.device

    def _draw(self) -> torch.Tensor:
        return torch.cat([torch.randn(self._shape, generator=generator) for generator in self._generators])

    def __call__(self, sigma: Any, sigma_next: Any) -> torch.Tensor:
        """Noise of a step, (n, ...), as ComfyUI's stochastic samplers ask for it: its levels do not matter."""
        return self._draw().to(getattr(sigma, "device", self._device))


def sample(
    model: Any,
    noise: BallNoise,
    latent: torch.Tensor,
    mask: Mask,
    sigmas: torch.Tensor,
    *,
    sampler: str,
    cfg: float,
    positive: Any,
    negative: Any,
    impute: Imputing,
    from_noise: bool,
    evaluations: int,
) -> torch.Tensor:
    """Paint a batch of balls in latent space.

    Args:
        model: MODEL.
        noise: of the balls.
        latent: (1, C, h, w) of the canvas.
        mask: (1, S, S) where to paint.
        sigmas: noise levels to visit, the last one 0.
        sampler: of `SAMPLERS`.
        cfg: guidance scale.
        positive: CONDITIONING wanted.
        negative: CONDITIONING unwanted.
        impute: noise put on what lies outside the mask.
        from_noise: whether the first evaluation sees noise alone. ComfyUI puts the photograph in around the mask from
            the first evaluation on; the authors' code and Algorithm 0 start from noise everywhere and put it in after
            the first step.
        evaluations: of the model for each ball, at most the steps of `sigmas`. After fewer the answer is what the last
            one took for the clean latents, the photograph's around the mask; so it is that of a whole run's step.

    Returns:
        (n, C, h, w) latents.
    """
    predicted = _PredictedNoise() if impute == "predicted" else None
    if predicted is not None:
        model = model.clone()
        model.set_model_sampler_post_cfg_function(predicted.record)
    count = len(noise.initial)
    return comfy.sample.sample_custom(  # type: ignore[no-any-return]
        model,
        noise.initial,
        cfg,
        _sampler(
            sampler,
            model,
            noise,
            predicted,
            from_noise=from_noise,
            evaluations=evaluations if evaluations < len(sigmas) - 1 else None,
        ),
        sigmas.clone(),  # uni_pc writes into it
        positive,
        negative,
        latent.expand(count, -1, -1, -1),
        noise_mask=mask,
        disable_pbar=True,
        seed=0,  # of draws that no sampler offered here makes
    )


def _sampler(
    name: str,
    model: Any,
    noise: BallNoise,
    predicted: _PredictedNoise | None,
    *,
    from_noise: bool,
    evaluations: int | None,
) -> Any:
    """ComfyUI's sampler of a name, with the balls' own noise and what is asked for around the mask.

    It stops after so many evaluations, where a number is given.
    """
    sampler = comfy.samplers.sampler_object(name)
    extra = {**sampler.extra_options, **({"noise_sampler": noise} if name in STOCHASTIC else {})}
    sampling = model.get_model_object("model_sampling")

    def run(inpaint: Any, x: torch.Tensor, sigmas: torch.Tensor, **options: Any) -> torch.Tensor:
        start = None
        if from_noise:
            x = sampling.noise_scaling(sigmas[0], inpaint.noise, torch.zeros_like(x), True)
            # Where the first estimate is the answer, the photograph belongs around it, and the noise makes up for it.
            around = inpaint.latent_image if evaluations == 1 else torch.zeros_like(x)
            start = (around, (x - around) / sigmas[0])
        try:
            return sampler.sampler_function(  # type: ignore[no-any-return]
                _AroundTheMask(inpaint, start, predicted, evaluations), x, sigmas, **options
            )
        except _EarlyAnswer as early:
            return early.latents

    return comfy.samplers.KSAMPLER(run, extra, sampler.inpaint_options)


class _PredictedNoise:
    """The noise that the last evaluation predicted, guidance included, as Algorithm 0 imputes it."""

    def __init__(self) -> None:
        self.noise: torch.Tensor | None = None

    def record(self, evaluated: dict[str, Any]) -> torch.Tensor:
        """Hear of an evaluation, as ComfyUI's hook after guidance."""
        sigma, denoised = evaluated["sigma"], evaluated["denoised"]
        self.noise = (evaluated["input"] - denoised) / sigma.reshape(-1, *[1] * (denoised.ndim - 1))
        return denoised  # type: ignore[no-any-return]


class _EarlyAnswer(Exception):  # noqa: N818 -- no error: the way out of a sampler before its schedule ends
    """Clean latents as the last evaluation asked for took them to be."""

    def __init__(self, latents: torch.Tensor) -> None:
        super().__init__("denoising ends here")
        self.latents = latents


class _AroundTheMask:
    """ComfyUI's inpainting denoiser, told evaluation by evaluation what to put around the mask.

    Args:
        inpaint: ComfyUI's; what lies around the mask is its `latent_image` under its `noise`.
        start: latents and noise put there at the first evaluation in place of the photograph's, the noise in units of
            the first noise level.
        predicted: where the noise of later evaluations is found; the initial noise throughout without it.
        evaluations: after which `_EarlyAnswer` ends the sampling; none for a sampler that runs to its end.
    """

    def __init__(
        self,
        inpaint: Any,
        start: tuple[torch.Tensor, torch.Tensor] | None,
        predicted: _PredictedNoise | None,
        evaluations: int | None,
    ) -> None:
        self._inpaint, self._start, self._predicted = inpaint, start, predicted
        self._known = (inpaint.latent_image, inpaint.noise)
        self._left = evaluations

    def __call__(self, *arguments: Any, **options: Any) -> torch.Tensor:
        inpaint, (latent, initial) = self._inpaint, self._known
        if self._start is not None:
            inpaint.latent_image, inpaint.noise = self._start
            self._start = None
        elif self._predicted is not None and self._predicted.noise is not None:
            inpaint.noise = self._predicted.noise
        try:
            clean = inpaint(*arguments, **options)
        finally:
            inpaint.latent_image, inpaint.noise = latent, initial
        if self._left is not None:
            self._left -= 1
            if self._left == 0:
                raise _EarlyAnswer(clean)
        return clean  # type: ignore[no-any-return]

    def __getattr__(self, name: str) -> Any:
        return getattr(self._inpaint, name)
