# SPDX-License-Identifier: GPL-3.0-or-later
"""Linked characters and library overrides in shots: playback, saved shots, changed libraries, models of the shot."""

import shutil
from pathlib import Path

import bpy
import numpy as np
import pytest

import fdda_addon
from fdda_addon.core.errors import ModelError, RigError
from fdda_addon.models import model_list
from fdda_addon.runtime import model_files, playback_modifier
from fdda_addon.runtime.binding import bind, unbind
from fdda_addon.runtime.session import session

from ..conftest import ADDED, ELBOW, ELBOW_RIG, assert_plays, evaluated_positions, predicted_positions
from ..linked import (
    ANGLES,
    COLLECTION,
    Library,
    armature_of,
    assert_overrides_play,
    bend_elbow,
    buffer_name,
    link_character,
    overridden_meshes,
    override_character,
    rig_of,
    run_in_another_process,
    save_and_reopen_shot,
    save_character,
    save_new_shot,
    shot_path,
)
from ..playback import animate, count_calls, render_positions, rig_pixels, set_camera, still

CROWD_SIZE = 20


@pytest.mark.parametrize("is_editable", [True, False], ids=["editable", "system override"])
def test_overrides_play_when_another_process_opens_the_shot(library, tmp_path, is_editable):
    collection = link_character(library.path)
    for angle in ANGLES:
        override_character(collection, angle, is_editable)
    assert_overrides_play(library)
    bpy.ops.wm.save_as_mainfile(filepath=str(shot_path(tmp_path)))
    assert_overrides_play(library)
    run_in_another_process(f"open_shot({str(shot_path(tmp_path))!r}, {str(library.model)!r})")


def test_overrides_follow_their_actions(library, tmp_path):
    collection = link_character(library.path)
    override_character(collection)
    second = override_character(collection)
    armature_object = armature_of(second)
    armature_object.animation_data.action = None
    for frame, angle in ((1, 1.5), (30, 0.1)):
        bend_elbow(second, angle)
        armature_object.pose.bones["lower"].keyframe_insert("rotation_euler", index=0, frame=frame)
    save_and_reopen_shot(tmp_path)
    positions_by_frame = []
    for frame in (2, 15, 27):
        bpy.context.scene.frame_set(frame)
        positions_by_frame.append([assert_plays(mesh_object, library.model) for mesh_object in overridden_meshes()])
        first_positions, second_positions = positions_by_frame[-1]
        assert np.abs(first_positions - second_positions).max() > 1e-3
    assert np.abs(positions_by_frame[0][1] - positions_by_frame[2][1]).max() > 1e-2


def test_overrides_play_after_undo_and_redo(pair, library):
    assert_overrides_play(library)
    bpy.ops.ed.undo_push(message="start")
    bend_elbow(pair[0], 0.9)
    bpy.context.view_layer.update()
    bpy.ops.ed.undo_push(message="bent")
    pair[1].fdda.mode = "RIG"
    bpy.context.view_layer.update()
    bpy.ops.ed.undo_push(message="rig")
    bpy.ops.ed.undo()
    assert_overrides_play(library, (0.9, 1.4))
    bpy.ops.ed.undo()
    assert_overrides_play(library)
    bpy.ops.ed.redo()
    bpy.ops.ed.redo()
    first, second = overridden_meshes()
    assert (second.fdda.mode, second.fdda.is_playing) == ("RIG", False)
    assert_plays(first, library.model)
    second.fdda.mode = "FDDA"
    assert_overrides_play(library, (0.9, 1.4))


@pytest.mark.parametrize("use_in_render", [False, True])
def test_renders_of_overrides_show_the_rig_or_the_model(pair, library, tmp_path, use_in_render):
    first, second = pair
    second.hide_render = True
    set_camera()
    first.fdda.use_in_render = use_in_render
    bpy.context.view_layer.update()
    rendered = still(tmp_path / "still.png")
    model_image = render_positions(first, predicted_positions(first, library.model), tmp_path / "plain.png")
    rig_image = rig_pixels(first, tmp_path)
    assert not np.array_equal(model_image, rig_image)
    assert np.array_equal(rendered, model_image if use_in_render else rig_image)
    assert_overrides_play(library)


