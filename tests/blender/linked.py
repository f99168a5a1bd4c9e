# SPDX-License-Identifier: GPL-3.0-or-later
"""The elbow in a library file, and shots that link it."""

import itertools
import shutil
import subprocess
import sys
from dataclasses import dataclass
from pathlib import Path

import bpy
import numpy as np
import pytest

import fdda_addon
from fdda_addon.models import model_list
from fdda_addon.runtime import playback_modifier
from fdda_addon.runtime.session import session
from fdda_addon.scene.scene_rig import SceneRig, armature_modifier
from fdda_addon.scene.stored_paths import stored_path

from .conftest import ELBOW, ELBOW_RIG, ElbowFiles, assert_plays

ROOT = Path(__file__).resolve().parents[2]
COLLECTION = "Character"
ANGLES = (0.3, 1.4)
"""Angle of the elbow of each override in a shot, in radians."""


@dataclass(frozen=True)
class Library:
    """Paths of a library: the file of the character, and its model in the same folder."""

    path: Path
    model: Path


def save_character(source: Path, path: Path) -> None:
    """Save a copy of a file in which the character is in a collection that can be linked."""
    bpy.ops.wm.open_mainfile(filepath=str(source))
    collection = bpy.data.collections.new(COLLECTION)
    bpy.context.scene.collection.children.link(collection)
    for name in (ELBOW, ELBOW_RIG):
        bpy.context.scene.collection.objects.unlink(bpy.data.objects[name])
        collection.objects.link(bpy.data.objects[name])
    binding, model = bpy.data.objects[ELBOW].fdda, stored_path(path.with_name("elbow.onnx"))
    binding.model = model if binding.is_bound else ""
    for entry in binding.models:
        entry.path = model
    bpy.ops.wm.save_as_mainfile(filepath=str(path), copy=True)


def make_library(elbow_files: ElbowFiles, folder: Path) -> Library:
    """Save the bound elbow as a library in one folder; then open an empty shot in another folder."""
    session.chosen_paths.clear()
    files = Library(folder / "characters" / "elbow.blend", folder / "characters" / "elbow.onnx")
    files.path.parent.mkdir()
    shutil.copy(elbow_files.model, files.model)
    save_character(elbow_files.bound, files.path)
    save_new_shot(folder)
    return files


def save_new_shot(folder: Path) -> None:
    bpy.ops.wm.read_factory_settings(use_empty=True)
    fdda_addon.register()
    (folder / "shots").mkdir(exist_ok=True)
    bpy.ops.wm.save_as_mainfile(filepath=str(shot_path(folder)))


def shot_path(folder: Path) -> Path:
    return folder / "shots" / "shot.blend"


def save_and_reopen_shot(folder: Path) -> None:
    bpy.ops.wm.save_as_mainfile(filepath=str(shot_path(folder)))
    bpy.ops.wm.open_mainfile(filepath=str(shot_path(folder)))


def link_character(path: Path) -> bpy.types.Collection:
    with bpy.data.libraries.load(str(path), link=True, relative=True) as (_, linked_data):
        linked_data.collections = [COLLECTION]
    return linked_data.collections[0]


def override_character(collection: bpy.types.Collection, angle: float | None = None, is_editable: bool = True):
    """Create a library override of a linked character, and return its mesh object.

    With an angle, remove the override's action and bend the elbow.
    """
    root = collection.override_hierarchy_create(
        bpy.context.scene, bpy.context.view_layer, do_fully_editable=is_editable
    )
    mesh_object = next(o for o in root.all_objects if o.type == "MESH")
    if angle is not None:
        armature_of(mesh_object).animation_data.action = None
        bend_elbow(mesh_object, angle)
    return mesh_object


def armature_of(mesh_object: bpy.types.Object) -> bpy.types.Object:
    return armature_modifier(mesh_object).object


def rig_of(mesh_object: bpy.types.Object) -> SceneRig:
    return SceneRig(mesh_object, armature_of(mesh_object))


def bend_elbow(mesh_object: bpy.types.Object, angle: float) -> None:
    armature_of(mesh_object).pose.bones["lower"].rotation_euler[0] = angle


def overridden_meshes() -> list[bpy.types.Object]:
    """Return the mesh objects of all library overrides in the open file, sorted by name."""
    return [o for o in bpy.data.objects if o.type == "MESH" and o.override_library]


def buffer_name(mesh_object: bpy.types.Object) -> str:
    return playback_modifier.buffer_of(playback_modifier.find_modifier(mesh_object)).name


def assert_overrides_play(library: Library, angles: tuple[float, ...] = ANGLES) -> list[np.ndarray]:
    """Assert that each override shows the model's output for its own pose; return the positions of each."""
    bpy.context.view_layer.update()
    mesh_objects = overridden_meshes()
    elbow_angles = [armature_of(o).pose.bones["lower"].rotation_euler[0] for o in mesh_objects]
    assert elbow_angles == pytest.approx(angles)
    positions = [assert_plays(o, library.model) for o in mesh_objects]
    for first, second in itertools.pairwise(positions):
        assert np.abs(first - second).max() > 1e-3
    return positions


def run_in_another_process(call: str) -> None:
    """Call a function of this module in a new process."""
    code = f"""
import fdda_addon
from tests.blender import linked
fdda_addon.register()
try:
    linked.{call}
finally:
    fdda_addon.unregister()
"""
    result = subprocess.run([sys.executable, "-c", code], cwd=ROOT, capture_output=True, text=True, check=False)
    assert result.returncode == 0, result.stdout + result.stderr


def open_shot(path: str, model: str) -> None:
    """Open a shot, and assert that its overrides play in their saved poses."""
    bpy.ops.wm.open_mainfile(filepath=path)
    assert_overrides_play(Library(Path(), Path(model)))


def pack_model(path: str) -> None:
    """Pack the model into the character's file, set the mode RIG, and save the file."""
    bpy.ops.wm.open_mainfile(filepath=path)
    mesh_object = bpy.data.objects[ELBOW]
    model_list.add_bound_model(mesh_object)
    model_list.pack_entry(mesh_object, mesh_object.fdda.models[0])
    mesh_object.fdda.mode = "RIG"
    bpy.ops.wm.save_mainfile()
