# SPDX-License-Identifier: GPL-3.0-or-later
"""Frames stay correct after users, scripts or other add-ons change a character during playback."""

import os
import sys

import bpy
import numpy as np
import pytest

import fdda_addon
from fdda_addon.core.errors import ModelError
from fdda_addon.runtime import modifier_switch, playback_modifier
from fdda_addon.runtime.session import session
from fdda_addon.runtime.transitions import Event, State
from fdda_addon.scene.scene_rig import armature_modifier

from ..conftest import (
    ADDED,
    ELBOW,
    ELBOW_RIG,
    assert_plays,
    evaluated_positions,
    pose,
    predicted_positions,
    rig_positions,
)
from ..crowds import crowd_of
from ..evaluations import handler
from ..rendering import FRAME, animation, set_camera

RENDER_HANDLERS = ("render_pre", "render_post", "render_write")


def in_memory() -> tuple[int, int]:
    return len(bpy.data.objects), len(bpy.data.meshes)


@pytest.mark.parametrize("when", RENDER_HANDLERS)
@pytest.mark.parametrize("what", ["save", "strength", "mode"])
@pytest.mark.parametrize("use_in_render", [False, True])
def test_a_handler_of_a_render_that_touches_it(bound_elbow, elbow_files, tmp_path, when, what, use_in_render):
    bound_elbow.fdda.use_in_render = use_in_render
    set_camera()
    before = animation(tmp_path / "before")

    def touch(*_):
        if what == "save":
            bpy.ops.wm.save_as_mainfile(filepath=str(tmp_path / "backup.blend"), copy=True)
        elif what == "strength":
            bound_elbow.fdda.strength = 0.5
            bound_elbow.fdda.strength = 1.0
        else:
            bound_elbow.fdda.mode = "RIG"
            bound_elbow.fdda.mode = "FDDA"

    with handler(when, touch):
        touched = animation(tmp_path / "touched")
    for frame, pixels in before.items():
        assert np.array_equal(touched[frame], pixels), frame
    bpy.context.scene.frame_set(FRAME)
    assert_plays(bound_elbow, elbow_files.model)


@pytest.mark.parametrize("is_applied", [False, True], ids=["removed", "applied"])
def test_removing_the_playback_modifier_shows_the_rig_immediately(bound_elbow, is_applied, capsys):
    pose(angle=1.2)
    if is_applied:
        with bpy.context.temp_override(object=bound_elbow):
            bpy.ops.object.modifier_apply(modifier="FDDA")
    else:
        bound_elbow.modifiers.remove(playback_modifier.find_modifier(bound_elbow))
    bpy.context.view_layer.update()
    assert bound_elbow.fdda.mode == "RIG" and "was removed; bind the model again" in bound_elbow.fdda.status
    assert [m.show_viewport for m in bound_elbow.modifiers] == [True, True, False]
    first = evaluated_positions(bound_elbow)
    pose(angle=0.3)
    assert np.abs(evaluated_positions(bound_elbow) - first).max() > 1e-2
    assert capsys.readouterr().out.count("switched off") == 1
    bound_elbow.fdda.mode = "LINEAR"
    assert bound_elbow.fdda.mode == "RIG" and "was removed; bind the model again" in bound_elbow.fdda.status


def test_duplicates_and_deletions_leave_nothing(bound_elbow, tmp_path):
    pose(angle=0.5)
    objects, meshes = in_memory()
    for _ in range(30):
        copy = bound_elbow.copy()
        bpy.context.scene.collection.objects.link(copy)
        bpy.context.view_layer.update()
        assert in_memory() == (objects + 2, meshes + 1)
        bpy.data.objects.remove(copy)
        bpy.context.view_layer.update()
    assert in_memory() == (objects, meshes)
    bpy.ops.wm.save_as_mainfile(filepath=str(tmp_path / "saved.blend"))
    fdda_addon.unregister()
    bpy.ops.wm.open_mainfile(filepath=str(tmp_path / "saved.blend"))
    assert in_memory() == (objects - 1, meshes - 1)


def test_data_of_deleted_duplicates_is_not_saved(bound_elbow, elbow_files, tmp_path):
    bpy.ops.ed.undo_push(message="start")
    for _ in range(30):
        bpy.ops.object.select_all(action="DESELECT")
        bpy.data.objects[ELBOW].select_set(True)
        bpy.context.view_layer.objects.active = bpy.data.objects[ELBOW]
        bpy.ops.object.duplicate()
        bpy.context.view_layer.update()
        bpy.ops.object.delete()
        bpy.context.view_layer.update()
        bpy.ops.ed.undo_push(message="deleted")
    assert_plays(bpy.data.objects[ELBOW], elbow_files.model)
    bpy.ops.wm.save_as_mainfile(filepath=str(tmp_path / "saved.blend"), copy=True)
    with bpy.data.libraries.load(str(tmp_path / "saved.blend")) as (found, _):
        assert found.meshes == [ELBOW] and sorted(found.objects) == [ELBOW, ELBOW_RIG]


