"""ComfyPainter: the Painter port on ComfyUI's own sampling.

With nodes/sampling.py, nodes/from_diffusers.py and nodes/mini.py this is the only file that touches ComfyUI's
internals: `comfy.model_management` (interruption, free memory), a model's `model_function_wrapper`, `model_config`,
`memory_required`, `model_size`, `loaded_size` and `patches_uuid`, a ControlNet's `copy`, `set_cond_hint` and
`get_models`, and a VAE's `encode`, `decode` and `first_stage_model`.

How it differs from the paper's Algorithm 0 in its authors' code. Outside the mask both hold the photograph's latent
with the same noise at the level of every evaluation (there: put in after a step; here: before an evaluation, which is
the same moment). At strength 1 the first evaluation sees noise alone, as there. On cells the mask covers partly, here
the estimate is blended with the clean latent too. The autoencoder's mode is encoded, not a sample.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Iterator
from dataclasses import dataclass, fields, replace
from typing import Any, Final

import comfy.model_management
import torch

from ..dl_core.ball import disc_mask
from ..dl_core.batches import Batches
from ..dl_core.decoding import decode_ball, decode_margin
from ..dl_core.errors import OptionError
from ..dl_core.finished import FinishedBalls, content_key
from ..dl_core.painter import IMPUTINGS, Imputing, Observer, PaintRequest, PaintResult, steps_run
from ..dl_core.shapes import BallImage, Mask
from .architecture import require_conditioning, require_control_net, require_sdxl, require_vae
from .sampling import LEADING, SAMPLERS, SCHEDULERS, STOCHASTIC, BallNoise, sample, sigmas_of

__all__ = ["ComfyPainter", "Guidance", "Networks"]

MOST_AT_ONCE: Final = 16
"""Balls of a batch that is chosen from free memory: beyond it a batch gains little, and an interrupt loses more."""


@dataclass(frozen=True)
class Networks:
    """What a graph connects to a node that paints, by socket.

    Attributes:
        model: MODEL of SDXL's architecture.
        positive: CONDITIONING of the ball at the exposure to paint.
        negative: CONDITIONING to move away from.
        vae: VAE of the model.
        control_net: CONTROL_NET for depth, of SDXL's architecture.
    """

    model: Any
    positive: Any
    negative: Any
    vae: Any
    control_net: Any


@dataclass(frozen=True)
class Guidance:
    """How the model is steered and sampled.

    Attributes:
        cfg: scale of classifier-free guidance; at 1 the negative prompt is not evaluated.
        sampler: of `SAMPLERS`.
        scheduler: of `SCHEDULERS`.
        control_strength: of the depth ControlNet; at 0 it is not evaluated.
        batch_size: balls painted at once; 0 is as many as memory allows (`_room`), up to `MOST_AT_ONCE`.
        impute: noise put on what lies outside the mask, see `painter.Imputing`.
    """

    cfg: float = 5.0
    sampler: str = "uni_pc"
    scheduler: str = LEADING
    control_strength: float = 0.5
    batch_size: int = 0
    impute: Imputing = "initial"

    def __post_init__(self) -> None:
        tables = {"sampler": SAMPLERS, "scheduler": SCHEDULERS, "impute": IMPUTINGS}
        for name, accepted in tables.items():
            value = getattr(self, name)
            if value not in accepted:
                raise OptionError(name, value, ", ".join(accepted))
        if not 1 <= self.cfg < math.inf:
            raise OptionError("cfg", self.cfg, "1 or more; at 1 the negative prompt is left out")
        if self.batch_size < 0:
            raise OptionError("batch_size", self.batch_size, "1 or more, or 0 to let free memory decide")


class ComfyPainter:
    """Paints chrome balls with a graph's MODEL, CONDITIONING, VAE and CONTROL_NET."""

    def __init__(
        self,
        networks: Networks,
        guidance: Guidance,
        *,
        mask: Mask | None = None,
        on_balls: Callable[[BallImage], None] | None = None,
        finished: FinishedBalls | None = None,
    ) -> None:
        """Take the graph's models.

        Args:
            networks: what the graph connects.
            guidance: how to sample.
            mask: (1, S, S) where to paint; the ball's disc grown by its dilation when not given.
            on_balls: hears of the balls of a request painted so far, (n, D, D, 3), after every batch.
            finished: balls of earlier runs, and where those painted now are kept. A ball that is there is not painted
                again; what it cost is told to the observer and left out of the result's cost.

        Raises:
            ModelError: a model or conditioning of another architecture; the socket is named.
        """
        require_sdxl(networks.model)
        require_vae(networks.vae, networks.model)
        require_control_net(networks.control_net)
        for socket in ("positive", "negative"):
            require_conditioning(socket, getattr(networks, socket), networks.model)
        self._networks, self._guidance = networks, guidance
        self._mask, self._on_balls = mask, on_balls
        self._finished = FinishedBalls(0) if finished is None else finished
        self._batches: Batches | None = None

    def evaluations(self, balls: int, steps: int, strength: float, until: float = 1.0) -> int:
        """Denoiser evaluations that painting so many balls takes, exactly."""
        return balls * len(steps_run(steps, strength, until)) * (1 if self._guidance.cfg == 1 else 2)

    def paint(self, request: PaintRequest, observer: Observer) -> PaintResult:
        """Paint the balls of a request.

        ComfyUI's interruption is honoured before every evaluation of the model, and passes through as ComfyUI's own
        exception.

        Raises:
            OptionError: a schedule the sampler cannot run.
        """
        counter, notes = _Counter(observer), list[str]()
        mask = self._mask if self._mask is not None else disc_mask(request.ball, grow=request.ball.dilation)
        sampler, scheduler = self._guidance.sampler, self._guidance.scheduler
        every = sigmas_of(self._networks.model, sampler, scheduler, request.steps)
        run = steps_run(request.steps, request.strength, request.until)
        sigmas, evaluated = every[run.start :], len(run)
        if len(sigmas) < 3 and sampler.startswith("uni_pc"):
            raise OptionError("steps", request.steps, f"at least 2 steps to run with the sampler {sampler}")
        if sampler in STOCHASTIC and request.strength == 1:  # once an exposure
            notes.append(
                f"{sampler} is stochastic: it draws new noise at every step, from each ball's seed, so balls repeat, "
                "but the noise a ball starts from no longer decides it, as the paper assumes"
            )
        key = self._key(request, mask)
        balls = self._finished.find(key, request.seeds)
        if balls:
            notes.append(f"{len(balls)} of {len(request.seeds)} balls taken from an earlier run")
            observer.evaluated(self.evaluations(len(balls), request.steps, request.strength, request.until))
        wanted = tuple(seed for seed in request.seeds if seed not in balls)
        for seeds, painted in self._paint(request, wanted, mask, sigmas, evaluated, counter, notes.append):
            self._finished.keep(key, seeds, painted)
            balls |= dict(zip(seeds, painted.split(1), strict=True))
            if self._on_balls:
                self._on_balls(torch.cat(list(balls.values())))
        return PaintResult(torch.cat([balls[seed] for seed in request.seeds]), counter.count, tuple(notes))

    def _paint(
        self,
        request: PaintRequest,
        wanted: tuple[int, ...],
        mask: Mask,
        sigmas: torch.Tensor,
        evaluations: int,
        counter: _Counter,
        note: Callable[[str], None],
    ) -> Iterator[tuple[tuple[int, ...], BallImage]]:
        """Paint the balls of the seeds wanted, batch by batch; nothing but their crops outlives a batch."""
        if not wanted:
            return
        model = _watched(self._networks.model, counter)
        vae = self._networks.vae
        latent, margin = vae.encode(request.canvas), decode_margin(vae.first_stage_model)
        positive, negative = self._controlled(request)

        guidance = self._guidance
        after_posterior = _draws_posterior(vae)

        def paint(seeds: tuple[int, ...]) -> BallImage:
            samples = sample(
                model,
                BallNoise(seeds, latent, after_posterior=after_posterior),
                latent,
                mask,
                sigmas,
                sampler=guidance.sampler,
                cfg=guidance.cfg,
                positive=positive,
                negative=negative,
                impute=guidance.impute,
                from_noise=request.strength == 1,
                evaluations=evaluations,
            )
            return decode_ball(vae.decode, samples, request.ball, margin)

        if self._batches is None:
            size = self._guidance.batch_size or self._room(latent)
            self._batches = Batches(size, comfy.model_management.soft_empty_cache)
        yield from self._batches.paint(wanted, paint, note)

    def _room(self, latent: torch.Tensor) -> int:
        """Balls that fit in free memory at once, by ComfyUI's own estimate of what the model needs.

        Of the memory that is free now, weights still to be loaded and ComfyUI's own reserve are left out. What other
        models hold counts as taken, though ComfyUI may unload them: a careful guess, and a shortage halves it.
        """
        model, doubled = self._networks.model, 1 if self._guidance.cfg == 1 else 2
        each = model.memory_required([doubled, *latent.shape[1:]])
        networks = [model, *self._networks.control_net.get_models()]
        unloaded = sum(network.model_size() - network.loaded_size() for network in networks)
        free = comfy.model_management.get_free_memory(model.load_device)
        spare = free - unloaded - comfy.model_management.minimum_inference_memory()
        return max(1, min(MOST_AT_ONCE, int(spare / each)))

    def _key(self, request: PaintRequest, mask: Mask) -> str:
        """What decides the balls of a request, but for their seeds."""
        networks = {field.name: getattr(self._networks, field.name) for field in fields(Networks)}
        guidance = replace(self._guidance, batch_size=0)
        patches = getattr(self._networks.model, "patches_uuid", None)
        # The EV reaches the ball through its conditioning alone.
        asked = replace(request, seeds=(0,), ev=0.0)
        return content_key(networks, str(patches), guidance, mask, asked)

    def _controlled(self, request: PaintRequest) -> tuple[Any, Any]:
        """Both conditionings with SDXL's picture sizes (their own win) and the depth control (after any they have)."""
        side = request.ball.canvas
        sizes = {"width": side, "height": side, "target_width": side, "target_height": side}
        hint = request.depth.movedim(-1, 1)
        controls: dict[int, Any] = {}

        def with_control(options: dict[str, Any]) -> dict[str, Any]:
            strength = self._guidance.control_strength
            if strength == 0:
                return {}
            # Prompts share one control object: ComfyUI evaluates only such conditionings together.
            previous = options.get("control")
            if id(previous) not in controls:
                control = self._networks.control_net.copy().set_cond_hint(
                    hint, strength, (0.0, 1.0), vae=self._networks.vae
                )
                control.set_previous_controlnet(previous)
                controls[id(previous)] = control
            return {"control": controls[id(previous)], "control_apply_to_uncond": False}

        def dress(conditioning: Any) -> Any:
            return [[embedding, {**sizes, **options, **with_control(options)}] for embedding, options in conditioning]

        return dress(self._networks.positive), dress(self._networks.negative)


class _Counter:
    """Counts evaluations of the model, and tells an observer."""

    def __init__(self, observer: Observer) -> None:
        self.count = 0
        self._observer = observer

    def add(self, evaluations: int) -> None:
        self.count += evaluations
        self._observer.evaluated(evaluations)


def _watched(model: Any, counter: _Counter) -> Any:
    """A clone of a MODEL that counts its evaluations and gives way to interruption before each."""
    watched = model.clone()
    wrapped = watched.model_options.get("model_function_wrapper")

    def evaluate(apply_model: Callable[..., torch.Tensor], arguments: dict[str, Any]) -> torch.Tensor:
        comfy.model_management.throw_exception_if_processing_interrupted()
        if wrapped is None:
            output = apply_model(arguments["input"], arguments["timestep"], **arguments["c"])
        else:
            output = wrapped(apply_model, arguments)
        counter.add(len(arguments["input"]))
        return output

    watched.set_model_unet_function_wrapper(evaluate)
    return watched


def _draws_posterior(vae: Any) -> bool:
    """Whether a VAE encodes to a distribution, as SDXL's does, and not to latents, as TAESD does."""
    return hasattr(vae.first_stage_model, "regularization")
