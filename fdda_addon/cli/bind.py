# SPDX-License-Identifier: GPL-3.0-or-later
"""`bind RIG.blend MODEL.onnx OUT.blend`: saves a file in which a model, or each model of a folder, is bound."""

import argparse
import os
from contextlib import suppress
from pathlib import Path

from ..core.errors import FDDAError, OutputError
from ..core.files.file_kind import BLEND
from ..core.files.open_files import remove_file
from ..core.files.output import atomic_write, check_outputs
from ..core.formats.model import read_model_info
from ..models.model_list import add_bound_model, bound_entry
from ..runtime.binding import bind, check_plays, unbind
from ..runtime.model_meshes import describe_missing_meshes, find_mesh
from ..scene.blend_file import save_copy
from ..scene.scene_rig import SceneRig
from ..scene.stored_paths import stored_path
from .files import add_model_argument, add_overwrite_option, add_rig_options, open_rigs


def add_options(parser: argparse.ArgumentParser) -> None:
    add_rig_options(parser)
    add_model_argument(parser)
    parser.add_argument("out", metavar="OUT.blend", type=Path, help="file to save, with the bound model")
    parser.add_argument(
        "--use-in-render", action="store_true", help="use the model in final renders too, instead of the rig"
    )
    add_overwrite_option(parser)


def run(options: argparse.Namespace) -> None:
    check_outputs({options.out: BLEND}, (options.rig, options.model), options.overwrite)
    rigs_and_models, refusals, missing = [], [], ""
    found = list(open_rigs(options).values())
    if not (options.object or options.model.is_dir()):
        info = read_model_info(options.model)
        missing = describe_missing_meshes(info, {find_mesh(model, info, rig.mesh_object) for rig, model in found})
    for scene_rig, model in found:
        try:
            if note := bind(scene_rig, model, options.use_in_render):
                print(note)
            # Evaluate now, so that a model that cannot play raises an error here.
            check_plays(scene_rig.mesh_object)
            if warning := scene_rig.mesh_object.fdda.status:
                print(warning)
            rigs_and_models.append((scene_rig, model))
        except FDDAError as error:
            # Of a character, the meshes that have not changed play.
            if options.model.is_dir():
                raise
            refusals.append((scene_rig.mesh_object.name, error))
            unbind(scene_rig.mesh_object)
    if not rigs_and_models:
        raise refusals[0][1]
    models_by_copy: dict[Path, Path] = {}
    try:
        for scene_rig, model in rigs_and_models:
            copy_path = _copy_model_beside(scene_rig, model, options.out)
            if copy_path != model:
                models_by_copy[copy_path] = model
        save_copy(options.out)
    except BaseException:
        for copy_path in models_by_copy:
            with suppress(OSError):
                remove_file(copy_path)
        raise
    for copy_path, model in models_by_copy.items():
        print(f"{copy_path}: a copy of {model}, beside the file that plays it")
    for scene_rig, model in rigs_and_models:
        print(f"{options.out}: '{scene_rig.mesh_object.name}' plays {model.name}")
    for name, error in refusals:
        print(f"Left out '{name}': {error}")
    if missing:
        print(missing)


def _copy_model_beside(scene_rig: SceneRig, model: Path, out: Path) -> Path:
    """Copy the model next to the bound file if needed, store its path in the file, and return the path."""
    model_path = bound_model_path(model, out)
    binding = scene_rig.mesh_object.fdda
    add_bound_model(scene_rig.mesh_object)
    entry = bound_entry(scene_rig.mesh_object)
    # Symbolic links may lead out of the folder, so both paths are resolved.
    entry.path = binding.model = stored_path(out.parent / model_path.resolve().relative_to(out.resolve().parent))
    if model_path.exists():
        return model
    with atomic_write(model_path) as temporary:
        temporary.write_bytes(model.read_bytes())
    return model_path


def bound_model_path(model: Path, out: Path) -> Path:
    """Return the path that the model of a bound file must have. A bound file loads no model outside of its folder.

    Returns:
        The path of the model if it is in the folder of the bound file or below, else a path in this folder.

    Raises:
        OutputError: another file with that name exists.
    """
    if model.resolve().is_relative_to(out.resolve().parent):
        return model
    copy_path = out.parent / model.name
    if copy_path.name == out.name:
        raise OutputError(f"Cannot write '{out}': the copy of the model beside it has that name; give another name.")
    if os.path.lexists(copy_path) and not (copy_path.is_file() and copy_path.read_bytes() == model.read_bytes()):
        raise OutputError(
            f"Cannot put the model beside '{out}': there is another '{copy_path.name}'; remove it or choose another "
            "folder."
        )
    return copy_path
