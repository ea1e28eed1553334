"""Every node says what it is and what each socket takes; ids and sockets are those of the design."""

from __future__ import annotations

import asyncio
import subprocess
import sys
from typing import Any

import pytest
from comfy_host import REPOSITORY, load_pack, pack_module

SOCKETS = {
    "MiniProbeLoader": ("", "model clip vae control_net"),
    "EstimateDepth": ("image", "depth depth_model"),
    "TurboLoRASwap": ("model", "model"),
    "DepthBallMask": ("image depth", "canvas_image control_depth mask ball"),
    "EVPromptInterp": ("clip model original dark", "model positive ev"),
    "ChromeBallInpaint": (
        "model positive negative vae control_net image depth ball mask ev",
        "balls composite evaluations",
    ),
    "IterativeMedian": (
        "model positive negative vae control_net image depth ball mask ev depth_model",
        "ball median spread composite report balls light_balls",
    ),
    "CanvasToImage": ("canvas_image image ball", "image framed mask"),
    "HDRMerge": ("balls ev report light_balls", "hdr report"),
    "FitBall": ("balls photograph ball", "fit report"),
    "BallToEquirect": ("image ball fit", "latlong coverage"),
    "EquirectToBall": ("latlong", "ball_image"),
    "ConfidenceMap": ("balls ev latlong", "confidence picture expected_error report"),
    "ProbeQuality": ("balls ev composite ball photograph", "score report json"),
    "FrontFill": ("latlong photograph", "latlong filled"),
    "LightModel": ("latlong", "latlong report picture"),
    "EstimateLight": (
        "model clip vae control_net image depth depth_model",
        "latlong hdr composite balls ball report confidence",
    ),
    "BallGrid": ("image", "x y name"),
    "LoadPhotoFolder": ("", "images names report"),
    "SpeedAccuracyChart": ("", "chart report"),
    "SaveEnvMap": ("latlong report confidence", "path"),
    "LoadEnvMap": ("", "latlong"),
}
WIDGETS = ("INT", "FLOAT", "STRING", "BOOLEAN", "COMBO")


@pytest.fixture(scope="module")
def schemas(pack: Any) -> dict[str, Any]:
    extension = asyncio.run(pack.comfy_entrypoint())
    nodes = asyncio.run(extension.get_node_list())
    return {node.GET_SCHEMA().node_id: node.GET_SCHEMA() for node in nodes}


def is_socket(item: Any) -> bool:
    return item.get_io_type() not in WIDGETS or bool(getattr(item, "force_input", False))


def test_nodes_and_sockets(schemas: dict[str, Any]) -> None:
    found = {
        name: (
            " ".join(item.id for item in schema.inputs if is_socket(item)),
            " ".join(item.display_name for item in schema.outputs),
        )
        for name, schema in schemas.items()
    }
    assert found == SOCKETS


@pytest.mark.parametrize("name", SOCKETS)
def test_node_explains_itself(schemas: dict[str, Any], name: str) -> None:
    schema = schemas[name]
    assert schema.category == "LightProbe"
    assert schema.display_name
    assert len(schema.description) > 40
    for item in [*schema.inputs, *schema.outputs]:
        assert item.tooltip, f"{item.id} has no tooltip"
        assert item.tooltip.endswith("."), item.tooltip


@pytest.mark.parametrize("name", SOCKETS)
def test_node_has_a_help_page(name: str) -> None:
    page = REPOSITORY / "js" / "docs" / f"{name}.md"
    assert page.is_file()
    assert page.read_text().startswith("# ")


def test_defaults_are_the_papers(schemas: dict[str, Any]) -> None:
    defaults = {item.id: getattr(item, "default", None) for item in schemas["IterativeMedian"].inputs}
    wanted = {
        "balls": 30,
        "rounds": 2,
        "strength": 0.8,
        "final": True,
        "steps": 30,
        "cfg": 5.0,
        "control_strength": 0.5,
    }
    assert {name: defaults[name] for name in wanted} == wanted
    options = {item.id: item.options for item in schemas["IterativeMedian"].inputs if item.get_io_type() == "COMBO"}
    assert {name: values[0] for name, values in options.items()} == {
        "preset": "custom",
        "sampler": "uni_pc",
        "scheduler": "leading (paper)",
        "impute": "initial",
    }
    steering = {item.id: getattr(item, "default", None) for item in schemas["EVPromptInterp"].inputs}
    paper = pack_module("dl_core.presets").PAPER_EVS
    assert pack_module("nodes.sockets").parse_evs(steering["evs"]) == paper
    assert steering["ev_min"] == -5.0
    assert steering["lora_scale"] == 0.75
    whole = {item.id: getattr(item, "default", None) for item in schemas["EstimateLight"].inputs}
    shared = {*wanted, "evs", "ev_min", "prompt", "dark_prompt"}
    assert {name: whole[name] for name in shared} == {name: (defaults | steering)[name] for name in shared}
    assert whole["negative_prompt"] == pack_module("dl_core.prompts").NEGATIVE_PROMPT
    assert (whole["preset"], whole["canvas"], whole["diameter"]) == ("balanced", 1024, 256)
    turbo = {item.id: getattr(item, "default", None) for item in schemas["TurboLoRASwap"].inputs}
    assert (turbo["turbo_scale"], turbo["exposure_scale"], turbo["timestep"]) == (1.0, 0.75, 800)


def test_importing_the_pack_needs_no_comfyui() -> None:
    """The test runner and package tools import the root; ComfyUI is wanted only when it asks for the nodes."""
    code = (
        "import importlib.util, sys; "
        f"spec = importlib.util.spec_from_file_location('pack', {str(REPOSITORY / '__init__.py')!r}); "
        "module = importlib.util.module_from_spec(spec); spec.loader.exec_module(module); "
        "assert module.WEB_DIRECTORY == './js'; "
        "assert not {'comfy', 'comfy_api', 'torch', 'dl_core'} & set(sys.modules)"
    )
    subprocess.run([sys.executable, "-c", code], check=True, cwd=REPOSITORY.parent)


def test_starting_comfyui_does_not_import_diffusers() -> None:
    """It takes seconds, and only the mini model needs it; its depth models are transformers' part of that."""
    code = (
        "import sys; sys.path[:0] = ['tests', '.']; import comfy_host; comfy_host.load_pack(); "
        "assert 'diffusers' not in sys.modules"
    )
    subprocess.run([sys.executable, "-c", code], check=True, cwd=REPOSITORY)


def test_own_nodes_do_not_shadow_comfyuis(pack: Any) -> None:
    assert load_pack().__name__ + ".nodes" in sys.modules
    assert "nodes" not in sys.modules or not sys.modules["nodes"].__file__.startswith(str(REPOSITORY))
