"""LoRA files of any common naming on ComfyUI's MODEL: added to its weights, or at run time, one after the other.

Names are `dl_core.lora`'s matter. ComfyUI's own loader skips several of them with no more than a line in the log.
Relied on of ComfyUI: `comfy.lora.load_lora`, a model's `add_patches`, `add_wrapper_with_key` and `add_callback`, and
`comfy.utils.unet_to_diffusers`, which gives the layers' names.
"""

from __future__ import annotations

from collections.abc import Callable, Iterator, Mapping
from contextlib import ExitStack, contextmanager
from typing import Any, Final

import comfy.lora
import comfy.utils
import folder_paths
import torch
import torch.nn.functional as F
from comfy.patcher_extension import CallbacksMP, WrappersMP
from torch import Tensor

from ..dl_core.lora import LoraSwap, LowRank, read_lora
from .architecture import require_sdxl

__all__ = ["read_lora_file", "swaps_loras", "with_lora", "with_lora_swap"]

_KEY: Final = "lightprobe.lora_swap"
Hook = Callable[[torch.nn.Module, tuple[Tensor, ...], Tensor], Tensor]
"""What torch calls after a module's forward: module, inputs, output -> output."""


def read_lora_file(name: str) -> dict[str, Tensor]:
    """Weights of a LoRA in ComfyUI's folder `loras`."""
    path = folder_paths.get_full_path_or_raise("loras", name)
    return comfy.utils.load_torch_file(path, safe_load=True)  # type: ignore[no-any-return]


def _layers(model: Any) -> dict[str, str]:
    """Layers of a MODEL that a LoRA can act on: diffusers' name -> name of the module in `diffusion_model`.

    Raises:
        ModelError: a model whose layers have no such names.
    """
    inner = require_sdxl(model)
    present = inner.diffusion_model.state_dict().keys()
    names = comfy.utils.unet_to_diffusers(inner.model_config.unet_config)
    return {
        ours.removesuffix(".weight"): theirs.removesuffix(".weight")
        for ours, theirs in names.items()
        if ours.endswith(".weight") and theirs in present and "norm" not in ours and not ours.startswith("class_")
    }


def _read(model: Any, weights: Mapping[str, Tensor], source: str) -> dict[str, LowRank]:
    """A LoRA's products by the name of the module they act on."""
    layers = _layers(model)
    network = model.model.diffusion_model
    shapes = {ours: tuple(network.get_submodule(theirs).weight.shape) for ours, theirs in layers.items()}
    return {layers[layer]: product for layer, product in read_lora(weights, shapes, source).items()}


def with_lora(model: Any, weights: Mapping[str, Tensor], scale: float, source: str) -> Any:
    """A clone of a MODEL with a LoRA added to its weights at a scale.

    Raises:
        ModelError: a LoRA that does not fit the model, in whole or in part; `source` names the LoRA.
    """
    named: dict[str, Tensor] = {}
    keys: dict[str, str] = {}
    for module, product in _read(model, weights, source).items():
        keys[module] = f"diffusion_model.{module}.weight"
        named[f"{module}.lora_down.weight"], named[f"{module}.lora_up.weight"] = product.down, product.up
        named[f"{module}.alpha"] = torch.tensor(product.scale * len(product.down))
    patched = model.clone()
    patched.add_patches(comfy.lora.load_lora(named, keys), scale)
    return patched


def with_lora_swap(model: Any, turbo: Mapping[str, Tensor], exposure: Mapping[str, Tensor], swap: LoraSwap) -> Any:
    """A clone of a MODEL on which one of two LoRAs acts, by the timestep of each evaluation.

    The products are added to what the layers give (W x + s · B (A x)); the weights stay as they are. So nothing is
    loaded or merged when the LoRAs change places, once a pass, and every sampler and batch works as without them.

    Args:
        model: MODEL of SDXL's architecture; LoRAs it already has keep acting throughout.
        turbo: weights of the LoRA for the first, noisy timesteps.
        exposure: weights of the LoRA after it.
        swap: when, and how strongly each acts.

    Raises:
        ModelError: a LoRA that does not fit the model.
    """
    loras = {
        True: _RuntimeLora(_read(model, turbo, "turbo_lora"), swap.turbo_scale),
        False: _RuntimeLora(_read(model, exposure, "exposure_lora"), swap.exposure_scale),
    }

    def evaluate(executor: Any, x: Tensor, timesteps: Tensor, *arguments: Any, **options: Any) -> Tensor:
        with loras[swap.turbo_at(float(timesteps[0]))].acting_on(model.model.diffusion_model):
            return executor(x, timesteps, *arguments, **options)  # type: ignore[no-any-return]

    def release(*_: Any) -> None:
        for lora in loras.values():
            lora.release()

    swapped = model.clone()
    swapped.add_wrapper_with_key(WrappersMP.DIFFUSION_MODEL, _KEY, evaluate)
    swapped.add_callback_with_key(CallbacksMP.ON_CLEANUP, _KEY, release)
    return swapped


def swaps_loras(model: Any) -> bool:
    """Whether LoRAs take turns on a MODEL (`with_lora_swap`)."""
    return bool(model.get_wrappers(WrappersMP.DIFFUSION_MODEL, _KEY))


class _RuntimeLora:
    """A LoRA that acts while a network is evaluated."""

    def __init__(self, products: Mapping[str, LowRank], scale: float) -> None:
        self._products = products
        self._scale = scale
        self._resident: dict[tuple[str, torch.device, torch.dtype], tuple[Tensor, Tensor]] = {}

    @contextmanager
    def acting_on(self, network: torch.nn.Module) -> Iterator[None]:
        """Add the products to what the layers give, inside the context."""
        with ExitStack() as hooks:
            for name in self._products:
                handle = network.get_submodule(name).register_forward_hook(self._hook(name))
                hooks.callback(handle.remove)
            yield

    def _hook(self, name: str) -> Hook:
        def add(module: torch.nn.Module, inputs: tuple[Tensor, ...], output: Tensor) -> Tensor:
            down, up = self._weights(name, inputs[0])
            if isinstance(module, torch.nn.Conv2d):
                middle = F.conv2d(inputs[0], down, None, module.stride, module.padding, module.dilation)
                return output + F.conv2d(middle, up)
            return output + F.linear(F.linear(inputs[0], down), up)

        return add

    def _weights(self, name: str, like: Tensor) -> tuple[Tensor, Tensor]:
        """A layer's A and scaled B, where its input is and of its kind; moved there once a pass."""
        place = (name, like.device, like.dtype)
        if place not in self._resident:
            product = self._products[name]
            up = product.up.float() * (product.scale * self._scale)
            self._resident[place] = (product.down.to(like), up.to(like))
        return self._resident[place]

    def release(self) -> None:
        """Give up the copies where the network runs; they are in no account of ComfyUI's."""
        self._resident.clear()
