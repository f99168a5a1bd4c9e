# SPDX-License-Identifier: GPL-3.0-or-later
"""Several meshes of one armature in one go, and all steps with one button."""

import bpy
import pytest

from fdda_addon.core.recording.index import read_index
from fdda_addon.evaluation import last_evaluation
from fdda_addon.jobs import job
from fdda_addon.panels import checks
from fdda_addon.panels.trained_file import find_trained_file
from fdda_addon.properties.character import recording_folder, trained_file
from fdda_addon.scene.active_rig import active_rig, rigs_together
from fdda_addon.scene.scene_rig import SceneRig, armature_of

from ..conftest import ELBOW, ELBOW_RIG
from ..drawing import texts_of
from ..panels.test_sidebar import draw_section
from ..scene_state import fresh_elbow


@pytest.fixture
def two(tmp_path) -> tuple[bpy.types.Object, bpy.types.Object]:
    """The elbow and a copy of it on the same armature, which is active, in a saved file; few poses and epochs."""
    rig = fresh_elbow()
    other = rig.mesh_object.copy()
    other.data = rig.mesh_object.data.copy()
    bpy.context.scene.collection.objects.link(other)
    for mesh_object in (rig.mesh_object, other):
        mesh_object.select_set(False)
    bpy.context.view_layer.objects.active = rig.armature_object
    rig.mesh_object.fdda.settings.poses = 30
    for mesh_object in (rig.mesh_object, other):
        mesh_object.fdda.settings.passes = 4
    bpy.ops.wm.save_as_mainfile(filepath=str(tmp_path / "two.blend"))
    return bpy.data.objects[ELBOW], bpy.data.objects["elbow.001"]


def test_recorded_trained_bound_switched_and_evaluated_in_one_go(two, tmp_path):
    assert [rig.mesh_object for rig in rigs_together(bpy.context)] == list(two)
    assert bpy.ops.fdda.record(all_meshes=True) == {"FINISHED"}
    assert two[1].fdda.settings.poses == 30, "the other takes over how the first is recorded"
    paths = [recording_folder(mesh_object) for mesh_object in two]
    assert paths[0] == paths[1] and [mesh["name"] for mesh in read_index(paths[0])["meshes"]] == [o.name for o in two]
    assert bpy.ops.fdda.train(all_meshes=True) == {"FINISHED"}
    assert job.state_of("train").outcome.startswith("Trained 'two_elbow.onnx' in")
    assert bpy.ops.fdda.bind(all_meshes=True) == {"FINISHED"}
    for mode in ("RIG", "LINEAR", "FDDA"):
        bpy.ops.fdda.set_mode(mode=mode, all_meshes=True)
        assert [mesh_object.fdda.mode for mesh_object in two] == [mode, mode]
    bpy.ops.fdda.evaluate(source="RANDOM", poses=3, all_meshes=True)
    assert all(last_evaluation.get(mesh_object).poses == 3 for mesh_object in two)
    assert "of 'elbow.001'" in job.state_of("evaluate").outcome
    bpy.ops.fdda.set_mode(mode="RIG")
    assert [mesh_object.fdda.mode for mesh_object in two] == ["RIG", "FDDA"]
    assert bpy.ops.fdda.unbind(all_meshes=True) == {"FINISHED"}
    assert not any(mesh_object.fdda.is_bound for mesh_object in two)


def test_one_button_records_trains_and_binds(two):
    bpy.context.view_layer.objects.active = two[0]
    assert bpy.ops.fdda.build_model() == {"FINISHED"}
    assert bpy.data.is_dirty, "Blender asks before it closes the file"
    assert two[0].fdda.mode == "FDDA" and two[0].fdda.packed is not None and not two[1].fdda.is_bound
    checks.check_now(SceneRig(two[0], armature_of(two[0])))
    # The button says what the errors mean, and its training shows its curves and that the Python works.
    assert any(", unseen poses: " in text for text in texts_of(draw_section("rig")))
    texts = texts_of(draw_section("training"))
    assert "Error (mm) per Pass" in texts and not any("not checked yet" in text for text in texts)
    # Recorded already: it is trained again, and the new model plays.
    before = two[0].fdda.packed.session_uid
    two[0].fdda.settings.training_seed = 5
    assert bpy.ops.fdda.build_model() == {"FINISHED"}
    assert two[0].fdda.packed.session_uid != before


