# SPDX-License-Identifier: GPL-3.0-or-later
"""Every section draws without a window, and few of its fields are open at first."""

import webbrowser
from pathlib import Path
from types import MethodType, SimpleNamespace
from urllib.parse import urlsplit
from urllib.request import url2pathname

import bpy
import numpy as np
import pytest

from fdda_addon.evaluation import last_evaluation
from fdda_addon.operators.meshes import MENU_OPERATORS
from fdda_addon.panels import MODULES, checks, findings, limits, models, playback
from fdda_addon.panels.timed_value import timed_values
from fdda_addon.poses.motion_range import clear_rotation_range, set_rotation_range
from fdda_addon.properties.recording_options import copy_settings, meshes_with_other_settings
from fdda_addon.scene.compatibility import is_selected
from fdda_addon.scene.scene_rig import SceneRig

from ..conftest import ELBOW_RIG
from ..drawing import Context, DrawnElement, Layout, texts_of

MAX_OPEN_FIELDS = 5
"""Number of fields that a section shows at most before the user opens a sub-panel."""


def draw_section(name: str) -> list[DrawnElement]:
    """Return what a section draws, and check that its header has the button of the manual."""
    section, drawn, drawn_header = getattr(bpy.types, f"FDDA_PT_{name}"), [], []
    header = SimpleNamespace(layout=Layout(drawn_header), bl_label=section.bl_label, is_done=section.is_done)
    header.has_warning = section.has_warning
    section.draw_header_preset(header, Context())
    assert "Manual" in texts_of(drawn_header)
    panel = SimpleNamespace(layout=Layout(drawn), verbs=section.verbs, is_done=section.is_done)
    for method_name in ("enabled_layout", *(name for name in vars(section) if name.startswith("_draw"))):
        setattr(panel, method_name, MethodType(getattr(section, method_name), panel))
    section.draw(panel, Context())
    return drawn


@pytest.mark.parametrize("name", MODULES)
def test_a_section_of_a_rig_draws_few_fields(rig: SceneRig, name: str):
    bpy.context.view_layer.objects.active = rig.mesh_object
    checks.check_now(rig)
    drawn = draw_section(name)
    assert drawn
    fields = [text for kind, text, is_open in drawn if kind == "field" and is_open]
    assert len(fields) <= MAX_OPEN_FIELDS, fields


def test_missing_limits_are_named_beside_the_button_that_records(rig: SceneRig, tmp_path):
    bpy.ops.wm.save_as_mainfile(filepath=str(tmp_path / "rig.blend"))
    bpy.context.view_layer.objects.active = rig.mesh_object
    text, bones = "No rotation limits yet: set them in Training Poses first.", rig.armature_object.pose.bones
    for bone in bones:
        bone.lock_rotation = (False, False, False)
        for axis in range(3):
            clear_rotation_range(bone, axis)
    checks.check_now(rig)
    # Limbs come from the action of the elbow.
    assert text not in texts_of(draw_section("rig"))
    bpy.data.actions.remove(bpy.data.actions["elbow_wave"])
    checks.check_now(rig)
    assert text in texts_of(draw_section("rig"))
    set_rotation_range(bones[1], 0, 0.0, 2.0)
    checks.check_now(rig)
    assert text not in texts_of(draw_section("rig"))


@pytest.mark.parametrize(
    ("name", "text"),
    [
        ("rig", "Replaced by the Model:"),
        ("poses", "Also Record Actions"),
        ("recording", "Record"),
        ("training", "Train"),
        ("playback", "Confidence in This Pose"),
        ("evaluation", "Max Color (mm)"),
        ("models", "Matches this rig"),
    ],
)
def test_a_section_of_a_bound_model_draws(active: bpy.types.Object, name: str, text: str):
    checks.check_now(SceneRig(active, bpy.data.objects[ELBOW_RIG]))
    bpy.ops.fdda.evaluate()
    bpy.ops.fdda.measure(frames=5)
    bpy.ops.fdda.color_mesh(colors="ERRORS")
    timed_values.compute_now(playback._read_confidence, active)
    timed_values.compute_now(models._find_problems, active)
    assert text in texts_of(draw_section(name))


def test_the_reason_stays_in_view_without_an_armature(active: bpy.types.Object):
    bpy.data.objects.remove(bpy.data.objects[ELBOW_RIG])
    bpy.context.view_layer.update()
    assert active.fdda.status and " ".join(active.fdda.status.split()) in " ".join(texts_of(draw_section("rig")))


