"""Train the exposure LoRA: one set of low-rank weights, steered by interpolated prompts.

Source: DiffusionLight, Sec. 4.2 (Eq. 4 and 5), Sec. 5, and the appendix on LoRA training; Hu et al. 2022 (LoRA).
"""

from __future__ import annotations

import json
from collections.abc import Callable, Sequence
from contextlib import contextmanager
from dataclasses import dataclass, replace
from datetime import timedelta
from pathlib import Path
from typing import Any, Final

import torch
from accelerate import Accelerator
from accelerate.utils import InitProcessGroupKwargs
from peft import LoraConfig
from peft.utils import get_peft_model_state_dict
from torch import Tensor, nn

from ...backends.diffusers_lora import EXPOSURE, lora_shapes
from ...backends.diffusers_painter import DiffusersPainter, Guidance
from ...backends.mini import ModelDefaults
from ...errors import Interrupted, OptionError, OutputError
from ...exposure_prompts import embedding_at
from ..mini.denoiser import time_ids, weighted_error
from ..stopping import asked_to_stop
from .base import LoraBase
from .batches import LoraBatch, LoraBatches
from .file import kohya_weights
from .keeper import CheckpointKeeper, LoraJob
from .latent_cache import LatentCache, Pairs, data_fingerprint, encode_pairs
from .log import TrainingLog
from .settings import SEPARATE_PROMPT, LoraSettings
from .validation import VALIDATION_EVS, Validation, ValidationPictures

__all__ = ["ATTENTION_LAYERS", "TrainedLora", "add_exposure_adapter", "train_exposure_loras"]

ATTENTION_LAYERS: Final = ("to_q", "to_k", "to_v", "to_out.0")
"""The projections of every attention, which is where the authors' LoRA acts."""

NEAR: Final = 0.25
"""For a LoRA of one exposure: pairs so near to it, in EV, count as of that exposure."""

GRADIENT_NORM: Final = 1.0
PATIENCE: Final = timedelta(hours=3)
"""How long processes wait for one another: encoding and pictures of validation are not shared evenly."""

Report = Callable[[str], None]


@dataclass(frozen=True)
class TrainedLora:
    """A finished LoRA.

    Attributes:
        weights: as `file.kohya_weights` names them.
        metadata: what it was made of and how.
        ev: its exposure, where it is for one alone.
    """

    weights: dict[str, Tensor]
    metadata: dict[str, str]
    ev: float | None


@dataclass(frozen=True)
class _Frozen:
    """All that stays the same while LoRAs are trained."""

    accelerator: Accelerator
    base: LoraBase
    painter: DiffusersPainter
    original: Guidance
    dark: Guidance
    cache: LatentCache

    def predict(self, unet: nn.Module, batch: LoraBatch, ev_min: float) -> Tensor:
        """The model's prediction for a batch, single precision."""
        device = self.accelerator.device
        tokens = embedding_at(self.original.tokens, self.dark.tokens, batch.evs, ev_min)
        pooled = embedding_at(self.original.pooled, self.dark.pooled, batch.evs, ev_min)
        added = {"text_embeds": pooled, "time_ids": time_ids(len(pooled), self.cache.canvas).to(pooled)}
        predicted: Tensor = unet(
            batch.noisy.to(device, tokens.dtype),
            batch.timesteps.to(device),
            tokens,
            added_cond_kwargs=added,
            return_dict=False,
        )[0]
        return predicted.float()


def train_exposure_loras(
    base: LoraBase,
    pairs: Pairs,
    settings: LoraSettings,
    work: Path,
    *,
    separate: Sequence[float] = (),
    report: Report,
) -> list[TrainedLora]:
    """Train the exposure LoRA, or in its place one LoRA for each of some exposures (the paper's ablation).

    Base weights, text encoders and autoencoder stay as they are; encoders leave memory once their work is kept. Under
    `torchrun` P processes train as one would with `accumulation` P times as large. On a CPU the result follows bit for
    bit from settings, pairs and model, however often the training was stopped.

    Args:
        base: its pipeline's text encoders are gone afterwards, and the autoencoder too unless pictures are painted.
        pairs: at one canvas size, exposures in [ev_min, 0].
        settings: of the training.
        work: folder for cached latents, checkpoint, log and pictures; a training goes on from what is there.
        separate: exposures that get a LoRA of their own, each trained on the pairs within 0.25 EV and prompted with
            `SEPARATE_PROMPT`.
        report: told of progress.

    Returns:
        The LoRA, or those of `separate` in its order.

    Raises:
        OptionError: the checkpoint there is of another training, pairs are darker than `ev_min`, or there are none at
            one of `separate`.
        Interrupted: Ctrl-C, after a checkpoint.
        OutputError: latents cannot be written.
    """
    accelerator = Accelerator(
        mixed_precision=settings.precision,
        gradient_accumulation_steps=settings.accumulation,
        cpu=not torch.cuda.is_available(),
        kwargs_handlers=[InitProcessGroupKwargs(timeout=PATIENCE)],
    )
    work.mkdir(parents=True, exist_ok=True)
    defaults = _prompted(base.defaults, settings, bool(separate))
    data, model = data_fingerprint(pairs), base.fingerprint()
    told = {"the base model": model, "the data": data, "the prompts": _prompts(defaults)}
    told |= settings.decisive() | {"the number of processes": str(accelerator.num_processes)}
    jobs = [LoraJob(work, None, told | {"--separate": "none"})]
    if separate:
        jobs = [LoraJob(work / f"ev{ev:g}", ev, told | {"--separate": f"{ev:g}"}) for ev in separate]
    for job in jobs:
        job.resumed()  # a checkpoint of another training is refused before the long work of encoding
    frozen = _freeze(accelerator, base, defaults, pairs, work / "latents", {"base": model, "data": data}, report)
    _require_within(frozen.cache, settings.ev_min)
    chosen = [_chosen(frozen.cache, job.ev) for job in jobs]
    _release(frozen.painter.pipeline, keep_autoencoder=settings.validate_every > 0)
    return [_train(frozen, job, pairs, settings, report) for job, pairs in zip(jobs, chosen, strict=True)]


