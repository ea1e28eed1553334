"""`lightprobe queue` against a fake of a ComfyUI server: restarts, lost jobs, faults, several servers, resuming."""

from __future__ import annotations

import copy
import http.server
import json
import os
import signal
import socketserver
import subprocess
import sys
import threading
import time
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Any

import pytest
from fake_comfyui import FakeComfyUI
from foreground import hear_ctrl_c

from dl_core import cli
from dl_core.errors import OptionError
from dl_core.queueing.client import ComfyClient
from dl_core.queueing.jobs import Servers
from dl_core.queueing.ledger import Ledger, job_key, local_names
from dl_core.queueing.workflow import Workflow, read_workflow

ROOT = Path(cli.__file__).parent.parent

PROMPT: dict[str, Any] = {
    "2": {"class_type": "LoadImage", "inputs": {"image": "coffee.jpg"}, "_meta": {"title": "Photograph"}},
    "8": {"class_type": "IterativeMedian", "inputs": {"image": ["2", 0], "seed": 0, "steps": 6}},
    "9": {"class_type": "PreviewImage", "inputs": {"images": ["8", 0]}},
    "12": {"class_type": "SaveEnvMap", "inputs": {"latlong": ["8", 0], "filename_prefix": "lightprobe/probe"}},
}

Photo = Callable[[str, str], Path]
Queue = Callable[..., tuple[int, dict[str, Any]]]


@pytest.fixture
def server() -> Iterator[FakeComfyUI]:
    fake = FakeComfyUI()
    yield fake
    fake.stop()


@pytest.fixture
def second() -> Iterator[FakeComfyUI]:
    fake = FakeComfyUI()
    yield fake
    fake.stop()


@pytest.fixture
def workflow(tmp_path: Path) -> Path:
    path = tmp_path / "flow.api.json"
    path.write_text(json.dumps(PROMPT))
    return path


@pytest.fixture
def photo(tmp_path: Path) -> Photo:
    """A photograph for the fake: an order, and the name to make its content its own."""

    def make(name: str, content: str = "ok") -> Path:
        path = tmp_path / "photos" / name
        path.parent.mkdir(parents=True, exist_ok=True)
        path.write_text(f"{content}\n{name}")
        return path

    return make


