"""The real server: it serves the nodes, accepts the workflows, and runs the quickstart to an EXR that /view gives."""

from __future__ import annotations

import asyncio
import json
import re
import time
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import pytest
import torch
from comfy_host import PHOTO, REPOSITORY, WORKFLOWS, Server, pack_module
from depth_models import save_depth_anything
from lora_files import RandomLora, attention_layers
from safetensors.torch import save_file

WIDGETS = ("INT", "FLOAT", "STRING", "BOOLEAN", "COMBO")
FILE_INPUTS = {
    ("LoadImage", "image"),
    ("CheckpointLoaderSimple", "ckpt_name"),
    ("ControlNetLoader", "control_net_name"),
    ("LoraLoader", "lora_name"),
    ("TurboLoRASwap", "turbo_lora"),
    ("TurboLoRASwap", "exposure_lora"),
    ("LoadPhotoFolder", "folder"),
}
"""Inputs that name a file of the user's: their values need not be on offer."""
CLIENT_INPUTS = {("PreviewAny", "preview")}
"""Widgets that the web client adds to a node and sends along; the server drops them."""


def workflow(name: str) -> dict[str, Any]:
    return json.loads((REPOSITORY / "workflows" / f"{name}.api.json").read_text())


def note(name: str) -> str:
    """What a workflow's note says."""
    nodes = json.loads((REPOSITORY / "workflows" / f"{name}.json").read_text())["nodes"]
    (text,) = [node["widgets_values"][0] for node in nodes if node["type"] == "MarkdownNote"]
    return text


@pytest.fixture(scope="module")
def info(server: Server) -> dict[str, Any]:
    return server.get_json("/object_info")


def faults(prompt: dict[str, Any], info: dict[str, Any]) -> list[str]:
    """What keeps a prompt from running, files of the user aside."""
    found = []
    for number, node in prompt.items():
        kind = info.get(node["class_type"])
        if kind is None:
            found.append(f"{number}: unknown class {node['class_type']}")
            continue
        required, optional = kind["input"]["required"], kind["input"].get("optional", {})
        found += [f"{number}: {name} is missing" for name in required.keys() - node["inputs"].keys()]
        others = {name for kind_name, name in CLIENT_INPUTS if kind_name == node["class_type"]}
        known = required.keys() | optional.keys() | others
        found += [f"{number}: {name} is unknown" for name in node["inputs"].keys() - known]
        for name, value in node["inputs"].items():
            spec = required.get(name) or optional.get(name)
            fault = spec and _fault(prompt, info, node["class_type"], name, spec, value)
            if fault:
                found.append(f"{number}: {name} {fault}")
    return found


def _fault(prompt: dict[str, Any], info: dict[str, Any], kind: str, name: str, spec: list[Any], value: Any) -> str:
    wanted, options = spec[0], spec[1] if len(spec) > 1 else {}
    if isinstance(value, list):
        source = prompt.get(value[0])
        given = info[source["class_type"]]["output"][value[1]] if source else None
        return "" if given == wanted or wanted == "*" else f"takes {wanted}, is linked to {given}"
    choices = wanted if isinstance(wanted, list) else options.get("options")
    if choices is not None:
        return "" if value in choices or (kind, name) in FILE_INPUTS else f"is {value!r}, not one of {choices}"
    types = {"INT": int, "FLOAT": (int, float), "STRING": str, "BOOLEAN": bool}
    if wanted not in types or not isinstance(value, types[wanted]):
        return f"is {value!r}, {wanted} is wanted"
    if "min" in options and not options["min"] <= value <= options["max"]:
        return f"is {value!r}, outside {options['min']} to {options['max']}"
    return ""


@pytest.mark.parametrize("name", WORKFLOWS)
def test_workflow_is_valid(info: dict[str, Any], name: str) -> None:
    assert faults(workflow(name), info) == []


def test_validator_finds_faults(info: dict[str, Any]) -> None:
    prompt = workflow("mini_quickstart")
    by_class = {node["class_type"]: node["inputs"] for node in prompt.values()}
    by_class["HDRMerge"]["method"] = "guess"
    by_class["IterativeMedian"]["steps"] = 5000
    by_class["IterativeMedian"]["vae"] = by_class["IterativeMedian"]["model"]
    del by_class["SaveEnvMap"]["latlong"]
    assert len(faults(prompt, info)) == 4


