"""SaveEnvMap and LoadEnvMap: environment maps as files of ComfyUI's folders."""

from __future__ import annotations

import json
from pathlib import Path
from typing import Any, Final

import folder_paths
import torch
from comfy.cli_args import args
from comfy_api.latest import io, ui

from ..dl_core.errors import OptionError, OutputError
from ..dl_core.imageio import read_envmap, tone_map_preview, write_exr, write_hdr, write_png
from .sockets import CATEGORY, as_rgb, named_output

__all__ = ["LoadEnvMap", "SaveEnvMap"]

SUFFIXES: Final = (".exr", ".hdr")
PRECISIONS: Final = ("half", "float")


class SaveEnvMap(io.ComfyNode):  # type: ignore[misc]
    """Writes environment maps into ComfyUI's output folder."""

    @classmethod
    def define_schema(cls) -> io.Schema:
        """Sockets of the node."""
        return io.Schema(
            node_id="SaveEnvMap",
            display_name="Save Environment Map",
            category=CATEGORY,
            description="Writes maps as EXR light probes (Rec.709 chromaticities, latlong attribute, the workflow "
            "inside) and shows them tone-mapped. Nothing is ever overwritten.",
            is_output_node=True,
            inputs=[
                io.Image.Input("latlong", tooltip="Maps in linear radiance, twice as wide as high."),
                io.String.Input(
                    "filename_prefix",
                    default="lightprobe/probe",
                    tooltip="Start of the file names, inside ComfyUI's output folder; a counter follows.",
                ),
                io.Combo.Input(
                    "precision", options=list(PRECISIONS), tooltip="half (16 bits a channel) serves nearly always."
                ),
                io.Boolean.Input("radiance_hdr", default=False, tooltip="Write a Radiance .hdr file beside the EXR."),
                io.String.Input(
                    "report", optional=True, force_input=True, tooltip="What was run, to be kept in the file."
                ),
                io.Mask.Input(
                    "confidence",
                    optional=True,
                    tooltip="Of Confidence Map or Estimate Light: kept in the EXR as the layer confidence.Y.",
                ),
            ],
            outputs=[named_output(io.String, "path", "Where the EXR files are, one a line.")],
        )

    @classmethod
    def execute(
        cls,
        latlong: torch.Tensor,
        filename_prefix: str,
        precision: str,
        radiance_hdr: bool,
        report: str = "",
        confidence: torch.Tensor | None = None,
    ) -> io.NodeOutput:
        """Write every map of the batch and its preview."""
        maps = as_rgb(latlong, "latlong")
        metadata = _metadata(cls.hidden, report)
        if confidence is not None and len(confidence) != len(maps):
            raise OptionError("confidence", f"{len(confidence)} masks", f"one for each map, that is {len(maps)}")
        layers = [None] * len(maps) if confidence is None else list(confidence)
        files, previews = [], []
        for item, layer in zip(maps, layers, strict=True):
            path, subfolder = _new_path(filename_prefix, item)
            write_exr(path, item, metadata=metadata, half=precision == "half", confidence=layer)
            files.append(ui.SavedResult(path.name, subfolder, io.FolderType.output))
            if radiance_hdr:
                write_hdr(path.with_suffix(".hdr"), item)
                files.append(ui.SavedResult(path.with_suffix(".hdr").name, subfolder, io.FolderType.output))
            previews.append(_preview(item, path.stem))
        folder = Path(folder_paths.get_output_directory())
        paths = [str(folder / file.subfolder / file.filename) for file in files if file.filename.endswith(".exr")]
        return io.NodeOutput("\n".join(paths), ui={"images": previews, "envmaps": files})


def _metadata(hidden: Any, report: str) -> dict[str, str]:
    """String attributes of the EXR: the report, and, unless ComfyUI is told not to, prompt and workflow as JSON."""
    metadata = {"lightprobe": report} if report else {}
    if hidden is None or args.disable_metadata:
        return metadata
    if hidden.prompt is not None:
        metadata["prompt"] = json.dumps(hidden.prompt)
    return metadata | {name: json.dumps(value) for name, value in (hidden.extra_pnginfo or {}).items()}


def _new_path(prefix: str, latlong: torch.Tensor) -> tuple[Path, str]:
    """A new EXR name for a (H, W, 3) map, and its folder relative to the output folder. Folders are made as needed.

    Raises:
        OutputError: the prefix leaves the output folder, or its folder cannot be made.
    """
    output = Path(folder_paths.get_output_directory()).resolve()
    if not (output / prefix).resolve().is_relative_to(output) or not prefix.strip():
        raise OutputError(prefix, f"filename_prefix has to name a file inside the output folder {output}")
    height, width = latlong.shape[:2]
    try:
        folder, name, counter, subfolder, _ = folder_paths.get_save_image_path(prefix, str(output), width, height)
    except OSError as error:
        raise OutputError(output / prefix, f"its folder cannot be made ({error.strerror or error})") from error
    while any((Path(folder) / f"{name}_{counter:05}_{suffix}").exists() for suffix in SUFFIXES):
        counter += 1
    return Path(folder) / f"{name}_{counter:05}_.exr", subfolder


def _preview(latlong: torch.Tensor, stem: str) -> ui.SavedResult:
    """Write a tone-mapped picture of a map into ComfyUI's temporary folder."""
    folder = Path(folder_paths.get_temp_directory())
    folder.mkdir(parents=True, exist_ok=True)
    path = folder / f"{stem}preview.png"
    while path.exists():
        path = path.with_stem(path.stem + "_")
    write_png(path, tone_map_preview(latlong))
    return ui.SavedResult(path.name, "", io.FolderType.temp)


class LoadEnvMap(io.ComfyNode):  # type: ignore[misc]
    """Reads an environment map from ComfyUI's input folder."""

    @classmethod
    def define_schema(cls) -> io.Schema:
        """Sockets of the node."""
        folder = Path(folder_paths.get_input_directory())
        names = sorted(path.name for path in folder.glob("*") if path.suffix.lower() in SUFFIXES)
        return io.Schema(
            node_id="LoadEnvMap",
            display_name="Load Environment Map",
            category=CATEGORY,
            description="Reads an equirectangular map (EXR or Radiance .hdr) from ComfyUI's input folder.",
            inputs=[io.Combo.Input("file", options=names, tooltip="An .exr or .hdr file in ComfyUI's input folder.")],
            outputs=[named_output(io.Image, "latlong", "The map in linear radiance.")],
        )

    @classmethod
    def execute(cls, file: str) -> io.NodeOutput:
        """Read the map."""
        return io.NodeOutput(read_envmap(folder_paths.get_annotated_filepath(file)))

    @classmethod
    def fingerprint_inputs(cls, file: str) -> float:
        """When the file changed last: a new version is read again."""
        return Path(folder_paths.get_annotated_filepath(file)).stat().st_mtime

    @classmethod
    def validate_inputs(cls, file: str) -> bool | str:
        """Say which file is missing before the graph runs."""
        if not folder_paths.exists_annotated_filepath(file):
            return f"LoadEnvMap, file: {file!r} is not in ComfyUI's input folder"
        return True
