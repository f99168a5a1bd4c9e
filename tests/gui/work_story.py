# SPDX-License-Identifier: GPL-3.0-or-later
"""Story: work with a bound model. Each function is a step, and the mouse presses the buttons.

The story starts with the file that the story `path` has saved.
"""

import shutil
from collections.abc import Iterator
from pathlib import Path

import bpy
import numpy as np
import sidebar
from arm import (
    BLEND_FILE_NAME,
    arm_object,
    arm_positions,
    armature_object,
    extension_module,
    frame_object,
    make_empty_folder,
    mean_distance_mm,
    open_copy_in,
    pose_without_keyframe,
    require_unkeyed_pose,
    wait_for_job,
)
from window import (
    close_browser,
    file_browser_count,
    park_mouse,
    press_keys,
    redraw_window,
    region_override,
    require,
    save_screenshot,
    view_area,
    wait_until,
)

ENDLESS_EPOCHS = 100_000
"""Number of epochs for a training that runs until it is canceled."""


def open_the_bound_file(folder: Path) -> Iterator[float]:
    """Open a copy of the file in a folder without model files: the packed model plays."""
    yield from open_copy_in(folder / "work" / "alone", folder)
    require(arm_object().fdda.packed is not None, "the model is not packed")
    yield from sidebar.open_tab()


def bake_asks_each_time(folder: Path) -> Iterator[float]:
    """Press Bake… before and after a bake: both times it opens the file browser, and canceling keeps the first bake."""
    baked_file = folder / "work" / "alone" / "first.abc"
    bpy.context.scene.frame_end = 5
    yield from sidebar.open_section("playback")
    yield from sidebar.press_button("fdda.bake(")
    yield from wait_until(file_browser_count, 5, "Bake… opens no file browser")
    yield from save_screenshot(folder / "bake_dialog.png")
    yield from close_browser("Escape")
    pose_without_keyframe()
    if bpy.app.build_options.alembic:
        with region_override("UI"):
            bpy.ops.fdda.bake("EXEC_DEFAULT", filepath=str(baked_file))
    else:
        # Blender of a distribution.
        baked_file.write_bytes(b"Ogawa")
    yield 0.3
    require_unkeyed_pose("Bake")
    initial_content = baked_file.read_bytes()
    yield from redraw_window()
    yield from sidebar.press_button("fdda.bake(")
    yield from wait_until(file_browser_count, 5, "Bake… opens no file browser the second time")
    yield from close_browser("Escape")
    require(baked_file.read_bytes() == initial_content, "the first bake was overwritten")
    require([p.name for p in baked_file.parent.glob("*baked*")] == [], "a canceled dialog has baked a file")


def add_model_asks_each_time(_folder: Path) -> Iterator[float]:
    """Press + in the section Model Library twice and cancel: it opens the file browser each time."""
    yield from sidebar.open_section("models")
    for _ in range(2):
        yield from sidebar.press_button("fdda.add_model", across=0.97)
        yield from wait_until(file_browser_count, 5, "+ opens no file browser")
        yield from close_browser("Escape")
    require(len(arm_object().fdda.models) == 1, f"the list has {len(arm_object().fdda.models)} models")


def save_into_another_folder(folder: Path) -> Iterator[float]:
    """Save the file into another folder and open it there: the model plays."""
    initial_positions = arm_positions()
    other_folder = make_empty_folder(folder / "work" / "elsewhere")
    bpy.ops.wm.save_as_mainfile(filepath=str(other_folder / BLEND_FILE_NAME))
    bpy.ops.wm.open_mainfile(filepath=str(other_folder / BLEND_FILE_NAME), load_ui=False)
    yield 1.0
    distance = mean_distance_mm(arm_positions(), initial_positions)
    require(
        arm_object().fdda.mode == "FDDA" and distance < 1e-3, f"it is {distance:.3f} mm off; {arm_object().fdda.status}"
    )
    frame_object(arm_object())


def select_bones_in_the_list(folder: Path) -> Iterator[float]:
    """Check bones in the list: they are selected in the view. Give them the same limits."""
    compatibility = extension_module("scene.compatibility")
    bones = armature_object().pose.bones
    for bone in bones:
        compatibility.select_bone(bone, False)
    yield from sidebar.open_section("poses")
    yield from sidebar.open_subpanel("fdda.rest_pose", ".select", across=0.07, across_above=0.85)
    yield from sidebar.press_button(".select", across=0.07)
    selected = [bone.name for bone in bones if compatibility.is_selected(bone)]
    require(len(selected) == 1, f"{selected} are selected instead of one bone")
    yield from save_screenshot(folder / "bone_in_list.png")
    compatibility.select_bone(bones["forearm"] if "forearm" in bones else bones[3], True)
    yield from redraw_window()
    with region_override("UI"):
        bpy.ops.fdda.set_limits("INVOKE_DEFAULT")
    yield 0.5
    yield from save_screenshot(folder / "ranges_dialog.png")
    yield from press_keys("Return")
    yield 0.5
    limits = {(bone.ik_min_x, bone.ik_max_x) for bone in bones if compatibility.is_selected(bone)}
    require(len(limits) == 1, f"the selected bones have the ranges {limits}")


