# SPDX-License-Identifier: GPL-3.0-or-later
"""A saved file contains the original rig, and its models play as soon as the add-on is enabled."""

import bpy
import numpy as np
import pytest

import fdda_addon

from ..conftest import ADDED, ELBOW, assert_plays, evaluated_positions, pose
from ..evaluations import add_shape_key


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


def test_saving_does_not_stop_the_playback(keyed, elbow_files):
    keyed.fdda.use_in_render = True
    before = state(keyed)
    pose(angle=0.8)
    first = assert_plays(keyed, elbow_files.model)
    bpy.ops.wm.save_as_mainfile(filepath=str(elbow_files.bound.with_name("again.blend")), copy=True)
    assert state(keyed) == before
    assert np.array_equal(assert_plays(keyed, elbow_files.model), first)
    keyed.fdda.mode = "RIG"
    assert [m.show_viewport for m in keyed.modifiers] == [True, True, False, False]


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


def test_undo_across_a_save(bound_elbow, elbow_files):
    bpy.ops.ed.undo_push(message="start")
    pose(angle=0.5)
    bpy.ops.ed.undo_push(message="posed")
    bpy.ops.wm.save_as_mainfile(filepath=str(elbow_files.bound.with_name("undone.blend")), copy=True)
    pose(angle=1.5)
    bpy.ops.ed.undo_push(message="posed again")
    bpy.ops.ed.undo()
    assert_plays(bpy.data.objects[ELBOW], elbow_files.model)
    assert bpy.data.objects[ELBOW].fdda.is_playing
