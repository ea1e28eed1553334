"""Checkpoints of LoRA training: whole or not there, and only for the run they come from."""

from __future__ import annotations

import io
import pickle
from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import torch
from torch import Tensor

from ...errors import ModelError, OptionError
from ...imageio import atomic

__all__ = ["CHECKPOINT", "LoraState", "read_checkpoint", "require_same", "write_checkpoint"]

CHECKPOINT = "checkpoint.pt"


@dataclass(frozen=True)
class LoraState:
    """Where a training stands.

    Attributes:
        identity: by option or name, what the result depends on.
        step: optimizer steps done.
        lora: weights by name.
        optimizer: state of AdamW.
        scaler: state of the scale of half-precision gradients; None without one.
    """

    identity: dict[str, str]
    step: int
    lora: dict[str, Tensor]
    optimizer: dict[str, Any]
    scaler: dict[str, Any] | None


def write_checkpoint(folder: Path, state: LoraState) -> None:
    """Write a state; the one before is there until this one is whole.

    Raises:
        OutputError: it cannot be written, because the disk is full for example; the one before is kept.
    """
    # Through memory: torch's own writer reports a full disk in its own way.
    content = io.BytesIO()
    torch.save(vars(state), content)
    with atomic(folder / CHECKPOINT) as partial:
        partial.write_bytes(content.getbuffer())


def read_checkpoint(folder: Path) -> LoraState | None:
    """The state of a folder; None if there is none yet.

    Raises:
        ModelError: it is damaged.
    """
    path = folder / CHECKPOINT
    if not path.is_file():
        return None
    try:
        return LoraState(**torch.load(path, map_location="cpu", weights_only=True))
    except (OSError, RuntimeError, EOFError, TypeError, ValueError, KeyError, pickle.UnpicklingError) as error:
        reason = " ".join(str(error).split())[:200]
        raise ModelError(path, f"is no whole checkpoint ({reason}); delete it to begin anew") from error


def require_same(state: LoraState, identity: Mapping[str, str], folder: Path) -> None:
    """Make sure that a state comes from this training.

    Raises:
        OptionError: it does not; names all that differs.
    """
    names = [name for name in identity if state.identity.get(name) != identity[name]]
    if not names:
        return
    theirs = ", ".join(f"{name} {state.identity.get(name)}" for name in names)
    others = f" (and {', '.join(names[1:])} differ as well)" if names[1:] else ""
    raise OptionError(
        names[0], identity[names[0]], f"what {folder / CHECKPOINT} was made with: {theirs}{others}; or another --work"
    )