def test_a_fast_rig_offers_no_comparison_with_the_rig(active: bpy.types.Object):
    sections = ("rig", "playback", "evaluation")
    compared = {"Record, Train & Bind", "Measure Speed", "Frame Profile", "Rig", "Evaluate", "Beside"}
    full_texts = {text for name in sections for text in texts_of(draw_section(name))}
    assert compared <= full_texts
    active.fdda.is_fast_rig = True
    fast_texts = {text for name in sections for text in texts_of(draw_section(name))}
    assert not compared & fast_texts and {"Skinning", "Model", "Unbind"} <= fast_texts
    assert "This is a fast rig: compare the model in the file of the full rig." in fast_texts


def test_a_fast_rig_in_which_no_model_plays_says_so(active: bpy.types.Object):
    note = "'elbow' belongs to a fast rig: without a model, only what is left of its bones and modifiers deforms it."

    def says_so() -> bool:
        return any(text.startswith(note) for text in texts_of(draw_section("playback")))

    active.fdda.is_fast_rig = active.fdda.use_in_render = True
    assert not says_so()
    # The user hides the modifier, which shows the rig in a full rig.
    active.modifiers["FDDA"].show_viewport = False
    bpy.context.view_layer.update()
    assert active.fdda.mode == "RIG" and says_so()
    bpy.ops.fdda.unbind()
    assert says_so()
    active.fdda.is_fast_rig = False
    assert not says_so()


def test_a_fast_rig_says_where_no_model_plays(active: bpy.types.Object):
    """In some frames, or in renders, while the viewport shows the model."""

    def notes() -> list[str]:
        return [text for text in texts_of(draw_section("playback")) if "belongs to a fast rig" in text]

    active.fdda.is_fast_rig, active.fdda.use_in_render = True, False
    left = "only what is left of its bones and modifiers deforms it."
    assert notes() == [
        f"'elbow' belongs to a fast rig: in renders, where the model is off, {left} Switch Use in Render on, or open "
        "the file of the full rig."
    ]
    active.fdda.use_in_render = True
    assert notes() == []
    keyed = f"'elbow' belongs to a fast rig: where its keyed or driven mode is Rig, {left} Remove these keys or the "
    active.keyframe_insert("fdda.mode", frame=1)
    assert len(notes()) == 1 and notes()[0].startswith(keyed)
    active.animation_data_clear()
    assert notes() == []
    active.driver_add("fdda.mode")
    assert len(notes()) == 1 and notes()[0].startswith(keyed)
    active.fdda.is_fast_rig = False
    assert notes() == []


def test_a_removed_modifier_can_be_bound_again(active: bpy.types.Object):
    bpy.context.view_layer.update()
    active.modifiers.remove(active.modifiers["FDDA"])
    bpy.context.view_layer.update()
    assert "was removed; bind the model again" in active.fdda.status
    texts = texts_of(draw_section("playback"))
    assert "Bind Again" in texts and "Try Again" not in texts
    assert bpy.ops.fdda.bind(object=active.name) == {"FINISHED"}
    assert active.fdda.mode == "FDDA" and not active.fdda.status
    active.modifiers["FDDA"].show_viewport = False
    bpy.context.view_layer.update()
    assert "Try Again" in texts_of(draw_section("playback"))


def test_worst_random_poses_are_numbered_from_1_as_in_the_preview(active: bpy.types.Object, capfd):
    bpy.ops.fdda.evaluate(source="RANDOM", poses=3)
    index, error_mm = last_evaluation.get(active).worst_poses(1)[0]
    assert f"Pose {index + 1}: {error_mm:.2f} mm" in texts_of(draw_section("evaluation"))
    bpy.ops.fdda.jump_to_worst()
    assert f"Random pose {index + 1}: max error {error_mm:.2f} mm." in capfd.readouterr().out


def test_the_menu_has_all_operators_but_those_that_need_a_button_of_a_panel():
    in_menu = {name.removeprefix("fdda.") for group in MENU_OPERATORS for name in group}
    assert set(dir(bpy.ops.fdda)) - in_menu == {
        *("add_trusted_folder", "remove_trusted_folder"),
        *("cancel", "cancel_trainer_environment", "open_trainer_log", "remove_trainer_environment"),
        *("show_bone", "show_mesh", "copy_objects"),
    }


@pytest.mark.parametrize("name", MODULES)
def test_a_section_without_a_rig_draws(name: str):
    texts = texts_of(draw_section(name))
    if name == "rig":
        assert "Add Sample Arm" in texts


