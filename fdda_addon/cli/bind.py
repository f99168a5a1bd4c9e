# SPDX-License-Identifier: GPL-3.0-or-later
"""`bind RIG.blend MODEL.onnx OUT.blend`: a file in which the model plays."""

import argparse
from pathlib import Path


def add_options(parser: argparse.ArgumentParser) -> None:
    from .files import add_rig_options

    add_rig_options(parser)
    parser.add_argument("model", metavar="MODEL.onnx", type=Path, help="the model")
    parser.add_argument("out", metavar="OUT.blend", type=Path, help="where to save the bound file")
    parser.add_argument("--use-in-render", action="store_true", help="final renders use the model too, not the rig")


def run(options: argparse.Namespace) -> None:
    import bpy

    from ..core.output import check_writable
    from ..runtime.binding import bind
    from .files import open_rig, save_copy

    check_writable(options.out)
    scene_rig = open_rig(options)
    bind(scene_rig, options.model, options.use_in_render)
    # The file is saved with the positions of its current pose, for a Blender that has no add-on.
    bpy.context.view_layer.update()
    model = beside(options.model, options.out)
    scene_rig.mesh_object.fdda.model = "//" + model.resolve().relative_to(options.out.resolve().parent).as_posix()
    save_copy(options.out)
    print(f"{options.out}: '{scene_rig.mesh_object.name}' plays {model.name}")


def beside(model: Path, out: Path) -> Path:
    """A bound file follows no path out of its folder: bring the model there when it is elsewhere.

    Raises:
        OutputError: another file of that name is there.
    """
    from ..core.errors import OutputError
    from ..core.output import replacing

    if model.resolve().is_relative_to(out.resolve().parent):
        return model
    copy = out.parent / model.name
    data = model.read_bytes()
    if not copy.exists():
        with replacing(copy) as temporary:
            temporary.write_bytes(data)
        print(f"{copy}: a copy of {model}, beside the file that plays it")
    elif copy.read_bytes() != data:
        raise OutputError(
            f"Cannot put the model beside '{out}': there is another '{copy.name}'; remove it or choose another folder."
        )
    return copy
