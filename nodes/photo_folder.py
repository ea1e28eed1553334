"""LoadPhotoFolder: the photographs of a folder as lists."""

from __future__ import annotations

import math
from pathlib import Path

import comfy.utils
import folder_paths
from comfy_api.latest import io

from ..dl_core.errors import OptionError, ProbeError
from ..dl_core.photo_folder import PhotoFolder, folder_files, folder_fingerprint, read_folder
from .sockets import CATEGORY, named_output

__all__ = ["LoadPhotoFolder"]


class LoadPhotoFolder(io.ComfyNode):  # type: ignore[misc]
    """Reads a folder of photographs."""

    @classmethod
    def define_schema(cls) -> io.Schema:
        """Sockets of the node."""
        return io.Schema(
            node_id="LoadPhotoFolder",
            display_name="Load Photo Folder",
            category=CATEGORY,
            description="Reads the photographs of a folder, in the order of their names, as a list: the nodes that "
            "follow run once for each. Files that are no photographs are left out and named in the report.",
            inputs=[
                io.String.Input(
                    "folder",
                    default="photographs",
                    tooltip="A folder inside ComfyUI's input folder, or an absolute path. Its subfolders are left out.",
                ),
                io.Int.Input(
                    "kept_side",
                    default=1024,
                    min=64,
                    max=8192,
                    tooltip="Pictures at least twice as large are averaged over blocks of pixels, and keep this many "
                    "on their longer side: 1024 is SDXL's canvas. All photographs are in memory at once.",
                ),
            ],
            outputs=[
                named_output(io.Image, "images", "The photographs, upright, each at its own size.", is_list=True),
                named_output(io.String, "names", "Their file names without suffix.", is_list=True),
                named_output(io.String, "report", "How many were read, and what was left out and why."),
            ],
        )

    @classmethod
    def execute(cls, folder: str, kept_side: int) -> io.NodeOutput:
        """Read, and say what was left out."""
        path = _path(folder)
        bar = comfy.utils.ProgressBar(len(folder_files(path)))
        found = read_folder(path, kept_side=kept_side, on_file=lambda: bar.update(1))
        return io.NodeOutput(list(found.images), list(found.names), _report(path, found))

    @classmethod
    def fingerprint_inputs(cls, folder: str | None, kept_side: int | None) -> str | float:
        """Names, sizes and times of the files: a folder that changed is read again.

        One that another node names is not known yet, and read every time: nan is never what it was before.
        """
        return math.nan if folder is None else folder_fingerprint(_path(folder))

    @classmethod
    def validate_inputs(cls, folder: str | None) -> bool | str:
        """Say what is wrong with the folder before the graph runs; one that another node names is seen later."""
        try:
            if folder is not None:
                folder_files(_path(folder))
        except ProbeError as error:
            return f"LoadPhotoFolder, {error}"
        return True


def _path(folder: str) -> Path:
    """The folder that a user names.

    Raises:
        OptionError: no name, or a relative one that leaves ComfyUI's input folder.
    """
    inputs = Path(folder_paths.get_input_directory()).resolve()
    name = folder.strip()
    try:
        path = (inputs / name).resolve()
    except (OSError, ValueError) as error:  # no file system takes such a name
        raise OptionError("folder", folder, "the name of a folder") from error
    if not name or not (Path(name).is_absolute() or path.is_relative_to(inputs)):
        raise OptionError("folder", folder, f"a folder inside ComfyUI's input folder {inputs}, or an absolute path")
    return path


def _report(path: Path, found: PhotoFolder) -> str:
    count = len(found.images)
    lines = [f"{count} photograph{'' if count == 1 else 's'} in {path}."]
    return "\n".join(lines + [f"Left out: {name} {reason}." for name, reason in found.skipped])
