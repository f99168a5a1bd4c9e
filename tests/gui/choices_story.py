# SPDX-License-Identifier: GPL-3.0-or-later
"""Story: what the sidebar chooses and says before a recording, at the default width and at 200 % resolution scale.

The characters are a game character, whose bones have no limits, with actions and several meshes, and one whose
deforming bones follow control bones.
"""

from collections.abc import Iterator
from pathlib import Path

import bmesh
import bpy
import sidebar
from arm import extension_module, make_empty_folder, show_preferences, wait_for_job
from window import (
    park_mouse,
    press_keys,
    redraw_window,
    region_override,
    require,
    save_screenshot,
    view_area,
    wait_until,
)

from blend_fixtures.elbow import build_elbow

CONTROL = "control"


def open_a_character_of_several_meshes(folder: Path) -> Iterator[float]:
    """Build it: a body with an action, a mesh that cannot be recorded, and one with each kind of finding."""
    bpy.ops.wm.read_homefile(app_template="", load_ui=False, use_empty=True)
    yield 0.5
    build_elbow()
    body, armature_object = bpy.data.objects["elbow"], bpy.data.objects["elbow_rig"]
    for bone in armature_object.pose.bones:
        for constraint in list(bone.constraints):
            bone.constraints.remove(constraint)
    for name in ("sleeve", "mirrored", "trousers", "cap"):
        other = bpy.data.objects.new(name, body.data.copy())
        bpy.context.collection.objects.link(other)
        other.parent = body.parent
        other.modifiers.new("Armature", "ARMATURE").object = armature_object
        if name == "mirrored":
            other.modifiers.new("Mirror", "MIRROR")
            other.modifiers.move(1, 0)
        if name != "cap":
            other.modifiers.new("Corrective Smooth", "CORRECTIVE_SMOOTH")
    bpy.data.objects["sleeve"].vertex_groups.clear()
    mesh, trousers = bmesh.new(), bpy.data.objects["trousers"].data
    mesh.from_mesh(trousers)
    mesh.edges.ensure_lookup_table()
    bmesh.ops.split_edges(mesh, edges=mesh.edges[:200])
    mesh.to_mesh(trousers)
    mesh.free()
    bpy.context.view_layer.objects.active = body
    bpy.ops.wm.save_as_mainfile(filepath=str(make_empty_folder(folder / "choices") / "character.blend"))
    yield from sidebar.open_tab()
    yield from _show_sections(folder, "default", ("rig", "poses", "recording", "training"))


def _show_sections(folder: Path, name: str, sections: tuple[str, ...]) -> Iterator[float]:
    """Write a picture of each section."""
    for section in sections:
        yield from sidebar.open_section(section)
        yield 0.6
        yield from park_mouse()
        yield from save_screenshot(folder / f"choices_{name}_{section}.png")


def mend_what_is_found(folder: Path) -> Iterator[float]:
    """Show each mesh with a finding, and press the button that mends it."""
    find, find_rig = extension_module("panels.findings").find, extension_module("scene.scene_rig").find_rig
    bone = bpy.data.objects["elbow_rig"].pose.bones["upper"]
    limit = bone.constraints.new("LIMIT_ROTATION")
    limit.use_limit_x, limit.max_x, limit.owner_space = True, 1.0, "LOCAL"
    yield from sidebar.open_section("rig")
    for name, operator, text in (
        ("sleeve", "fdda.fit_base_skinning", "No vertex of sleeve has weights"),
        ("trousers", "fdda.merge_vertices", "of 593 vertices lie on others along cuts"),
        ("cap", "", "Only linear skinning deforms cap"),
        ("elbow", "fdda.select_unlimited", "1 of 2 bones have no rotation limits"),
    ):
        yield from sidebar.press_button(f'fdda.show_mesh(object="{name}")', across=0.2)
        yield 0.8
        yield from park_mouse()
        yield from save_screenshot(folder / f"choices_found_{name}.png")
        finding = find(find_rig(name))[0]
        require(finding.operator == operator and text in finding.text, f"{name}: {finding}")
        if operator:
            yield from sidebar.press_button(operator)
            yield 0.8
    for name in ("sleeve", "trousers"):
        operators = [finding.operator for finding in find(find_rig(name))]
        require(operators == ["fdda.select_unlimited"], f"{name} still has {operators}")
    selected = [b.name for b in bone.id_data.pose.bones if extension_module("scene.compatibility").is_selected(b)]
    require(selected == ["lower"], f"{selected} are selected")
    bone.constraints.remove(limit)
    with region_override("WINDOW"):
        bpy.ops.object.mode_set(mode="OBJECT")
    bpy.context.view_layer.objects.active = bpy.data.objects["elbow"]


