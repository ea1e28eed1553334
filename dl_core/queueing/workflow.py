"""A workflow in API form: where the photograph goes in, which seeds it has, which nodes save maps."""

from __future__ import annotations

import copy
import hashlib
import json
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any, Final

from ..errors import OptionError
from ..json_text import read_json

__all__ = ["Prompt", "Workflow", "read_workflow"]

Prompt = dict[str, dict[str, Any]]
"""What ComfyUI's /prompt takes: nodes by id, each with `class_type` and `inputs`."""

LOADER: Final = "LoadImage"
SAVER: Final = "SaveEnvMap"
SEED_INPUTS: Final = ("seed", "noise_seed")


@dataclass(frozen=True)
class Workflow:
    """A workflow that one photograph goes through.

    Attributes:
        prompt: its nodes by id; not changed by anything here.
        photo_node: id of the node whose input `image` takes the photograph.
    """

    prompt: Prompt
    photo_node: str

    @property
    def savers(self) -> frozenset[str]:
        """Ids of the nodes whose files are the result."""
        return frozenset(number for number, node in self.prompt.items() if node["class_type"] == SAVER)

    @property
    def identity(self) -> str:
        """A digest of all that decides the result, the photograph aside: nodes, links and values, not titles."""
        nodes = {
            number: {"class_type": node["class_type"], "inputs": node["inputs"]}
            for number, node in self.with_photo("").items()
        }
        return hashlib.sha256(json.dumps(nodes, sort_keys=True).encode()).hexdigest()

    def with_photo(self, name: str) -> Prompt:
        """The prompt to queue for a photograph that the server knows by this name."""
        prompt = copy.deepcopy(self.prompt)
        prompt[self.photo_node]["inputs"]["image"] = name
        return prompt

    def with_seed(self, seed: int) -> Workflow:
        """The same workflow with every seed that is a plain number set to this one.

        Raises:
            OptionError: a seed outside 0 to 2^53, or a workflow in which no node has one.
        """
        if not 0 <= seed <= 2**53:
            raise OptionError("seed", seed, "0 to 9007199254740992")
        prompt = copy.deepcopy(self.prompt)
        places = [
            (node["inputs"], name)
            for node in prompt.values()
            for name in SEED_INPUTS
            if type(node["inputs"].get(name)) is int  # a list is a link, and keeps what it is linked to
        ]
        if not places:
            raise OptionError("seed", seed, "no seed, since no node of this workflow has one that is a plain number")
        for inputs, name in places:
            inputs[name] = seed
        return replace(self, prompt=prompt)


def read_workflow(path: str | Path, photo_node: str | None = None) -> Workflow:
    """A workflow file in API form.

    Args:
        path: of the JSON file.
        photo_node: id of the node that takes the photograph; None finds the only Load Image node.

    Raises:
        OptionError: no such file, not in API form, without a node that takes a photograph or saves a map, or with
            several Load Image nodes and no choice among them.
    """
    prompt = _read_prompt(Path(path))
    workflow = Workflow(prompt, _photo_node(prompt, photo_node))
    if not workflow.savers:
        raise OptionError("workflow", str(path), f"a workflow with a Save Environment Map node ({SAVER})")
    return workflow


def _read_prompt(path: Path) -> Prompt:
    try:
        content = read_json(path)
    except OSError as error:
        raise OptionError("workflow", str(path), f"a file that can be read ({error.strerror or error})") from error
    except ValueError as error:
        raise OptionError("workflow", str(path), f"a JSON file ({error})") from error
    if isinstance(content, dict) and isinstance(content.get("nodes"), list):
        raise OptionError(
            "workflow",
            str(path),
            "a workflow in API form; this one is in graph form: open it in ComfyUI and choose Export (API)",
        )
    if not isinstance(content, dict) or not content or not all(map(_is_node, content.values())):
        raise OptionError("workflow", str(path), "a workflow in API form: nodes by id, with class_type and inputs")
    return content


def _is_node(node: Any) -> bool:
    return isinstance(node, dict) and isinstance(node.get("class_type"), str) and isinstance(node.get("inputs"), dict)


def _photo_node(prompt: Prompt, chosen: str | None) -> str:
    loaders = [number for number, node in prompt.items() if node["class_type"] == LOADER]
    if chosen is None:
        if len(loaders) == 1:
            return loaders[0]
        found = "none" if not loaders else "nodes " + ", ".join(loaders)
        raise OptionError(
            "photo-node", chosen, f"the id of the node that takes the photograph; {LOADER} nodes here: {found}"
        )
    if not isinstance(prompt.get(chosen, {"inputs": {}})["inputs"].get("image"), str):
        images = [number for number, node in prompt.items() if isinstance(node["inputs"].get("image"), str)]
        raise OptionError("photo-node", chosen, f"a node whose input image is a file: {', '.join(images) or 'none'}")
    return chosen