def test_lists_draw_their_items(active: bpy.types.Object):
    control = active.fdda.settings.extra_inputs.add()
    control.name, control.has_range = "flex", True
    assert list_items("poses") == [
        "Record elbow_wave 1…30",
        "Select upper ±45°  ±45°  ±45°",
        "Select lower 0…120°  locked  locked",
        "flex 0…1",
    ]
    assert list_items("models") == ["Name"]
    rig = SceneRig(active, active.find_armature())
    lower = rig.armature_object.pose.bones["lower"]
    assert limits._bone_row(rig, lower, False)[2] == "120°  lock  lock", "a narrow sidebar cuts a longer text"


def list_items(section_name: str) -> list[str]:
    """Return the text of each list item that a section draws. Of a field, the text is the name of its property."""
    return [text for kind, text, _ in draw_section(section_name) if kind == "list item"]


def test_the_button_in_the_header_of_a_section_opens_the_manual(monkeypatch: pytest.MonkeyPatch):
    addresses = []
    monkeypatch.setattr(webbrowser, "open", addresses.append)
    assert bpy.ops.fdda.help(section="Training Poses") == {"FINISHED"}
    (address,) = addresses
    page, _, anchor = address.partition("#")
    assert anchor == "training-poses"
    assert "\n### Training Poses\n" in Path(url2pathname(urlsplit(page).path)).read_text(encoding="utf-8")


def split_vertices(mesh_object: bpy.types.Object) -> None:
    """Give each face its own vertices, as importers of game formats do."""
    import bmesh  # bpy brings it, so it is there after bpy has loaded.

    edited = bmesh.new()
    edited.from_mesh(mesh_object.data)
    bmesh.ops.split_edges(edited, edges=edited.edges)
    edited.to_mesh(mesh_object.data)
    edited.free()


def remove_weights(mesh_object: bpy.types.Object) -> None:
    mesh_object.vertex_groups.clear()


def leave_only_skinning(mesh_object: bpy.types.Object) -> None:
    mesh_object.modifiers.remove(mesh_object.modifiers["CorrectiveSmooth"])


def remove_limits(mesh_object: bpy.types.Object) -> None:
    bone = bpy.data.objects[ELBOW_RIG].pose.bones["lower"]
    for constraint in list(bone.constraints):
        bone.constraints.remove(constraint)
    other = bpy.data.objects[ELBOW_RIG].pose.bones["upper"].constraints.new("LIMIT_ROTATION")
    other.use_limit_x, other.owner_space = True, "LOCAL"


@pytest.mark.parametrize(
    ("change", "text", "button"),
    [
        (split_vertices, "vertices lie on others along cuts, which come apart.", "merge_vertices"),
        (remove_weights, "No vertex of elbow has weights on deforming bones.", "fit_base_skinning"),
        (leave_only_skinning, "Only linear skinning deforms elbow: a model is not worth it.", ""),
        (remove_limits, "1 of 2 bones have no rotation limits, and turn by ±45°.", "select_unlimited"),
    ],
)
def test_what_makes_a_good_model_unlikely_has_a_remedy(saved: SceneRig, change, text: str, button: str):
    bpy.context.view_layer.objects.active = saved.mesh_object
    checks.check_now(saved)
    assert not findings.find(saved) and bpy.types.FDDA_PT_rig.is_done(bpy.context)
    vertex_count = len(saved.mesh_object.data.vertices)
    change(saved.mesh_object)
    bpy.context.view_layer.update()
    checks.unregister()
    checks.check_now(saved)
    (finding,) = findings.find(saved)
    assert finding.text.endswith(text) and finding.operator == (f"fdda.{button}" if button else "")
    assert not bpy.types.FDDA_PT_rig.is_done(bpy.context)
    assert f"{ELBOW_RIG}: 2 bones" in texts_of(draw_section("rig")), "the joint of a mesh without weights is no bone"
    assert " ".join(finding.text.split()) in " ".join(" ".join(texts_of(draw_section("rig"))).split())
    if button:
        assert getattr(bpy.ops.fdda, button)() == {"FINISHED"}
    if button == "select_unlimited":
        bones = saved.armature_object.pose.bones
        assert bpy.context.mode == "POSE" and [bone.name for bone in bones if is_selected(bone)] == ["lower"]
    elif button:
        checks.unregister()
        checks.check_now(saved)
        assert not findings.find(saved) and len(saved.mesh_object.data.vertices) == vertex_count
    else:
        saved.mesh_object.modifiers["Armature"].use_deform_preserve_volume = True
        checks.check_now(saved)
        assert not findings.find(saved)


