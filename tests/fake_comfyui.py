"""A small stand-in for a ComfyUI server: its queue, history, files and websocket, and ways to make it fail.

Nothing is computed. A prompt's photograph decides what becomes of it: the first line of the file is an order.
"""

from __future__ import annotations

import base64
import hashlib
import json
import threading
import time
from contextlib import suppress
from dataclasses import dataclass, field
from email.message import Message
from email.parser import BytesParser
from http.server import BaseHTTPRequestHandler, ThreadingHTTPServer
from typing import Any
from urllib.parse import parse_qs, urlsplit

MAGIC = "258EAFA5-E914-47DA-95CA-C5AB0DC85B11"
"""Of the websocket's handshake (RFC 6455, 1.3)."""


def order(content: bytes) -> tuple[str, str]:
    """What a photograph asks for.

    `ok`; `slow SECONDS`; `break` in a node; `refuse` when queued; `partly` valid; `nothing` saved; `crash` the server.
    """
    word, _, argument = content.decode().splitlines()[0].partition(" ")
    return word, argument


@dataclass
class Log:
    """What the server saw, over its restarts."""

    uploads: list[str] = field(default_factory=list)
    started: list[str] = field(default_factory=list)
    prompts: list[dict[str, Any]] = field(default_factory=list)
    interrupts: list[str] = field(default_factory=list)
    deleted: list[str] = field(default_factory=list)


class FakeComfyUI:
    """One server on one port; `stop` and `start` make a restart, which forgets queue and history."""

    def __init__(self, port: int = 0) -> None:
        self.log = Log()
        self.port = port
        self.crashes_left = 10**6
        self.gone_files: set[str] = set()
        """Files that /view does not find, once each."""
        self.start()

    @property
    def url(self) -> str:
        return f"http://127.0.0.1:{self.port}"

    def start(self) -> None:
        """Serve, with an empty queue and history. Uploaded files are still there."""
        self.pending: list[tuple[str, dict[str, Any]]] = []
        self.running: tuple[str, dict[str, Any]] | None = None
        self.history: dict[str, Any] = {}
        self.inputs: dict[str, bytes] = getattr(self, "inputs", {})
        self.sockets: list[Any] = []
        self.connections: list[Any] = []
        self.interrupted = False
        self.lock = threading.RLock()
        self.alive = True
        fake = self

        class Handler(_Handler):
            server_state = fake

        self._http = ThreadingHTTPServer(("127.0.0.1", self.port), Handler)
        self._http.daemon_threads = True
        self.port = self._http.server_address[1]
        threading.Thread(target=self._http.serve_forever, kwargs={"poll_interval": 0.02}, daemon=True).start()
        threading.Thread(target=self._work, args=(self._http,), daemon=True).start()

    def stop(self) -> None:
        """Die: connections end, what was queued is forgotten."""
        self.alive = False
        self._http.shutdown()
        self._http.server_close()
        for connection in [*self.connections]:
            with suppress(OSError):
                connection.shutdown(2)

    def forget(self) -> None:
        """Lose queue and history while staying up."""
        with self.lock:
            self.pending.clear()
            self.running = None
            self.history.clear()

    def wait_until(self, condition: Any, timeout: float = 20) -> None:
        deadline = time.monotonic() + timeout
        while not condition():
            assert time.monotonic() < deadline, "the fake server was not asked for what was expected"
            time.sleep(0.01)

    # --- what runs ---

    def _work(self, generation: Any) -> None:
        while self.alive and self._http is generation:
            with self.lock:
                if self.running is None and self.pending:
                    self.running, self.interrupted = self.pending.pop(0), False
                item = self.running
            if item is None:
                time.sleep(0.01)
                continue
            self._execute(item)

    def _execute(self, item: tuple[str, dict[str, Any]]) -> None:
        prompt_id, prompt = item
        photo = next(node["inputs"]["image"] for node in prompt.values() if node["class_type"] == "LoadImage")
        word, argument = order(self.inputs[photo])
        self.log.started.append(photo)
        self.log.prompts.append(prompt)
        began = time.time()
        self._say("execution_start", prompt_id=prompt_id)
        self._say("progress", prompt_id=prompt_id, node="8", value=1, max=2)
        if word == "crash" and self.crashes_left > 0:
            self.crashes_left -= 1
            time.sleep(0.3)  # what it said before is heard
            self.stop()
            self.start()
            return
        end = time.monotonic() + float(argument or 0) if word == "slow" else 0
        while time.monotonic() < end and self.alive and not self.interrupted and self.running is item:
            time.sleep(0.01)
        with self.lock:
            if self.running is not item or not self.alive:
                return
            self.history[prompt_id] = self._entry(word, photo, began)
            self.running = None
        self._say("executing", prompt_id=prompt_id, node=None)

    def _entry(self, word: str, photo: str, began: float) -> dict[str, Any]:
        messages = [["execution_start", {"timestamp": int(began * 1000)}]]
        status, outputs = "error", {}
        stamp = {"timestamp": int(began * 1000) + 1500}
        if self.interrupted:
            messages.append(["execution_interrupted", {"node_id": "8", "node_type": "IterativeMedian", **stamp}])
        elif word == "break":
            text = {"exception_message": "steps is 0; accepted: 1 to 998\n", "exception_type": "OptionError"}
            messages.append(["execution_error", {"node_id": "8", "node_type": "IterativeMedian", **text, **stamp}])
        else:
            status = "success"
            messages.append(["execution_success", stamp])
            name = photo.rpartition("/")[2]
            maps = [{"filename": f"{name}_00001_.exr", "subfolder": "lightprobe", "type": "output"}]
            images = [{"filename": f"{name}_00001_preview.png", "subfolder": "", "type": "temp"}]
            outputs = {"12": {"envmaps": maps, "images": images}, "9": {"images": images * 3}}
            if word == "nothing":
                outputs = {"9": {"images": images}}
        return {"outputs": outputs, "status": {"status_str": status, "messages": messages}}

    def _say(self, kind: str, **data: Any) -> None:
        text = json.dumps({"type": kind, "data": data}).encode()
        head = b"\x81" + (bytes([len(text)]) if len(text) < 126 else b"\x7e" + len(text).to_bytes(2, "big"))
        for socket in [*self.sockets]:
            try:
                socket.sendall(head + text)
            except OSError:
                self.sockets.remove(socket)

    # --- what is asked ---

    def upload(self, subfolder: str, name: str, content: bytes) -> dict[str, str]:
        full = f"{subfolder}/{name}" if subfolder else name
        self.log.uploads.append(full)
        self.inputs[full] = content
        return {"name": name, "subfolder": subfolder, "type": "input"}

    def prompt(self, body: dict[str, Any]) -> tuple[int, dict[str, Any]]:
        prompt, prompt_id = body["prompt"], body["prompt_id"]
        photo = next(node["inputs"]["image"] for node in prompt.values() if node["class_type"] == "LoadImage")
        word, _ = order(self.inputs[photo])
        reason = {"message": "Value not in list", "details": "lora: 'absent.safetensors' not in ['none']"}
        errors = {"6": {"class_type": "EVPromptInterp", "errors": [reason]}} if word in ("refuse", "partly") else {}
        if word == "refuse":
            error = {"message": "Prompt outputs failed validation", "details": ""}
            return 400, {"error": error, "node_errors": errors}
        with self.lock:
            self.pending.append((prompt_id, prompt))
        return 200, {"prompt_id": prompt_id, "node_errors": errors}

    def queue(self) -> dict[str, Any]:
        with self.lock:
            running = [self.running] if self.running else []
            return {
                "queue_running": [[0, *item, {}, []] for item in running],
                "queue_pending": [[0, *item, {}, []] for item in self.pending],
            }

    def delete(self, prompt_ids: list[str]) -> None:
        with self.lock:
            self.log.deleted += [item[0] for item in self.pending if item[0] in prompt_ids]
            self.pending = [item for item in self.pending if item[0] not in prompt_ids]

    def interrupt(self, prompt_id: str) -> None:
        with self.lock:
            if self.running and self.running[0] == prompt_id:
                self.log.interrupts.append(prompt_id)
                self.interrupted = True

    def view(self, name: str) -> bytes | None:
        if name in self.gone_files:
            self.gone_files.remove(name)
            return None
        return f"content of {name}".encode()