def choose_the_number_of_poses(folder: Path) -> Iterator[float]:
    """Press Auto twice: the number of poses can be typed in between, and Auto is on again afterwards."""
    settings = bpy.data.objects["elbow"].fdda.settings
    yield from sidebar.open_section("poses")
    require(settings.auto_poses, "the number of poses is not automatic")
    yield from sidebar.press_button("auto_poses", across=0.6)
    require(not settings.auto_poses, "Auto cannot be switched off")
    yield from save_screenshot(folder / "choices_number.png")
    yield from sidebar.press_button("auto_poses", across=0.95)
    require(settings.auto_poses, "Auto cannot be switched on")


def choose_limbs_from_actions(folder: Path) -> Iterator[float]:
    """Check an action: random poses then combine limbs from it."""
    options = extension_module("properties.recording_options")
    rig = extension_module("scene.scene_rig").find_rig("elbow")
    require("from 1 action," in options.describe_chosen_bones(rig), options.describe_chosen_bones(rig))
    yield from sidebar.press_button("fdda.record", across=0.1)
    sentence = options.describe_chosen_bones(rig)
    require(sentence == "Random poses combine limbs from 1 recorded action.", sentence)
    yield from save_screenshot(folder / "choices_action.png")


def show_a_rig_of_control_bones(folder: Path) -> Iterator[float]:
    """Let the deforming bones follow others: this is named, and no tick is shown."""
    bpy.data.actions["elbow_wave"].fdda.record = False
    armature_object = bpy.data.objects["elbow_rig"]
    bpy.context.view_layer.objects.active = armature_object
    bpy.ops.object.mode_set(mode="EDIT")
    bone = armature_object.data.edit_bones.new(CONTROL)
    bone.tail, bone.use_deform = (0, 0, 1), False
    bpy.ops.object.mode_set(mode="OBJECT")
    for name in ("upper", "lower"):
        constraint = armature_object.pose.bones[name].constraints.new("COPY_ROTATION")
        constraint.target, constraint.subtarget = armature_object, CONTROL
    limit = armature_object.pose.bones[CONTROL].constraints.new("LIMIT_ROTATION")
    limit.use_limit_x, limit.max_x, limit.owner_space = True, 1.0, "LOCAL"
    armature_object.data.bones["upper"].use_deform = True
    bpy.data.actions.remove(bpy.data.actions["elbow_wave"])
    bpy.context.view_layer.objects.active = bpy.data.objects["elbow"]
    yield from _show_sections(folder, "controls", ("rig", "poses"))


def record_train_and_bind(folder: Path) -> Iterator[float]:
    """Press the button, and follow its labels to the verdict; the profile and the times follow."""
    bpy.ops.wm.open_mainfile(filepath=str(folder / "choices" / "character.blend"), load_ui=False)
    yield 1.0
    body = bpy.data.objects["elbow"]
    bpy.context.view_layer.objects.active = body
    for name in ("sleeve", "mirrored", "trousers", "cap"):
        bpy.data.objects.remove(bpy.data.objects[name])
    body.fdda.settings.poses, body.fdda.settings.passes = 200, 30
    bpy.ops.wm.save_as_mainfile(filepath=str(folder / "choices" / "bound.blend"))
    job = extension_module("jobs.job")
    yield from sidebar.open_section("rig")
    yield from sidebar.press_button("fdda.build_model")
    yield from wait_until(lambda: job.state_of("build_model") is not None, 30, "nothing begins")
    yield 2.0
    yield from save_screenshot(folder / "choices_job.png")
    yield from wait_for_job("build_model", 200)
    require(body.fdda.is_bound, job.state_of("build_model").outcome)
    yield from _show_sections(folder, "bound", ("rig", "training", "playback", "evaluation", "models"))