def _prompted(defaults: ModelDefaults, settings: LoraSettings, separate: bool) -> ModelDefaults:
    defaults = replace(defaults, ev_min=settings.ev_min)
    return replace(defaults, prompt=SEPARATE_PROMPT, dark_prompt=SEPARATE_PROMPT) if separate else defaults


def _prompts(defaults: ModelDefaults) -> str:
    return json.dumps([defaults.prompt, defaults.dark_prompt])


def _require_within(cache: LatentCache, ev_min: float) -> None:
    darkest = float(cache.evs.min())
    if darkest < ev_min:
        raise OptionError("--ev-min", ev_min, f"{darkest:.4g} or below, the darkest of the pairs")


def _chosen(cache: LatentCache, ev: float | None) -> Tensor:
    chosen = torch.arange(cache.count) if ev is None else cache.near(ev, NEAR)
    if len(chosen) == 0:
        found = f"{float(cache.evs.min()):.3g} to {float(cache.evs.max()):.3g}"
        raise OptionError("--separate", ev, f"EVs that pairs are within {NEAR} of; these pairs span {found}")
    return chosen


def _freeze(
    accelerator: Accelerator,
    base: LoraBase,
    defaults: ModelDefaults,
    pairs: Pairs,
    folder: Path,
    identity: dict[str, str],
    report: Report,
) -> _Frozen:
    """Encode prompts and pictures."""
    pipeline = base.pipeline
    for name in ("text_encoder", "text_encoder_2", "vae"):
        getattr(pipeline, name).requires_grad_(False).eval()
    pipeline.to(accelerator.device)
    painter = DiffusersPainter(pipeline, defaults)
    original, dark = painter.guidance_at(0.0), painter.guidance_at(defaults.ev_min)
    cache = encode_pairs(
        pairs,
        base.encode,
        folder,
        identity,
        share=(accelerator.process_index, accelerator.num_processes),
        together=accelerator.wait_for_everyone,
        report=report,
    )
    return _Frozen(accelerator, base, painter, original, dark, cache)


def _release(pipeline: Any, *, keep_autoencoder: bool) -> None:
    """Let go of what only encodes; the autoencoder waits on the CPU where pictures are painted now and then."""
    pipeline.register_modules(text_encoder=None, text_encoder_2=None)
    if keep_autoencoder:
        pipeline.vae.to("cpu")
    else:
        pipeline.register_modules(vae=None)
    if torch.cuda.is_available():
        torch.cuda.empty_cache()


def add_exposure_adapter(unet: Any, settings: LoraSettings) -> list[nn.Parameter]:
    """Give a UNet a LoRA that does nothing yet, on the projections of all its attentions; everything else is frozen.

    Returns:
        The LoRA's weights, single precision. The down halves are normal with deviation 1 / rank from the seed; the up
        halves are 0.
    """
    unet.requires_grad_(False)
    with torch.random.fork_rng(devices=[]):
        torch.manual_seed(settings.seed)
        config = LoraConfig(
            r=settings.rank,
            lora_alpha=settings.rank,
            target_modules=list(ATTENTION_LAYERS),
            init_lora_weights="gaussian",
        )
        unet.add_adapter(config, adapter_name=EXPOSURE)
    weights = [weight for weight in unet.parameters() if weight.requires_grad]
    for weight in weights:
        weight.data = weight.data.float()
    if settings.gradient_checkpointing:
        unet.enable_gradient_checkpointing()
    unet.train()
    return weights