def test_a_linked_character_without_override_plays_its_action(library, tmp_path):
    bpy.context.scene.collection.children.link(link_character(library.path))
    save_and_reopen_shot(tmp_path)
    linked = next(o for o in bpy.context.scene.objects if o.type == "MESH")
    assert linked.library is not None and linked.override_library is None
    frames = [assert_plays(linked, library.model) for f in (5, 12, 25) if not bpy.context.scene.frame_set(f)]
    assert np.abs(frames[0] - frames[1]).max() > 1e-3
    bpy.ops.ed.undo_push(message="start")
    bpy.context.scene.frame_set(8)
    bpy.ops.ed.undo_push(message="frame")
    bpy.ops.ed.undo()
    assert_plays(next(o for o in bpy.context.scene.objects if o.type == "MESH"), library.model)


def test_an_override_of_a_playing_instance(library, tmp_path):
    """Users link a character as an instance, and then make a library override of the instance."""
    empty = bpy.data.objects.new("instance", None)
    empty.instance_type, empty.instance_collection = "COLLECTION", link_character(library.path)
    bpy.context.scene.collection.objects.link(empty)
    bpy.context.scene.frame_set(9)
    empty.select_set(True)
    bpy.context.view_layer.objects.active = empty
    bpy.ops.object.make_override_library()
    mesh_object = overridden_meshes()[0]
    armature_of(mesh_object).animation_data.action = None
    bend_elbow(mesh_object, 0.8)
    assert_overrides_play(library, (0.8,))
    assert playback_modifier.buffer_of(playback_modifier.find_modifier(mesh_object)).is_runtime_data
    save_and_reopen_shot(tmp_path)
    assert_overrides_play(library, (0.8,))


@pytest.mark.parametrize("is_linked", [True, False], ids=["linked", "local"])
def test_instances_of_a_collection_show_one_pose(library, is_linked):
    if is_linked:
        collection = link_character(library.path)
    else:
        bpy.ops.wm.open_mainfile(filepath=str(library.path))
        collection = bpy.data.collections[COLLECTION]
        bpy.context.scene.collection.children.unlink(collection)
    for index in range(2):
        empty = bpy.data.objects.new(f"instance {index}", None)
        empty.instance_type, empty.instance_collection, empty.location.x = "COLLECTION", collection, index
        bpy.context.scene.collection.objects.link(empty)
    mesh_object = next(o for o in collection.all_objects if o.type == "MESH")
    for frame in (4, 21):
        bpy.context.scene.frame_set(frame)
        expected = predicted_positions(mesh_object, library.model)
        x_locations = []
        for instance in bpy.context.evaluated_depsgraph_get().object_instances:
            if instance.object.type == "MESH":
                x_locations.append(instance.matrix_world.translation.x)
                positions = np.array([vertex.co[:] for vertex in instance.object.data.vertices])
                assert np.abs(positions - expected).max() < 1e-5
        assert x_locations == [0, 1]
        assert not mesh_object.fdda.status


def test_a_duplicated_override_has_its_own_positions(pair, library, tmp_path):
    bpy.context.view_layer.update()
    for mesh_object in (pair[1], armature_of(pair[1])):
        mesh_object.select_set(True)
    bpy.ops.object.duplicate()
    copy = next(o for o in bpy.context.selected_objects if o.type == "MESH")
    assert copy not in pair and copy.override_library and armature_of(copy) != armature_of(pair[1])
    bend_elbow(copy, 0.7)
    assert_overrides_play(library, (*ANGLES, 0.7))
    assert len({buffer_name(o) for o in overridden_meshes()}) == 3
    save_and_reopen_shot(tmp_path)
    assert_overrides_play(library, (*ANGLES, 0.7))


def test_many_overrides_play_in_one_batch(library, monkeypatch):
    collection = link_character(library.path)
    crowd = [override_character(collection, 1.2 * index / CROWD_SIZE) for index in range(CROWD_SIZE)]
    animate(crowd)
    calls = count_calls(monkeypatch)
    for frame in (1, 2, 3, 4):
        bpy.context.scene.frame_set(frame)
    assert calls[-1] == CROWD_SIZE
    for mesh_object in crowd:
        assert_plays(mesh_object, library.model)
    assert len({buffer_name(mesh_object) for mesh_object in crowd}) == CROWD_SIZE


