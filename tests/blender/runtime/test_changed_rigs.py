# SPDX-License-Identifier: GPL-3.0-or-later
"""Changes of a rig while its model plays: the model keeps playing if it still fits; otherwise the rig shows."""

from collections import Counter
from collections.abc import Callable
from types import SimpleNamespace

import bpy
import numpy as np
import pytest

from fdda_addon.runtime import playback, rig_signature
from fdda_addon.runtime import session as session_module
from fdda_addon.runtime.session import session
from fdda_addon.runtime.transitions import State
from fdda_addon.scene.scene_rig import SceneRig, armature_modifier

from ..conftest import ELBOW, ELBOW_RIG, assert_plays, evaluated_positions, pose
from ..playback import add_shape_key, crowd_of
from ..rig_changes import (
    EDIT_MODE_CHANGES,
    REST_POSE_OF,
    SCRIPT_CHANGES,
    WEIGHTS_DIFFER,
    add_bone,
    change_bone_roll,
    change_in_edit_mode,
    drive_b_bone,
    edit_bones,
    flip_faces,
    move_reference_key,
    trigger_check,
    vertex_groups,
)


def assert_rig_shown(mesh_object: bpy.types.Object, clause: str, capsys: pytest.CaptureFixture[str]) -> None:
    """Assert that the evaluated mesh is the rig's, and that one message gave the reason."""
    assert mesh_object.fdda.mode == "RIG" and clause in mesh_object.fdda.status
    assert mesh_object.fdda.status.endswith("undo the change, or record and train again.")
    assert all(m.show_viewport for m in mesh_object.modifiers if not m.name.startswith("FDDA"))
    assert capsys.readouterr().out.count("switched off") == 1
    shown = evaluated_positions(mesh_object)
    mesh_object.update_tag()
    bpy.context.view_layer.update()
    assert np.array_equal(evaluated_positions(mesh_object), shown)


@pytest.mark.parametrize("is_driven", [False, True])
@pytest.mark.parametrize("update", ["view layer", "frame"])
@pytest.mark.parametrize("change_name", [*EDIT_MODE_CHANGES, *SCRIPT_CHANGES])
def test_a_change_of_the_rig_shows_the_rig(bound_elbow, change_name, update, is_driven, capsys):
    if is_driven:
        drive_b_bone()
    pose(angle=1.0)
    if change_name in EDIT_MODE_CHANGES:
        object_name, change, clause = EDIT_MODE_CHANGES[change_name]
        change_in_edit_mode(bpy.data.objects[object_name], change)
    else:
        change, clause = SCRIPT_CHANGES[change_name]
        change()
    trigger_check(update)
    assert_rig_shown(bound_elbow, clause, capsys)


@pytest.mark.parametrize("update", ["view layer", "frame"])
def test_other_armature_data_show_the_rig_if_they_differ(bound_elbow, elbow_files, update, capsys):
    rig = bpy.data.objects[ELBOW_RIG]
    for is_deforming in (True, False):
        pose(angle=1.0)
        data = rig.data.copy()
        data.bones["lower"].use_deform = is_deforming
        rig.data = data
        trigger_check(update)
        if is_deforming:
            assert_plays(bound_elbow, elbow_files.model)
    assert_rig_shown(bound_elbow, "some vertices follow no bone", capsys)


def test_a_change_of_a_copy_of_evaluated_armature_data_shows_the_rig(bound_elbow, elbow_files, capsys):
    """Blender copies custom properties of evaluated data, too."""
    rig = bpy.data.objects[ELBOW_RIG]
    pose(angle=0.5)
    rig.data = rig.data.evaluated_get(bpy.context.evaluated_depsgraph_get()).copy()
    pose(angle=1.0)
    assert_plays(bound_elbow, elbow_files.model)
    rig.data.bones["lower"].use_deform = False
    trigger_check("view layer")
    assert_rig_shown(bound_elbow, "some vertices follow no bone", capsys)


def test_a_change_of_the_reference_key_shows_the_rig(bound_elbow, capsys):
    add_shape_key(bound_elbow)
    pose(angle=1.0)
    assert not bound_elbow.fdda.status
    move_reference_key()
    trigger_check("view layer")
    assert_rig_shown(bound_elbow, f"{REST_POSE_OF} mesh differs", capsys)