def test_paper_workflow_has_the_papers_settings() -> None:
    nodes = {node["class_type"]: node["inputs"] for node in workflow("paper_sdxl").values()}
    paint = nodes["IterativeMedian"]
    wanted = {"preset": "custom", "balls": 30, "rounds": 2, "strength": 0.8, "final": True, "steps": 30, "cfg": 5.0}
    wanted |= {"sampler": "uni_pc", "scheduler": "leading (paper)", "control_strength": 0.5}
    assert {name: paint[name] for name in wanted} == wanted
    place = nodes["DepthBallMask"]
    assert (place["canvas"], place["diameter"], place["depth_disc"]) == (1024, 256, "authors")
    assert nodes["EVPromptInterp"]["evs"] == "0, -2.5, -5"
    assert (nodes["LoraLoader"]["strength_model"], nodes["LoraLoader"]["strength_clip"]) == (0.75, 0.0)
    assert nodes["EVPromptInterp"]["lora"] == "none"
    assert nodes["HDRMerge"]["method"] == "paper"


@pytest.mark.parametrize(
    ("name", "guided_steps", "lora"),
    [("paper_sdxl", 4932, True), ("sdxl_fast", 450, True), ("lora_only", 90, True), ("base_only", 30, False)],
)
def test_workflows_cost_what_their_notes_say(name: str, guided_steps: int, lora: bool) -> None:
    presets, rounds = pack_module("dl_core.presets"), pack_module("dl_core.iterative")
    nodes = {node["class_type"]: node["inputs"] for node in workflow(name).values()}
    paint = nodes["IterativeMedian"]
    schedule = rounds.Rounds(**{key: paint[key] for key in ("balls", "rounds", "strength", "steps", "final")})
    evs = tuple(float(ev) for ev in nodes["EVPromptInterp"]["evs"].split(","))
    assert presets.Preset(schedule, evs, name).guided_steps == guided_steps
    assert ("LoraLoader" in nodes) == lora
    assert f"{guided_steps:,} guided steps" in note(name)


@pytest.mark.parametrize(
    ("name", "times", "guided_steps", "at_paper"),
    [("spatially_varying", 9, 4050, 44388), ("batch_folder", 1, 450, 4932)],
)
def test_workflows_of_many_maps_cost_what_their_notes_say(
    name: str, times: int, guided_steps: int, at_paper: int
) -> None:
    presets = pack_module("dl_core.presets")
    nodes = {node["class_type"]: node["inputs"] for node in workflow(name).values()}
    whole = nodes["EstimateLight"]
    evs = tuple(float(ev) for ev in whole["evs"].split(","))
    cost = {
        preset: presets.Preset(presets.preset(preset).rounds, evs, name).guided_steps
        for preset in (whole["preset"], "paper")
    }
    assert {preset: times * steps for preset, steps in cost.items()} == {"balanced": guided_steps, "paper": at_paper}
    text = note(name)
    assert f"{guided_steps:,} guided steps" in text
    assert f"{at_paper:,}" in text
    assert (nodes["LoraLoader"]["strength_model"], nodes["LoraLoader"]["strength_clip"]) == (0.75, 0.0)


def test_spatially_varying_places_the_balls_that_it_paints() -> None:
    nodes = {node["class_type"]: node["inputs"] for node in workflow("spatially_varying").values()}
    grid, whole = nodes["BallGrid"], nodes["EstimateLight"]
    assert grid["rows"] * grid["columns"] == 9
    assert (grid["canvas"], grid["diameter"]) == (whole["canvas"], whole["diameter"]) == (1024, 256)


def test_turbo_workflow_has_the_authors_settings() -> None:
    nodes = {node["class_type"]: node["inputs"] for node in workflow("turbo").values()}
    assert nodes["IterativeMedian"]["preset"] == "turbo"
    turbo = pack_module("dl_core.presets").preset("turbo")
    assert (turbo.rounds.rounds, turbo.rounds.steps, turbo.guided_steps) == (0, 30, 90)
    swap = nodes["TurboLoRASwap"]
    assert (swap["timestep"], swap["turbo_scale"], swap["exposure_scale"]) == (800, 1.0, 0.75)
    assert nodes["EVPromptInterp"]["lora"] == "none"
    assert not {"LoraLoader", "LoraLoaderModelOnly"} & nodes.keys()


