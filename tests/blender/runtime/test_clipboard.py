# SPDX-License-Identifier: GPL-3.0-or-later
"""Characters copied to the clipboard or written to a library contain the rig; pasted characters play."""

from pathlib import Path

import bpy
import numpy as np
import pytest

import fdda_addon
from fdda_addon.operators import clipboard
from fdda_addon.runtime import playback

from ..conftest import ADDED, ELBOW, ELBOW_RIG, assert_plays, evaluated_positions, pose


@pytest.fixture(autouse=True)
def _clipboard(tmp_path, monkeypatch):
    """Put Blender's clipboard, which is a file, into the folder of the test."""
    monkeypatch.setattr(bpy.context.preferences.filepaths, "temporary_directory", str(tmp_path))


def copy_to_clipboard(_: bpy.types.Object, folder: Path) -> Path:
    bpy.ops.object.select_all(action="SELECT")
    assert bpy.ops.fdda.copy_objects() == {"FINISHED"}
    (path,) = folder.rglob("copybuffer*.blend")
    return path


def write_library(mesh_object: bpy.types.Object, folder: Path) -> Path:
    with playback.suspended_playback():
        bpy.data.libraries.write(str(folder / "library.blend"), {mesh_object})
    return folder / "library.blend"


@pytest.mark.parametrize("write", [copy_to_clipboard, write_library])
@pytest.mark.parametrize("use_in_render", [False, True])
def test_a_copied_character_shows_its_rig_without_the_add_on(bound_elbow, elbow_files, tmp_path, write, use_in_render):
    bound_elbow.fdda.use_in_render = use_in_render
    bpy.data.objects[ELBOW_RIG].animation_data_clear()
    pose(angle=1.2)
    bound_elbow.fdda.mode = "RIG"
    rig_shape = evaluated_positions(bound_elbow)
    bound_elbow.fdda.mode = "FDDA"
    bpy.context.view_layer.update()
    path = write(bound_elbow, tmp_path)
    pose(angle=0.7)
    assert_plays(bound_elbow, elbow_files.model)
    fdda_addon.unregister()
    bpy.ops.wm.read_factory_settings(use_empty=True)
    with bpy.data.libraries.load(str(path)) as (available, appended):
        assert sorted(available.objects) == [ELBOW, ELBOW_RIG] and available.meshes == [ELBOW]
        appended.objects = list(available.objects)
    for pasted in appended.objects:
        bpy.context.scene.collection.objects.link(pasted)
    bpy.context.view_layer.update()
    shown = {m.name: (m.show_viewport, m.show_render) for m in bpy.data.objects[ELBOW].modifiers}
    assert shown == {"Armature": (True, True), "CorrectiveSmooth": (True, True), **ADDED}
    assert np.array_equal(evaluated_positions(bpy.data.objects[ELBOW]), rig_shape)


def test_a_pasted_character_plays(bound_elbow, elbow_files, tmp_path):
    copy_to_clipboard(bound_elbow, tmp_path)
    assert bpy.ops.view3d.pastebuffer() == {"FINISHED"}
    bpy.context.view_layer.update()
    pasted = bpy.data.objects[f"{ELBOW}.001"]
    assert pasted.fdda.is_playing
    pose(f"{ELBOW_RIG}.001", angle=1.0)
    assert_plays(pasted, elbow_files.model)
    assert_plays(bound_elbow, elbow_files.model)


def test_a_character_copied_by_blender_s_operator_plays(bound_elbow, elbow_files):
    """Menus and scripts call Blender's operator. It saves the modifiers disabled; mode RIG enables them."""
    bpy.ops.object.select_all(action="SELECT")
    bpy.ops.view3d.copybuffer()
    bpy.ops.view3d.pastebuffer()
    bpy.context.view_layer.update()
    pasted = bpy.data.objects[f"{ELBOW}.001"]
    assert_plays(pasted, elbow_files.model)
    pasted.fdda.mode = "RIG"
    assert [m.show_viewport for m in pasted.modifiers] == [True, True, False, False]


def test_copying_in_edit_mode_shows_an_error(bound_elbow):
    bpy.context.view_layer.objects.active = bound_elbow
    bpy.ops.object.mode_set(mode="EDIT")
    with pytest.raises(RuntimeError, match="Objects can only be copied in Object Mode"):
        bpy.ops.fdda.copy_objects()


def test_the_shortcut_is_removed_beside_a_key_map_of_the_same_name():
    """Many add-ons make a key map "3D View" without its editor."""
    keymaps = bpy.context.window_manager.keyconfigs.addon.keymaps
    clipboard.unregister()
    while (keymap := keymaps.get("3D View")) is not None:
        keymaps.remove(keymap)
    other_keymap = keymaps.new("3D View")
    other_keymap.keymap_items.new("view3d.copybuffer", "C", "PRESS")
    try:
        for _ in range(2):
            clipboard.register()
            names = [item.idname for keymap in keymaps if keymap.name == "3D View" for item in keymap.keymap_items]
            assert sorted(names) == ["fdda.copy_objects", "view3d.copybuffer"]
            clipboard.unregister()
    finally:
        keymaps.remove(other_keymap)
        clipboard.register()