def test_a_deleted_character_leaves_nothing(bound_elbow):
    bpy.ops.object.select_all(action="DESELECT")
    bound_elbow.select_set(True)
    bpy.context.view_layer.objects.active = bound_elbow
    bpy.ops.object.delete()
    bpy.context.view_layer.update()
    assert [o.name for o in bpy.data.objects] == [ELBOW_RIG]
    pose(angle=1.3)
    bpy.context.scene.frame_set(7)


def test_playback_continues_after_a_purge_of_unused_data(bound_elbow, elbow_files):
    crowd = crowd_of(bound_elbow, 5)
    for frame in (1, 2, 3, 4):
        bpy.context.scene.frame_set(frame)
    bpy.data.orphans_purge(do_recursive=True)
    for frame in (5, 6):
        bpy.context.scene.frame_set(frame)
        for mesh_object in crowd:
            assert_plays(mesh_object, elbow_files.model)


def test_disabled_and_enabled(bound_elbow, elbow_files, capfd):
    pose(angle=1.0)
    expected, count = rig_positions(bound_elbow), in_memory()
    for _ in range(3):
        fdda_addon.unregister()
        assert not hasattr(bpy.types.Object, "fdda_playback")
        assert in_memory() == (count[0] - 1, count[1] - 1)
        visibilities = {m.name: (m.show_viewport, m.show_render) for m in bound_elbow.modifiers}
        assert visibilities == {"Armature": (True, True), "CorrectiveSmooth": (True, True), **ADDED}
        bpy.context.view_layer.update()
        assert np.abs(evaluated_positions(bound_elbow) - expected).max() < 1e-6
        fdda_addon.register()
        bpy.context.view_layer.update()
        assert_plays(bound_elbow, elbow_files.model)
        assert in_memory() == count
    assert "rror" not in "".join(capfd.readouterr())


def test_an_auto_saved_file_shows_the_mesh_without_the_addon(bound_elbow, elbow_files, tmp_path):
    """An auto-save calls no handler. Without the add-on, its file must show the mesh in rest pose, not a point."""
    handlers = [bpy.app.handlers.save_pre[:], bpy.app.handlers.save_post[:]]
    bpy.app.handlers.save_pre.clear()
    bpy.app.handlers.save_post.clear()
    path = elbow_files.bound.with_name("itself.blend")
    bpy.ops.wm.save_as_mainfile(filepath=str(path), copy=True)
    bpy.app.handlers.save_pre[:], bpy.app.handlers.save_post[:] = handlers
    bpy.ops.wm.open_mainfile(filepath=str(path))
    pose(angle=0.8)
    assert_plays(bpy.data.objects[ELBOW], elbow_files.model)
    fdda_addon.unregister()
    bpy.ops.wm.open_mainfile(filepath=str(path))
    mesh_object = bpy.data.objects[ELBOW]
    rest = np.array([vertex.co[:] for vertex in mesh_object.data.vertices], np.float32)
    assert np.abs(evaluated_positions(mesh_object) - rest).max() < 1e-6


def test_a_joint_that_is_not_a_number(bound_elbow, elbow_files):
    """Vertices of this joint follow its parent, and the rest of the character does not change."""
    armature_object = bpy.data.objects[ELBOW_RIG]
    armature_object.animation_data_clear()
    pose(angle=0.0)
    straight = assert_plays(bound_elbow, elbow_files.model)
    armature_object.pose.bones["lower"].rotation_euler[0] = float("nan")
    pose(bone="upper", angle=0.5)
    shown = evaluated_positions(bound_elbow)
    assert np.isfinite(shown).all() and "joint 'lower' of 'elbow_rig' is not a number" in bound_elbow.fdda.status
    assert bound_elbow.fdda.mode == "FDDA"
    pose(angle=0.0)
    assert np.abs(shown - assert_plays(bound_elbow, elbow_files.model)).max() < 1e-5
    assert np.abs(shown - straight).max() > 1e-2