@pytest.mark.parametrize("name", ["turbo", "paper_sdxl", "spatially_varying", "batch_folder"])
def test_graph_form_and_api_form_say_the_same(info: dict[str, Any], name: str) -> None:
    """Links by node and socket; widgets in the order the server declares them."""
    graph = json.loads((REPOSITORY / "workflows" / f"{name}.json").read_text())
    links = {link[0]: [str(link[1]), link[2]] for link in graph["links"]}
    nodes = {str(node["id"]): node for node in graph["nodes"] if "Note" not in node["type"]}
    prompt = workflow(name)
    assert nodes.keys() == prompt.keys()
    for number, node in nodes.items():
        linked = {item["name"]: links[item["link"]] for item in node["inputs"] if item["link"] is not None}
        wanted = {key: value for key, value in prompt[number]["inputs"].items() if isinstance(value, list)}
        assert linked == wanted, node["type"]
        values = iter(value for value in node["widgets_values"] if value not in ("fixed", "image"))
        kinds = info[node["type"]]["input"]
        for key, spec in (kinds["required"] | kinds.get("optional", {})).items():
            if isinstance(spec[0], list) or (spec[0] in WIDGETS and not spec[1].get("forceInput")):
                found = next(values, "")
                if key in linked:
                    continue  # a widget's value is kept beside its link
                assert found == prompt[number]["inputs"].get(key, ""), f"{node['type']}.{key}"
        assert not list(values), node["type"]


@pytest.fixture
def lora_files(server: Server, generator: torch.Generator) -> Iterator[dict[str, str]]:
    """Two random LoRAs in the server's folder, by the socket that takes them."""
    mini = pack_module("dl_core.backends.mini").load_mini()
    layers = pack_module("dl_core.backends.diffusers_lora").lora_shapes(mini.unet)
    shapes, names = attention_layers(layers), pack_module("dl_core.lora_names").comfyui_layers(layers)
    folder = server.base / "models" / "loras"
    folder.mkdir(parents=True, exist_ok=True)
    files = {"turbo_lora": "kohya for SDXL", "exposure_lora": "diffusers, attention processors"}
    for socket, convention in files.items():
        save_file(RandomLora.on(shapes, generator).written(convention, names), folder / f"{socket}.safetensors")
    yield {socket: f"{socket}.safetensors" for socket in files}
    for socket in files:
        (folder / f"{socket}.safetensors").unlink()


def test_turbo_runs_on_the_mini_model(server: Server, lora_files: dict[str, str]) -> None:
    """The quickstart's graph with the swap before it; six steps visit 853 and then 711 ...: one lies before it."""
    prompt = workflow("mini_quickstart")
    loader = next(number for number, node in prompt.items() if node["class_type"] == "MiniProbeLoader")
    prompt[loader]["inputs"]["lora_scale"] = 0.0
    for node in prompt.values():
        for socket, value in node["inputs"].items():
            if value == [loader, 0]:
                node["inputs"][socket] = ["turbo", 0]
        if node["class_type"] == "IterativeMedian":
            node["inputs"] |= {"preset": "custom", "balls": 1, "rounds": 0, "steps": 6}
    scales = {"turbo_scale": 1.0, "exposure_scale": 0.75, "timestep": 800}
    prompt["turbo"] = {"class_type": "TurboLoRASwap", "inputs": {"model": [loader, 0], **lora_files, **scales}}
    entry = server.run(prompt)
    assert entry["status"]["status_str"] == "success", entry["status"]
    (file,) = [file for output in entry["outputs"].values() for file in output.get("envmaps", [])]
    header = pack_module("dl_core.imageio").read_exr_header(
        server.base / "output" / file["subfolder"] / file["filename"]
    )
    assert header["lightprobe"].count("12 denoiser evaluations") == 3