def measure_and_profile(folder: Path) -> Iterator[float]:
    """Press Measure Speed and Profile Frame: the section has one truth about speed."""
    yield from sidebar.open_section("rig")
    yield from sidebar.press_button("fdda.measure")
    yield from wait_for_job("measure", 60)
    yield from sidebar.open_subpanel("fdda.measure", "fdda.profile_frame")
    yield from sidebar.press_button("fdda.profile_frame")
    yield from wait_for_job("profile_frame", 90)
    yield from redraw_window()
    yield from save_screenshot(folder / "choices_speed.png")


def save_during_a_job(folder: Path) -> Iterator[float]:
    """Press Ctrl S while poses are recorded: the panel says why the file is not saved. Cancel with ESC."""
    job, settings = extension_module("jobs.job"), bpy.data.objects["elbow"].fdda.settings
    settings.auto_poses, settings.poses, settings.recording = False, 50_000, "//long"
    yield from sidebar.open_section("recording")
    yield from sidebar.press_button("fdda.record(")
    yield from wait_until(lambda: job.current() is not None, 10, "nothing is recorded")
    yield from park_mouse()
    yield from press_keys("ctrl+s")
    yield from wait_until(lambda: job.current().note.startswith("Not saved"), 5, "nothing is said about the file")
    yield from save_screenshot(folder / "choices_not_saved.png")
    yield from press_keys("Escape")
    yield from wait_until(lambda: job.current() is None, 10, "ESC does not cancel")
    require("Resume" in job.state_of("record").outcome, job.state_of("record").outcome)


def delete_the_armature(folder: Path) -> Iterator[float]:
    """Delete the armature of a bound mesh: the sidebar says why the mesh does not move."""
    bpy.data.objects.remove(bpy.data.objects["elbow_rig"])
    body = bpy.data.objects["elbow"]
    yield from wait_until(lambda: "armature" in body.fdda.status, 5, f"the status is '{body.fdda.status}'")
    yield from sidebar.open_section("rig")
    yield from save_screenshot(folder / "choices_no_armature.png")


def show_the_preferences(folder: Path) -> Iterator[float]:
    """The preferences show one state of the training environment, at both sizes."""
    area = view_area()
    yield from show_preferences(area)
    yield from save_screenshot(folder / "choices_preferences.png")
    bpy.context.preferences.view.ui_scale = 2.0
    yield 1.0
    yield from save_screenshot(folder / "choices_preferences_200.png")
    bpy.context.preferences.view.ui_scale, area.type = 1.0, "VIEW_3D"
    yield 0.5


def show_all_at_twice_the_size(folder: Path) -> Iterator[float]:
    """Repeat the pictures at 200 % resolution scale."""
    bpy.context.preferences.view.ui_scale = 2.0
    bpy.ops.wm.open_mainfile(filepath=str(folder / "choices" / "character.blend"), load_ui=False)
    yield 1.0
    bpy.context.view_layer.objects.active = bpy.data.objects["elbow"]
    view_area().spaces[0].show_region_ui = True
    yield 1.0
    yield from _show_sections(folder, "200", ("rig", "poses", "recording", "training"))
    bpy.context.preferences.view.ui_scale = 1.0
    yield 0.5


STEPS = (
    open_a_character_of_several_meshes,
    mend_what_is_found,
    choose_the_number_of_poses,
    choose_limbs_from_actions,
    show_a_rig_of_control_bones,
    record_train_and_bind,
    measure_and_profile,
    save_during_a_job,
    delete_the_armature,
    show_all_at_twice_the_size,
    show_the_preferences,
)