@pytest.mark.parametrize("left_out", [None, "unchecked", "hidden", "unrecordable"])
def test_the_sidebar_is_about_the_character_with_a_mesh_active(two, left_out):
    """All meshes are recorded and bound whichever is active; one that is left out is named, with the reason."""
    first, other = two
    bpy.context.view_layer.objects.active = first
    reasons = {"unchecked": "", "hidden": "Left out: the mesh 'elbow.001', which is hidden.", None: ""}
    if left_out == "unchecked":
        other.fdda.in_model = False
    elif left_out == "hidden":
        other.hide_set(True)
    elif left_out:
        other.modifiers.new("Decimate", "DECIMATE")
        other.modifiers.move(len(other.modifiers) - 1, 0)
        reasons[left_out] = "Left out: 'elbow.001'"
    for rig in (SceneRig(o, armature_of(o)) for o in two):
        checks.check_now(rig)
    for section in ("rig", "recording"):
        texts = texts_of(draw_section(section))
        assert f"{1 + (left_out != 'unchecked')} of 2 Meshes Checked" in texts
        assert any(text.startswith(reasons[left_out][:9]) for text in texts)
    assert bpy.ops.fdda.build_model(all_meshes=True) == {"FINISHED"}
    assert first.fdda.mode == "FDDA" and other.fdda.is_bound == (left_out is None)
    meshes = [mesh["name"] for mesh in read_index(recording_folder(first))["meshes"]]
    assert meshes == [o.name for o in two[: 1 if left_out else 2]]
    assert reasons[left_out].removesuffix(".") in job.state_of("build_model").outcome.replace(
        "out 'elbow", "out: 'elbow"
    )
    assert "2 of 2 Meshes Checked" in texts_of(draw_section("playback")) or left_out == "unchecked"


def test_an_unchecked_mesh_is_by_itself(two):
    first, other = two
    other.fdda.in_model, other.fdda.settings.poses = False, 5
    bpy.context.view_layer.objects.active = other
    assert rigs_together(bpy.context) == []
    assert bpy.ops.fdda.record(all_meshes=True) == {"FINISHED"}
    assert job.state_of("record").subject == other.session_uid
    assert [mesh["name"] for mesh in read_index(recording_folder(other))["meshes"]] == [other.name]
    assert first.fdda.settings.poses == 30


def test_a_click_in_the_list_shows_another_mesh(two):
    for active in (two[0], two[0].parent or armature_of(two[0])):
        bpy.context.view_layer.objects.active = active
        bpy.ops.fdda.show_mesh(object=two[1].name)
        assert active_rig(bpy.context).mesh_object == two[1]
    bpy.context.view_layer.objects.active = None
    assert bpy.ops.fdda.show_mesh(object=two[0].name) == {"FINISHED"}


def test_a_click_on_a_mesh_that_cannot_be_selected_is_refused(two):
    first, other = two
    bpy.context.view_layer.objects.active = first
    bpy.ops.object.mode_set(mode="WEIGHT_PAINT")
    with pytest.raises(RuntimeError, match="'elbow' is not in Object Mode; leave its mode first"):
        bpy.ops.fdda.show_mesh(object=other.name)
    assert bpy.context.view_layer.objects.active == first
    bpy.ops.object.mode_set(mode="OBJECT")
    collection = bpy.data.collections.new("excluded")
    bpy.context.scene.collection.children.link(collection)
    bpy.context.scene.collection.objects.unlink(other)
    collection.objects.link(other)
    bpy.context.view_layer.layer_collection.children["excluded"].exclude = True
    bpy.context.view_layer.objects.active = first
    with pytest.raises(RuntimeError, match="is in a collection that the view layer excludes; include it"):
        bpy.ops.fdda.show_mesh(object=other.name)
    # The armature stays active, so nothing has to be selected.
    bpy.context.view_layer.objects.active = bpy.data.objects[ELBOW_RIG]
    assert bpy.ops.fdda.show_mesh(object=other.name) == {"FINISHED"}


@pytest.mark.parametrize("text", ["smile", 'mesh_object/["x"]', ""])
def test_other_meshes_need_neither_the_extra_inputs_nor_a_sampled_bone(two, text):
    """The head has an extra input, all weights of the eye are on a constrained bone, and no bone has limits."""
    first, other = two
    armature_object = bpy.context.view_layer.objects.active
    bpy.ops.object.mode_set(mode="EDIT")
    armature_object.data.edit_bones.new("eye").tail = (0.0, 0.0, 0.1)
    bpy.ops.object.mode_set(mode="OBJECT")
    for bone in armature_object.pose.bones:
        for constraint in list(bone.constraints):
            bone.constraints.remove(constraint)
    armature_object.pose.bones["eye"].constraints.new("COPY_ROTATION").target = armature_object
    other.vertex_groups.clear()
    other.vertex_groups.new(name="eye").add(range(len(other.data.vertices)), 1.0, "REPLACE")
    first.shape_key_add(name="Basis")
    first.shape_key_add(name="smile").data[0].co.x += 0.1
    first["x"] = 0.5
    first.fdda.settings.auto_poses, first.fdda.settings.bones_to_pose = False, "WEIGHTS"
    control = first.fdda.settings.extra_inputs.add()
    control.name, control.has_range, control.low, control.high = text, True, 0.0, 1.0
    for recorded in (False, True):
        for mesh_object in two:
            checks.check_now(SceneRig(mesh_object, armature_object))
        assert not any("Left out" in text for text in texts_of(draw_section("rig"))), recorded
        assert recorded or bpy.ops.fdda.record(all_meshes=True) == {"FINISHED"}
    assert [mesh["name"] for mesh in read_index(recording_folder(first))["meshes"]] == [o.name for o in two]