@pytest.fixture
def queue(workflow: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> Queue:
    """Runs the command; exit code and report."""

    def run(photos: list[Path], servers: list[FakeComfyUI], *options: str) -> tuple[int, dict[str, Any]]:
        addresses = [word for server in servers for word in ("--server", server.url)]
        words = ["queue", str(workflow), *map(str, photos), *addresses, "--out", str(tmp_path / "out"), "--json"]
        code = cli.main([*words, *options])
        return code, json.loads(capsys.readouterr().out)

    return run


def statuses(report: dict[str, Any]) -> list[str]:
    return [row["status"] for row in report["photos"]]


# --- workflows ---------------------------------------------------------------------------------------------------


def written(tmp_path: Path, content: Any) -> Path:
    path = tmp_path / "given.json"
    path.write_text(content if isinstance(content, str) else json.dumps(content))
    return path


def without(*nodes: str) -> dict[str, Any]:
    return {number: node for number, node in PROMPT.items() if number not in nodes}


@pytest.mark.parametrize(
    ("content", "words"),
    [
        ({"nodes": [], "links": [], "version": 0.4}, "API form; this one is in graph form"),
        ("{", "a JSON file"),
        ([], "API form"),
        ({}, "API form"),
        ({"2": {"class_type": "LoadImage"}}, "class_type and inputs"),
        (without("2"), "LoadImage nodes here: none"),
        (PROMPT | {"3": PROMPT["2"]}, "LoadImage nodes here: nodes 2, 3"),
        (without("12"), "Save Environment Map"),
    ],
)
def test_what_is_no_workflow_for_photographs_is_refused(tmp_path: Path, content: Any, words: str) -> None:
    with pytest.raises(OptionError, match=words):
        read_workflow(written(tmp_path, content))


FOLDER_WORKFLOWS = {"batch_folder.api.json"}
"""They read their photographs from the server's own folder."""


@pytest.mark.parametrize("path", sorted((ROOT / "workflows").glob("*.json")), ids=lambda path: path.name)
def test_workflows_of_the_pack_are_accepted_in_api_form_only(path: Path) -> None:
    if not path.name.endswith(".api.json"):
        with pytest.raises(OptionError, match="graph form"):
            read_workflow(path)
        return
    nodes = json.loads(path.read_text())
    loaders = [number for number, node in nodes.items() if node["class_type"] == "LoadImage"]
    assert (not loaders) == (path.name in FOLDER_WORKFLOWS)
    if loaders:
        assert read_workflow(path, loaders[0]).savers
    else:
        with pytest.raises(OptionError, match="LoadImage nodes here: none"):
            read_workflow(path)


def test_of_several_loaders_one_is_chosen(tmp_path: Path) -> None:
    path = written(tmp_path, PROMPT | {"3": PROMPT["2"]})
    prompt = read_workflow(path, "3").with_photo("new.jpg")
    assert (prompt["2"]["inputs"]["image"], prompt["3"]["inputs"]["image"]) == ("coffee.jpg", "new.jpg")
    for wrong in ("8", "12", "77"):  # linked, without an image, not there
        with pytest.raises(OptionError, match=r"photo-node is '\d+'.*: 2, 3"):
            read_workflow(path, wrong)


def test_a_seed_goes_to_every_node_that_has_a_number_for_it() -> None:
    prompt = PROMPT | {"20": {"class_type": "KSamplerAdvanced", "inputs": {"noise_seed": 3, "seed": ["8", 0]}}}
    flow = Workflow(copy.deepcopy(prompt), "2")
    seeded = flow.with_seed(9).prompt
    assert seeded["8"]["inputs"]["seed"] == seeded["20"]["inputs"]["noise_seed"] == 9
    assert seeded["20"]["inputs"]["seed"] == ["8", 0]
    assert flow.prompt == prompt
    with pytest.raises(OptionError, match="no node of this workflow"):
        Workflow(without("8"), "2").with_seed(9)
    with pytest.raises(OptionError, match="seed is -1"):
        flow.with_seed(-1)


def test_a_workflow_is_known_by_what_decides_its_result() -> None:
    flow = Workflow(PROMPT, "2")
    titled = copy.deepcopy(PROMPT)
    titled["2"] |= {"_meta": {"title": "Photo"}, "inputs": {"image": "other.jpg"}}
    assert Workflow(titled, "2").identity == flow.identity
    assert flow.with_seed(1).identity != flow.identity
    assert job_key(b"a", flow) != job_key(b"b", flow)
    assert job_key(b"a", flow) == job_key(b"a", Workflow(titled, "2"))


@pytest.mark.parametrize("url", ["ftp://here", "http://", "://"])
def test_what_is_no_address_is_refused(url: str) -> None:
    with pytest.raises(OptionError, match="server is"):
        ComfyClient(url)


def test_options_of_servers_are_checked() -> None:
    url = "http://127.0.0.1:1"
    for servers, name in (
        (Servers(()), "server"),
        (Servers((url, url + "/")), "server"),
        (Servers((url,), timeout=-1), "timeout"),
        (Servers((url,), timeout=float("nan")), "timeout"),
        (Servers((url,), retries=-1), "retries"),
    ):
        with pytest.raises(OptionError, match=f"^{name} is"):
            servers.clients()


# --- names -------------------------------------------------------------------------------------------------------


def test_names_of_files_never_run_together(tmp_path: Path) -> None:
    """What begins like another photograph's files, up to a point, gets a name of its own; case does not count."""
    ledger = Ledger(tmp_path)
    (tmp_path / "theirs.exr").touch()
    (tmp_path / "photo.jpg").touch()
    wanted = ["coffee", "Coffee", "coffee.2", "coffeepot", "theirs", "photo"]
    keys = [job_key(name.encode(), Workflow(PROMPT, "2")) for name in wanted]
    names = [ledger.record(key, Path(f"{name}.jpg")).name for key, name in zip(keys, wanted, strict=True)]
    own = [
        name if free else f"{name}-{key[:12]}" for name, key, free in zip(wanted, keys, (1, 0, 0, 1, 0, 1), strict=True)
    ]
    assert names == own
    assert [Ledger(tmp_path).record(key, Path("renamed.jpg")).name for key in keys] == names


def test_all_files_of_a_node_have_names() -> None:
    def file(name: str) -> dict[str, str]:
        return {"filename": name, "subfolder": "", "type": "output"}

    output = {"envmaps": [file("a.exr"), file("a.hdr"), file("b.exr")], "images": [file("a.png"), file("b.png")]}
    names = [name for name, _ in local_names("room", output, set())]
    assert names == ["room.exr", "room.hdr", "room.2.exr", "room.preview.png", "room.2.preview.png"]


def test_a_damaged_record_is_no_record(tmp_path: Path) -> None:
    ledger = Ledger(tmp_path)
    key = job_key(b"a", Workflow(PROMPT, "2"))
    ledger.record(key, Path("a.jpg"))
    (record,) = (tmp_path / ".lightprobe").iterdir()
    record.write_text("{")
    assert Ledger(tmp_path).record(key, Path("b.jpg")).name == "b"


# --- runs --------------------------------------------------------------------------------------------------------


def test_every_photograph_gets_the_files_of_the_saving_node(
    server: FakeComfyUI, photo: Photo, queue: Queue, tmp_path: Path
) -> None:
    code, report = queue([photo("kitchen.jpg"), photo("hall.jpg")], [server], "--seed", "12")
    assert (code, statuses(report)) == (0, ["done", "done"])
    assert sorted(path.name for path in (tmp_path / "out").glob("*.*") if path.is_file()) == [
        "hall.exr",
        "hall.preview.png",
        "kitchen.exr",
        "kitchen.preview.png",
    ]
    uploads = [name.removeprefix("lightprobe/") for name in server.log.uploads]
    assert (tmp_path / "out" / "kitchen.exr").read_text() == f"content of {uploads[0]}_00001_.exr"
    assert [prompt["8"]["inputs"]["seed"] for prompt in server.log.prompts] == [12, 12]
    assert [(row["seconds"], row["server"]) for row in report["photos"]] == [(1.5, server.url)] * 2
    assert report["counts"] == {"done": 2, "skipped": 0, "failed": 0, "cancelled": 0}


def test_photographs_of_one_name_do_not_meet(server: FakeComfyUI, photo: Photo, queue: Queue, tmp_path: Path) -> None:
    photos = [photo("one/room.jpg"), photo("two/room.jpg")]
    code, report = queue(photos, [server])
    assert code == 0
    assert len(set(server.log.uploads)) == 2
    maps = [Path(row["files"][0]) for row in report["photos"]]
    assert len(set(maps)) == len({path.read_text() for path in maps}) == 2
    assert maps[0].name == "room.exr"
    assert maps[1].name.startswith("room-")


def test_one_photograph_given_twice_runs_once(server: FakeComfyUI, photo: Photo, queue: Queue, tmp_path: Path) -> None:
    first = photo("room.jpg")
    other = tmp_path / "copy.jpg"
    other.write_bytes(first.read_bytes())
    code, report = queue([first, other], [server])
    assert (code, len(server.log.started)) == (0, 1)
    assert report["photos"][0]["files"] == report["photos"][1]["files"]


def test_faults_are_told_in_the_servers_words_and_stop_nothing(
    server: FakeComfyUI, photo: Photo, queue: Queue, tmp_path: Path
) -> None:
    words = {
        "break": "IterativeMedian (node 8): steps is 0; accepted: 1 to 998",
        "refuse": "EVPromptInterp (node 6): Value not in list: lora: 'absent.safetensors' not in ['none']",
        "partly": "EVPromptInterp (node 6): Value not in list: lora: 'absent.safetensors' not in ['none']",
        "nothing": "the server reports no file of a Save Environment Map node",
    }
    photos = [photo("first.jpg"), *(photo(f"{word}.jpg", word) for word in words), photo("last.jpg")]
    missing = tmp_path / "missing.jpg"
    code, report = queue([*photos, missing], [server])
    assert code == 1
    assert statuses(report) == ["done", "failed", "failed", "failed", "failed", "done", "failed"]
    said = [row["errors"][0] for row in report["photos"] if row["status"] == "failed"]
    assert [error["message"] for error in said[:4]] == list(words.values())
    assert (said[0]["node"], said[0]["node_type"]) == ("8", "IterativeMedian")
    assert "missing.jpg cannot be read" in said[4]["message"]
    # What is valid in part would run without its map: it is taken back.
    assert not server.pending
    assert not any(file for row in report["photos"] if row["status"] == "failed" for file in row["files"])


def test_text_report_names_files_and_faults(
    server: FakeComfyUI, photo: Photo, workflow: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    good, bad = photo("good.jpg"), photo("bad.jpg", "break")
    words = ["queue", str(workflow), str(good), str(bad), "--server", server.url, "--out", str(tmp_path / "out")]
    assert cli.main(words) == 1
    printed = capsys.readouterr()
    assert f"{tmp_path / 'out' / 'good.exr'}" in printed.out
    assert "IterativeMedian (node 8): steps is 0" in printed.out
    assert "1 done, 1 failed" in printed.out
    assert "bad.jpg: IterativeMedian (node 8): steps is 0" in printed.err


def test_a_second_run_takes_up_what_is_missing(server: FakeComfyUI, photo: Photo, queue: Queue, tmp_path: Path) -> None:
    photos = [photo("kitchen.jpg"), photo("hall.jpg"), photo("bad.jpg", "break")]
    queue(photos, [server])
    started = len(server.log.started)
    renamed = photos[1].rename(photos[1].with_name("corridor.jpg"))
    (tmp_path / "out" / "kitchen.preview.png").unlink()
    code, report = queue([photos[0], renamed, photos[2]], [server])
    assert (code, statuses(report)) == (1, ["done", "skipped", "failed"])
    assert report["photos"][1]["files"][0] == str(tmp_path / "out" / "hall.exr")
    assert len(server.log.started) == started + 2
    code, report = queue(photos[:1], [server], "--seed", "5")
    assert statuses(report) == ["done"]
    assert Path(report["photos"][0]["files"][0]).name.startswith("kitchen-")


def test_a_finished_run_asks_no_server(server: FakeComfyUI, photo: Photo, queue: Queue) -> None:
    photos = [photo("kitchen.jpg")]
    queue(photos, [server])
    server.stop()
    code, report = queue(photos, [server])
    assert (code, statuses(report)) == (0, ["skipped"])


def test_files_gone_from_the_server_are_made_again(server: FakeComfyUI, photo: Photo, queue: Queue) -> None:
    """A server that starts empties its temporary folder: what the history names may not be there."""
    path = photo("kitchen.jpg")
    key = job_key(path.read_bytes(), Workflow(PROMPT, "2"))
    server.gone_files.add(f"kitchen-{key[:16]}.jpg_00001_preview.png")
    code, report = queue([path], [server])
    assert (code, statuses(report), len(server.log.started)) == (0, ["done"], 2)


# --- servers that go away ----------------------------------------------------------------------------------------


class Background(threading.Thread):
    """Runs the command beside the test."""

    def __init__(self, queue: Queue, *arguments: Any) -> None:
        super().__init__(daemon=True)
        self.queue, self.arguments = queue, arguments
        self.answer: tuple[int, dict[str, Any]] = (-1, {})
        self.start()

    def run(self) -> None:
        self.answer = self.queue(*self.arguments)

    def result(self) -> tuple[int, dict[str, Any]]:
        self.join(60)
        assert not self.is_alive()
        return self.answer


def test_jobs_of_a_restarted_server_are_queued_again(server: FakeComfyUI, photo: Photo, queue: Queue) -> None:
    photos = [photo("first.jpg"), photo("slow.jpg", "slow 1"), photo("waits.jpg"), photo("last.jpg")]
    run = Background(queue, photos, [server])
    server.wait_until(lambda: len(server.log.started) == 2 and len(server.pending) == 1)
    server.stop()
    time.sleep(0.7)
    server.start()
    code, report = run.result()
    assert (code, statuses(report)) == (0, ["done"] * 4)
    stems = [name.split("/")[1].split("-")[0] for name in server.log.started]
    assert sorted(stems) == ["first", "last", "slow", "slow", "waits"]


def test_jobs_that_a_server_forgot_are_queued_again(server: FakeComfyUI, photo: Photo, queue: Queue) -> None:
    run = Background(queue, [photo("slow.jpg", "slow 1"), photo("waits.jpg")], [server])
    server.wait_until(lambda: server.running is not None and len(server.pending) == 1)
    server.forget()
    code, report = run.result()
    assert (code, statuses(report)) == (0, ["done", "done"])


def test_a_job_that_kills_its_server_is_given_up_and_others_are_not(
    server: FakeComfyUI, photo: Photo, queue: Queue
) -> None:
    photos = [photo("killer.jpg", "crash"), photo("a.jpg"), photo("b.jpg")]
    code, report = queue(photos, [server], "--retries", "1")
    assert (code, statuses(report)) == (1, ["failed", "done", "done"])
    assert "lost 2 times while it ran" in report["photos"][0]["errors"][0]["message"]
    assert sum("killer" in name for name in server.log.started) == 2


def test_a_job_that_killed_its_server_once_gets_another_chance(server: FakeComfyUI, photo: Photo, queue: Queue) -> None:
    server.crashes_left = 1
    code, report = queue([photo("killer.jpg", "crash")], [server])
    assert (code, statuses(report)) == (0, ["done"])


def test_a_server_that_starts_late_is_waited_for(server: FakeComfyUI, photo: Photo, queue: Queue) -> None:
    server.stop()
    run = Background(queue, [photo("a.jpg")], [server])
    time.sleep(1)
    server.start()
    code, report = run.result()
    assert (code, statuses(report)) == (0, ["done"])


def test_two_servers_share_the_photographs(
    server: FakeComfyUI, second: FakeComfyUI, photo: Photo, queue: Queue
) -> None:
    photos = [photo(f"{number}.jpg", "slow 0.3") for number in range(8)]
    code, report = queue(photos, [server, second])
    assert (code, statuses(report)) == (0, ["done"] * 8)
    assert min(len(server.log.started), len(second.log.started)) >= 2
    assert len(server.log.started) + len(second.log.started) == 8


def test_jobs_of_a_server_that_stays_away_go_to_another(
    server: FakeComfyUI, second: FakeComfyUI, photo: Photo, queue: Queue
) -> None:
    photos = [photo(f"{number}.jpg", "slow 0.5") for number in range(4)]
    run = Background(queue, photos, [server, second], "--timeout", "1")
    server.wait_until(lambda: server.running is not None and len(server.pending) == 1)
    server.stop()
    code, report = run.result()
    assert (code, statuses(report)) == (0, ["done"] * 4)
    assert {row["server"] for row in report["photos"]} == {second.url}


def test_without_any_server_jobs_fail_with_the_reason(server: FakeComfyUI, photo: Photo, queue: Queue) -> None:
    server.stop()
    started = time.monotonic()
    code, report = queue([photo("a.jpg"), photo("b.jpg")], [server], "--timeout", "1")
    assert 1 <= time.monotonic() - started < 10
    assert (code, statuses(report)) == (1, ["failed", "failed"])
    message = report["photos"][0]["errors"][0]["message"]
    assert message.startswith(f"no server left: {server.url} stayed away for 1 s, ")


def test_what_is_no_comfyui_server_is_given_up_at_once(
    second: FakeComfyUI, photo: Photo, queue: Queue, tmp_path: Path
) -> None:
    with socketserver.ThreadingTCPServer(("127.0.0.1", 0), http.server.SimpleHTTPRequestHandler) as other:
        threading.Thread(target=other.serve_forever, daemon=True).start()
        address = f"http://127.0.0.1:{other.server_address[1]}"
        code, report = queue([photo("a.jpg")], [second], "--server", address)
        assert (code, report["photos"][0]["server"]) == (0, second.url)
        code, report = queue([photo("b.jpg")], [], "--server", address, "--timeout", "50")
        other.shutdown()
    assert (code, report["photos"][0]["status"]) == (1, "failed")
    assert report["photos"][0]["errors"][0]["message"].startswith(f"no server left: {address} /queue: 404")
    assert report["seconds"] < 10


# --- stopped by the user -----------------------------------------------------------------------------------------


@pytest.mark.skipif(sys.platform == "win32", reason="signals as on Unix")
@pytest.mark.parametrize("number", [signal.SIGINT, signal.SIGTERM])
def test_an_interrupt_cancels_our_jobs_and_keeps_what_was_collected(
    server: FakeComfyUI, photo: Photo, queue: Queue, workflow: Path, tmp_path: Path, number: signal.Signals
) -> None:
    photos = [photo("quick.jpg"), photo("slow.jpg", "slow 60"), photo("waits.jpg"), photo("never.jpg")]
    server.inputs["theirs.jpg"] = b"ok"
    command = [sys.executable, "-c", "import sys; from dl_core.cli import main; sys.exit(main(sys.argv[1:]))"]
    command += ["queue", str(workflow), *map(str, photos), "--server", server.url, "--out", str(tmp_path / "out")]
    process = subprocess.Popen(
        [*command, "--json"], cwd=ROOT, stdout=subprocess.PIPE, env=os.environ | {"CI": ""}, preexec_fn=hear_ctrl_c
    )
    server.wait_until(lambda: len(server.log.started) == 2 and len(server.pending) == 1, 60)
    theirs = copy.deepcopy(PROMPT)
    theirs["2"]["inputs"]["image"] = "theirs.jpg"
    server.prompt({"prompt": theirs, "prompt_id": "theirs"})
    process.send_signal(number)
    report = json.loads(process.communicate(timeout=60)[0])
    assert process.returncode == 130
    assert report["interrupted"]
    assert statuses(report) == ["done", "cancelled", "cancelled", "cancelled"]
    assert (len(server.log.interrupts), len(server.log.deleted)) == (1, 1)
    server.wait_until(lambda: "theirs" in server.history)
    assert sorted(path.name for path in (tmp_path / "out").iterdir()) == [
        ".lightprobe",
        "quick.exr",
        "quick.preview.png",
    ]
    _, report = queue([photos[0], photos[3]], [server])
    assert statuses(report) == ["skipped", "done"]
