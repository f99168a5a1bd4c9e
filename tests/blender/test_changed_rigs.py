# SPDX-License-Identifier: GPL-3.0-or-later
"""A rig that is changed while a model plays on it: the model goes on where it may, else the rig is back, with why."""

import bpy
import numpy as np
import pytest

from fdda_addon.rig.reading import read_model_rig
from fdda_addon.runtime import rig_signature
from fdda_addon.runtime.model_files import network_of
from fdda_addon.scene.scene_rig import find_rig

from .conftest import ELBOW, ELBOW_RIG, assert_plays, evaluated, pose
from .rig_changes import (
    EDIT_MODE_CHANGES,
    REST_POSE_OF,
    SCRIPT_CHANGES,
    WEIGHTS_DIFFER,
    add_bone,
    change_bone_roll,
    change_in_edit_mode,
    edit_bones,
    flip_faces,
    move_reference_key,
    vertex_groups,
)
from .test_evaluations import keyed
from .test_player_batch import crowd_of


def assert_given_back(mesh_object: bpy.types.Object, clause: str, capsys: pytest.CaptureFixture[str]) -> None:
    """The rig shows, as it does where nothing was ever bound, and it was said why, once."""
    assert mesh_object.fdda.mode == "RIG" and clause in mesh_object.fdda.status
    assert mesh_object.fdda.status.endswith("undo the change, or record and train again.")
    assert all(m.show_viewport for m in mesh_object.modifiers if m.name != "FDDA")
    assert capsys.readouterr().out.count("switched off") == 1
    shown = evaluated(mesh_object)
    mesh_object.update_tag()
    bpy.context.view_layer.update()
    assert np.array_equal(evaluated(mesh_object), shown)


def look(when: str) -> None:
    if when == "frame":
        bpy.context.scene.frame_set(7)
    else:
        bpy.context.view_layer.update()


@pytest.mark.parametrize("when", ["update", "frame"])
@pytest.mark.parametrize("what", EDIT_MODE_CHANGES)
def test_an_edit_gives_the_rig_back(bound, what, when, capsys):
    name, change, clause = EDIT_MODE_CHANGES[what]
    pose(angle=1.0)
    change_in_edit_mode(bpy.data.objects[name], change)
    look(when)
    assert_given_back(bound, clause, capsys)


@pytest.mark.parametrize("when", ["update", "frame"])
@pytest.mark.parametrize("what", SCRIPT_CHANGES)
def test_a_script_gives_the_rig_back(bound, what, when, capsys):
    change, clause = SCRIPT_CHANGES[what]
    pose(angle=1.0)
    change()
    look(when)
    assert_given_back(bound, clause, capsys)


def test_the_reference_key_gives_the_rig_back(bound, capsys):
    keyed(bound)
    pose(angle=1.0)
    assert not bound.fdda.status
    move_reference_key()
    look("update")
    assert_given_back(bound, f"{REST_POSE_OF} mesh differs", capsys)


def test_data_of_another_object_give_the_rig_back(bound, capsys):
    """The armature is edited, and the mesh is, through an object that has nothing to do with the character."""
    for scene_object, change, clause in (
        (bpy.data.objects[ELBOW_RIG], change_bone_roll, f"{REST_POSE_OF} armature differs"),
        (bound, flip_faces, "the topology of the mesh differs"),
    ):
        other = bpy.data.objects.new("other", scene_object.data)
        bpy.context.scene.collection.objects.link(other)
        pose(angle=1.0)
        change_in_edit_mode(other, change)
        look("update")
        assert_given_back(bound, clause, capsys)
        if scene_object.type == "ARMATURE":
            change_in_edit_mode(other, lambda: setattr(edit_bones()["lower"], "roll", edit_bones()["lower"].roll - 0.4))
            bound.fdda.mode = "FDDA"
            look("update")
            assert not bound.fdda.status
            assert bound.fdda.mode == "FDDA"