def test_a_change_of_what_leaves_a_mesh_out_alone_is_noticed(two):
    rig = SceneRig(two[0], armature_of(two[0]))
    two[0].fdda.settings.extra_inputs.add().name = "missing"
    before = checks.check_now(rig)
    two[0].scale.x = 0.0
    bpy.context.view_layer.update()
    after = checks.check_now(rig)
    assert before.problems == after.problems and not before.problems_beside_others
    assert after.problems_beside_others == ("'elbow' has a scale of zero; give it another.",)


def test_a_mesh_that_a_later_recording_lacks_is_left_out(two, tmp_path):
    first, other = two
    other.data.vertices[0].co.z += 0.01
    bpy.ops.fdda.record(all_meshes=True)
    other.hide_set(True)
    bpy.ops.fdda.delete_recording()
    bpy.ops.fdda.record(all_meshes=True)
    assert [mesh["name"] for mesh in read_index(recording_folder(other))["meshes"]] == [first.name]
    other.hide_set(False)
    bpy.context.view_layer.objects.active = first
    for mesh_object in two:
        checks.check_now(SceneRig(mesh_object, armature_of(first)))
    assert "Train" in texts_of(draw_section("training")) and "Train & Bind" in texts_of(draw_section("rig"))
    # A recording of its own is not that of the shown mesh, which the button uses.
    bpy.ops.fdda.record(object=other.name, folder=str(tmp_path / "other"))
    other.fdda.settings.recording = str(tmp_path / "other")
    checks.check_now(SceneRig(other, armature_of(first)))
    assert "Train & Bind" in texts_of(draw_section("rig"))
    other.fdda.settings.recording = ""
    assert bpy.ops.fdda.train(all_meshes=True) == {"FINISHED"}
    assert job.state_of("train").outcome.endswith("Left out: the mesh 'elbow.001', which is not in this recording.")
    assert not other.fdda.models
    checks.check_now(SceneRig(first, armature_of(first)))
    assert "Bind two_elbow" in texts_of(draw_section("playback"))
    assert bpy.ops.fdda.bind(all_meshes=True) == {"FINISHED"}
    assert first.fdda.is_bound and not other.fdda.is_bound
    bpy.ops.fdda.unbind()
    assert bpy.ops.fdda.build_model(all_meshes=True) == {"FINISHED"}
    assert first.fdda.is_bound and not other.fdda.models and not other.fdda.is_bound
    outcome = job.state_of("build_model").outcome
    assert outcome.endswith("Left out: the mesh 'elbow.001', which is not in this recording.")


def test_an_added_model_is_bound_to_all_its_meshes_and_train_leaves_out_hidden_ones(two, tmp_path):
    first, other = two
    other.data.vertices[0].co.z += 0.01
    bpy.context.view_layer.objects.active = first
    bpy.ops.fdda.record(all_meshes=True)
    bpy.ops.fdda.train(all_meshes=True)
    for mesh_object in two:
        checks.check_now(SceneRig(mesh_object, armature_of(first)))
        mesh_object.fdda.models.clear()
    assert "Train & Bind (2 Meshes)" in texts_of(draw_section("rig"))
    trained_file(first).rename(tmp_path / "added.onnx")
    other.name = "renamed"
    bpy.ops.fdda.add_model(filepath=str(tmp_path / "added.onnx"))
    assert "Bind added" in texts_of(draw_section("playback"))
    other.hide_set(True)
    assert "Train & Bind" in texts_of(draw_section("rig"))
    bpy.ops.fdda.bind(all_meshes=True)
    assert first.fdda.is_bound and other.fdda.is_bound


def test_a_model_that_an_undo_takes_off_the_list_is_known_and_does_not_fit_a_changed_mesh(two):
    first, _ = two
    bpy.context.view_layer.objects.active = first
    bpy.ops.fdda.record()
    bpy.context.view_layer.objects.active = bpy.data.objects[ELBOW_RIG]
    assert bpy.ops.fdda.train(all_meshes=True) == {"FINISHED"}
    # The other mesh has the recorded shape.
    assert [[entry.name for entry in mesh_object.fdda.models] for mesh_object in two] == [["two_elbow"]] * 2
    bpy.context.view_layer.objects.active = first
    first.fdda.models.clear()
    rig = SceneRig(first, bpy.data.objects[ELBOW_RIG])
    checks.check_now(rig)
    assert find_trained_file(rig).path.name == "two_elbow.onnx" and not find_trained_file(rig).mismatch
    assert bpy.ops.fdda.bind() == {"FINISHED"} and first.fdda.is_bound
    bpy.ops.fdda.unbind()
    first.data.vertices[0].co.x += 0.3
    first.data.update()
    bpy.context.view_layer.update()
    checks.check_now(rig)
    assert "the rest pose of the mesh differs" in find_trained_file(rig).mismatch
