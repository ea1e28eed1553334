"""A LoRA that is being trained, and the checkpoints it goes on from."""

from __future__ import annotations

import time
from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from accelerate import Accelerator
from peft.utils import get_peft_model_state_dict, set_peft_model_state_dict

from ...backends.diffusers_lora import EXPOSURE
from ...errors import OutputError
from .checkpoint import LoraState, read_checkpoint, require_same, write_checkpoint
from .settings import LoraSettings

__all__ = ["CheckpointKeeper", "LoraJob"]


@dataclass(frozen=True)
class LoraJob:
    """One LoRA to train.

    Attributes:
        folder: for checkpoint, log and pictures.
        ev: its exposure, where it is for one alone.
        identity: by option or name, what the result depends on.
    """

    folder: Path
    ev: float | None
    identity: dict[str, str]

    def resumed(self) -> LoraState | None:
        """Where it stands; None before its first checkpoint.

        Raises:
            OptionError: the folder's checkpoint is of another training.
            ModelError: it is damaged.
        """
        state = read_checkpoint(self.folder)
        if state is not None:
            require_same(state, self.identity, self.folder)
        return state


class CheckpointKeeper:
    """Checkpoints of a job, by time; only the main process writes."""

    def __init__(
        self,
        accelerator: Accelerator,
        unet: Any,
        optimizer: Any,
        job: LoraJob,
        settings: LoraSettings,
        report: Callable[[str], None],
    ) -> None:
        self._accelerator, self._unet, self._optimizer = accelerator, unet, optimizer
        self._job, self._settings, self._report = job, settings, report
        self._saved = self._spoken = time.monotonic()
        self._kept: int | None = None

    def resume(self) -> int:
        """Take up the folder's checkpoint; the step it stands at."""
        state = self._job.resumed()
        if state is None:
            return 0
        set_peft_model_state_dict(self._unet, state.lora, adapter_name=EXPOSURE)
        self._optimizer.load_state_dict(state.optimizer)
        if state.scaler is not None and self._accelerator.scaler is not None:
            self._accelerator.scaler.load_state_dict(state.scaler)
        self._kept = state.step
        self._report(f"going on from step {state.step}")
        return state.step

    def after(self, step: int, loss: float) -> None:
        """Speak every ten seconds, and write a checkpoint when it is time."""
        now = time.monotonic()
        if self._accelerator.is_main_process and (now - self._spoken > 10 or step == self._settings.steps):
            self._report(f"step {step}/{self._settings.steps}  loss {loss:.4f}")
            self._spoken = now
        if now - self._saved >= 60 * self._settings.checkpoint_minutes and step < self._settings.steps:
            self.save(step)
            self._saved = now

    def save(self, step: int) -> str:
        """Write a checkpoint; says which one there is now. A full disk costs the new one, not the old one."""
        if not self._accelerator.is_main_process or self._kept == step:
            return f"the checkpoint is of step {step}"
        scaler = self._accelerator.scaler
        lora = get_peft_model_state_dict(self._unet, adapter_name=EXPOSURE)
        state = LoraState(
            self._job.identity,
            step,
            {name: weight.detach().cpu() for name, weight in lora.items()},
            self._optimizer.state_dict(),
            None if scaler is None else scaler.state_dict(),
        )
        try:
            write_checkpoint(self._job.folder, state)
        except OutputError as error:
            kept = "there is none yet" if self._kept is None else f"the one of step {self._kept} is kept"
            self._report(f"the checkpoint of step {step} was not written ({error.reason}); {kept}")
            return kept if self._kept is None else f"the checkpoint is of step {self._kept}"
        self._kept = step
        return f"the checkpoint is of step {step}"