def test_a_change_through_another_object_shows_the_rig(bound_elbow, capsys):
    """Armature and mesh are edited through another object that shares their data."""
    for scene_object, change, clause in (
        (bpy.data.objects[ELBOW_RIG], change_bone_roll, f"{REST_POSE_OF} armature differs"),
        (bound_elbow, flip_faces, "the topology of the mesh differs"),
    ):
        other = bpy.data.objects.new("other", scene_object.data)
        bpy.context.scene.collection.objects.link(other)
        pose(angle=1.0)
        change_in_edit_mode(other, change)
        trigger_check("view layer")
        assert_rig_shown(bound_elbow, clause, capsys)
        if scene_object.type == "ARMATURE":
            change_in_edit_mode(other, lambda: setattr(edit_bones()["lower"], "roll", edit_bones()["lower"].roll - 0.4))
            bound_elbow.fdda.mode = "FDDA"
            trigger_check("view layer")
            assert not bound_elbow.fdda.status
            assert bound_elbow.fdda.mode == "FDDA"


@pytest.mark.parametrize("update", ["view layer", "frame"])
def test_changes_of_bones_that_are_not_joints_keep_the_model_playing(bound_elbow, elbow_files, update):
    """The order of the bones changes, but the order of the joints does not."""
    rig = bpy.data.objects[ELBOW_RIG]

    def names():
        return [bone.name for bone in rig.data.bones]

    change_in_edit_mode(rig, lambda: (add_bone("a"), add_bone("b"), add_bone("c", "upper")))
    trigger_check(update)
    pose(angle=0.7)
    assert_plays(bound_elbow, elbow_files.model)
    lower_indices = {names().index("lower")}
    for bone, parent in (("upper", "a"), ("a", "b"), ("upper", ""), ("b", "upper"), ("c", "a"), ("c", "")):
        change_in_edit_mode(rig, lambda b=bone, p=parent: setattr(edit_bones()[b], "parent", edit_bones().get(p)))
        lower_indices.add(names().index("lower"))
        trigger_check(update)
        pose(angle=0.9)
        assert_plays(bound_elbow, elbow_files.model)
    assert len(lower_indices) > 1
    change_in_edit_mode(rig, lambda: edit_bones().remove(edit_bones()["a"]))
    trigger_check(update)
    assert_plays(bound_elbow, elbow_files.model)
    assert bound_elbow.fdda.mode == "FDDA"


def test_changes_unrelated_to_the_rig_keep_the_model_playing(bound_elbow, elbow_files):
    change_in_edit_mode(bound_elbow, lambda: bpy.ops.mesh.select_all(action="SELECT"))
    bound_elbow.vertex_groups.new(name="no bone").add([0, 5], 0.5, "REPLACE")
    bound_elbow.data.attributes.new("color", "FLOAT_COLOR", "POINT")
    trigger_check("view layer")
    pose(angle=1.1)
    assert_plays(bound_elbow, elbow_files.model)


def test_a_change_in_mode_rig_is_found_when_the_mode_changes(bound_elbow, capsys):
    bound_elbow.fdda.mode = "RIG"
    change_in_edit_mode(bpy.data.objects[ELBOW_RIG], change_bone_roll)
    bound_elbow.fdda.mode = "FDDA"
    trigger_check("view layer")
    assert_rig_shown(bound_elbow, f"{REST_POSE_OF} armature differs", capsys)


def test_the_model_plays_again_after_undo(bound_elbow, elbow_files):
    bpy.ops.ed.undo_push(message="start")
    change_in_edit_mode(bpy.data.objects[ELBOW_RIG], change_bone_roll)
    bpy.context.view_layer.update()
    assert bound_elbow.fdda.mode == "RIG"
    bpy.ops.ed.undo_push(message="roll")
    bpy.ops.ed.undo()
    bpy.context.view_layer.update()
    pose(angle=1.0)
    assert_plays(bpy.data.objects[ELBOW], elbow_files.model)
    # Blender lists no objects whose names begin with a dot.
    assert [o.name[0] for o in bpy.data.objects if o.is_runtime_data] == ["."]
    bpy.ops.ed.redo()
    bpy.context.view_layer.update()
    assert "rest pose" in bpy.data.objects[ELBOW].fdda.status


def test_weights_restored_by_undo_show_the_rig(bound_elbow):
    """The weights change without an evaluation. The check after undo finds them."""
    bound_elbow.fdda.mode = "RIG"
    vertex_groups()["lower"].add([0], 0.3, "ADD")
    bpy.context.view_layer.update()
    bpy.ops.ed.undo_push(message="other weights")
    vertex_groups()["lower"].add([0], 0.3, "SUBTRACT")
    bound_elbow.fdda.mode = "FDDA"
    bpy.context.view_layer.update()
    bpy.ops.ed.undo_push(message="weights as before")
    bpy.ops.ed.undo()
    bpy.data.objects[ELBOW].fdda.mode = "FDDA"
    bpy.context.view_layer.update()
    assert WEIGHTS_DIFFER in bpy.data.objects[ELBOW].fdda.status