def switch_all_meshes_in_pose_mode(folder: Path) -> Iterator[float]:
    """In Pose Mode, with no mesh selected, press Rig, Skinning and Model: each switches both meshes of the armature."""
    sleeve = arm_object().copy()
    sleeve.name = "sleeve"
    sleeve.data = arm_object().data.copy()
    bpy.context.scene.collection.objects.link(sleeve)
    yield 0.5
    with region_override("WINDOW"):
        bpy.ops.object.select_all(action="DESELECT")
        bpy.context.view_layer.objects.active = armature_object()
        armature_object().select_set(True)
        bpy.ops.object.mode_set(mode="POSE")
    yield from redraw_window()
    yield from sidebar.open_section("playback")
    bindings = (arm_object().fdda, bpy.data.objects["sleeve"].fdda)
    for mode, across in (("RIG", 0.15), ("LINEAR", 0.5), ("FDDA", 0.88)):
        yield from sidebar.press_button(f"fdda.set_mode(all_meshes=True, mode='{mode}')", across)
        yield from wait_until(
            lambda mode=mode: all(b.mode == mode for b in bindings), 5, f"not both meshes switch to {mode}"
        )
    yield from save_screenshot(folder / "all_meshes.png")
    yield from sidebar.open_section("rig")
    yield from sidebar.press_button('fdda.show_mesh(object="sleeve")', across=0.2)
    require(bpy.context.window_manager.fdda.mesh == "sleeve", "the click does not show the other mesh")
    yield from save_screenshot(folder / "meshes.png")


def evaluate_both_meshes(folder: Path) -> Iterator[float]:
    """Press Evaluate: both meshes are compared on random poses."""
    view = bpy.context.window_manager.fdda_view
    view.source, view.poses = "RANDOM", 5
    yield from sidebar.open_section("evaluation")
    yield from sidebar.press_button("fdda.evaluate")
    yield from wait_for_job("evaluate", 90)
    evaluations = extension_module("evaluation.last_evaluation")
    missing = [name for name in ("arm", "sleeve") if evaluations.get(bpy.data.objects[name]) is None]
    require(not missing, f"{missing} were not evaluated")
    yield from save_screenshot(folder / "evaluated.png")


def click_a_body_part(folder: Path) -> Iterator[float]:
    """Click the name of a body part: its bone is selected in Pose Mode. Show the heat map below the bones."""
    yield from sidebar.press_button("fdda.show_bone", across=0.1)
    active = armature_object().data.bones.active
    require(active is not None and bpy.context.mode == "POSE", "no bone is selected")
    yield from sidebar.press_button("fdda.color_mesh(colors='ERRORS')", 0.5)
    yield 0.3
    yield from save_screenshot(folder / "bones_over_colors.png")
    extension_module("evaluation.heat_map").clear_all()
    with region_override("WINDOW"):
        bpy.ops.object.mode_set(mode="OBJECT")
        bpy.data.objects.remove(bpy.data.objects["sleeve"])
        bpy.context.view_layer.objects.active = arm_object()
        arm_object().select_set(True)
    yield from redraw_window()


def search_finds_the_buttons(folder: Path) -> Iterator[float]:
    """Search for "rest pose" and press Return: the operator of the add-on runs."""
    bone = armature_object().pose.bones[2]
    armature_object().animation_data.action = None
    bone.rotation_mode = "XYZ"
    bone.rotation_euler[0] = 0.5
    yield from park_mouse()
    with region_override("WINDOW"):
        # The operator that F3 calls, because not every virtual keyboard has that key.
        bpy.ops.wm.search_menu("INVOKE_DEFAULT")
    yield 1.0
    yield from press_keys(*"rest", "space", *"pose")
    yield 0.7
    yield from save_screenshot(folder / "search.png")
    yield from press_keys("Return")
    yield from wait_until(
        lambda: abs(armature_object().pose.bones[2].rotation_euler[0]) < 1e-6, 5, "F3 does not find Rest Pose"
    )


