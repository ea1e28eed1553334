"""LightProbe: HDR environment maps from one photograph, by a chrome ball that a diffusion model paints.

The library under the ComfyUI node pack; it never imports ComfyUI.
"""

__all__ = ["__version__"]

__version__ = "0.1.0"