def test_a_rig_changed_without_the_add_on_shows_after_loading(bound_elbow, tmp_path, capsys):
    import fdda_addon

    path = bpy.data.filepath.replace("bound.blend", "changed.blend")
    fdda_addon.unregister()
    change_in_edit_mode(bpy.data.objects[ELBOW_RIG], change_bone_roll)
    bpy.ops.wm.save_as_mainfile(filepath=path, copy=True)
    fdda_addon.register()
    capsys.readouterr()
    bpy.ops.wm.open_mainfile(filepath=path)
    bpy.context.view_layer.update()
    assert_rig_shown(bpy.data.objects[ELBOW], f"{REST_POSE_OF} armature differs", capsys)


@pytest.mark.parametrize("is_reloaded", [False, True], ids=["opened", "reloaded"])
def test_a_linked_rig_that_changed_in_its_library_shows(library, pair, is_reloaded):
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
    """Change the roll of a bone in a file, in another process."""
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


def test_weight_paint_mode_delays_the_check(bound_elbow, capsys):
    """The rig is checked after the mesh has left the mode."""
    pose(angle=1.0)
    bpy.context.view_layer.objects.active = bound_elbow
    bpy.ops.object.mode_set(mode="WEIGHT_PAINT")
    vertex_groups()["lower"].add([0, 1], 0.3, "ADD")
    bpy.context.view_layer.update()
    assert bound_elbow.fdda.mode == "FDDA" and not bound_elbow.fdda.status
    bpy.ops.object.mode_set(mode="OBJECT")
    bpy.context.view_layer.update()
    assert_rig_shown(bound_elbow, WEIGHTS_DIFFER, capsys)


def test_playback_and_posing_do_not_check_the_rig(bound_elbow, elbow_files, monkeypatch):
    """Frame changes, posing and driven shape keys do not read the rig again."""
    add_shape_key(bound_elbow)
    key = bound_elbow.data.shape_keys.key_blocks["bulge"]
    driver = key.driver_add("value").driver
    variable = driver.variables.new()
    variable.type, variable.targets[0].id = "TRANSFORMS", bpy.data.objects[ELBOW_RIG]
    variable.targets[0].bone_target, variable.targets[0].transform_type = "lower", "ROT_X"
    driver.type = "SUM"
    pose(angle=0.2)
    pose(angle=0.3)
    monkeypatch.setattr(rig_signature, "read_model_rig", None)
    monkeypatch.setattr(rig_signature, "rest_digest", None)
    for frame in range(5):
        bpy.context.scene.frame_set(frame)
        pose(angle=0.1 * frame)
    assert_plays(bound_elbow, elbow_files.model)


def test_posing_reads_the_bones_of_a_shared_armature_once_and_no_modifiers(bound_elbow, elbow_files, monkeypatch):
    crowd = crowd_of(bound_elbow, 3)
    bpy.context.view_layer.update()
    counts = Counter()
    for name in ("bone_signature", "read_modifiers_and_drivers"):
        function = getattr(rig_signature, name)
        monkeypatch.setattr(
            rig_signature,
            name,
            lambda *arguments, name=name, function=function: counts.update([name]) or function(*arguments),
        )
    for angle in (0.2, 0.4):
        pose(angle=angle)
        for mesh_object in crowd:
            assert_plays(mesh_object, elbow_files.model)
    assert counts == {"bone_signature": 2}


def test_a_frame_reads_no_bones_of_driven_armature_data(bound_elbow, elbow_files, monkeypatch):
    drive_b_bone()
    monkeypatch.setattr(rig_signature, "bone_signature", None)
    shown = []
    for frame in (5, 12, 25):
        bpy.context.scene.frame_set(frame)
        shown.append(assert_plays(bound_elbow, elbow_files.model))
    assert np.abs(shown[0] - shown[-1]).max() > 1e-3


def test_a_bone_without_weights_that_becomes_a_b_bone_shows_the_rig(bound_elbow, elbow_files, capsys):
    change_in_edit_mode(bpy.data.objects[ELBOW_RIG], lambda: add_bone("control"))
    pose(angle=0.3)
    assert_plays(bound_elbow, elbow_files.model)
    bpy.data.objects[ELBOW_RIG].data.bones["control"].bbone_segments = 3
    pose(angle=0.4)
    assert_rig_shown(bound_elbow, "the bone 'control' was no B-Bone when it was recorded", capsys)