def test_the_others_play_on_when_one_character_raises_any_error(bound_elbow, elbow_files, monkeypatch, capsys):
    from fdda_addon.runtime.player import Player

    crowd = crowd_of(bound_elbow, 3)
    bpy.context.view_layer.update()
    real = Player.write_positions

    def write(self, buffer, mesh_object):
        if mesh_object.name == crowd[1].name:
            raise SystemExit("out")
        real(self, buffer, mesh_object)

    monkeypatch.setattr(Player, "write_positions", write)
    for mesh_object in crowd:
        armature_modifier(mesh_object).object.pose.bones["lower"].rotation_euler[0] += 0.1
    bpy.context.view_layer.update()
    assert [o.fdda.mode for o in crowd] == ["FDDA", "RIG", "FDDA"]
    assert "cannot be played (SystemExit('out'))" in crowd[1].fdda.status
    assert [m.show_viewport for m in crowd[1].modifiers] == [True, True, False, False]
    for mesh_object in (crowd[0], crowd[2]):
        assert_plays(mesh_object, elbow_files.model)
    assert capsys.readouterr().out.count("switched off") == 1


def test_a_failure_is_reported_even_if_switching_the_modifiers_fails_too(bound_elbow, monkeypatch, capsys):
    def refuse(*_: object) -> None:
        raise RuntimeError("read-only")

    character = session.character_of(bound_elbow)
    monkeypatch.setattr(modifier_switch, "switch_modifiers", refuse)
    session.dispatch(Event.FAIL, character, ModelError("the reason"))
    assert character.state == State.FAILED and bound_elbow.fdda.mode == "RIG"
    assert bound_elbow.fdda.status == "the reason" and "the reason" in capsys.readouterr().out


def test_the_rig_is_shown_even_if_the_terminal_is_closed(bound_elbow, monkeypatch):
    with open(os.devnull) as unwritable:
        monkeypatch.setattr(sys, "stdout", unwritable)
        session.dispatch(Event.FAIL, session.character_of(bound_elbow), ModelError("the reason"))
        monkeypatch.undo()
    assert bound_elbow.fdda.status == "the reason"
    assert not any(character.player for character in session.characters.values())
    assert armature_modifier(bound_elbow).show_viewport


def test_a_topology_that_changes_shows_the_rig_in_the_same_frame(bound_elbow):
    bound_elbow.data.vertices.add(3)
    bound_elbow.data.update()
    bpy.context.scene.frame_set(9)
    bpy.context.view_layer.update()
    assert "has 303 vertices and its model was trained for 300" in bound_elbow.fdda.status
    assert len(evaluated_positions(bound_elbow)) == 303 and bound_elbow.modifiers["Armature"].show_viewport


def test_undo_of_many_kinds(bound_elbow, elbow_files):
    """Undo steps before and after a duplicate, a mode and a deletion."""

    def step(name):
        bpy.context.view_layer.update()
        bpy.ops.ed.undo_push(message=name)

    step("start")
    pose(angle=0.6)
    step("pose")
    copy = bpy.data.objects[ELBOW].copy()
    bpy.context.scene.collection.objects.link(copy)
    step("duplicate")
    bpy.data.objects[ELBOW].fdda.mode = "RIG"
    step("mode")
    bpy.data.objects.remove(bpy.data.objects[copy.name])
    step("delete")

    def check():
        bpy.context.view_layer.update()
        for mesh_object in [o for o in bpy.data.objects if o.type == "MESH" and o.fdda.is_bound]:
            if mesh_object.fdda.mode == "FDDA":
                assert_plays(mesh_object, elbow_files.model)
            else:
                assert (
                    np.abs(evaluated_positions(mesh_object) - predicted_positions(mesh_object, elbow_files.model)).max()
                    > 1e-5
                )

    for _ in range(2):
        for _ in range(4):
            bpy.ops.ed.undo()
            check()
        for _ in range(4):
            bpy.ops.ed.redo()
            check()
    bpy.ops.ed.undo()
    pose(angle=1.0)
    check()


def test_enabled_while_the_mesh_is_in_edit_mode(bound_elbow, elbow_files):
    """In Edit Mode Blender has no mesh attributes. The add-on must register, and the model plays afterwards."""
    bpy.context.view_layer.objects.active = bound_elbow
    fdda_addon.unregister()
    bpy.ops.object.mode_set(mode="EDIT")
    fdda_addon.register()
    bpy.ops.object.mode_set(mode="OBJECT")
    bpy.data.objects[ELBOW].fdda.mode = "FDDA"
    pose(angle=0.8)
    assert_plays(bpy.data.objects[ELBOW], elbow_files.model)
