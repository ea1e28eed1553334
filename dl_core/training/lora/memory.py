"""Bytes that a step of LoRA training takes, computed on tensors without storage; nothing is run on a device.

The UNet is walked through on torch's meta device and every tensor that is kept for the way back is counted once by its
storage. Casts are those of torch's autocast on CUDA; attention keeps its inputs, its output and a number a row, as the
fused kernels do. What an allocator wastes, what a kernel borrows for itself, and CUDA's own few hundred MB come on top.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, fields
from typing import Any, Final

import torch
import torch.nn.functional as F
from diffusers import UNet2DConditionModel
from torch import Tensor, nn
from torch.overrides import TorchFunctionMode

from .exposure_lora import add_exposure_adapter
from .settings import LoraSettings

__all__ = ["StepMemory", "step_memory"]

_DTYPES: Final = {"no": torch.float32, "fp16": torch.float16, "bf16": torch.bfloat16}


@dataclass(frozen=True)
class StepMemory:
    """Bytes by purpose, at the fullest moment of a step.

    Attributes:
        weights: of the frozen UNet.
        lora: of the LoRA, single precision.
        gradients: of the LoRA.
        optimizer: two moments for every weight of the LoRA.
        activations: kept for the way back.
        recomputed: kept by the largest block while it is computed a second time; 0 without checkpointing.
    """

    weights: int
    lora: int
    gradients: int
    optimizer: int
    activations: int
    recomputed: int

    @property
    def total(self) -> int:
        """All of it."""
        return sum(getattr(self, field.name) for field in fields(self))

    def table(self) -> str:
        """A line a purpose, in GB (10^9 bytes)."""
        rows = [(field.name, getattr(self, field.name)) for field in fields(self)] + [("total", self.total)]
        return "\n".join(f"{name:12} {size / 1e9:8.3f} GB" for name, size in rows)


def step_memory(config: dict[str, Any], settings: LoraSettings, canvas: int, text_width: int = 1280) -> StepMemory:
    """Memory of a step of a UNet of SDXL's kind.

    Args:
        config: of the UNet, diffusers'.
        settings: batch, rank, precision and checkpointing count.
        canvas: side of the pictures, pixels.
        text_width: of the pooled text embedding.
    """
    dtype = _DTYPES[settings.precision]
    with torch.device("meta"):
        unet = UNet2DConditionModel.from_config(config)
        nn.Module.to(unet, dtype)  # diffusers' own would warn of layers that have to stay in single precision: of none
        weights = _bytes(unet.parameters())
        lora = _bytes(add_exposure_adapter(unet, settings))
        kept, recomputed = _activations(unet, settings, canvas // 8, text_width, dtype)
    return StepMemory(weights, lora, lora, 2 * lora, kept, recomputed)


def _bytes(tensors: Any) -> int:
    return sum(tensor.numel() * tensor.element_size() for tensor in tensors)


class _Kept:
    """Storages kept for the way back, each counted once; weights are counted elsewhere."""

    def __init__(self, weights: set[int]) -> None:
        self._seen = set(weights)
        self._alive: list[Tensor] = []  # so that no storage's address is used twice
        self.bytes = 0

    def add(self, tensor: Tensor) -> Tensor:
        storage = tensor.untyped_storage()
        if storage._cdata not in self._seen:
            self._seen.add(storage._cdata)
            self._alive.append(tensor)
            self.bytes += storage.nbytes()
        return tensor

    def __enter__(self) -> _Kept:
        self._hooks = torch.autograd.graph.saved_tensors_hooks(self.add, lambda tensor: tensor)
        self._hooks.__enter__()
        return self

    def __exit__(self, *fault: Any) -> None:
        self._hooks.__exit__(*fault)


def _activations(unet: Any, settings: LoraSettings, side: int, text_width: int, dtype: torch.dtype) -> tuple[int, int]:
    """Bytes kept over the whole way, and by the largest block that is computed twice."""
    count = settings.batch
    weights = {parameter.untyped_storage()._cdata for parameter in unet.parameters()}
    kept = _Kept(weights)
    largest = 0

    def checkpointed(block: Callable[..., Any], *inputs: Any) -> Any:
        """What checkpointing keeps: a block's inputs. What the block keeps itself is there once, on the way back."""
        nonlocal largest
        for given in inputs:
            if isinstance(given, Tensor):
                kept.add(given)
        with _Kept(weights) as inside:
            result = block(*inputs)
        largest = max(largest, inside.bytes)
        return result

    if settings.gradient_checkpointing:
        unet.enable_gradient_checkpointing(checkpointed)
    latents = torch.empty(count, unet.config.in_channels, side, side, dtype=dtype)
    tokens = torch.empty(count, 77, unet.config.cross_attention_dim, dtype=dtype)
    added = {
        "text_embeds": torch.empty(count, text_width, dtype=dtype),
        "time_ids": torch.empty(count, 6, dtype=dtype),
    }
    with kept, _Autocast(dtype):
        unet(latents, torch.empty(count), tokens, added_cond_kwargs=added)
    return kept.bytes, largest


class _FusedAttention(torch.autograd.Function):
    """Keeps what fused attention keeps."""

    @staticmethod
    def forward(ctx: Any, query: Tensor, key: Tensor, value: Tensor) -> Tensor:
        result = query.new_empty(*query.shape[:-1], value.shape[-1])
        ctx.save_for_backward(query, key, value, result, query.new_empty(query.shape[:-1], dtype=torch.float32))
        return result


class _Autocast(TorchFunctionMode):
    """torch.autocast's casts for CUDA, which do not happen on the meta device, and fused attention."""

    _LOW: Final = (F.linear, F.conv2d)
    _HIGH: Final = (F.layer_norm, F.group_norm)

    def __init__(self, dtype: torch.dtype) -> None:
        super().__init__()
        self._dtype = dtype

    def __torch_function__(self, func: Any, types: Any, args: Any = (), kwargs: Any = None) -> Any:
        kwargs = kwargs or {}
        if func is F.scaled_dot_product_attention:
            return _FusedAttention.apply(*args[:3])  # type: ignore[no-untyped-call]
        wanted = self._dtype if func in self._LOW else torch.float32 if func in self._HIGH else None
        if wanted is None or self._dtype == torch.float32:
            return func(*args, **kwargs)
        cast = [_cast(given, wanted) for given in args]
        return func(*cast, **{name: _cast(given, wanted) for name, given in kwargs.items()})


def _cast(given: Any, dtype: torch.dtype) -> Any:
    return given.to(dtype) if isinstance(given, Tensor) and given.is_floating_point() else given