EXPECTED_OVERRIDES = {"parent", 'modifiers["Armature"].object', 'modifiers["FDDA"].properties.inputs.Socket_1.value'}
"""Properties that every override of the elbow's mesh changes: its armature and the object with its positions."""


def test_overrides_keep_mode_strength_and_use_in_render(pair, library, tmp_path):
    first, second = pair
    first.fdda.mode, second.fdda.strength, second.fdda.use_in_render = "RIG", 0.25, True
    bpy.context.view_layer.update()
    saved_positions = evaluated_positions(first), evaluated_positions(second)
    save_and_reopen_shot(tmp_path)
    first, second = overridden_meshes()
    assert (first.fdda.mode, first.fdda.is_playing) == ("RIG", False)
    assert (second.fdda.mode, second.fdda.strength, second.fdda.use_in_render) == ("FDDA", 0.25, True)
    for mesh_object, positions in zip((first, second), saved_positions, strict=True):
        assert np.abs(evaluated_positions(mesh_object) - positions).max() < 1e-6


def positions_in_mode(mesh_objects: list[bpy.types.Object], mode: str) -> list[np.ndarray]:
    """Set the mode of characters, and return the evaluated positions (V, 3) of each."""
    for mesh_object in mesh_objects:
        mesh_object.fdda.mode = mode
    bpy.context.view_layer.update()
    return [evaluated_positions(mesh_object) for mesh_object in mesh_objects]


def test_saved_overrides_show_their_rig_without_the_add_on(pair, library, tmp_path):
    pair[0].fdda.use_in_render = True
    rig_shapes, model_shapes = (positions_in_mode(pair, mode) for mode in ("RIG", "FDDA"))
    for rig_shape, model_shape in zip(rig_shapes, model_shapes, strict=True):
        assert np.abs(rig_shape - model_shape).max() > 1e-5, "rig and model differ"
    bpy.ops.ed.undo_push(message="playing")
    bpy.ops.wm.save_as_mainfile(filepath=str(shot_path(tmp_path)))
    fdda_addon.unregister()
    bpy.ops.wm.open_mainfile(filepath=str(shot_path(tmp_path)))
    for mesh_object, positions in zip(overridden_meshes(), rig_shapes, strict=True):
        assert not hasattr(mesh_object, "fdda")
        shown = {m.name: (m.show_viewport, m.show_render) for m in mesh_object.modifiers}
        assert shown == {"Armature": (True, True), "CorrectiveSmooth": (True, True), **ADDED}
        assert np.abs(evaluated_positions(mesh_object) - positions).max() < 1e-6


def overridden_paths(mesh_object: bpy.types.Object) -> set[str]:
    """Return the paths of the properties that an override changes, as Blender 5.2 spells them."""
    paths = {entry.rna_path for entry in mesh_object.override_library.properties}
    return {path.replace('["Socket_1"]', ".properties.inputs.Socket_1.value") for path in paths}


def test_a_saved_shot_contains_only_changed_properties(pair, library, tmp_path):
    pair[0].fdda.strength = 0.5
    bpy.context.view_layer.update()
    bpy.ops.ed.undo_push(message="playing")
    save_and_reopen_shot(tmp_path)
    bpy.ops.wm.save_as_mainfile(filepath=str(shot_path(tmp_path)))
    # Saving updates the list of changed properties.
    assert overridden_paths(overridden_meshes()[0]) - EXPECTED_OVERRIDES == {"fdda.strength"}
    assert overridden_paths(overridden_meshes()[1]) - EXPECTED_OVERRIDES == set()
    fdda_addon.unregister()
    bpy.ops.wm.open_mainfile(filepath=str(shot_path(tmp_path)))
    first, second = overridden_meshes()
    # The shot contains no objects with positions.
    assert [o for o in bpy.data.objects if o.library is None and o.type == "MESH"] == [first, second]
    assert {mesh.library is None for mesh in bpy.data.meshes} == {False}


