# SPDX-License-Identifier: GPL-3.0-or-later
"""Playback of linked characters: with and without library overrides, as instances, duplicated and rendered."""

import bpy
import numpy as np
import pytest

from fdda_addon.runtime import playback_modifier

from ..conftest import assert_plays, predicted_positions
from ..crowds import animate, count_calls
from ..linked import (
    ANGLES,
    COLLECTION,
    armature_of,
    assert_overrides_play,
    bend_elbow,
    buffer_name,
    link_character,
    overridden_meshes,
    override_character,
    run_in_another_process,
    save_and_reopen_shot,
    shot_path,
)
from ..rendering import render_positions, rig_pixels, set_camera, still

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
