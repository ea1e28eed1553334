"""Choices that run, but hardly give what was wanted: sentences for a report.

What weights do not tell, the names of files in the queued graph often do.
"""

from __future__ import annotations

import re
from collections.abc import Mapping
from typing import Any, Final

from .lora import swaps_loras

__all__ = ["control_net_doubt", "doubts"]

_KINDS: Final = (
    "canny", "hed", "softedge", "lineart", "scribble", "sketch", "mlsd", "openpose", "pose", "normal", "seg",
    "segmentation", "tile", "blur", "inpaint", "recolor", "shuffle", "ip2p", "qrcode",
)  # fmt: skip
"""What ControlNets are trained to see, other than depth, as their files are named."""


def doubts(hidden: Any, preset: str, model: Any) -> list[str]:
    """What speaks against a preset and the models connected.

    Args:
        hidden: the node's hidden inputs, of them `prompt` and `unique_id`; None outside a queued graph.
        preset: the one chosen.
        model: the MODEL.
    """
    found = []
    if preset == "turbo" and not swaps_loras(model):
        found.append("preset turbo without Turbo LoRA Swap: each exposure is a single ball, as the noise has it")
    queued = None if hidden is None or hidden.prompt is None else control_net_doubt(hidden.prompt, hidden.unique_id)
    return [*found, *([queued] if queued else [])]


def control_net_doubt(prompt: Mapping[str, Any], node: str) -> str | None:
    """What speaks against the ControlNet of a node: the name of its file, if that is of another kind than depth.

    Args:
        prompt: the queued graph, by node: `class_type` and `inputs`, a link being [node, output].
        node: id of the node whose input `control_net` is asked about.

    Returns:
        A sentence, or None where the file is one for depth, is of no known kind, or cannot be found.
    """
    name = _control_net_file(prompt, node)
    words = set(re.split(r"[^a-z0-9]+", name.lower()))
    kinds = [kind for kind in _KINDS if kind in words]
    if not kinds or "depth" in name.lower() or "union" in words:
        return None
    return f"socket control_net: {name} looks like a ControlNet for {kinds[0]}; one for depth is wanted"


def _control_net_file(prompt: Mapping[str, Any], node: str) -> str:
    """Name of the file that a chain of CONTROL_NET links begins with; empty if there is none."""
    seen = set[str]()
    while node not in seen and node in prompt:
        seen.add(node)
        inputs = prompt[node].get("inputs", {})
        if isinstance(inputs.get("control_net_name"), str):
            return str(inputs["control_net_name"])
        link = inputs.get("control_net")
        if not isinstance(link, list):
            break
        node = str(link[0])
    return ""
