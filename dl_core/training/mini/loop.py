"""A training loop that can be killed at any moment: seeded, checkpointed, resumed where it stood.

Under `torchrun` the processes share every step: each draws its own batch and the gradients are averaged, so P processes
train as one would with batches P times as large.
"""

from __future__ import annotations

import json
import math
import time
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import torch
from accelerate import PartialState
from accelerate.utils import reduce
from torch import Tensor, nn

from ...errors import Interrupted, OptionError

__all__ = ["Budget", "average_weights", "train", "training_device"]


@dataclass(frozen=True)
class Budget:
    """How long to train, how fast, and in what precision.

    Attributes:
        steps: optimizer steps in all.
        learning_rate: at the end of the warm-up; it falls to zero along a cosine.
        warmup: steps of linear warm-up.
        checkpoint_seconds: time between checkpoints.
        bf16: compute losses under autocast to bfloat16; weights, averages and optimizer stay in single precision.
    """

    steps: int
    learning_rate: float
    warmup: int = 50
    checkpoint_seconds: float = 120.0
    bf16: bool = False

    def __post_init__(self) -> None:
        if self.steps < 1:
            raise OptionError("steps", self.steps, "1 or more")
        if not self.learning_rate > 0:
            raise OptionError("learning rate", self.learning_rate, "above 0")

    def rate(self, step: int) -> float:
        """Learning rate of a step."""
        if step < self.warmup:
            return self.learning_rate * (step + 1) / self.warmup
        progress = (step - self.warmup) / max(1, self.steps - self.warmup)
        return self.learning_rate * 0.5 * (1 + math.cos(math.pi * min(1.0, progress)))


def training_device() -> torch.device:
    """Where networks are trained: this process's GPU if there is one."""
    device: torch.device = PartialState(cpu=not torch.cuda.is_available()).device
    return device


@torch.no_grad()
def average_weights(averages: Sequence[Tensor], weights: Sequence[Tensor], step: int, horizon: float = 0.998) -> None:
    """Move exponential averages of weights towards the current ones; early steps are forgotten faster."""
    decay = min(horizon, (1 + step) / (10 + step))
    torch._foreach_lerp_(tuple(averages), tuple(weights), 1 - decay)


def _share_gradients(weights: Sequence[Tensor]) -> None:
    """Give every process the mean of all processes' gradients; a weight its batch did not touch counts as zero."""
    own = [torch.zeros_like(weight) if weight.grad is None else weight.grad for weight in weights]
    shared = reduce(torch.cat([gradient.flatten() for gradient in own]), reduction="mean")
    for weight, mean in zip(weights, shared.split([weight.numel() for weight in weights]), strict=True):
        weight.grad = mean.view_as(weight)


def train(
    networks: Mapping[str, nn.Module],
    loss_of_step: Callable[[int], Tensor],
    budget: Budget,
    folder: Path,
    *,
    report: Callable[[str], None],
) -> dict[str, dict[str, Tensor]]:
    """Train networks until the budget is used, resuming from the folder's checkpoint if there is one.

    Args:
        networks: what is trained, on `training_device`; parameters without `requires_grad` stay as they are.
        loss_of_step: the loss of a batch, by its number; it must follow from the number alone, so that a resumed run
            sees what the killed one would have seen. There is a batch per step and process.
        budget: steps and learning rate.
        folder: for `checkpoint.pt` and `log.jsonl` (step, loss, seconds).
        report: told of progress about every ten seconds.

    Returns:
        Averaged weights (exponential moving average) by network.

    Raises:
        Interrupted: on Ctrl-C, after a checkpoint.
    """
    folder.mkdir(parents=True, exist_ok=True)
    trained = {
        f"{name}/{key}": parameter
        for name, network in networks.items()
        for key, parameter in network.named_parameters()
        if parameter.requires_grad
    }
    weights = list(trained.values())
    optimizer = torch.optim.AdamW(weights, lr=budget.learning_rate, betas=(0.9, 0.99), weight_decay=0.01, fused=True)
    averages = {name: parameter.detach().clone() for name, parameter in trained.items()}
    step = _resume(folder, networks, optimizer, averages)
    processes = PartialState(cpu=not torch.cuda.is_available())
    losses: list[Tensor] = []
    spoken = saved = started = time.monotonic()
    try:
        while step < budget.steps:
            for group in optimizer.param_groups:
                group["lr"] = budget.rate(step)
            with torch.autocast(processes.device.type, torch.bfloat16, enabled=budget.bf16):
                loss = loss_of_step(step * processes.num_processes + processes.process_index)
            loss.backward()  # type: ignore[no-untyped-call]
            if processes.num_processes > 1:
                _share_gradients(weights)
            nn.utils.clip_grad_norm_(weights, 1.0)
            optimizer.step()
            optimizer.zero_grad(set_to_none=True)
            step += 1
            average_weights(tuple(averages.values()), weights, step)
            if not processes.is_main_process:
                continue
            losses.append(loss.detach())  # to read it would wait for the GPU
            now = time.monotonic()
            if now - spoken > 10 or step == budget.steps:
                mean = float(torch.stack(losses).mean())
                _log(folder, step, mean, now - started)
                report(f"step {step}/{budget.steps}  loss {mean:.4f}")
                losses, spoken = [], now
            if now - saved > budget.checkpoint_seconds:
                _save(folder, step, networks, optimizer, averages)
                saved = now
    except KeyboardInterrupt as error:
        if processes.is_main_process:
            _save(folder, step, networks, optimizer, averages)
        raise Interrupted(f"training stopped at step {step}; run the same command again to go on") from error
    if processes.is_main_process:
        _save(folder, step, networks, optimizer, averages)
    return _averaged(networks, averages)


def _averaged(networks: Mapping[str, nn.Module], averages: Mapping[str, Tensor]) -> dict[str, dict[str, Tensor]]:
    return {
        name: {key: averages.get(f"{name}/{key}", value).detach() for key, value in network.state_dict().items()}
        for name, network in networks.items()
    }


def _log(folder: Path, step: int, loss: float, seconds: float) -> None:
    with (folder / "log.jsonl").open("a") as log:
        log.write(json.dumps({"step": step, "loss": loss, "seconds": round(seconds, 1)}) + "\n")


def _save(
    folder: Path,
    step: int,
    networks: Mapping[str, nn.Module],
    optimizer: torch.optim.Optimizer,
    averages: Mapping[str, Tensor],
) -> None:
    state = {
        "step": step,
        "networks": {name: network.state_dict() for name, network in networks.items()},
        "optimizer": optimizer.state_dict(),
        "averages": dict(averages),
    }
    partial = folder / "checkpoint.partial"
    torch.save(state, partial)
    partial.replace(folder / "checkpoint.pt")


def _resume(
    folder: Path, networks: Mapping[str, nn.Module], optimizer: torch.optim.Optimizer, averages: dict[str, Tensor]
) -> int:
    path = folder / "checkpoint.pt"
    if not path.is_file():
        return 0
    state: dict[str, Any] = torch.load(path, weights_only=True, map_location=training_device())
    for name, network in networks.items():
        network.load_state_dict(state["networks"][name])
    optimizer.load_state_dict(state["optimizer"])
    averages.update(state["averages"])
    return int(state["step"])
