# SPDX-License-Identifier: GPL-3.0-or-later
"""Saved files, clipboards, libraries and exports contain the rig; the models play again where the add-on is."""

from pathlib import Path

import addon_utils
import bpy
import numpy as np
import pytest

import fdda_addon
from fdda_addon.operators import clipboard
from fdda_addon.runtime import gltf_export, playback

from ..conftest import ADDED, ELBOW, ELBOW_RIG, assert_plays, evaluated_positions, pose
from ..playback import add_shape_key


@pytest.fixture
def keyed(bound_elbow):
    """The bound elbow with a shape key that has no effect while the model plays."""
    add_shape_key(bound_elbow).active_shape_key_index = 1
    return bound_elbow


def state(mesh_object):
    return (
        {m.name: (m.show_viewport, m.show_render) for m in mesh_object.modifiers},
        mesh_object.show_only_shape_key,
        mesh_object.active_shape_key_index,
    )


@pytest.mark.parametrize("use_in_render", [False, True])
def test_without_the_addon_the_file_shows_and_renders_the_rig(keyed, tmp_path, capfd, use_in_render):
    """Blender prints no warning, and nothing of the add-on is in the file."""
    keyed.fdda.use_in_render = use_in_render
    pose(angle=1.3)
    keyed.fdda.mode = "RIG"
    true = evaluated_positions(keyed)
    keyed.fdda.mode = "FDDA"
    playing = evaluated_positions(keyed)
    assert np.abs(playing - true).max() > 1e-5
    bpy.ops.wm.save_as_mainfile(filepath=str(tmp_path / "saved.blend"), copy=True)
    fdda_addon.unregister()
    capfd.readouterr()
    bpy.ops.wm.open_mainfile(filepath=str(tmp_path / "saved.blend"))
    mesh_object = bpy.data.objects[ELBOW]
    assert {o.name for o in bpy.data.objects} == {ELBOW, "elbow_rig"}
    assert not hasattr(mesh_object, "fdda")
    shown, pinned, index = state(mesh_object)
    assert shown == {"Armature": (True, True), "CorrectiveSmooth": (True, True), **ADDED}
    assert (pinned, index) == (False, 1)
    pose(angle=1.3)
    assert np.abs(evaluated_positions(mesh_object) - true).max() < 1e-6
    printed = "".join(capfd.readouterr())
    assert "rror" not in printed and "river" not in printed and "fdda" not in printed


def test_a_handler_that_saves_a_backup_during_a_save(bound_elbow, elbow_files, tmp_path):
    """Such a handler of another add-on runs after ours, so both files must get the rig."""

    def back_up(*_: object) -> None:
        bpy.app.handlers.save_pre.remove(back_up)
        bpy.ops.wm.save_as_mainfile(filepath=str(tmp_path / "backup.blend"), copy=True)

    bpy.app.handlers.save_pre.append(back_up)
    bpy.ops.wm.save_as_mainfile(filepath=str(tmp_path / "saved.blend"), copy=True)
    pose(angle=0.8)
    assert_plays(bound_elbow, elbow_files.model)
    # The next save suspends and resumes too.
    bpy.ops.wm.save_as_mainfile(filepath=str(tmp_path / "next.blend"), copy=True)
    pose(angle=0.9)
    assert_plays(bound_elbow, elbow_files.model)
    fdda_addon.unregister()
    for name in ("backup", "saved", "next"):
        bpy.ops.wm.open_mainfile(filepath=str(tmp_path / f"{name}.blend"))
        shown = state(bpy.data.objects[ELBOW])[0]
        assert shown == {"Armature": (True, True), "CorrectiveSmooth": (True, True), **ADDED}, name


def test_a_save_that_fails_does_not_stop_the_playback(bound_elbow, elbow_files, tmp_path):
    folder = tmp_path / "taken.blend"
    folder.mkdir()
    with pytest.raises(RuntimeError):
        bpy.ops.wm.save_as_mainfile(filepath=str(folder), copy=True)
    pose(angle=1.1)
    assert_plays(bound_elbow, elbow_files.model)
    assert bound_elbow.fdda.is_playing


