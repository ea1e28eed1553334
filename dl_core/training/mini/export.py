"""Write trained networks as the mini model's files."""

from __future__ import annotations

from collections.abc import Mapping
from pathlib import Path

from safetensors.torch import save_file
from torch import Tensor

from ...backends.mini import NETWORK_FILES
from ...imageio import atomic

__all__ = ["write_networks"]


def write_networks(folder: Path, weights: Mapping[str, Mapping[str, Tensor]]) -> list[Path]:
    """Write networks, named as in `NETWORK_FILES`, as fp16 safetensors; returns the files.

    Text encoders are written under the hub's key names whatever the installed transformers calls them.

    Raises:
        OutputError: the folder cannot be written.
    """
    written = []
    for name, tensors in weights.items():
        prefix = "text_model." if name.startswith("text_encoder") else ""
        named = {_hub_key(key, prefix): tensor for key, tensor in tensors.items()}
        written.append(_write(folder / NETWORK_FILES[name], named))
    return written


def _hub_key(key: str, prefix: str) -> str:
    return key if not prefix or key.startswith((prefix, "text_projection")) else prefix + key


def _write(path: Path, tensors: Mapping[str, Tensor]) -> Path:
    halves = {
        key: (tensor.half() if tensor.is_floating_point() else tensor).contiguous() for key, tensor in tensors.items()
    }
    with atomic(path) as partial:
        save_file(halves, partial)
    return path