@pytest.mark.parametrize("change", ["use_deform", "rest pose", "name"])
def test_a_changed_bone_without_weights_lets_the_rig_be_read_again(bound_elbow, elbow_files, change, monkeypatch):
    """Whether a bone has an effect is for `read_model_rig` to tell: it chooses the joints and their parents."""
    armature_object, reads = bpy.data.objects[ELBOW_RIG], []
    change_in_edit_mode(armature_object, lambda: add_bone("control"))
    pose(angle=0.3)
    read = rig_signature.read_model_rig
    monkeypatch.setattr(rig_signature, "read_model_rig", lambda *arguments: reads.append(1) or read(*arguments))
    pose(angle=0.35)
    assert not reads
    if change == "rest pose":
        change_in_edit_mode(armature_object, lambda: edit_bones()["control"].head.__setitem__(0, 2.0))
    else:
        setattr(armature_object.data.bones["control"], change, False if change == "use_deform" else "renamed")
    pose(angle=0.4)
    assert reads
    assert_plays(bound_elbow, elbow_files.model)


def test_envelopes_are_compared_only_where_they_have_an_effect(bound_elbow):
    armature_object = bpy.data.objects[ELBOW_RIG]
    rig = SceneRig(bound_elbow, armature_object)

    def bones() -> tuple:
        return rig_signature.read_signature(rig, parts=["bones"])["bones"]

    for has_effect in (False, True):
        armature_modifier(bound_elbow).use_bone_envelopes = has_effect
        before = bones()
        assert bones() == before
        armature_object.data.bones["lower"].envelope_distance += 0.1
        assert (bones() != before) is has_effect


@pytest.fixture
def window(monkeypatch) -> SimpleNamespace:
    """A stand-in for what the session asks of Blender: a window, in which timers run."""
    timers: list[Callable[[], float | None]] = []
    registered = SimpleNamespace(is_registered=timers.__contains__, register=lambda timer, **_: timers.append(timer))
    app = SimpleNamespace(background=False, timers=registered)
    for module in (session_module, playback):
        monkeypatch.setattr(module, "bpy", Proxy(bpy, app=app))
    return SimpleNamespace(timers=timers)


class Proxy:
    """A module with some attributes replaced."""

    def __init__(self, module: object, **replaced: object):
        self._module = module
        vars(self).update(replaced)

    def __getattr__(self, name: str) -> object:
        return getattr(self._module, name)


def test_in_a_window_posing_reads_no_bones_until_it_pauses(bound_elbow, elbow_files, window, monkeypatch, capsys):
    drive_b_bone()
    read_parts, read_signature = [], rig_signature.read_signature
    monkeypatch.setattr(
        rig_signature,
        "read_signature",
        lambda *arguments: read_parts.append(set(arguments[-1])) or read_signature(*arguments),
    )
    monkeypatch.setattr(session_module, "CHECK_DELAY_S", 1e6)
    for angle in (0.2, 0.4, 0.6):
        pose(angle=angle)
        assert_plays(bound_elbow, elbow_files.model)
    assert not read_parts and window.timers == [session.check_timer]
    assert session.check_timer() > 0, "posing has not paused long enough"
    assert not read_parts
    monkeypatch.setattr(session_module, "CHECK_DELAY_S", 0)
    assert session.check_timer() is None
    assert read_parts == [{"bones", "object"}] and not bound_elbow.fdda.status
    assert session.characters[bound_elbow.session_uid].state == State.PLAYING
    bpy.data.objects[ELBOW_RIG].data.bones["lower"].use_deform = False
    pose(angle=0.8)
    assert bound_elbow.fdda.mode == "FDDA"
    assert session.check_timer() is None
    bpy.context.view_layer.update()
    assert_rig_shown(bound_elbow, "some vertices follow no bone", capsys)


def test_in_a_window_a_frame_checks_what_has_changed_before(bound_elbow, window, capsys):
    pose(angle=1.0)
    bpy.data.objects[ELBOW_RIG].data.bones["lower"].use_deform = False
    bpy.context.view_layer.update()
    assert bound_elbow.fdda.mode == "FDDA"
    bpy.context.scene.frame_set(7)
    assert_rig_shown(bound_elbow, "some vertices follow no bone", capsys)
