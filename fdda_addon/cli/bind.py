# SPDX-License-Identifier: GPL-3.0-or-later
"""`bind RIG.blend MODEL.onnx OUT.blend`: saves a file in which a model, or each model of a folder, plays."""

import argparse
import os
from contextlib import suppress
from pathlib import Path
from typing import TYPE_CHECKING

if TYPE_CHECKING:
    from ..scene.scene_rig import SceneRig


def add_options(parser: argparse.ArgumentParser) -> None:
    from .files import add_rig_options
    from .outputs import add_overwrite_option

    add_rig_options(parser)
    parser.add_argument("model", metavar="MODEL.onnx", type=Path, help="the model, or a folder of models")
    parser.add_argument("out", metavar="OUT.blend", type=Path, help="where to save the bound file")
    parser.add_argument("--use-in-render", action="store_true", help="final renders use the model too, not the rig")
    add_overwrite_option(parser)


def run(options: argparse.Namespace) -> None:
    from ..core.file_kind import BLEND
    from ..core.open_files import remove_file
    from ..core.output import check_outputs
    from ..scene.blend_file import save_copy
    from .folders import open_rigs

    check_outputs({options.out: BLEND}, (options.rig, options.model), options.overwrite)
    rigs_and_models = list(open_rigs(options).values())
    for scene_rig, model in rigs_and_models:
        _bind(scene_rig, model, options.use_in_render)
    copied: dict[Path, Path] = {}
    try:
        for scene_rig, model in rigs_and_models:
            model_path = _copy_model_beside(scene_rig, model, options.out)
            if model_path != model:
                copied[model_path] = model
        save_copy(options.out)
    except BaseException:
        for model_path in copied:
            with suppress(OSError):
                remove_file(model_path)
        raise
    for model_path, model in copied.items():
        print(f"{model_path}: a copy of {model}, beside the file that plays it")
    for scene_rig, model in rigs_and_models:
        print(f"{options.out}: '{scene_rig.mesh_object.name}' plays {model.name}")


def _bind(scene_rig: "SceneRig", model: Path, use_in_render: bool) -> None:
    import bpy

    from ..core.errors import ModelError
    from ..runtime.binding import bind

    bind(scene_rig, model, use_in_render)
    # Evaluate now, so that a model that cannot play is an error here.
    bpy.context.view_layer.update()
    if scene_rig.mesh_object.fdda.status:
        raise ModelError(scene_rig.mesh_object.fdda.status)


def _copy_model_beside(scene_rig: "SceneRig", model: Path, out: Path) -> Path:
    """Store the model's path relative to the bound file, and copy the model beside it where needed; return its path."""
    from ..core.output import atomic_write
    from ..models.entries import bound_entry
    from ..models.model_list import add_bound_model
    from ..scene.stored_paths import stored_path

    model_path = bound_model_path(model, out)
    binding = scene_rig.mesh_object.fdda
    add_bound_model(scene_rig.mesh_object)
    entry = bound_entry(scene_rig.mesh_object)
    # Links may lead out of the folder, so both paths are resolved.
    entry.path = binding.model = stored_path(out.parent / model_path.resolve().relative_to(out.resolve().parent))
    if model_path.exists():
        return model
    with atomic_write(model_path) as temporary:
        temporary.write_bytes(model.read_bytes())
    return model_path


def bound_model_path(model: Path, out: Path) -> Path:
    """Return where the model of a bound file must be, because a bound file follows no path out of its folder.

    Returns:
        The model itself where it is in the folder or below, else a path in the folder.

    Raises:
        OutputError: another file with that name exists.
    """
    from ..core.errors import OutputError

    if model.resolve().is_relative_to(out.resolve().parent):
        return model
    copy = out.parent / model.name
    if copy.name == out.name:
        raise OutputError(f"Cannot write '{out}': the copy of the model beside it has that name; give another name.")
    if os.path.lexists(copy) and not (copy.is_file() and copy.read_bytes() == model.read_bytes()):
        raise OutputError(
            f"Cannot put the model beside '{out}': there is another '{copy.name}'; remove it or choose another folder."
        )
    return copy
