"""Where a socket's value comes from in the graph that is queued: what weights do not tell, file names often do."""

from __future__ import annotations

import re
from collections.abc import Mapping
from typing import Any, Final

__all__ = ["control_net_doubt"]

_KINDS: Final = (
    "canny", "hed", "softedge", "lineart", "scribble", "sketch", "mlsd", "openpose", "pose", "normal", "seg",
    "segmentation", "tile", "blur", "inpaint", "recolor", "shuffle", "ip2p", "qrcode",
)  # fmt: skip
"""What ControlNets are trained to see, other than depth, as their files are named."""


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