@pytest.mark.parametrize("mode", ["FDDA", "LINEAR", "RIG"])
def test_the_mode_is_restored_with_the_file(bound_elbow, elbow_files, mode):
    bound_elbow.fdda.mode = mode
    pose(angle=1.2)
    before, shown = evaluated_positions(bound_elbow), state(bound_elbow)
    path = elbow_files.bound.with_name("mode.blend")
    bpy.ops.wm.save_as_mainfile(filepath=str(path), copy=True)
    bpy.ops.wm.open_mainfile(filepath=str(path))
    mesh_object = bpy.data.objects[ELBOW]
    assert mesh_object.fdda.mode == mode and state(mesh_object) == shown
    pose(angle=1.2)
    assert np.abs(evaluated_positions(mesh_object) - before).max() < 1e-6


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


def rest_positions() -> np.ndarray:
    """Return the positions of the imported mesh in the rest position of its armature, and check that it has one."""
    mesh_object = next(o for o in bpy.data.objects if o.type == "MESH" and len(o.data.vertices) > 100)
    assert [m.type for m in mesh_object.modifiers] == ["ARMATURE"] and len(mesh_object.vertex_groups) == 2
    mesh_object.modifiers[0].object.data.pose_position = "REST"
    bpy.context.view_layer.update()
    evaluated = mesh_object.evaluated_get(bpy.context.evaluated_depsgraph_get())
    return np.array([evaluated.matrix_world @ vertex.co for vertex in evaluated.data.vertices])


def assert_same_surface(imported: np.ndarray, mesh: np.ndarray) -> None:
    """Assert that each vertex lies on one of the mesh; importers sort and split vertices."""
    distances = np.linalg.norm(imported[:, None] - mesh[None], axis=2).min(axis=1)
    assert distances.max() < 1e-5


@pytest.mark.parametrize("use_in_render", [False, True], ids=["viewport", "render"])
@pytest.mark.parametrize("use_collection", [False, True], ids=["file", "collection"])
def test_gltf_with_applied_modifiers(use_collection, use_in_render, bound_elbow, elbow_files, tmp_path):
    addon_utils.enable("io_scene_gltf2")
    if gltf_export.__name__ not in bpy.context.preferences.addons:
        # Tests reset the preferences.
        bpy.context.preferences.addons.new().module = gltf_export.__name__
    bound_elbow.fdda.use_in_render = use_in_render
    bpy.data.objects[ELBOW_RIG].animation_data_clear()
    pose(angle=1.5)
    path, rest = str(tmp_path / "elbow.glb"), np.array([v.co for v in bound_elbow.data.vertices])
    if use_collection:
        collection = bpy.data.collections.new("export")
        bpy.context.scene.collection.children.link(collection)
        for scene_object in (bound_elbow, bpy.data.objects[ELBOW_RIG]):
            collection.objects.link(scene_object)
        layer_collection = bpy.context.view_layer.layer_collection.children["export"]
        bpy.context.view_layer.active_layer_collection = layer_collection
        bpy.ops.collection.exporter_add(name="IO_FH_gltf2")
        settings = collection.exporters[0].export_properties
        settings.filepath, settings.export_apply = path, True
        bpy.ops.collection.export_all()
    else:
        bpy.ops.export_scene.gltf(filepath=path, export_apply=True, export_skins=True)
    assert_plays(bound_elbow, elbow_files.model)
    assert not bound_elbow.fdda.status
    bpy.ops.wm.read_factory_settings(use_empty=True)
    addon_utils.enable("io_scene_gltf2")
    bpy.ops.import_scene.gltf(filepath=path)
    assert_same_surface(rest_positions(), rest)


@pytest.mark.parametrize("use_in_render", [False, True], ids=["viewport", "render"])
@pytest.mark.parametrize("evaluation", ["RENDER", "VIEWPORT"])
@pytest.mark.parametrize("animation", [False, True], ids=["frame", "animation"])
def test_usd(animation, evaluation, use_in_render, bound_elbow, elbow_files, tmp_path):
    bound_elbow.fdda.use_in_render = use_in_render
    bpy.data.objects[ELBOW_RIG].animation_data_clear()
    pose(angle=1.5)
    path, rest = str(tmp_path / "elbow.usda"), np.array([v.co for v in bound_elbow.data.vertices])
    bpy.context.scene.frame_end = 2
    bpy.ops.wm.usd_export(filepath=path, export_armatures=True, export_animation=animation, evaluation_mode=evaluation)
    assert_plays(bound_elbow, elbow_files.model)
    bpy.ops.wm.read_factory_settings(use_empty=True)
    bpy.ops.wm.usd_import(filepath=path)
    assert_same_surface(rest_positions(), rest)