def test_an_auto_saved_shot_plays(library, tmp_path):
    """Auto Save calls no handler, so it saves an override while its model plays, unlike its library."""
    run_in_another_process(f"pack_model({str(library.path)!r})")
    mesh_object = override_character(link_character(library.path), 0.6)
    mesh_object.fdda.mode = "FDDA"
    expected = assert_plays(mesh_object, library.model)
    handlers = [bpy.app.handlers.save_pre[:], bpy.app.handlers.save_post[:]]
    bpy.app.handlers.save_pre.clear()
    bpy.app.handlers.save_post.clear()
    bpy.ops.wm.save_as_mainfile(filepath=str(shot_path(tmp_path)))
    bpy.app.handlers.save_pre[:], bpy.app.handlers.save_post[:] = handlers
    bpy.ops.wm.open_mainfile(filepath=str(shot_path(tmp_path)))
    mesh_object = overridden_meshes()[0]
    assert np.array_equal(assert_plays(mesh_object, library.model), expected)
    mesh_object.fdda.mode = "RIG"
    assert [m.show_viewport for m in mesh_object.modifiers] == [True, True, False, False]


def test_a_packed_model_is_found_in_the_library(library, tmp_path):
    bpy.ops.wm.open_mainfile(filepath=str(library.path))
    mesh_object = bpy.data.objects[ELBOW]
    model_list.add_bound_model(mesh_object)
    model_list.pack_entry(mesh_object, mesh_object.fdda.models[0])
    bpy.ops.wm.save_as_mainfile(filepath=str(library.path))
    moved = library.model.rename(tmp_path / "moved.onnx")
    save_new_shot(tmp_path)
    collection = link_character(library.path)
    for angle in ANGLES:
        override_character(collection, angle)
    bpy.context.scene.collection.children.link(collection)
    assert_overrides_play(Library(library.path, moved))
    save_and_reopen_shot(tmp_path)
    assert_overrides_play(Library(library.path, moved))
    assert overridden_meshes()[0].fdda.packed.library is not None
    assert_plays(overridden_meshes()[0].override_library.reference, moved)


def test_a_model_outside_the_library_s_folder_is_not_loaded(library, tmp_path):
    bpy.ops.wm.open_mainfile(filepath=str(library.path))
    outside_path = library.model.rename(tmp_path / "shots" / "elbow.onnx")
    bpy.data.objects[ELBOW].fdda.model = f"//../shots/{outside_path.name}"
    bpy.ops.wm.save_as_mainfile(filepath=str(library.path))
    session.chosen_paths.clear()
    save_new_shot(tmp_path)
    mesh_object = override_character(link_character(library.path), 0.5)
    bpy.context.view_layer.update()
    assert "lies outside the folder of 'elbow.blend' and is not followed" in mesh_object.fdda.status
    assert (mesh_object.fdda.mode, mesh_object.modifiers["Armature"].show_viewport) == ("RIG", True)


def change_library(library: Library, edit, folder: Path) -> None:
    """Save the shot, then open the library's file, edit it and save it."""
    bpy.ops.wm.save_as_mainfile(filepath=str(shot_path(folder)))
    bpy.ops.wm.open_mainfile(filepath=str(library.path))
    edit()
    bpy.ops.wm.save_as_mainfile(filepath=str(library.path))


def add_hat_and_modifiers() -> None:
    """Add an object and modifiers to the library, so that overrides must be resynchronized."""
    hat = bpy.data.objects.new("hat", bpy.data.meshes.new("hat"))
    hat.parent = bpy.data.objects[ELBOW_RIG]
    bpy.data.collections[COLLECTION].objects.link(hat)
    bpy.data.objects[ELBOW].modifiers.new("Cast", "CAST").factor = 0
    bpy.data.objects[ELBOW].modifiers.new("Subdivision", "SUBSURF").show_viewport = False


