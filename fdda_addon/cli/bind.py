# SPDX-License-Identifier: GPL-3.0-or-later
"""`bind RIG.blend MODEL.onnx OUT.blend`: a file in which the model plays, or each model of a folder of models."""

import argparse
import os
from contextlib import suppress
from pathlib import Path
from typing import TYPE_CHECKING

if TYPE_CHECKING:
    from ..scene.scene_rig import SceneRig


def add_options(parser: argparse.ArgumentParser) -> None:
    from .files import add_rig_options
    from .outputs import add_overwrite

    add_rig_options(parser)
    parser.add_argument("model", metavar="MODEL.onnx", type=Path, help="the model, or a folder of models")
    parser.add_argument("out", metavar="OUT.blend", type=Path, help="where to save the bound file")
    parser.add_argument("--use-in-render", action="store_true", help="final renders use the model too, not the rig")
    add_overwrite(parser)


def run(options: argparse.Namespace) -> None:
    from ..core.file_kind import BLEND
    from ..core.open_files import remove_file
    from ..core.output import check_outputs
    from ..scene.blend_file import save_copy
    from .folders import open_rigs

    check_outputs({options.out: BLEND}, (options.rig, options.model), options.overwrite)
    bound = list(open_rigs(options).values())
    for scene_rig, model in bound:
        _bind(scene_rig, model, options.use_in_render)
    copied: dict[Path, Path] = {}
    try:
        for scene_rig, model in bound:
            place = _put_beside(scene_rig, model, options.out)
            if place != model:
                copied[place] = model
        save_copy(options.out)
    except BaseException:
        for place in copied:
            with suppress(OSError):
                remove_file(place)
        raise
    for place, model in copied.items():
        print(f"{place}: a copy of {model}, beside the file that plays it")
    for scene_rig, model in bound:
        print(f"{options.out}: '{scene_rig.mesh_object.name}' plays {model.name}")


def _bind(scene_rig: "SceneRig", model: Path, use_in_render: bool) -> None:
    import bpy

    from ..core.errors import ModelError
    from ..runtime.binding import bind

    bind(scene_rig, model, use_in_render)
    # What cannot play says so here and not when the file is opened.
    bpy.context.view_layer.update()
    if scene_rig.mesh_object.fdda.status:
        raise ModelError(scene_rig.mesh_object.fdda.status)


def _put_beside(scene_rig: "SceneRig", model: Path, out: Path) -> Path:
    """Let the bound object find its model from the file; returns the copy if one was made, else the model."""
    from ..core.output import atomic_write
    from ..models.entries import bound_entry
    from ..models.model_list import add_bound_model
    from ..scene.stored_paths import stored_path

    place = beside(model, out)
    binding = scene_rig.mesh_object.fdda
    add_bound_model(scene_rig.mesh_object)
    entry = bound_entry(scene_rig.mesh_object)
    # Through links the way may lead elsewhere than to what lies below the file.
    entry.path = binding.model = stored_path(out.parent / place.resolve().relative_to(out.resolve().parent))
    if place.exists():
        return model
    with atomic_write(place) as temporary:
        temporary.write_bytes(model.read_bytes())
    return place


def beside(model: Path, out: Path) -> Path:
    """Where the model of a bound file must be: a bound file follows no path out of its folder.

    Returns:
        The model itself where it lies in the folder or below, else its name in the folder.

    Raises:
        OutputError: another file of that name is there.
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
