"""The real web client opens the workflows, queues one, and shows its result."""

from __future__ import annotations

import json
import os
import time
from collections.abc import Iterator
from pathlib import Path

import pytest
from browser.chromium import CHROMIUM, NO_CHROMIUM, Page, open_page
from comfy_host import NO_COMFYUI, REPOSITORY, WORKFLOWS, Server, installed, serve

pytestmark = [
    pytest.mark.skipif(not installed(), reason=NO_COMFYUI),
    pytest.mark.skipif(CHROMIUM is None, reason=NO_CHROMIUM),
]


DIALOGS = """[...document.querySelectorAll('[role=dialog], .comfy-modal')]
    .filter(element => element.offsetParent !== null).map(element => element.innerText)"""

SHOW_ALL = """(() => {
    const boxes = [...app.graph.nodes, ...app.graph._groups].map(item => item.boundingRect ?? item._bounding);
    const left = Math.min(...boxes.map(b => b[0])), top = Math.min(...boxes.map(b => b[1])) - 40;
    const right = Math.max(...boxes.map(b => b[0] + b[2])), bottom = Math.max(...boxes.map(b => b[1] + b[3]));
    const view = app.canvas.ds;
    view.scale = Math.min((innerWidth - 120) / (right - left), (innerHeight - 180) / (bottom - top));
    view.offset[0] = 80 / view.scale - left;
    view.offset[1] = 20 / view.scale - top;
    app.canvas.setDirty(true, true);
})()"""


@pytest.fixture(scope="module")
def server(tmp_path_factory: pytest.TempPathFactory) -> Iterator[Server]:
    base = tmp_path_factory.mktemp("client") / "base"
    settings = base / "user" / "default" / "comfy.settings.json"
    settings.parent.mkdir(parents=True)
    # Otherwise the template browser opens on the first visit and covers the graph.
    settings.write_text(json.dumps({"Comfy.TutorialCompleted": True}))
    with serve(base) as running:
        yield running


@pytest.fixture(scope="module")
def page(server: Server, tmp_path_factory: pytest.TempPathFactory) -> Iterator[Page]:
    with open_page(tmp_path_factory.mktemp("profile")) as tab:
        tab.call("Page.enable")
        tab.call("Page.navigate", url=server.url)
        tab.wait_for("window.app?.graph && app.extensionManager && window.LiteGraph?.registered_node_types.SaveEnvMap")
        yield tab


def screenshots(tmp_path: Path) -> Path:
    """Where pictures go: the folder SCREENSHOTS names, if it does."""
    folder = Path(os.environ.get("SCREENSHOTS", tmp_path))
    folder.mkdir(parents=True, exist_ok=True)
    return folder


def read(name: str) -> str:
    return (REPOSITORY / "workflows" / name).read_text()


def open_workflow(page: Page, name: str) -> None:
    graph = json.loads(read(f"{name}.json"))
    for kind in {node["type"] for node in graph["nodes"]}:
        page.wait_for(f"LiteGraph.registered_node_types[{json.dumps(kind)}]", timeout=30)
    page.evaluate(f"app.loadGraphData({json.dumps(graph)}, true, true, {json.dumps(name)})")
    time.sleep(1.5)  # a dialog about missing nodes would open after loading
    page.evaluate(SHOW_ALL)


@pytest.mark.parametrize("name", WORKFLOWS)
def test_workflow_opens_without_complaint(page: Page, name: str, tmp_path: Path) -> None:
    open_workflow(page, name)
    time.sleep(1)
    page.screenshot(screenshots(tmp_path) / f"{name}.png")
    assert page.evaluate(DIALOGS) == []
    assert page.evaluate("app.graph.nodes.filter(node => node.has_errors).map(node => node.type)") == []


@pytest.mark.parametrize("name", WORKFLOWS)
def test_client_makes_the_committed_api_form_of_the_graph(page: Page, name: str) -> None:
    open_workflow(page, name)
    assert page.evaluate("app.graphToPrompt().then(result => result.output)") == json.loads(read(f"{name}.api.json"))


def test_quickstart_runs_from_the_canvas(page: Page, server: Server, tmp_path: Path) -> None:
    open_workflow(page, "mini_quickstart")
    before = set(server.get_json("/history"))
    page.evaluate("app.queuePrompt(0).then(() => true)")
    deadline = time.monotonic() + 400
    while not (new := set(server.get_json("/history")) - before):
        assert time.monotonic() < deadline, (server.base / "server.log").read_text()[-3000:]
        time.sleep(1)
    entry = server.get_json("/history")[new.pop()]
    assert entry["status"]["status_str"] == "success", entry["status"]
    saver = "app.graph.nodes.find(node => node.type === 'SaveEnvMap')"
    page.wait_for(f"{saver}.imgs?.length && {saver}.imgs.every(image => image.complete)", timeout=60)
    time.sleep(1)
    page.screenshot(screenshots(tmp_path) / "mini_quickstart_done.png")
    assert page.evaluate(f"[{saver}.imgs[0].naturalWidth, {saver}.imgs[0].naturalHeight]") == [512, 256]
