"""Tensors as safetensors files, whole or not there."""

from __future__ import annotations

from collections.abc import Mapping
from pathlib import Path

from safetensors import SafetensorError
from safetensors.torch import save_file
from torch import Tensor

from ..imageio import atomic

__all__ = ["write_tensors"]


def write_tensors(path: Path, tensors: Mapping[str, Tensor], metadata: Mapping[str, str]) -> Path:
    """Write tensors and what is said of them in the header; returns the path.

    Raises:
        OutputError: the file cannot be written.
    """
    packed = {name: tensor.detach().cpu().contiguous() for name, tensor in tensors.items()}
    with atomic(path) as partial:
        try:
            save_file(packed, partial, metadata={"format": "pt", **metadata})
        except SafetensorError as error:  # how a full disk arrives here
            raise OSError(str(error)) from error
    return path