@pytest.mark.parametrize("name", ["paper_sdxl", "turbo", "spatially_varying", "batch_folder"])
def test_server_accepts_a_workflow_of_sdxl_but_for_files_it_lacks(server: Server, name: str) -> None:
    answer = server.post("/prompt", {"prompt": workflow(name)})
    complaints = [error for node in answer["node_errors"].values() for error in node["errors"]]
    assert complaints
    named = {error["extra_info"].get("input_name") for error in complaints}
    assert named <= {name for _, name in FILE_INPUTS}, complaints


@pytest.fixture(scope="module")
def quickstart(server: Server) -> dict[str, Any]:
    entry = server.run(workflow("mini_quickstart"))
    assert entry["status"]["status_str"] == "success", entry["status"]
    return entry


def test_quickstart_exr_is_in_the_history_and_served(
    server: Server, quickstart: dict[str, Any], tmp_path: Path
) -> None:
    (saved,) = [output for output in quickstart["outputs"].values() if "envmaps" in output]
    (file,) = saved["envmaps"]
    assert file["type"] == "output"
    path = tmp_path / "probe.exr"
    path.write_bytes(server.get("/view", **file))
    io = pack_module("dl_core.imageio")
    assert io.read_envmap(path).shape == (1, 256, 512, 3)
    header = io.read_exr_header(path)
    inputs = {number: node["inputs"] for number, node in workflow("mini_quickstart").items()}
    assert {number: node["inputs"] for number, node in json.loads(header["prompt"]).items()} == inputs
    report = header["lightprobe"].splitlines()
    assert [line.split(":")[0] for line in report[:3]] == ["EV 0", "EV -2.5", "EV -5"]
    assert "30 denoiser evaluations" in report[0]
    (preview,) = saved["images"]
    assert server.get("/view", **preview).startswith(b"\x89PNG")


def test_quickstart_paints_once_per_exposure(quickstart: dict[str, Any]) -> None:
    counts = sorted(len(output["images"]) for output in quickstart["outputs"].values())
    assert counts == [1, 1, 3]  # depth, map, composites


def test_running_again_overwrites_nothing(server: Server, quickstart: dict[str, Any]) -> None:
    prompt = workflow("mini_quickstart")
    for node in prompt.values():
        if node["class_type"] == "BallToEquirect":
            node["inputs"]["height"] = 64
    entry = server.run(prompt)
    names = [file["filename"] for output in entry["outputs"].values() for file in output.get("envmaps", [])]
    first = [file["filename"] for output in quickstart["outputs"].values() for file in output.get("envmaps", [])]
    assert names
    assert not set(names) & set(first)


def test_error_names_node_and_reason(server: Server) -> None:
    prompt = workflow("mini_quickstart")
    for node in prompt.values():
        if node["class_type"] == "SaveEnvMap":
            node["inputs"]["filename_prefix"] = "../outside"
        if node["class_type"] == "IterativeMedian":
            node["inputs"] |= {"preset": "custom", "balls": 1, "steps": 2}
    entry = server.run(prompt)
    (error,) = [body for kind, body in entry["status"]["messages"] if kind == "execution_error"]
    assert error["node_type"] == "SaveEnvMap"
    assert "inside the output folder" in error["exception_message"]


def test_interruption_ends_the_run_within_a_step(server: Server) -> None:
    prompt = workflow("mini_quickstart")
    for node in prompt.values():
        if node["class_type"] == "IterativeMedian":
            node["inputs"] |= {"preset": "paper", "batch_size": 1, "seed": 5}
    prompt_id = server.post("/prompt", {"prompt": prompt})["prompt_id"]
    time.sleep(15)
    assert prompt_id not in server.get_json(f"/history/{prompt_id}")
    started = time.monotonic()
    server.post("/interrupt", {})
    entry = server.wait(prompt_id, timeout=60)
    assert time.monotonic() - started < 10  # an evaluation of the mini model takes a few tenths of a second
    kinds = [kind for kind, _ in entry["status"]["messages"]]
    assert "execution_interrupted" in kinds
    assert not entry["outputs"] or all("envmaps" not in output for output in entry["outputs"].values())