@pytest.mark.parametrize("when", ["update", "frame"])
def test_bones_that_are_no_joints_may_come_go_and_change_places(bound, elbow, when):
    """The order of the bones is another, that of the joints is not."""
    rig = bpy.data.objects[ELBOW_RIG]

    def names():
        return [bone.name for bone in rig.data.bones]

    change_in_edit_mode(rig, lambda: (add_bone("a"), add_bone("b"), add_bone("c", "upper")))
    look(when)
    pose(angle=0.7)
    assert_plays(bound, elbow.model)
    seen = {names().index("lower")}
    for bone, parent in (("upper", "a"), ("a", "b"), ("upper", ""), ("b", "upper"), ("c", "a"), ("c", "")):
        change_in_edit_mode(rig, lambda b=bone, p=parent: setattr(edit_bones()[b], "parent", edit_bones().get(p)))
        seen.add(names().index("lower"))
        look(when)
        pose(angle=0.9)
        assert_plays(bound, elbow.model)
    assert len(seen) > 1
    change_in_edit_mode(rig, lambda: edit_bones().remove(edit_bones()["a"]))
    look(when)
    assert_plays(bound, elbow.model)
    assert bound.fdda.mode == "FDDA"


def test_an_edit_that_changes_nothing_of_the_rig(bound, elbow):
    change_in_edit_mode(bound, lambda: bpy.ops.mesh.select_all(action="SELECT"))
    bound.vertex_groups.new(name="no bone").add([0, 5], 0.5, "REPLACE")
    bound.data.attributes.new("color", "FLOAT_COLOR", "POINT")
    look("update")
    pose(angle=1.1)
    assert_plays(bound, elbow.model)


def test_objects_that_move_on_their_own_play_on(bound, elbow):
    """The relation of mesh and armature is no part of the rig: animation moves both."""
    bpy.data.objects[ELBOW_RIG].location = (0.3, 0.1, 0)
    bpy.data.objects[ELBOW_RIG].rotation_euler = (0.2, 0.1, 0.4)
    bpy.context.view_layer.update()
    bound.data.update()
    rig_signature.invalidate_all()
    pose(angle=1.1)
    assert_plays(bound, elbow.model)


def test_a_change_while_no_model_played(bound, capsys):
    bound.fdda.mode = "RIG"
    change_in_edit_mode(bpy.data.objects[ELBOW_RIG], change_bone_roll)
    bound.fdda.mode = "FDDA"
    look("update")
    assert_given_back(bound, f"{REST_POSE_OF} armature differs", capsys)


def test_undone_it_plays_again(bound, elbow):
    bpy.ops.ed.undo_push(message="start")
    change_in_edit_mode(bpy.data.objects[ELBOW_RIG], change_bone_roll)
    bpy.context.view_layer.update()
    assert bound.fdda.mode == "RIG"
    bpy.ops.ed.undo_push(message="roll")
    bpy.ops.ed.undo()
    bpy.context.view_layer.update()
    pose(angle=1.0)
    assert_plays(bpy.data.objects[ELBOW], elbow.model)
    bpy.ops.ed.redo()
    bpy.context.view_layer.update()
    assert "rest pose" in bpy.data.objects[ELBOW].fdda.status


def test_weights_that_an_undo_brings_back(bound):
    """What is written without an evaluation is found by the undo that reads it."""
    bound.fdda.mode = "RIG"
    vertex_groups()["lower"].add([0], 0.3, "ADD")
    bpy.context.view_layer.update()
    bpy.ops.ed.undo_push(message="other weights")
    vertex_groups()["lower"].add([0], 0.3, "SUBTRACT")
    bound.fdda.mode = "FDDA"
    bpy.context.view_layer.update()
    bpy.ops.ed.undo_push(message="weights as before")
    bpy.ops.ed.undo()
    bpy.data.objects[ELBOW].fdda.mode = "FDDA"
    bpy.context.view_layer.update()
    assert WEIGHTS_DIFFER in bpy.data.objects[ELBOW].fdda.status


def test_a_file_in_which_the_rig_was_changed_without_the_addon(bound, tmp_path, capsys):
    import fdda_addon

    path = bpy.data.filepath.replace("bound.blend", "changed.blend")
    fdda_addon.unregister()
    change_in_edit_mode(bpy.data.objects[ELBOW_RIG], change_bone_roll)
    bpy.ops.wm.save_as_mainfile(filepath=path, copy=True)
    fdda_addon.register()
    capsys.readouterr()
    bpy.ops.wm.open_mainfile(filepath=path)
    bpy.context.view_layer.update()
    assert_given_back(bpy.data.objects[ELBOW], f"{REST_POSE_OF} armature differs", capsys)