def test_a_resynchronized_override_plays(pair, library, tmp_path):
    assert_overrides_play(library)
    change_library(library, add_hat_and_modifiers, tmp_path)
    bpy.ops.wm.open_mainfile(filepath=str(shot_path(tmp_path)))
    assert sum("hat" in o.name and o.library is None for o in bpy.data.objects) == 2
    pair = [o for o in overridden_meshes() if o.fdda.is_bound]
    assert [[m.name for m in o.modifiers][2:] for o in pair] == [["FDDA", "FDDA Undeformed", "Cast", "Subdivision"]] * 2
    for mesh_object in pair:
        assert_plays(mesh_object, library.model)
        bend_elbow(mesh_object, 0.5)
    bpy.context.view_layer.update()
    for mesh_object in pair:
        assert_plays(mesh_object, library.model)


def test_overrides_play_after_the_library_is_reloaded(pair, library, tmp_path):
    bpy.context.scene.collection.children.link(pair[0].override_library.reference.users_collection[0])
    assert_overrides_play(library)
    bpy.data.libraries[0].reload()
    assert_overrides_play(library)
    bend_elbow(overridden_meshes()[0], 0.6)
    assert_overrides_play(library, (0.6, 1.4))
    assert_plays(overridden_meshes()[0].override_library.reference, library.model)
    save_and_reopen_shot(tmp_path)
    assert_overrides_play(library, (0.6, 1.4))


def test_overrides_play_the_new_model_of_a_reloaded_library(pair, library, tmp_path, elbow_files):
    """While the shot is open, another process packs the model, sets mode RIG and saves the library."""
    bpy.ops.wm.save_as_mainfile(filepath=str(shot_path(tmp_path)), copy=True)
    pair[1].fdda.mode = "LINEAR"
    bpy.context.view_layer.update()
    run_in_another_process(f"pack_model({str(library.path)!r})")
    library.model.unlink()
    bpy.data.libraries[0].reload()
    bpy.context.view_layer.update()
    first, second = overridden_meshes()
    # The first override has the mode of its library. The second override has a mode of its own.
    assert [(o.fdda.mode, o.fdda.is_playing) for o in (first, second)] == [("RIG", False), ("LINEAR", True)]
    assert first.modifiers["Armature"].show_viewport and not second.modifiers["Armature"].show_viewport
    first.fdda.mode = second.fdda.mode = "FDDA"
    bpy.context.view_layer.update()
    for mesh_object in (first, second):
        assert mesh_object.fdda.packed is not None
        assert_plays(mesh_object, elbow_files.model)


def test_an_override_of_an_override_plays(library, tmp_path):
    """The shot links a set which contains an override of the character, so the model is two libraries away."""
    mesh_object = override_character(link_character(library.path), 0.2)
    collection = mesh_object.users_collection[0]
    collection.name = COLLECTION
    folder = tmp_path / "sets"
    folder.mkdir()
    bpy.ops.wm.save_as_mainfile(filepath=str(folder / "set.blend"), copy=True)
    save_new_shot(tmp_path)
    collection = link_character(folder / "set.blend")
    for angle in ANGLES:
        override_character(collection, angle)
    save_and_reopen_shot(tmp_path)
    mesh_objects = [o for o in overridden_meshes() if o.library is None]
    for mesh_object in mesh_objects:
        assert mesh_object.override_library.reference.override_library
        assert_plays(mesh_object, library.model)
    assert len(mesh_objects) == 2


def test_binding_to_an_override(elbow_files, tmp_path):
    """A model in the shot for a character whose library has none."""
    source, model = tmp_path / "plain.blend", tmp_path / "shots" / "elbow.onnx"
    save_character(elbow_files.rig, source)
    save_new_shot(tmp_path)
    shutil.copy(elbow_files.model, model)
    mesh_object = override_character(link_character(source), 1.1)
    bpy.context.view_layer.update()
    true = evaluated_positions(mesh_object)
    model_list.bind_entry(rig_of(mesh_object), model_list.add_model(mesh_object, model))
    session.chosen_paths.clear()
    for _ in range(2):
        mesh_object = overridden_meshes()[0]
        assert_plays(mesh_object, model)
        assert [m.name for m in mesh_object.modifiers] == ["Armature", "CorrectiveSmooth", "FDDA", "FDDA Undeformed"]
        assert [entry.path for entry in mesh_object.fdda.models] == [mesh_object.fdda.model] == ["//elbow.onnx"]
        save_and_reopen_shot(tmp_path)
    unbind(overridden_meshes()[0])
    save_and_reopen_shot(tmp_path)
    mesh_object = overridden_meshes()[0]
    assert not mesh_object.fdda.is_bound
    assert [(m.name, m.show_viewport) for m in mesh_object.modifiers] == [
        ("Armature", True),
        ("CorrectiveSmooth", True),
    ]
    assert np.abs(evaluated_positions(mesh_object) - true).max() < 1e-6