def _train(frozen: _Frozen, job: LoraJob, chosen: Tensor, settings: LoraSettings, report: Report) -> TrainedLora:
    job.folder.mkdir(parents=True, exist_ok=True)
    accelerator, unet = frozen.accelerator, frozen.base.pipeline.unet
    weights = add_exposure_adapter(unet, settings)
    prepared, optimizer = accelerator.prepare(unet, torch.optim.AdamW(weights, lr=settings.learning_rate))
    keeper = CheckpointKeeper(accelerator, unet, optimizer, job, settings, report)
    batches = LoraBatches(
        frozen.cache,
        chosen,
        frozen.base.schedule,
        settings.batch,
        settings.timesteps,
        settings.seed,
        frozen.base.from_noise,
    )

    def loss_of_batch(number: int) -> Tensor:
        batch = batches.batch(number)
        predicted = frozen.predict(prepared, batch, settings.ev_min)
        return weighted_error(predicted, batch.target.to(predicted), batch.ball.to(predicted))

    step = keeper.resume()
    pictures = _pictures(frozen, job, settings)
    with _log(job.folder, step, accelerator, report) as log, asked_to_stop() as stop:
        while step < settings.steps:
            loss, stopped = _step(accelerator, prepared, optimizer, weights, loss_of_batch, step, settings, stop)
            step += 1
            if log is not None:
                log.step(step, loss, settings.rate(step - 1))
            keeper.after(step, loss)
            if pictures is not None and log is not None and _is_time(step, settings):
                _show(pictures, step, log, report)
            if stopped and step < settings.steps:
                kept = keeper.save(step)
                raise Interrupted(f"training stopped at step {step}; {kept}; the same command goes on")
    keeper.save(step)
    adapter = get_peft_model_state_dict(unet, adapter_name=EXPOSURE)
    layers = lora_shapes(unet)
    trained = TrainedLora(kohya_weights(adapter, layers), _metadata(frozen, job, settings), job.ev)
    accelerator.unwrap_model(prepared, keep_fp32_wrapper=False)
    accelerator.free_memory()
    unet.unload_lora()
    return trained


def _step(
    accelerator: Accelerator,
    unet: nn.Module,
    optimizer: Any,
    weights: Sequence[nn.Parameter],
    loss_of_batch: Callable[[int], Tensor],
    step: int,
    settings: LoraSettings,
    stop: Callable[[], bool],
) -> tuple[float, bool]:
    """One optimizer step; the loss over all its batches, and whether any process was asked to stop."""
    for group in optimizer.param_groups:
        group["lr"] = settings.rate(step)
    total = torch.zeros((), device=accelerator.device)
    for part in range(settings.accumulation):
        number = (step * settings.accumulation + part) * accelerator.num_processes + accelerator.process_index
        with accelerator.accumulate(unet):
            loss = loss_of_batch(number)
            accelerator.backward(loss)
            if accelerator.sync_gradients:
                accelerator.clip_grad_norm_(weights, GRADIENT_NORM)
            optimizer.step()
            optimizer.zero_grad()
        total += loss.detach() / settings.accumulation
    told = torch.stack((total, total.new_tensor(float(stop()))))
    mean, stopped = accelerator.reduce(told, reduction="mean").tolist()  # type: ignore[union-attr]
    return mean, stopped > 0


def _pictures(frozen: _Frozen, job: LoraJob, settings: LoraSettings) -> ValidationPictures | None:
    if not settings.validate_every or not frozen.accelerator.is_main_process:
        return None
    evs = VALIDATION_EVS if job.ev is None else (job.ev,)
    validation = Validation.of(frozen.painter, frozen.cache.canvas, tuple(ev for ev in evs if ev >= settings.ev_min))
    return ValidationPictures(validation, job.folder / "pictures")


def _show(pictures: ValidationPictures, step: int, log: TrainingLog, report: Report) -> None:
    try:
        log.picture(pictures.title, pictures.paint(step), step)
    except OutputError as error:
        report(f"{error}; training goes on without this picture")


def _is_time(step: int, settings: LoraSettings) -> bool:
    return step % settings.validate_every == 0 or step == settings.steps


@contextmanager
def _log(folder: Path, step: int, accelerator: Accelerator, report: Report) -> Any:
    """The log of the main process; the others keep none."""
    if not accelerator.is_main_process:
        yield None
        return
    log = TrainingLog(folder, step, report)
    try:
        yield log
    finally:
        log.close()


def _metadata(frozen: _Frozen, job: LoraJob, settings: LoraSettings) -> dict[str, str]:
    defaults = frozen.painter.defaults
    return {
        "base": f"{frozen.base.source} {job.identity['the base model']}",
        "rank": str(settings.rank),
        "ev_min": f"{settings.ev_min:g}",
        "steps": str(settings.steps),
        "timesteps": "{}-{}".format(*settings.timesteps),
        "batch": str(settings.batch * settings.accumulation * frozen.accelerator.num_processes),
        "learning_rate": f"{settings.learning_rate:g}",
        "seed": str(settings.seed),
        "prompt": defaults.prompt,
        "dark_prompt": defaults.dark_prompt,
        "data": job.identity["the data"],
        "pairs": str(frozen.cache.count),
    } | ({} if job.ev is None else {"ev": f"{job.ev:g}"})
