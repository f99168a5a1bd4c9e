# SPDX-License-Identifier: GPL-3.0-or-later
"""Handles folders that contain a model for each of several meshes."""

import argparse
from pathlib import Path

import bpy

from ..core.errors import FDDAError, ModelError
from ..core.formats.model import read_model_info
from ..runtime.model_meshes import find_model_rigs
from ..scene.scene_rig import SceneRig, find_rig
from .files import open_file


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