@pytest.mark.parametrize("is_reloaded", [False, True], ids=["opened", "reloaded"])
def test_a_linked_rig_that_its_own_file_changed(library, pair, is_reloaded):
    shot = str(library.path.with_name("shot.blend"))
    bpy.context.view_layer.update()
    assert not any(o.fdda.status for o in pair)
    bpy.ops.wm.save_as_mainfile(filepath=shot)
    if is_reloaded:
        bpy.ops.wm.open_mainfile(filepath=shot)
        bpy.context.view_layer.update()
        change_in_another_process(library.path)
        bpy.data.libraries[0].reload()
    else:
        change_in_another_process(library.path)
        bpy.ops.wm.open_mainfile(filepath=shot)
    bpy.context.view_layer.update()
    overrides = [o for o in bpy.data.objects if o.type == "MESH" and o.override_library and o.fdda.is_bound]
    assert len(overrides) == 2
    for mesh_object in overrides:
        assert mesh_object.fdda.mode == "RIG" and "rest pose of the armature differs" in mesh_object.fdda.status


def change_in_another_process(path) -> None:
    import subprocess
    import sys

    lines = [
        "import bpy",
        f"bpy.ops.wm.open_mainfile(filepath={str(path)!r})",
        f"bpy.context.view_layer.objects.active = bpy.data.objects[{ELBOW_RIG!r}]",
        "bpy.ops.object.mode_set(mode='EDIT')",
        f"bpy.data.objects[{ELBOW_RIG!r}].data.edit_bones['lower'].roll += 0.4",
        "bpy.ops.object.mode_set(mode='OBJECT')",
        "bpy.ops.wm.save_mainfile()",
    ]
    subprocess.run([sys.executable, "-c", "\n".join(lines)], check=True, capture_output=True, timeout=120)


def test_one_of_a_crowd(bound, elbow):
    crowd = crowd_of(bound, 5)
    for frame in (1, 2, 3):
        bpy.context.scene.frame_set(frame)
    crowd[2].data = crowd[2].data.copy()
    crowd[2].vertex_groups["lower"].add([0], 0.3, "ADD")
    bpy.context.scene.frame_set(4)
    assert [o.fdda.mode for o in crowd] == ["FDDA", "FDDA", "RIG", "FDDA", "FDDA"]
    bpy.context.scene.frame_set(5)
    for mesh_object in crowd[:2] + crowd[3:]:
        assert_plays(mesh_object, elbow.model)


def test_the_mode_of_the_mesh_holds_the_check_back(bound, capsys):
    """Where it is left, the rig is looked at."""
    pose(angle=1.0)
    bpy.context.view_layer.objects.active = bound
    bpy.ops.object.mode_set(mode="WEIGHT_PAINT")
    vertex_groups()["lower"].add([0, 1], 0.3, "ADD")
    bpy.context.view_layer.update()
    assert bound.fdda.mode == "FDDA" and not bound.fdda.status
    bpy.ops.object.mode_set(mode="OBJECT")
    bpy.context.view_layer.update()
    assert_given_back(bound, WEIGHTS_DIFFER, capsys)


def test_playback_and_posing_read_no_rig(bound, elbow, monkeypatch):
    """Neither frames nor poses by hand, nor shape keys that bones drive, have the rig read again."""
    keyed(bound)
    key = bound.data.shape_keys.key_blocks["bulge"]
    driver = key.driver_add("value").driver
    variable = driver.variables.new()
    variable.type, variable.targets[0].id = "TRANSFORMS", bpy.data.objects[ELBOW_RIG]
    variable.targets[0].bone_target, variable.targets[0].transform_type = "lower", "ROT_X"
    driver.type = "SUM"
    pose(angle=0.2)
    pose(angle=0.3)
    monkeypatch.setattr(rig_signature, "read_model_rig", None)
    monkeypatch.setattr(rig_signature, "rest_digest", None)
    for step in range(5):
        bpy.context.scene.frame_set(step)
        pose(angle=0.1 * step)
    assert_plays(bound, elbow.model)


def test_the_joints_of_a_model_keep_their_order(bound):
    rig = bpy.data.objects[ELBOW_RIG]
    change_in_edit_mode(rig, lambda: (add_bone("a", "upper"), add_bone("b", "a")))
    info = network_of(bound).info
    assert read_model_rig(find_rig(), info).joints == info.joints
