"""A real ComfyUI for tests: in this process, or as a server with this pack installed in a folder of its own.

COMFYUI_PATH says where ComfyUI is (~/ComfyUI if not set). Nothing is written there.
"""

from __future__ import annotations

import importlib
import importlib.util
import json
import os
import runpy
import shutil
import socket
import subprocess
import sys
import time
import urllib.error
import urllib.parse
import urllib.request
from collections.abc import Iterator, Mapping
from contextlib import contextmanager
from dataclasses import dataclass
from pathlib import Path
from types import ModuleType
from typing import Any

REPOSITORY = Path(__file__).resolve().parent.parent
WORKFLOWS = (
    "mini_quickstart",
    "paper_sdxl",
    "sdxl_fast",
    "base_only",
    "lora_only",
    "turbo",
    "spatially_varying",
    "batch_folder",
)
COMFYUI = Path(os.environ.get("COMFYUI_PATH", Path.home() / "ComfyUI"))
STANDIN = REPOSITORY / "tests" / "comfyui" / "standin"
PHOTO = REPOSITORY / "dl_core" / "data" / "photos" / "coffee.jpg"
PACK = "lightprobe_pack"
REQUIREMENTS = ("aiohttp", "alembic", "av", "comfyui_frontend_package", "einops", "psutil", "sqlalchemy", "torchsde")
"""What ComfyUI needs and this package does not."""


def _absence() -> str:
    """Why ComfyUI cannot be tested against; empty if it can."""
    if not ((COMFYUI / "main.py").is_file() and (COMFYUI / "comfy_api").is_dir()):
        return f"NO COMFYUI: {COMFYUI} holds none, its tests are skipped; set COMFYUI_PATH"
    missing = [name for name in REQUIREMENTS if importlib.util.find_spec(name) is None]
    if missing:
        return f"NO COMFYUI: this environment lacks {', '.join(missing)}, its tests are skipped; see .ci/run"
    return ""


NO_COMFYUI = _absence()


def installed() -> bool:
    """Whether there is a ComfyUI to test against, with what it needs."""
    return not NO_COMFYUI


# --- in this process ---------------------------------------------------------------------------------------------


def load_pack() -> ModuleType:
    """Import ComfyUI on the CPU, then the pack by path under another name, as ComfyUI does."""
    if PACK in sys.modules:
        return sys.modules[PACK]
    runpy.run_path(str(STANDIN / "sitecustomize.py"))
    sys.path.insert(0, str(COMFYUI))
    cli_args = importlib.import_module("comfy.cli_args")
    cli_args.args.cpu = True
    spec = importlib.util.spec_from_file_location(PACK, REPOSITORY / "__init__.py")
    assert spec is not None
    assert spec.loader is not None
    pack = importlib.util.module_from_spec(spec)
    sys.modules[PACK] = pack
    spec.loader.exec_module(pack)
    importlib.import_module(f"{PACK}.nodes")
    return pack


def pack_module(name: str) -> ModuleType:
    """A module of the loaded pack, such as `nodes.painter` or `dl_core.errors`.

    The pack's `dl_core` is not the one that `import dl_core` gives: ComfyUI loads it under another name.
    """
    load_pack()
    return importlib.import_module(f"{PACK}.{name}")


# --- as a server -------------------------------------------------------------------------------------------------


@dataclass(frozen=True)
class Server:
    """A running ComfyUI server, the folder it works in and its process."""

    url: str
    base: Path
    process: subprocess.Popen[bytes]

    def get(self, route: str, **query: str) -> bytes:
        """Body of a GET."""
        suffix = f"?{urllib.parse.urlencode(query)}" if query else ""
        with urllib.request.urlopen(f"{self.url}{route}{suffix}", timeout=60) as answer:
            return answer.read()

    def get_json(self, route: str, **query: str) -> Any:
        """Body of a GET, parsed."""
        return json.loads(self.get(route, **query))

    def post(self, route: str, body: dict[str, Any]) -> dict[str, Any]:
        """Answer to a JSON POST; a refusal comes back as its parsed body too."""
        request = urllib.request.Request(
            f"{self.url}{route}", json.dumps(body).encode(), {"Content-Type": "application/json"}
        )
        try:
            with urllib.request.urlopen(request, timeout=60) as answer:
                text = answer.read()
        except urllib.error.HTTPError as error:
            text = error.read()
        return json.loads(text) if text else {}

    def run(self, prompt: dict[str, Any], timeout: float = 400) -> dict[str, Any]:
        """Queue a prompt, wait for its end, and give its entry of the history."""
        answer = self.post("/prompt", {"prompt": prompt})
        assert "prompt_id" in answer, answer
        return self.wait(answer["prompt_id"], timeout)

    def wait(self, prompt_id: str, timeout: float = 400) -> dict[str, Any]:
        """Wait for the end of a queued prompt, and give its entry of the history."""
        deadline = time.monotonic() + timeout
        while time.monotonic() < deadline:
            entry = self.get_json(f"/history/{prompt_id}").get(prompt_id)
            if entry:
                return entry
            time.sleep(0.25)
        raise TimeoutError(f"the prompt did not end within {timeout:g} s")


