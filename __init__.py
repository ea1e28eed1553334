"""ComfyUI's entry point: hands over the nodes and the folder of web files. Nothing else happens at import."""

from __future__ import annotations

from typing import TYPE_CHECKING

if TYPE_CHECKING:
    from .nodes import LightProbeExtension

__all__ = ["WEB_DIRECTORY", "comfy_entrypoint"]

WEB_DIRECTORY = "./js"


async def comfy_entrypoint() -> LightProbeExtension:
    """What ComfyUI calls after import. The nodes need ComfyUI, so they are imported here and not above."""
    from .nodes import LightProbeExtension

    return LightProbeExtension()
