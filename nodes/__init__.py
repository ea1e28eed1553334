"""The nodes, one file per stage of the method. ComfyUI is imported here and below, nowhere else in the pack."""

from __future__ import annotations

from comfy_api.latest import ComfyExtension, io

from .ball_grid import BallGrid
from .confidence import ConfidenceMap
from .depth_ball import CanvasToImage, DepthBallMask
from .depth_model import EstimateDepth
from .envmap_files import LoadEnvMap, SaveEnvMap
from .equirect import BallToEquirect, EquirectToBall
from .estimate_light import EstimateLight
from .exposure import EVPromptInterp, HDRMerge
from .fit import FitBall
from .front_fill import FrontFill
from .inpaint import ChromeBallInpaint, IterativeMedian
from .light_model import LightModel
from .loaders import MiniProbeLoader
from .photo_folder import LoadPhotoFolder
from .quality import ProbeQuality
from .speed_accuracy import SpeedAccuracyChart
from .turbo import TurboLoRASwap

__all__ = ["NODES", "LightProbeExtension"]

NODES: tuple[type[io.ComfyNode], ...] = (
    MiniProbeLoader,
    EstimateDepth,
    TurboLoRASwap,
    DepthBallMask,
    EVPromptInterp,
    ChromeBallInpaint,
    IterativeMedian,
    CanvasToImage,
    HDRMerge,
    FitBall,
    BallToEquirect,
    EquirectToBall,
    ConfidenceMap,
    ProbeQuality,
    FrontFill,
    LightModel,
    EstimateLight,
    BallGrid,
    LoadPhotoFolder,
    SpeedAccuracyChart,
    SaveEnvMap,
    LoadEnvMap,
)


class LightProbeExtension(ComfyExtension):  # type: ignore[misc]
    """What ComfyUI asks for the pack's nodes."""

    async def get_node_list(self) -> list[type[io.ComfyNode]]:
        """All nodes, in the order of the method."""
        return list(NODES)
