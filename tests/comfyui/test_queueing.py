"""`lightprobe queue` and the README's curl lines against the real server, which is killed and started again once."""

from __future__ import annotations

import json
import re
import shutil
import signal
import subprocess
import sys
import threading
import time
from pathlib import Path
from typing import Any

import pytest
from comfy_host import PHOTO, REPOSITORY, Server, free_port, launch, prepare
from foreground import hear_ctrl_c

from dl_core import cli
from dl_core.imageio import read_envmap, read_exr_header

WORKFLOW = REPOSITORY / "workflows" / "mini_quickstart.api.json"
SMALLEST = {"preset": "custom", "balls": 1, "rounds": 0, "steps": 2}


def small(path: Path, **changes: Any) -> Path:
    """The quickstart at its smallest, written to `path`."""
    prompt = json.loads(WORKFLOW.read_text())
    for node in prompt.values():
        if node["class_type"] == "IterativeMedian":
            node["inputs"] |= SMALLEST | changes
        if node["class_type"] == "EVPromptInterp":
            node["inputs"]["evs"] = "0"
        if node["class_type"] == "BallToEquirect":
            node["inputs"]["height"] = 64
    path.write_text(json.dumps(prompt))
    return path


def queue(capsys: pytest.CaptureFixture[str], *words: object) -> tuple[int, dict[str, Any]]:
    code = cli.main(["queue", *map(str, words), "--json"])
    return code, json.loads(capsys.readouterr().out)


def test_photographs_become_maps_and_a_bad_one_an_error(
    server: Server, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    """The bad one is no picture; the other two are the same, under two names."""
    good, again, bad = tmp_path / "café.jpg", tmp_path / "again.jpg", tmp_path / "bad.jpg"
    shutil.copy(PHOTO, good)
    shutil.copy(PHOTO, again)
    bad.write_text("no picture")
    words = (small(tmp_path / "flow.json"), good, again, bad)
    code, report = queue(capsys, *words, "--server", server.url, "--out", tmp_path / "out", "--seed", 77)
    assert code == 1
    assert [row["status"] for row in report["photos"]] == ["done", "done", "failed"]
    (error,) = report["photos"][2]["errors"]
    assert error["node_type"] == "LoadImage"
    assert "cannot identify image file" in error["message"]
    assert report["photos"][0]["files"] == report["photos"][1]["files"]
    assert read_envmap(tmp_path / "out" / "café.exr").shape == (1, 64, 128, 3)
    assert (tmp_path / "out" / "café.preview.png").read_bytes().startswith(b"\x89PNG")
    prompt = json.loads(read_exr_header(tmp_path / "out" / "café.exr")["prompt"])
    assert next(node["inputs"]["seed"] for node in prompt.values() if "seed" in node["inputs"]) == 77


def test_a_workflow_that_is_valid_in_part_is_refused_as_a_whole(
    server: Server, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    """The server would run it for the sake of its previews."""
    flow = small(tmp_path / "flow.json", control_net=["3", 0])
    code, report = queue(capsys, flow, PHOTO, "--server", server.url, "--out", tmp_path / "out")
    assert (code, report["photos"][0]["status"]) == (1, "failed")
    assert report["photos"][0]["errors"][0]["node_type"] == "IterativeMedian"
    assert "control_net" in report["photos"][0]["errors"][0]["message"]
    state = server.get_json("/queue")
    assert (state["queue_running"], state["queue_pending"]) == ([], [])


def test_a_server_killed_in_the_middle_is_waited_for(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    base, port = tmp_path / "base", free_port()
    prepare(base)
    # Long enough to be killed at: a dozen seconds.
    flow = small(tmp_path / "flow.json", balls=4, rounds=1, steps=10, final=False, batch_size=1)
    answers: list[tuple[int, dict[str, Any]]] = []
    words = (flow, PHOTO, "--server", f"http://127.0.0.1:{port}", "--out", tmp_path / "out")
    run = threading.Thread(target=lambda: answers.append(queue(capsys, *words)))
    with launch(base, port) as first:
        run.start()
        wait_until(lambda: first.get_json("/queue")["queue_running"])
        first.process.kill()
        first.process.wait(20)
    with launch(base, port) as again:
        run.join(120)
        assert len(again.get_json("/history")) == 1
    ((code, report),) = answers
    assert (code, report["photos"][0]["status"]) == (0, "done")
    assert read_envmap(tmp_path / "out" / f"{PHOTO.stem}.exr").shape == (1, 64, 128, 3)


@pytest.mark.skipif(sys.platform == "win32", reason="signals as on Unix")
def test_ctrl_c_leaves_the_server_idle(server: Server, tmp_path: Path) -> None:
    """One job runs and one waits when the interrupt comes; the paper's schedule would take minutes."""
    flow, other = small(tmp_path / "flow.json", preset="paper", batch_size=1), tmp_path / "other.jpg"
    other.write_bytes(PHOTO.read_bytes() + b" ")
    command = [sys.executable, "-c", "import sys; from dl_core.cli import main; sys.exit(main(sys.argv[1:]))"]
    command += ["queue", str(flow), str(PHOTO), str(other), "--server", server.url, "--out", str(tmp_path / "out")]
    process = subprocess.Popen(command, cwd=REPOSITORY, preexec_fn=hear_ctrl_c)
    wait_until(lambda: all(server.get_json("/queue").values()))
    process.send_signal(signal.SIGINT)
    assert process.wait(30) == 130
    assert server.get_json("/queue")["queue_pending"] == []
    # ComfyUI gives way before the next evaluation, of which this job has a thousand.
    wait_until(lambda: server.get_json("/queue")["queue_running"] == [])


def wait_until(condition: Any, timeout: float = 60) -> None:
    deadline = time.monotonic() + timeout
    while not condition():
        assert time.monotonic() < deadline
        time.sleep(0.1)


@pytest.mark.skipif(not all(map(shutil.which, ("bash", "curl", "jq"))), reason="needs bash, curl and jq")
def test_the_readmes_curl_lines_work(server: Server, tmp_path: Path) -> None:
    """As they stand, but for the server's address and for a smaller workflow in a folder of its own."""
    text = (REPOSITORY / "README.md").read_text(encoding="utf-8")
    (script,) = re.findall(r"<!-- command: curl -->\n```sh\n(.+?)\n```", text, re.DOTALL)
    assert "http://127.0.0.1:8188" in script
    (tmp_path / "workflows").mkdir()
    small(tmp_path / "workflows" / WORKFLOW.name, seed=78)
    shutil.copy(PHOTO, tmp_path / "photo.jpg")
    command = ["bash", "-euo", "pipefail", "-c", script.replace("http://127.0.0.1:8188", server.url)]
    subprocess.run(command, cwd=tmp_path, check=True, timeout=120)
    assert read_envmap(tmp_path / "probe.exr").shape == (1, 64, 128, 3)
    assert json.loads(read_exr_header(tmp_path / "probe.exr")["prompt"])["2"]["inputs"]["image"].startswith("photo")
