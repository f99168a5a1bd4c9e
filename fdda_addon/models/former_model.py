# SPDX-License-Identifier: GPL-3.0-or-later
"""Keeps the model that a training replaces, so that a worse model can be replaced by the former one."""

import os
from itertools import count
from pathlib import Path

import bpy

from ..core.errors import FDDAError, OutputError, os_error_text
from ..core.files.output import atomic_write
from ..core.formats.model import read_model_info
from ..core.formats.report import page_path, report_path
from .model_list import add_model

FORMER_FOLDER = "previous"
"""Name of the folder beside a model that holds the former model with its report."""


def former_model_path(model: Path) -> Path:
    """Return the path at which the former model of a model file is kept."""
    return model.parent / FORMER_FOLDER / model.name


def keep_former_model(model: Path) -> None:
    """Copy a file and its report, which a training will replace; do nothing if the file is missing.

    A former model of other meshes, or one that cannot be read, gets another name.

    Raises:
        OutputError: a file cannot be copied.
    """
    if not model.is_file():
        return
    former_model = former_model_path(model)
    try:
        former_model.parent.mkdir(exist_ok=True)
        if former_model.is_file():
            if former_model.read_bytes() == model.read_bytes():
                return  # The training that was to replace it has failed.
            meshes = _meshes(former_model)
            if meshes is None or meshes != _meshes(model):
                others = (former_model.with_stem(f"{model.stem}-{number}") for number in count(1))
                former_model.rename(next(path for path in others if not os.path.lexists(path)))
        for path in (model, report_path(model), page_path(model)):
            if path.is_file():
                with atomic_write(former_model.parent / path.name) as temporary_path:
                    temporary_path.write_bytes(path.read_bytes())
    except OSError as error:
        raise OutputError(
            f"Cannot keep the former model in '{former_model.parent}': {os_error_text(error)}; make space, or choose "
            "another file under Model."
        ) from error


def _meshes(model: Path) -> list[tuple[str, int]] | None:
    """Return names and numbers of vertices of the meshes of a model; None if it cannot be read."""
    try:
        return [(mesh.name, mesh.vertices) for mesh in read_model_info(model).meshes]
    except FDDAError:
        return None


def add_former_model(mesh_object: bpy.types.Object, model: Path) -> None:
    """Add the former model of a model file to the Model Library of a mesh object, if there is one."""
    former_model = former_model_path(model)
    if former_model.is_file():
        count = len(mesh_object.fdda.models)
        entry = add_model(mesh_object, former_model)
        if len(mesh_object.fdda.models) > count:
            entry.name = f"{model.stem} (previous)"
