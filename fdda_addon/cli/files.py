# SPDX-License-Identifier: GPL-3.0-or-later
"""Options that verbs share, and opening of .blend files and of folders with a model for each of several meshes."""

import argparse
from pathlib import Path
from typing import Any

import bpy

from ..core.errors import FDDAError, ModelError
from ..core.formats.model import read_model_info
from ..runtime.model_meshes import find_model_rigs
from ..scene.blend_file import blender_path, report_message, silenced_stdout
from ..scene.scene_rig import SceneRig, find_rig


def add_rig_options(parser: argparse.ArgumentParser) -> None:
    """Add the argument RIG.blend and the option --object."""
    add_rig_argument(parser)
    parser.add_argument("--object", default="", metavar="NAME", help="mesh object to use, if several have a rig")


def add_rig_argument(parser: argparse.ArgumentParser) -> None:
    """Add the argument RIG.blend."""
    parser.add_argument("rig", metavar="RIG.blend", type=Path, help="the file with the rig")


def add_model_argument(parser: argparse.ArgumentParser) -> None:
    """Add the argument MODEL.onnx."""
    parser.add_argument("model", metavar="MODEL.onnx", type=Path, help="the model, or a folder of models")


def add_repeatable_option(
    parser: argparse.ArgumentParser, name: str, metavar: str, text: str, **arguments: Any
) -> None:
    """Add an option that may be given several times, with its help and further arguments of `add_argument`."""
    parser.add_argument(
        name, action="append", metavar=metavar, help=f"{text}; repeatable", **{"default": [], **arguments}
    )


def add_overwrite_option(parser: argparse.ArgumentParser) -> None:
    """Add the option --overwrite, for outputs that `core.files.output.check_outputs` refuses to overwrite."""
    parser.add_argument(
        "--overwrite", action="store_true", help="allow overwriting of input files and of files of another kind"
    )


def check_file(path: Path) -> None:
    """Raise an FDDAError if there is no file to open."""
    if not path.is_file():
        raise FDDAError(f"There is no file '{path}'; give the path of a .blend file.")


def open_file(path: Path) -> None:
    """Open a .blend file.

    Raises:
        FDDAError: there is no such file, or Blender cannot read it.
    """
    check_file(path)
    try:
        with silenced_stdout():
            bpy.ops.wm.open_mainfile(filepath=blender_path(path), load_ui=False)
    except RuntimeError as error:
        raise FDDAError(f"Blender cannot open '{path}' ({report_message(error)}); give a .blend file.") from error


def open_rigs(options: argparse.Namespace) -> dict[str, tuple[SceneRig, Path]]:
    """Open the rig file, and find the rigs of a model, or of all models in a folder.

    Returns:
        Rig and model, by name of the object. The name is empty for a single mesh.

    Raises:
        FDDAError: the file cannot be opened or has no rig, a model has no object name, or its object is missing.
    """
    if not options.model.is_dir():
        open_file(options.rig)
        info = None if options.object else read_model_info(options.model)
        if info is None or len(info.meshes) == 1:
            return {"": (find_rig(options.object), options.model)}
        rigs = find_model_rigs(options.model, info).values()
        return {scene_rig.mesh_object.name: (scene_rig, options.model) for scene_rig in rigs}
    folder = options.model
    paths = sorted([*folder.glob("*.onnx"), *folder.glob("*/*.onnx")])
    if not paths:
        raise ModelError(f"The folder '{folder}' contains no model; give a folder of models, or one model.")
    models: dict[str, Path] = {}
    for path in paths:
        for name in (mesh.name for mesh in read_model_info(path).meshes):
            if not name:
                raise ModelError(
                    f"'{path}' has no object name; give this file instead of the folder, with --object NAME."
                )
            if name in models:
                raise ModelError(f"'{models[name]}' and '{path}' are both models of '{name}'; remove one of them.")
            models[name] = path
    if options.object and options.object not in models:
        names = ", ".join(f"'{name}'" for name in models)
        raise ModelError(f"'{options.model}' has no model of '{options.object}'; it has those of {names}.")
    open_file(options.rig)
    if options.object:
        return {"": (find_rig(options.object), models[options.object])}
    rigs_and_models = {}
    for name, model in models.items():
        scene_object = bpy.context.scene.objects.get(name)
        if scene_object is None or scene_object.type != "MESH":
            raise FDDAError(
                f"'{model}' is a model of the object '{name}', and '{options.rig}' has no mesh object of that name; "
                "rename the object as it was, or use the models of the folder one by one."
            )
        rigs_and_models[name] = find_rig(name), model
    return rigs_and_models


def to_json_by_object(values: dict[str, dict]) -> dict:
    """Return the JSON of the values of all objects; the value itself of a single rig, which has no name."""
    return values.get("", {"objects": values})


def with_heading(name: str, text: str) -> str:
    """Return a text below a heading with the name of its rig. A single rig has no name, and so no heading."""
    return f"'{name}':\n{text}" if name else text