class _Handler(BaseHTTPRequestHandler):
    server_state: FakeComfyUI
    protocol_version = "HTTP/1.1"

    def setup(self) -> None:
        super().setup()
        self.server_state.connections.append(self.connection)

    def log_message(self, *arguments: Any) -> None:
        pass

    def do_GET(self) -> None:
        fake, parts = self.server_state, urlsplit(self.path)
        if parts.path == "/ws":
            self._open_socket()
        elif parts.path == "/queue":
            self._answer(200, fake.queue())
        elif parts.path.startswith("/history/"):
            prompt_id = parts.path.rpartition("/")[2]
            self._answer(200, {prompt_id: fake.history[prompt_id]} if prompt_id in fake.history else {})
        elif parts.path == "/view":
            content = fake.view(parse_qs(parts.query)["filename"][0])
            self._send(404 if content is None else 200, content or b"", "application/octet-stream")
        else:
            self._send(404, b"", "text/plain")

    def do_POST(self) -> None:
        fake, body = self.server_state, self.rfile.read(int(self.headers["Content-Length"]))
        if self.path == "/upload/image":
            fields = _form(self.headers, body)
            (name, content) = fields["image"]
            self._answer(200, fake.upload(fields.get("subfolder", ("", b""))[1].decode(), name, content))
        elif self.path == "/prompt":
            self._answer(*fake.prompt(json.loads(body)))
        elif self.path == "/queue":
            fake.delete(json.loads(body)["delete"])
            self._send(200, b"", "text/plain")
        elif self.path == "/interrupt":
            fake.interrupt(json.loads(body)["prompt_id"])
            self._send(200, b"", "text/plain")
        else:
            self._send(404, b"", "text/plain")

    def _open_socket(self) -> None:
        accept = hashlib.sha1((self.headers["Sec-WebSocket-Key"] + MAGIC).encode()).digest()
        self.send_response(101)
        for name, value in (("Upgrade", "websocket"), ("Connection", "Upgrade")):
            self.send_header(name, value)
        self.send_header("Sec-WebSocket-Accept", base64.b64encode(accept).decode())
        self.end_headers()
        self.wfile.flush()
        self.server_state.sockets.append(self.connection)
        with suppress(OSError):
            while self.connection.recv(4096):
                pass
        self.close_connection = True

    def _answer(self, status: int, body: dict[str, Any]) -> None:
        self._send(status, json.dumps(body).encode(), "application/json")

    def _send(self, status: int, content: bytes, kind: str) -> None:
        self.send_response(status)
        self.send_header("Content-Type", kind)
        self.send_header("Content-Length", str(len(content)))
        self.end_headers()
        self.wfile.write(content)


def _form(headers: Message, body: bytes) -> dict[str, tuple[str, bytes]]:
    """Fields of a multipart form: file name and content by field name."""
    head = f"Content-Type: {headers['Content-Type']}\r\n\r\n".encode()
    parts = BytesParser().parsebytes(head + body).get_payload()
    return {
        part.get_param("name", header="content-disposition"): (part.get_filename() or "", part.get_payload(decode=True))
        for part in parts
    }
