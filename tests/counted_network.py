"""Counts what a graph's denoiser evaluates."""

from __future__ import annotations

from collections.abc import Callable, Iterator
from contextlib import contextmanager
from typing import Any

import torch


class CountedNetwork:
    """Counts the pictures a network evaluates; it may be told to do something at one of them."""

    def __init__(self, then: Callable[[int, int], None] = lambda count, batch: None) -> None:
        self.count = 0
        self._then = then

    def __call__(self, module: Any, arguments: tuple[torch.Tensor, ...]) -> None:
        self.count += len(arguments[0])
        self._then(self.count, len(arguments[0]))


@contextmanager
def watched(graph: Any, then: Callable[[int, int], None] = lambda count, batch: None) -> Iterator[CountedNetwork]:
    counted = CountedNetwork(then)
    handle = graph.model.model.diffusion_model.register_forward_pre_hook(counted)
    try:
        yield counted
    finally:
        handle.remove()