def interrupt_at(server: Server, prompt: dict[str, Any], evaluations: int) -> dict[str, Any]:
    """Queue a prompt, interrupt it once its second bar is so far; its entry of the history."""

    async def follow() -> str:
        import aiohttp  # comes with ComfyUI, not with this package

        async with aiohttp.ClientSession() as session, session.ws_connect(f"{server.url}/ws?clientId=test") as socket:
            body = {"prompt": prompt, "client_id": "test"}
            async with session.post(f"{server.url}/prompt", json=body) as answer:
                prompt_id = (await answer.json())["prompt_id"]
            bars, value = 0, 0
            async for message in socket:
                event = json.loads(message.data) if message.type == aiohttp.WSMsgType.TEXT else {}
                if event.get("type") == "progress":
                    bars += event["data"]["value"] == 0 or event["data"]["value"] < value
                    value = event["data"]["value"]
                    if bars == 2 and value >= evaluations:
                        async with session.post(f"{server.url}/interrupt", json={}):
                            return prompt_id
        raise AssertionError("the connection ended before the run was so far")

    return server.wait(asyncio.run(asyncio.wait_for(follow(), 120)), timeout=60)


def test_a_graph_queued_again_goes_on_where_it_was_interrupted(server: Server) -> None:
    """ComfyUI keeps what ran before the interrupted node, so the models are the same objects in the second run."""
    prompt = workflow("mini_quickstart")
    for node in prompt.values():
        if node["class_type"] == "IterativeMedian":
            node["inputs"] |= {"preset": "custom", "balls": 9, "rounds": 1, "steps": 4, "final": False}
            node["inputs"] |= {"batch_size": 1, "seed": 31}
        if node["class_type"] == "DepthBallMask":
            node["inputs"] |= {"canvas": 64, "diameter": 32}
    each = 4 * 2
    entry = interrupt_at(server, prompt, 2 * each)
    assert "execution_interrupted" in [kind for kind, _ in entry["status"]["messages"]]
    entry = server.run(prompt)
    (saved,) = [output["envmaps"][0] for output in entry["outputs"].values() if "envmaps" in output]
    path = server.base / "output" / saved["subfolder"] / saved["filename"]
    report = pack_module("dl_core.imageio").read_exr_header(path)["lightprobe"]
    taken = dict(re.findall(r"EV (\S+): (\d+) of 9 balls taken from an earlier run", report))
    assert list(taken) == ["0", "-2.5"]
    assert taken["0"] == "9"
    # Two were finished when the interrupt was sent; a few small ones more until it arrived.
    assert 2 <= int(taken["-2.5"]) < 9


def test_an_exposure_changed_is_all_that_is_painted_anew(server: Server, quickstart: dict[str, Any]) -> None:
    prompt = workflow("mini_quickstart")
    for node in prompt.values():
        if node["class_type"] == "EVPromptInterp":
            node["inputs"]["evs"] = "0, -2.5, -4"
    entry = server.run(prompt)
    (saved,) = [output["envmaps"][0] for output in entry["outputs"].values() if "envmaps" in output]
    path = server.base / "output" / saved["subfolder"] / saved["filename"]
    report = pack_module("dl_core.imageio").read_exr_header(path)["lightprobe"]
    spent = dict(re.findall(r"EV (\S+): .*?; (\d+) denoiser evaluations", report))
    assert spent == {"0": "0", "-2.5": "0", "-4": "30"}


# --- many maps in one graph --------------------------------------------------------------------------------------


def at_mini_size(name: str, **options: Any) -> dict[str, Any]:
    """A workflow of SDXL on the mini model, small: its loaders replaced, 2 steps, one ball."""
    prompt = workflow(name)
    prompt["mini"] = {"class_type": "MiniProbeLoader", "inputs": {"lora_scale": 0.75}}
    outputs = {
        ("CheckpointLoaderSimple", 0): 0,
        ("CheckpointLoaderSimple", 1): 1,
        ("CheckpointLoaderSimple", 2): 2,
        ("ControlNetLoader", 0): 3,
        ("LoraLoader", 0): 0,
        ("LoraLoader", 1): 1,
    }
    for node in prompt.values():
        for socket, value in node["inputs"].items():
            source = (prompt[value[0]]["class_type"], value[1]) if isinstance(value, list) else None
            if source in outputs:
                node["inputs"][socket] = ["mini", outputs[source]]
        if node["class_type"] == "EstimateLight":
            node["inputs"] |= {"preset": "custom", "balls": 1, "rounds": 1, "steps": 2, "final": False, "height": 16}
        if node["class_type"] in ("EstimateLight", "BallGrid"):
            node["inputs"] |= {"canvas": 64, "diameter": 16}
    kinds = {kind for kind, _ in outputs}
    return {number: node for number, node in prompt.items() if node["class_type"] not in kinds}


