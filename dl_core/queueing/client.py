"""One ComfyUI server: what this package asks of its HTTP API and of its websocket.

Faults of transport, and the answers a proxy gives for a server that is starting, are `ServerAway`: worth another try.
What a server says no to is `Refused`.
"""

from __future__ import annotations

import time
import uuid
from collections.abc import Callable, Iterable, Iterator, Mapping
from contextlib import ExitStack, contextmanager
from dataclasses import dataclass
from http import HTTPStatus
from pathlib import Path
from typing import Any, Final
from urllib.parse import urlsplit

import requests
from websockets.exceptions import WebSocketException
from websockets.sync.client import ClientConnection, connect

from ..errors import OptionError, ServerError
from ..json_text import parse_json
from .workflow import Prompt

__all__ = ["ComfyClient", "Events", "Fault", "QueueState", "Refused", "RemoteFile", "ServerAway", "run_faults"]

TIMEOUTS: Final = (10.0, 60.0)
"""Seconds to connect and to wait for an answer: a server that computes on its CPU answers late."""
UPLOAD_FOLDER: Final = "lightprobe"
"""Inside the server's input folder."""
AWAY: Final = (HTTPStatus.BAD_GATEWAY, HTTPStatus.SERVICE_UNAVAILABLE, HTTPStatus.GATEWAY_TIMEOUT)
INTERRUPT_PAUSE: Final = 0.3
"""Seconds between looks at whether an interrupt arrived: one sent in the moment a job starts is forgotten."""


@dataclass(frozen=True)
class Fault:
    """What a server says is wrong, in its words.

    Attributes:
        message: the words.
        node: id of the node; None for a fault of no node.
        node_type: class of the node.
    """

    message: str
    node: str | None = None
    node_type: str | None = None

    def __str__(self) -> str:
        return self.message if self.node is None else f"{self.node_type} (node {self.node}): {self.message}"


class ServerAway(ServerError):  # noqa: N818  a state, not a mistake
    """The server cannot be reached, for now."""


class Refused(ServerError):  # noqa: N818  an answer
    """The server says no. `faults` are its reasons, `status` the HTTP status."""

    def __init__(self, server: str, faults: tuple[Fault, ...], status: int) -> None:
        super().__init__(server, "; ".join(map(str, faults)))
        self.faults = faults
        self.status = status


@dataclass(frozen=True)
class QueueState:
    """Ids of the prompts a server has before it."""

    running: frozenset[str]
    pending: frozenset[str]


@dataclass(frozen=True)
class RemoteFile:
    """A file as a server's history names it."""

    filename: str
    subfolder: str
    type: str


class Events:
    """Messages of an open websocket."""

    def __init__(self, server: str, connection: ClientConnection) -> None:
        self._server, self._connection = server, connection

    def next(self, timeout: float) -> Mapping[str, Any] | None:
        """The next message with a `type` and `data`, pictures left out; None if none came within `timeout` seconds.

        Raises:
            ServerAway: the connection is closed.
        """
        deadline = time.monotonic() + timeout
        while True:
            try:
                text = self._connection.recv(timeout=max(0.0, deadline - time.monotonic()))
            except TimeoutError:
                return None
            except (WebSocketException, OSError) as error:
                raise ServerAway(self._server, f"the websocket is closed ({error})") from error
            if isinstance(text, str) and (message := _message(text)) is not None:  # bytes are previews
                return message


def _message(text: str) -> Mapping[str, Any] | None:
    """A message of a type and its data; None for anything else that a server, or something before it, may send."""
    try:
        message = parse_json(text)
    except ValueError:
        return None
    is_one = (
        isinstance(message, dict) and isinstance(message.get("type"), str) and isinstance(message.get("data"), dict)
    )
    return message if is_one else None