def test_an_override_that_was_saved_without_the_addon_is_bound_again(elbow_files, tmp_path):
    source, model = tmp_path / "plain.blend", tmp_path / "shots" / "elbow.onnx"
    save_character(elbow_files.rig, source)
    save_new_shot(tmp_path)
    shutil.copy(elbow_files.model, model)
    bind(rig_of(override_character(link_character(source), 1.1)), model)
    bpy.ops.wm.save_as_mainfile(filepath=str(shot_path(tmp_path)))
    fdda_addon.unregister()
    save_and_reopen_shot(tmp_path)
    save_and_reopen_shot(tmp_path)
    fdda_addon.register()
    mesh_object = overridden_meshes()[0]
    assert not mesh_object.fdda.is_bound
    bind(rig_of(mesh_object), model)
    assert_plays(mesh_object, model)
    assert [m.name for m in mesh_object.modifiers] == ["Armature", "CorrectiveSmooth", "FDDA", "FDDA Undeformed"]
    assert sum("positions" in o.name for o in bpy.data.objects) == 1


def test_another_model_in_the_shot(pair, library, elbow_files, tmp_path):
    """One override unbound and bound to a model beside the shot, which is called as the library's own is."""
    model = tmp_path / "shots" / "elbow.onnx"
    shutil.copy(elbow_files.model, model)
    unbind(pair[0])
    assert [m.show_viewport for m in pair[0].modifiers] == [True, True, False, False]
    save_and_reopen_shot(tmp_path)
    first, second = overridden_meshes()
    assert not first.fdda.is_bound and second.fdda.is_bound
    model_list.bind_entry(rig_of(first), model_list.add_model(first, model))
    session.chosen_paths.clear()
    assert sum(m.type == "NODES" for m in first.modifiers) == 1
    assert model_files.model_path(first) == model
    library.model.unlink()
    save_and_reopen_shot(tmp_path)
    bpy.context.view_layer.update()
    first, second = overridden_meshes()
    assert_plays(first, model)
    assert "elbow.onnx' cannot be read" in second.fdda.status


def test_an_override_keeps_the_name_of_the_librarys_model(pair, library, tmp_path):
    model_list.add_bound_model(pair[0])
    model_list.bind_entry(rig_of(pair[0]), pair[0].fdda.models[0])
    session.chosen_paths.clear()
    assert pair[0].fdda.model == "//elbow.onnx"
    save_and_reopen_shot(tmp_path)
    assert_overrides_play(library)


def test_a_model_of_the_librarys_list_is_not_forgotten(library, elbow_files, tmp_path):
    run_in_another_process(f"pack_model({str(library.path)!r})")
    mesh_object = override_character(link_character(library.path), 0.6)
    own = model_list.add_model(mesh_object, elbow_files.model)
    assert [entry.name for entry in mesh_object.fdda.models] == ["elbow", own.name]
    with pytest.raises(ModelError, match=r"'elbow' is in the list of 'elbow\.blend'; remove it there, or unbind"):
        model_list.remove_entry(mesh_object, 0)
    model_list.remove_entry(mesh_object, 1)
    assert mesh_object.fdda.is_bound and len(mesh_object.fdda.models) == 1


def test_a_linked_character_is_not_bound(library):
    bpy.context.scene.collection.children.link(link_character(library.path))
    linked = next(o for o in bpy.context.scene.objects if o.type == "MESH")
    sentence = "'elbow' is linked from 'elbow.blend' and cannot be changed here; give it a library override"
    with pytest.raises(RigError, match=sentence):
        bind(rig_of(linked), library.model)
    with pytest.raises(RigError, match=sentence):
        unbind(linked)
    assert_plays(linked, library.model)