def check_headings_of_the_manual(_folder: Path) -> Iterator[float]:
    """Check that the manual page has an anchor for each section of the sidebar."""
    page = extension_module("operators.help").manual_path().read_text(encoding="utf-8")
    headings = [getattr(bpy.types, f"FDDA_PT_{name}").bl_label for name in sidebar.SECTIONS]
    missing = [heading for heading in headings if f'id="{heading.lower().replace(" ", "-")}"' not in page]
    require(not missing, f"the manual has no section {missing}")
    yield 0.1


def bind_the_trained_model_after_an_undo(folder: Path) -> Iterator[float]:
    """Clear the Model Library, as an undo does: Bind still finds the trained model file."""
    work = folder / "work" / "elsewhere"
    (work / "arm_model").mkdir(exist_ok=True)
    shutil.copy(folder / "work" / "arm_model" / "arm.away", work / "arm_model" / "arm.onnx")
    bpy.ops.fdda.unbind()
    arm_object().fdda.models.clear()
    yield 1.5
    yield from sidebar.open_section("playback")
    yield from sidebar.press_button("fdda.bind")
    yield from wait_until(lambda: arm_object().fdda.is_bound, 20, "the trained model is not bound")


def close_the_file_while_it_trains(folder: Path) -> Iterator[float]:
    """Open another file during a training, and this one again: it shows the running training. Cancel it."""
    job = extension_module("jobs.job")
    work = folder / "work" / "elsewhere"
    shutil.copytree(folder / "work" / "arm_recording", work / "arm_recording")
    arm_object().fdda.settings.passes, arm_object().fdda.settings.model = ENDLESS_EPOCHS, "//long/arm.onnx"
    bpy.ops.wm.save_mainfile()
    yield 1.5
    yield from sidebar.open_section("training")
    yield from sidebar.press_button("fdda.train")
    yield from wait_until(lambda: job.current() is not None, 10, "the button starts no training")
    yield from wait_until(lambda: len(job.current().curves.get("training", ())) > 3, 90, "there are no epochs")
    yield from save_screenshot(folder / "curves.png")
    bpy.ops.wm.read_homefile(app_template="", load_ui=False)
    yield 1.0
    require(job.state_of("train") is None, "another file shows the training")
    bpy.ops.wm.open_mainfile(filepath=str(work / BLEND_FILE_NAME), load_ui=False)
    yield from wait_until(lambda: job.current() is not None, 10, "the training is not followed")
    yield from wait_until(lambda: len(job.current().curves.get("training", ())) > 3, 30, "its curves are not restored")
    bpy.context.view_layer.objects.active = arm_object()
    yield from sidebar.open_section("training")
    yield from sidebar.press_button("fdda.cancel", across=0.3)
    yield from wait_until(lambda: job.current() is None, 30, "Cancel does not end it")
    require(not (work / "long" / "arm.onnx").exists(), "a canceled training has written a model")


def record_train_and_bind(folder: Path) -> Iterator[float]:
    """Press Record, Train & Bind in a new file with the arm: the model is bound and packed."""
    folder_of_file = make_empty_folder(folder / "work" / "build_model")
    bpy.ops.wm.read_homefile(app_template="", load_ui=False)
    yield 0.5
    bpy.ops.fdda.add_sample_arm(density="1")
    settings = arm_object().fdda.settings
    settings.poses, settings.passes = 60, 20
    bpy.ops.wm.save_as_mainfile(filepath=str(folder_of_file / BLEND_FILE_NAME))
    yield from redraw_window()
    yield from sidebar.open_section("rig")
    pose_without_keyframe()
    yield from sidebar.press_button("fdda.build_model")
    job = extension_module("jobs.job")
    yield from wait_until(
        lambda: job.state_of("build_model") and job.state_of("build_model").curves, 90, "nothing is trained"
    )
    yield from save_screenshot(folder / "one_go_trains.png")
    yield from wait_for_job("build_model", 180)
    require(
        arm_object().fdda.is_bound and arm_object().fdda.mode == "FDDA", f"it is not bound: {arm_object().fdda.status}"
    )
    yield 0.3
    require_unkeyed_pose("Record, Train & Bind")
    require(arm_object().fdda.packed is not None, "the model is not packed")
    require(np.isfinite(arm_positions()).all(), "the arm has no shape")
    require(view_area() is not None, "the view is gone")


STEPS = (
    open_the_bound_file,
    bake_asks_each_time,
    add_model_asks_each_time,
    save_into_another_folder,
    select_bones_in_the_list,
    switch_all_meshes_in_pose_mode,
    evaluate_both_meshes,
    click_a_body_part,
    search_finds_the_buttons,
    check_headings_of_the_manual,
    bind_the_trained_model_after_an_undo,
    close_the_file_while_it_trains,
    record_train_and_bind,
)