def install_pack(custom_nodes: Path) -> Path:
    """Copy the pack as a user would clone it. Where trained weights are missing, untrained ones are put in the copy."""
    target = custom_nodes / "ComfyUI-LightProbe"
    target.mkdir(parents=True)
    shutil.copy(REPOSITORY / "__init__.py", target)
    shutil.copy(REPOSITORY / "pyproject.toml", target)
    for folder in ("nodes", "dl_core", "js", "workflows"):
        shutil.copytree(REPOSITORY / folder, target / folder, ignore=shutil.ignore_patterns("__pycache__"))
    _fill_weights(target / "dl_core" / "data" / "mini")
    return target


def _fill_weights(folder: Path) -> None:
    import torch
    from safetensors.torch import save_file

    from dl_core.backends.mini import LORA_FILE, NETWORK_FILES, MiniModel

    if all((folder / name).is_file() for name in NETWORK_FILES.values()):
        return
    torch.manual_seed(0)
    for name, network in MiniModel.untrained(folder).networks().items():
        save_file(
            {key: value.contiguous() for key, value in network.state_dict().items()}, folder / NETWORK_FILES[name]
        )
    lora = {
        f"unet.down_blocks.1.attentions.0.transformer_blocks.0.attn1.to_q.lora_{half}.weight": 0.01 * torch.randn(shape)
        for half, shape in (("A", (4, 128)), ("B", (128, 4)))
    }
    save_file(lora, folder / LORA_FILE)


@contextmanager
def serve(base: Path) -> Iterator[Server]:
    """Run a ComfyUI server on a free port, working in `base`, with this pack and the package's photograph."""
    prepare(base)
    with launch(base, free_port()) as server:
        yield server


def prepare(base: Path) -> None:
    """Make the folder of a server: this pack and the package's photograph in it."""
    (base / "input").mkdir(parents=True)
    shutil.copy(PHOTO, base / "input")
    install_pack(base / "custom_nodes")


def free_port() -> int:
    """A port that nobody listens on."""
    with socket.socket() as probe:
        probe.bind(("127.0.0.1", 0))
        return int(probe.getsockname()[1])


@contextmanager
def launch(base: Path, port: int, variables: Mapping[str, str] | None = None) -> Iterator[Server]:
    """Run a ComfyUI server in a prepared folder. It may be killed and launched again, on the same port.

    `variables` are added to its environment.
    """
    command = [sys.executable, "main.py", "--cpu", "--listen", "127.0.0.1", "--port", str(port)]
    command += ["--disable-auto-launch", "--base-directory", str(base)]
    command += ["--database-url", f"sqlite:///{base / 'comfyui.db'}"]
    environment = os.environ | {"PYTHONPATH": str(STANDIN), "PYTHONDONTWRITEBYTECODE": "1"} | (variables or {})
    with (base / "server.log").open("a") as log:
        process = subprocess.Popen(command, cwd=COMFYUI, env=environment, stdout=log, stderr=log)
        try:
            server = Server(f"http://127.0.0.1:{port}", base, process)
            _wait_until_up(server)
            yield server
        finally:
            process.terminate()
            process.wait(20)


def _wait_until_up(server: Server, timeout: float = 180) -> None:
    deadline = time.monotonic() + timeout
    while time.monotonic() < deadline and server.process.poll() is None:
        try:
            server.get("/system_stats")
            return
        except OSError:
            time.sleep(0.5)
    raise RuntimeError(f"ComfyUI did not start:\n{(server.base / 'server.log').read_text()[-4000:]}")


def leading_euler(config: Any) -> Any:
    """diffusers' Euler on the timesteps of the paper's schedule: a row for the backend's table of samplers."""
    from diffusers import EulerDiscreteScheduler

    class LeadingEuler(EulerDiscreteScheduler):
        def set_timesteps(self, num_inference_steps: int, device: Any = None) -> None:
            super().set_timesteps(timesteps=pack_module("nodes.sampling").leading_timesteps(num_inference_steps))

    return LeadingEuler.from_config(config)