def test_deforming_bones_that_follow_control_bones_are_named(saved: SceneRig):
    """Random poses would move the few others, and a tick would say that all is well."""
    armature_object = saved.armature_object
    bpy.context.view_layer.objects.active = armature_object
    bpy.ops.object.mode_set(mode="EDIT")
    control = armature_object.data.edit_bones.new("control")
    control.tail, control.use_deform = (0, 0, 1), False
    bpy.ops.object.mode_set(mode="OBJECT")
    pose_bones = armature_object.pose.bones
    for name in ("upper", "lower"):
        constraint = pose_bones[name].constraints.new("COPY_ROTATION")
        constraint.target, constraint.subtarget = armature_object, "control"
    limit = pose_bones["control"].constraints.new("LIMIT_ROTATION")
    limit.use_limit_x, limit.max_x, limit.owner_space = True, 1.0, "LOCAL"
    checks.check_now(saved)
    (finding,) = findings.find(saved)
    assert finding.text == (
        "2 of 2 deforming bones follow control bones. Check actions that move these, or choose them as Bones to Pose."
    )
    assert not bpy.types.FDDA_PT_rig.is_done(bpy.context) and not bpy.types.FDDA_PT_poses.is_done(bpy.context)
    key_bone(pose_bones["control"])
    bpy.data.actions["wave"].fdda.record = True
    checks.check_now(saved)
    assert not findings.find(saved) and bpy.types.FDDA_PT_poses.is_done(bpy.context)


def test_shared_settings_are_named_and_other_ones_before_they_are_replaced(saved: SceneRig):
    sleeve = saved.mesh_object.copy()
    sleeve.name = "sleeve"
    bpy.context.collection.objects.link(sleeve)
    bpy.context.view_layer.objects.active = saved.armature_object
    shared = "Shared by 2 Meshes"
    assert shared in texts_of(draw_section("poses"))
    assert meshes_with_other_settings(saved.mesh_object, [saved.mesh_object, sleeve]) == []
    for name, value in (("seed", 3), ("poses", 50), ("bones_to_pose", "WEIGHTS"), ("recording", "//other")):
        setattr(sleeve.fdda.settings, name, value)
        assert meshes_with_other_settings(saved.mesh_object, [saved.mesh_object, sleeve]) == ["sleeve"]
        copy_settings(sleeve, saved.mesh_object)
        assert meshes_with_other_settings(saved.mesh_object, [saved.mesh_object, sleeve]) == []
    assert sleeve.fdda.settings.auto_poses
    sleeve.fdda.settings.extra_inputs.add().name = "bulge"
    text = " ".join(" ".join(texts_of(draw_section("poses"))).split())
    assert "Record replaces other settings of 'sleeve'." in text or "of 'elbow'." in text


def key_bone(bone: bpy.types.PoseBone) -> None:
    """Make an action "wave" in which a bone rotates."""
    bone.id_data.animation_data.action = bpy.data.actions.new("wave")
    bone.rotation_mode = "XYZ"
    for frame in (1, 10):
        bone.rotation_euler[0] = frame / 20
        bone.keyframe_insert("rotation_euler", frame=frame)


def test_merging_keeps_normals_and_the_cuts_that_weights_or_shape_keys_open(saved: SceneRig):
    mesh_object, mesh = saved.mesh_object, saved.mesh_object.data
    vertex_count = len(mesh.vertices)
    split_vertices(mesh_object)
    normals = np.random.default_rng(0).normal(size=(len(mesh.loops), 3))
    normals /= np.linalg.norm(normals, axis=1, keepdims=True)
    mesh.normals_split_custom_set(normals)

    def corner_normals() -> dict[tuple, np.ndarray]:
        return {
            (tuple(face.center), tuple(mesh.vertices[mesh.loops[i].vertex_index].co)): mesh.corner_normals[i].vector[:]
            for face in mesh.polygons
            for i in face.loop_indices
        }

    before = corner_normals()
    mesh_object.vertex_groups["lower"].add([0], 0.3, "REPLACE")
    mesh_object.vertex_groups["upper"].add([0], 0.7, "REPLACE")
    mesh_object.shape_key_add(name="Basis")
    mesh_object.shape_key_add(name="open").data[len(mesh.vertices) - 1].co.z += 0.1
    bpy.context.view_layer.objects.active = mesh_object
    # The second time nothing is left to merge.
    for _ in range(2):
        assert bpy.ops.fdda.merge_vertices() == {"FINISHED"}
        assert len(mesh.vertices) == vertex_count + 2
    after = corner_normals()
    assert after.keys() == before.keys() and "fdda_normals" not in mesh.attributes
    np.testing.assert_allclose([after[key] for key in before], list(before.values()), atol=1e-3)
    basis, opened = mesh.shape_keys.key_blocks
    heights = [opened.data[i].co.z - basis.data[i].co.z for i in range(len(mesh.vertices))]
    assert sorted(heights)[-2:] == pytest.approx([0.0, 0.1])
