# SPDX-License-Identifier: GPL-3.0-or-later
"""`bind RIG.blend MODEL.onnx OUT.blend`: a file in which the model plays."""

import argparse
import os
from pathlib import Path


def add_options(parser: argparse.ArgumentParser) -> None:
    from .files import add_rig_options

    add_rig_options(parser)
    parser.add_argument("model", metavar="MODEL.onnx", type=Path, help="the model")
    parser.add_argument("out", metavar="OUT.blend", type=Path, help="where to save the bound file")
    parser.add_argument("--use-in-render", action="store_true", help="final renders use the model too, not the rig")


def run(options: argparse.Namespace) -> None:
    import bpy

    from ..core.errors import ModelError, OutputError
    from ..core.output import check_writable, replacing
    from ..model_list import bound_entry
    from ..models import adopt
    from ..runtime.binding import bind
    from .files import open_rig, save_copy

    check_writable(options.out)
    scene_rig = open_rig(options)
    bind(scene_rig, options.model, options.use_in_render)
    # What cannot play says so here and not when the file is opened.
    bpy.context.view_layer.update()
    if scene_rig.mesh_object.fdda.status:
        raise ModelError(scene_rig.mesh_object.fdda.status)
    model = beside(options.model, options.out)
    binding = scene_rig.mesh_object.fdda
    adopt(scene_rig.mesh_object)
    entry = bound_entry(scene_rig.mesh_object)
    binding.model = "//" + model.resolve().relative_to(options.out.resolve().parent).as_posix()
    entry.path = binding.model
    copied = not model.exists()
    if copied:
        with replacing(model) as temporary:
            temporary.write_bytes(options.model.read_bytes())
    try:
        save_copy(options.out)
    except OutputError:
        if copied:
            model.unlink()
        raise
    if copied:
        print(f"{model}: a copy of {options.model}, beside the file that plays it")
    print(f"{options.out}: '{scene_rig.mesh_object.name}' plays {model.name}")


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
    if os.path.lexists(copy) and not (copy.is_file() and copy.read_bytes() == model.read_bytes()):
        raise OutputError(
            f"Cannot put the model beside '{out}': there is another '{copy.name}'; remove it or choose another folder."
        )
    return copy
