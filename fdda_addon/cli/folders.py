# SPDX-License-Identifier: GPL-3.0-or-later
"""Folders with a recording or a model for each of several meshes."""

import argparse
from collections.abc import Sequence
from pathlib import Path

import bpy

from ..core.errors import FDDAError, ModelError, OutputError
from ..core.model import read_model_info
from ..scene.scene_rig import SceneRig, find_rig
from .files import open_file


def mesh_folders(rigs: Sequence[SceneRig], folder: Path) -> list[tuple[SceneRig, Path]]:
    """Return the subfolder of each mesh, named after its object.

    Raises:
        OutputError: two subfolders would have the same name.
    """
    names_by_folder: dict[str, str] = {}
    rigs_and_models = []
    for scene_rig in rigs:
        name = scene_rig.mesh_object.name
        folder_name = bpy.path.clean_name(name)
        # Some file systems ignore case.
        if (other := names_by_folder.setdefault(folder_name.lower(), name)) != name:
            raise OutputError(
                f"'{other}' and '{name}' would both be recorded into '{folder / folder_name}'; rename one of them."
            )
        rigs_and_models.append((scene_rig, folder / folder_name))
    return rigs_and_models


def open_rigs(options: argparse.Namespace) -> dict[str, tuple[SceneRig, Path]]:
    """Open a file, and find the rig of a model, or the rigs of all models in a folder.

    Returns:
        Rig and model by name of the object; by "" for a single model file.

    Raises:
        FDDAError: as `open_rig`; a model has no object name, or the file lacks this object.
    """
    if not options.model.is_dir():
        open_file(options.rig)
        return {"": (find_rig(options.object), options.model)}
    models = _find_models_by_object(options.model)
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
    """Return the JSON of values by object name; a single rig has no name."""
    return values.get("", {"objects": values})


def with_heading(name: str, text: str) -> str:
    """Prefix a text with the name of its rig; a single rig has no name."""
    return f"'{name}':\n{text}" if name else text


def _find_models_by_object(folder: Path) -> dict[str, Path]:
    """Find the models in a folder and its subfolders, by name of their object."""
    paths = sorted([*folder.glob("*.onnx"), *folder.glob("*/*.onnx")])
    if not paths:
        raise ModelError(f"The folder '{folder}' holds no model; give one that train made of several recordings.")
    rigs_and_models: dict[str, Path] = {}
    for path in paths:
        name = read_model_info(path).object_name
        if not name:
            raise ModelError(f"'{path}' does not say of which object it is; give it by itself, with --object NAME.")
        if name in rigs_and_models:
            raise ModelError(f"'{rigs_and_models[name]}' and '{path}' are both models of '{name}'; remove one of them.")
        rigs_and_models[name] = path
    return rigs_and_models