def saved(server: Server, entry: dict[str, Any]) -> dict[str, Path]:
    """The maps of a run by the start of their names."""
    assert entry["status"]["status_str"] == "success", entry["status"]
    files = [file for output in entry["outputs"].values() for file in output.get("envmaps", [])]
    paths = [server.base / "output" / file["subfolder"] / file["filename"] for file in files]
    return {path.name.removesuffix("_00001_.exr"): path for path in paths}


@pytest.fixture(scope="module")
def nine(server: Server) -> dict[str, Path]:
    """Maps of nine places by name."""
    gradient = torch.linspace(0, 1, 60).expand(40, -1)[..., None].expand(-1, -1, 3)
    pack_module("dl_core.imageio").write_png(server.base / "input" / "coffee_depth.png", gradient)
    return saved(server, server.run(at_mini_size("spatially_varying")))


def test_nine_places_give_nine_maps(server: Server, nine: dict[str, Path]) -> None:
    assert list(nine) == [f"row{row}_column{column}" for row in (1, 2, 3) for column in (1, 2, 3)]
    assert {path.parent for path in nine.values()} == {server.base / "output" / "lightprobe" / "spatially_varying"}
    io = pack_module("dl_core.imageio")
    maps = [io.read_envmap(path) for path in nine.values()]
    assert {tuple(item.shape) for item in maps} == {(1, 16, 32, 3)}
    assert all(not torch.equal(a, b) for i, a in enumerate(maps) for b in maps[:i])
    for path in nine.values():
        report = io.read_exr_header(path)["lightprobe"].splitlines()
        assert [line.split(":")[0] for line in report] == ["EV 0", "EV -2.5", "EV -5", "no expected error", report[-1]]
        assert report[-1] == "Merged EV 0, -2.5, -5 by the method robust, gamma 2.4."
        assert [int(count) for count in re.findall(r"(\d+) denoiser evaluations", "\n".join(report))] == [4, 4, 4]


@pytest.mark.parametrize(("name", "row", "column"), [("row1_column3", 1, 3), ("row3_column2", 3, 2)])
def test_a_map_of_nine_is_that_of_its_place_alone(
    server: Server, nine: dict[str, Path], name: str, row: int, column: int
) -> None:
    """The place worked out by hand; the ball is the one of before, so that this also paints nothing."""
    prompt = at_mini_size("spatially_varying")
    # A ball of 16 with 1 around it; 64 x 43 pixels of photograph below 10 of bar.
    x, y = {1: 9, 2: 32, 3: 55}[column], {1: 19, 2: 32, 3: 44}[row]
    for node in prompt.values():
        if node["class_type"] == "EstimateLight":
            node["inputs"] |= {"x": x, "y": y}
        if node["class_type"] == "StringConcatenate":
            node["inputs"] |= {"string_a": "alone/", "string_b": name}
    (path,) = saved(server, server.run(prompt)).values()
    io = pack_module("dl_core.imageio")
    assert torch.equal(io.read_envmap(path), io.read_envmap(nine[name]))
    report = io.read_exr_header(path)["lightprobe"]
    assert report.count("; 0 denoiser evaluations") == report.count("1 of 1 balls taken from an earlier run") == 3