class ComfyClient:
    """A client of one server. A thread uses a client of its own."""

    def __init__(self, url: str) -> None:
        """Talk to the server at `url`, such as http://127.0.0.1:8188; nothing is sent yet.

        Raises:
            OptionError: not an address of HTTP.
        """
        address = url if "://" in url else f"http://{url}"
        parts = urlsplit(address)
        if parts.scheme not in ("http", "https") or not parts.hostname:
            raise OptionError("server", url, "an address such as http://127.0.0.1:8188")
        self.url: Final = address.rstrip("/")
        self.client_id: Final = uuid.uuid4().hex
        self._session = requests.Session()

    def close(self) -> None:
        """Close kept connections."""
        self._session.close()

    @contextmanager
    def events(self) -> Iterator[Events]:
        """The server's messages to this client.

        Raises:
            ServerAway: no connection.
        """
        address = "ws" + self.url.removeprefix("http") + f"/ws?clientId={self.client_id}"
        with ExitStack() as stack:
            try:
                # Previews can be larger than the library's limit for a message.
                connection = stack.enter_context(
                    connect(address, open_timeout=TIMEOUTS[0], close_timeout=1, max_size=None)
                )
            except (WebSocketException, OSError, EOFError) as error:
                raise ServerAway(self.url, f"no websocket ({error})") from error
            yield Events(self.url, connection)

    def upload(self, name: str, content: bytes) -> str:
        """Store a file in the server's input folder, in place of one of the same name; its name for Load Image.

        Raises:
            ServerError: away, or refused.
        """
        answer = self._json(
            "POST",
            "/upload/image",
            files={"image": (name, content)},
            data={"subfolder": UPLOAD_FOLDER, "overwrite": "true"},
        )
        return "/".join(part for part in (answer.get("subfolder"), answer["name"]) if part)

    def submit(self, prompt: Prompt, prompt_id: str) -> str:
        """Queue a prompt under an id of the caller's; the id it has, another one on servers that give their own.

        A server runs a prompt of which only some outputs are valid; here such a prompt is refused as a whole.

        Raises:
            ServerError: away, or refused.
        """
        body = {"prompt": prompt, "prompt_id": prompt_id, "client_id": self.client_id}
        answer = self._json("POST", "/prompt", json=body)
        given = str(answer.get("prompt_id", prompt_id))
        faults = tuple(_node_faults(answer.get("node_errors")))
        if faults:
            self.cancel([given])
            raise Refused(self.url, faults, HTTPStatus.BAD_REQUEST)
        return given

    def queue(self) -> QueueState:
        """What the server has before it.

        Raises:
            ServerError: away, or no ComfyUI server.
        """
        answer = self._json("GET", "/queue")
        try:
            running, pending = ({str(item[1]) for item in answer[f"queue_{state}"]} for state in ("running", "pending"))
        except (KeyError, TypeError, IndexError) as error:
            raise ServerError(self.url, "/queue answers as no ComfyUI server does") from error
        return QueueState(frozenset(running), frozenset(pending))

    def history(self, prompt_id: str) -> Mapping[str, Any] | None:
        """The entry of a prompt that ended; None if the server knows none.

        Raises:
            ServerError: away, or refused.
        """
        entry: Mapping[str, Any] | None = self._json("GET", f"/history/{prompt_id}").get(prompt_id)
        return entry

    def fetch(self, file: RemoteFile, target: Path) -> None:
        """Write a file of the server to `target`.

        Raises:
            ServerError: away, or refused: status 404 if the file is not there.
            OSError: `target` cannot be written.
        """
        query = {"filename": file.filename, "subfolder": file.subfolder, "type": file.type}
        with self._request("GET", "/view", params=query, stream=True) as answer, target.open("wb") as out:
            chunks = answer.iter_content(1 << 20)
            while chunk := self._transport(lambda: next(chunks, b"")):
                out.write(chunk)

    def cancel(self, prompt_ids: Iterable[str], patience: float = 10.0) -> None:
        """Take prompts out of the queue and stop the one that runs, for up to `patience` seconds. Others go on.

        Raises:
            ServerError: away, or refused.
        """
        wanted = set(prompt_ids)
        self._request("POST", "/queue", json={"delete": sorted(wanted)}).close()
        deadline = time.monotonic() + patience
        while running := self.queue().running & wanted:
            for prompt_id in running:
                # Servers that know no prompt_id here stop whatever runs: it was ours a moment ago.
                self._request("POST", "/interrupt", json={"prompt_id": prompt_id}).close()
            if time.monotonic() > deadline:
                return
            time.sleep(INTERRUPT_PAUSE)

    def _json(self, method: str, route: str, **options: Any) -> dict[str, Any]:
        with self._request(method, route, **options) as answer:
            try:
                content = answer.json()
            except ValueError:
                content = None
        if not isinstance(content, dict):
            raise ServerError(self.url, f"{route} answers with something other than a JSON object: no ComfyUI server?")
        return content

    def _request(self, method: str, route: str, **options: Any) -> requests.Response:
        answer = self._transport(
            lambda: self._session.request(method, f"{self.url}{route}", timeout=TIMEOUTS, **options)
        )
        if answer.ok:
            return answer
        with answer:
            if answer.status_code in AWAY:
                raise ServerAway(self.url, f"{route}: {answer.status_code} {answer.reason}")
            faults = tuple(_answer_faults(answer)) or (Fault(f"{route}: {answer.status_code} {answer.reason}"),)
            raise Refused(self.url, faults, answer.status_code)

    def _transport(self, call: Callable[[], Any]) -> Any:
        try:
            return call()
        except requests.RequestException as error:
            raise ServerAway(self.url, f"cannot be reached ({error})") from error


def _answer_faults(answer: requests.Response) -> Iterator[Fault]:
    """Reasons in the body of a refusal: those of nodes, or else the refusal's own."""
    try:
        body = answer.json()
    except ValueError:
        return
    if not isinstance(body, dict):
        return
    faults = list(_node_faults(body.get("node_errors")))
    error = body.get("error")
    if not faults and isinstance(error, dict):
        faults = [Fault(_joined(error.get("message"), error.get("details")))]
    elif not faults and isinstance(error, str):
        faults = [Fault(error)]
    yield from faults


def _node_faults(node_errors: Any) -> Iterator[Fault]:
    """Reasons by node, as validation gives them."""
    for number, node in (node_errors or {}).items():
        for error in node.get("errors", []):
            yield Fault(_joined(error.get("message"), error.get("details")), str(number), node.get("class_type"))


def _joined(*parts: Any) -> str:
    return ": ".join(dict.fromkeys(str(part).strip() for part in parts if part))


def run_faults(entry: Mapping[str, Any]) -> tuple[Fault, ...]:
    """Why a prompt of the history failed; empty if it did not."""
    status = entry.get("status") or {}
    if status.get("status_str") == "success":
        return ()
    faults = []
    for kind, body in status.get("messages", []):
        node = (str(body.get("node_id")), body.get("node_type"))
        if kind == "execution_error":
            faults.append(Fault(str(body.get("exception_message", "")).strip() or body["exception_type"], *node))
        if kind == "execution_interrupted":
            faults.append(Fault("interrupted on the server", *node))
    return tuple(faults) or (Fault("failed, and the server says no reason"),)
