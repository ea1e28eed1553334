from __future__ import annotations

import argparse
import ast
import importlib.metadata
import re
import shlex
from pathlib import Path

import pytest

import dl_core
from dl_core.commands.estimate import add_arguments
from dl_core.presets import PRESETS

ROOT = Path(dl_core.__file__).parent
SOURCES = sorted(path for path in ROOT.rglob("*.py"))
IDS = [str(path.relative_to(ROOT)) for path in SOURCES]


def parse(path: Path) -> ast.Module:
    return ast.parse(path.read_text(encoding="utf-8"))


def defined_names(tree: ast.Module) -> tuple[set[str], set[str]]:
    """What a module's own statements bind, without imports: functions and classes; constants."""
    code: set[str] = set()
    constants: set[str] = set()
    for node in tree.body:
        if isinstance(node, ast.FunctionDef | ast.ClassDef):
            code.add(node.name)
        elif isinstance(node, ast.AnnAssign) and isinstance(node.target, ast.Name):
            constants.add(node.target.id)
        elif isinstance(node, ast.Assign):
            constants |= {target.id for target in node.targets if isinstance(target, ast.Name)}
    return {name for name in code if not name.startswith("_")}, constants


def exported_names(tree: ast.Module) -> list[str]:
    for node in tree.body:
        if isinstance(node, ast.Assign) and isinstance(node.targets[0], ast.Name) and node.targets[0].id == "__all__":
            return ast.literal_eval(node.value)
    return []


def order(name: str) -> tuple[int, str]:
    """Constants, then classes, then the rest: the order the linter keeps."""
    return (0 if name.isupper() else 1 if name[:1].isupper() else 2, name)


@pytest.mark.parametrize("path", SOURCES, ids=IDS)
def test_what_is_public_is_exported(path: Path) -> None:
    tree = parse(path)
    exported = exported_names(tree)
    assert exported == sorted(exported, key=order)
    code, constants = defined_names(tree)
    # Every public function and class is exported; a module may keep its constants to itself.
    assert set(exported) - constants == code


@pytest.mark.parametrize("path", SOURCES, ids=IDS)
def test_the_library_never_imports_its_host(path: Path) -> None:
    imported: list[str] = []
    for node in ast.walk(parse(path)):
        if isinstance(node, ast.Import):
            imported += [alias.name for alias in node.names]
        elif isinstance(node, ast.ImportFrom):
            imported.append("." * node.level + (node.module or ""))
    assert not [
        name for name in imported if name.lstrip(".").split(".")[0] in ("comfy", "comfy_api", "nodes", "server")
    ]
    # Loaded as part of a node pack the package has another name: it refers to itself relatively.
    assert not [name for name in imported if name.split(".")[0] == "dl_core"]


@pytest.mark.parametrize("path", SOURCES, ids=IDS)
def test_diffusers_stays_behind_the_port(path: Path) -> None:
    """Only backends and training know diffusers; commands load them when asked to."""
    if path.relative_to(ROOT).parts[0] in ("backends", "training"):
        return
    top_level = [node for node in parse(path).body if isinstance(node, ast.Import | ast.ImportFrom)]
    assert not [node for node in top_level if "diffusers" in ast.unparse(node)]


def test_version_is_stated_once() -> None:
    pyproject = ROOT.parent / "pyproject.toml"
    if pyproject.exists():
        assert f'version = "{dl_core.__version__}"' in pyproject.read_text(encoding="utf-8")
    try:
        installed = importlib.metadata.version("comfyui-lightprobe")
    except importlib.metadata.PackageNotFoundError:
        pytest.skip("comfyui-lightprobe is not installed here")
    assert installed == dl_core.__version__


def readme_commands() -> dict[str, str]:
    """Commands of the README that are marked, by mark: the line below the opening fence."""
    text = (ROOT.parent / "README.md").read_text(encoding="utf-8")
    return dict(re.findall(r"<!-- command: (\w+) -->\n```sh\n(.+)\n```", text))


@pytest.mark.skipif(not (ROOT.parent / "README.md").exists(), reason="an installed package has no README")
def test_readme_commands_are_ones_that_work() -> None:
    """The first is understood by the command line and names files that are there; CI runs the second."""
    commands = readme_commands()
    assert list(commands) == ["estimate", "test"]
    words = shlex.split(commands["estimate"].split("&&")[-1])
    assert words[0] == ".venv/bin/lightprobe"
    parser = argparse.ArgumentParser()
    add_arguments(parser)
    args = parser.parse_args(words[2:])
    assert (ROOT.parent / args.photo).is_file()
    assert args.preset in PRESETS
    assert "-c constraints.txt" in commands["estimate"]
    assert "-c constraints.txt" in commands["test"]