def test_places_go_on_where_they_were_interrupted(server: Server, nine: dict[str, Path]) -> None:
    """At the second place, two of four balls into its first exposure."""
    prompt = at_mini_size("spatially_varying")
    for node in prompt.values():
        if node["class_type"] == "EstimateLight":
            node["inputs"] |= {"balls": 4, "steps": 4, "batch_size": 1, "seed": 50}
        if node["class_type"] == "StringConcatenate":
            node["inputs"]["string_a"] = "interrupted/"
    entry = interrupt_at(server, prompt, 2 * 4 * 2)
    assert "execution_interrupted" in [kind for kind, _ in entry["status"]["messages"]]
    reports = [
        pack_module("dl_core.imageio").read_exr_header(path)["lightprobe"]
        for path in saved(server, server.run(prompt)).values()
    ]
    taken = [sum(map(int, re.findall(r"(\d) of 4 balls taken from an earlier run", report))) for report in reports]
    assert taken[0] == 3 * 4
    # Two of the second place were finished when the interrupt was sent; a few small ones more until it arrived.
    assert taken[1] >= 2
    assert taken[-1] == 0
    assert taken == sorted(taken, reverse=True)


@pytest.fixture
def photographs(server: Server) -> Path:
    """Three photographs, one of them on its side, and a text, in a folder of the server's input folder."""
    from PIL import Image

    folder = server.base / "input" / "photographs"
    folder.mkdir(exist_ok=True)
    for path in folder.iterdir():
        path.unlink()
    exif = Image.Exif()
    exif[0x0112] = 6
    with Image.open(PHOTO) as coffee:
        coffee.save(folder / "upright.png")
        coffee.crop((0, 0, 300, 300)).save(folder / "part.webp")
        coffee.resize((150, 100)).save(folder / "side.jpg", exif=exif)
    (folder / "notes.txt").write_text("three photographs")
    return folder


def test_a_folder_of_photographs_gives_maps_named_after_them(server: Server, photographs: Path) -> None:
    save_depth_anything(server.base / "models" / "depth_estimation" / "toy")
    prompt = at_mini_size("batch_folder")
    for node in prompt.values():
        if node["class_type"] == "EstimateDepth":
            node["inputs"]["model"] = "toy"
    entry = server.run(prompt)
    maps = saved(server, entry)
    assert list(maps) == ["part", "side", "upright"]
    folder = server.base / "output" / "lightprobe" / "batch"
    assert sorted(path.name for path in folder.iterdir()) == [f"{name}_00001_.exr" for name in maps]
    read = pack_module("dl_core.imageio").read_envmap
    part, side, upright = (read(path) for path in maps.values())
    assert not torch.equal(part, upright)
    assert not torch.equal(side, upright)
    (text,) = [output["text"][0] for output in entry["outputs"].values() if "text" in output]
    assert text.splitlines()[0] == f"3 photographs in {photographs}."
    assert text.splitlines()[1].startswith("Left out: notes.txt cannot be read as a photograph")
    # A new name: the folder is read again, and nothing is painted, as the photographs are those of before.
    (photographs / "part.webp").rename(photographs / "again.webp")
    again = saved(server, server.run(prompt))["again"]
    assert torch.equal(read(again), part)
    report = pack_module("dl_core.imageio").read_exr_header(again)["lightprobe"]
    assert report.count("; 0 denoiser evaluations") == 3


def test_a_folder_that_another_node_names_is_read(server: Server, photographs: Path) -> None:
    joined = {"string_a": "photo", "string_b": "graphs", "delimiter": ""}
    prompt = {
        "1": {"class_type": "StringConcatenate", "inputs": joined},
        "2": {"class_type": "LoadPhotoFolder", "inputs": {"folder": ["1", 0], "kept_side": 100}},
        "3": {"class_type": "PreviewImage", "inputs": {"images": ["2", 0]}},
        "4": {"class_type": "PreviewAny", "inputs": {"source": ["2", 1]}},
    }
    for _ in range(2):
        entry = server.run(prompt)
        assert entry["status"]["status_str"] == "success", entry["status"]
    assert len(entry["outputs"]["3"]["images"]) == 3
    assert entry["outputs"]["4"]["text"] == ["part", "side", "upright"]


def test_a_folder_that_is_missing_is_refused_before_anything_runs(server: Server) -> None:
    prompt = at_mini_size("batch_folder")
    for node in prompt.values():
        if node["class_type"] == "LoadPhotoFolder":
            node["inputs"]["folder"] = "../input_of_another"
    answer = server.post("/prompt", {"prompt": prompt})
    complaints = [error["details"] for node in answer["node_errors"].values() for error in node["errors"]]
    assert any("LoadPhotoFolder, folder is '../input_of_another'" in complaint for complaint in complaints)
