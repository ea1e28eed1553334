"""Every fault this library reports, as one tree.

ProbeError
├── OptionError      an option or argument has a value that is not accepted
├── ImageError       an image or map cannot be read, or holds what it must not (NaN, negative radiance)
├── ModelError       a model file is missing, or is not of the architecture asked for
├── OutputError      a result cannot be written where it was asked for
├── ServerError      a ComfyUI server is away, or refuses what it is asked for
└── Interrupted      the user stopped the run; what was finished is still usable
"""

from __future__ import annotations

from typing import Any

__all__ = ["ImageError", "Interrupted", "ModelError", "OptionError", "OutputError", "ProbeError", "ServerError"]


class ProbeError(Exception):
    """Root of the tree: catching it catches every fault the library raises on purpose."""

    def __reduce__(self) -> tuple[Any, ...]:
        """Pickle with attributes and message as they are, since a subclass makes the message from its arguments."""
        return _again, (type(self), self.args, self.__dict__)


def _again(kind: type[ProbeError], args: tuple[Any, ...], attributes: dict[str, Any]) -> ProbeError:
    error = kind.__new__(kind, *args)
    error.__dict__.update(attributes)
    return error


class OptionError(ProbeError, ValueError):
    """An option outside what is accepted.

    `name`, `value` and `accepted` are kept as attributes, so that a caller need not parse the message.
    """

    def __init__(self, name: str, value: object, accepted: str) -> None:
        super().__init__(f"{name} is {value!r}; accepted: {accepted}")
        self.name = name
        self.value = value
        self.accepted = accepted


class ImageError(ProbeError, ValueError):
    """An image that cannot be read or used. `source` names the file or argument."""

    def __init__(self, source: object, reason: str) -> None:
        super().__init__(f"{source}: {reason}")
        self.source = source
        self.reason = reason


class ModelError(ProbeError):
    """A model that is missing or of the wrong kind. `model` names the file, folder or socket."""

    def __init__(self, model: object, reason: str) -> None:
        super().__init__(f"{model}: {reason}")
        self.model = model
        self.reason = reason


class OutputError(ProbeError, OSError):
    """A result that cannot be written. `path` is where it was to go."""

    def __init__(self, path: object, reason: str) -> None:
        super().__init__(f"{path}: {reason}")
        self.path = path
        self.reason = reason


class ServerError(ProbeError):
    """A ComfyUI server that is away or refuses something. `server` is its address."""

    def __init__(self, server: str, reason: str) -> None:
        super().__init__(f"{server}: {reason}")
        self.server = server
        self.reason = reason


class Interrupted(ProbeError):  # noqa: N818  an event, not a mistake
    """The user stopped the run."""
