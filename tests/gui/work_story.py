# SPDX-License-Identifier: GPL-3.0-or-later
"""What a rigger and an animator do with a model that is there: a function a step, with its checks.

Begins with the file that the path of a first model has left. Buttons are pressed with the mouse.
"""

import shutil
from collections.abc import Iterator
from pathlib import Path

import bpy
import numpy as np
import sidebar
from arm import BLEND, arm, armature, distance_mm, emptied, job_done, look_at, open_in, part, shape
from window import (
    browsers,
    check,
    close_browser,
    over,
    picture,
    press,
    redraw,
    rest_mouse,
    until,
    view_area,
)

LONG = 100_000
"""Epochs of a training that does not end by itself."""


def open_the_bound_file(folder: Path) -> Iterator[float]:
    """Open the file of the path, in a folder of its own without any model beside it: the model came along inside."""
    yield from open_in(folder / "work" / "alone", folder)
    check(arm().fdda.packed is not None, "the model is not packed")
    yield from sidebar.show()


def bake_asks_each_time(folder: Path) -> Iterator[float]:
    """Press Bake… and leave its dialog, bake, and press it again: it asks again, and what was baked is as it was."""
    baked = folder / "work" / "alone" / "first.pc2"
    bpy.context.scene.frame_end = 5
    yield from sidebar.open_section("playback")
    yield from sidebar.push("fdda.bake")
    yield from until(browsers, 5, "Bake… opens no file browser")
    yield from picture(folder / "bake_dialog.png")
    yield from close_browser("Escape")
    bpy.ops.fdda.bake(filepath=str(baked))
    before = baked.read_bytes()
    yield from redraw()
    yield from sidebar.push("fdda.bake")
    yield from until(browsers, 5, "Bake… opens no file browser the second time")
    yield from close_browser("Escape")
    check(baked.read_bytes() == before, "the first bake was written over")
    check([p.name for p in baked.parent.glob("*baked*")] == [], "something was baked that nobody asked for")


def add_model_asks_each_time(_folder: Path) -> Iterator[float]:
    """Press + in the section Model Library twice, and leave the dialog each time."""
    yield from sidebar.open_section("models")
    for _ in range(2):
        yield from sidebar.push("fdda.add_model", across=0.97)
        yield from until(browsers, 5, "+ opens no file browser")
        yield from close_browser("Escape")
    check(len(arm().fdda.models) == 1, f"the list has {len(arm().fdda.models)} models")


def save_into_another_folder(folder: Path) -> Iterator[float]:
    """Save As elsewhere and open that: it plays."""
    before = shape()
    other = emptied(folder / "work" / "elsewhere")
    bpy.ops.wm.save_as_mainfile(filepath=str(other / BLEND))
    bpy.ops.wm.open_mainfile(filepath=str(other / BLEND), load_ui=False)
    yield 1.0
    apart = distance_mm(shape(), before)
    check(arm().fdda.mode == "FDDA" and apart < 1e-3, f"it is {apart:.3f} mm off; {arm().fdda.status}")
    look_at(arm())


def select_bones_in_the_list(folder: Path) -> Iterator[float]:
    """Check bones in the list: they are selected in the view. Give them the same limits."""
    compatibility = part("scene.compatibility")
    bones = armature().pose.bones
    for bone in bones:
        compatibility.select_bone(bone, False)
    yield from sidebar.open_section("poses")
    yield from sidebar.push(".select", across=0.07)
    selected = [bone.name for bone in bones if compatibility.is_selected(bone)]
    check(len(selected) == 1, f"{selected} are selected instead of one bone")
    yield from picture(folder / "bone_in_list.png")
    compatibility.select_bone(bones["forearm"] if "forearm" in bones else bones[3], True)
    yield from redraw()
    with over("UI"):
        bpy.ops.fdda.set_limits("INVOKE_DEFAULT")
    yield 0.5
    yield from picture(folder / "ranges_dialog.png")
    yield from press("Return")
    yield 0.5
    limits = {(bone.ik_min_x, bone.ik_max_x) for bone in bones if compatibility.is_selected(bone)}
    check(len(limits) == 1, f"the selected bones have the ranges {limits}")


def switch_all_meshes_in_pose_mode(folder: Path) -> Iterator[float]:
    """A second mesh on the armature, pose mode: Rig, Skinning and Model switch both, no mesh is selected."""
    sleeve = arm().copy()
    sleeve.name = "sleeve"
    sleeve.data = arm().data.copy()
    bpy.context.scene.collection.objects.link(sleeve)
    yield 0.5
    with over("WINDOW"):
        bpy.ops.object.select_all(action="DESELECT")
        bpy.context.view_layer.objects.active = armature()
        armature().select_set(True)
        bpy.ops.object.mode_set(mode="POSE")
    yield from redraw()
    yield from sidebar.open_section("playback")
    both = (arm().fdda, bpy.data.objects["sleeve"].fdda)
    for mode, across in (("RIG", 0.15), ("LINEAR", 0.5), ("FDDA", 0.88)):
        yield from sidebar.push(f"fdda.set_mode(all_meshes=True, mode='{mode}')", across)
        yield from until(lambda mode=mode: all(b.mode == mode for b in both), 5, f"not both meshes switch to {mode}")
    yield from picture(folder / "all_meshes.png")
    yield from sidebar.open_section("rig")
    yield from sidebar.push('fdda.show_mesh(object="sleeve")', across=0.2)
    check(bpy.context.window_manager.fdda.mesh == "sleeve", "the click does not show the other mesh")
    yield from picture(folder / "meshes.png")


def evaluate_all_meshes(folder: Path) -> Iterator[float]:
    """Evaluate on a few random poses: both meshes are compared in one go."""
    view = bpy.context.window_manager.fdda_view
    view.source, view.poses = "RANDOM", 5
    yield from sidebar.open_section("evaluation")
    yield from sidebar.push("fdda.evaluate")
    yield from job_done("evaluate", 90)
    evaluations = part("evaluation.last_evaluation")
    missing = [name for name in ("arm", "sleeve") if evaluations.get(bpy.data.objects[name]) is None]
    check(not missing, f"{missing} were not evaluated")
    yield from picture(folder / "evaluated.png")


def pick_a_partition(folder: Path) -> Iterator[float]:
    """Press a partition's name: its bone is selected. A bone that is clicked has its partition on top."""
    yield from sidebar.push("fdda.show_bone", across=0.1)
    active = armature().data.bones.active
    check(active is not None and bpy.context.mode == "POSE", "no bone is selected")
    yield from sidebar.push("fdda.color_mesh(colors='ERRORS')", 0.5)
    yield 0.3
    yield from picture(folder / "bones_over_colors.png")
    part("evaluation.heat_map").clear_all()
    with over("WINDOW"):
        bpy.ops.object.mode_set(mode="OBJECT")
        bpy.data.objects.remove(bpy.data.objects["sleeve"])
        bpy.context.view_layer.objects.active = arm()
        arm().select_set(True)
    yield from redraw()


def search_finds_the_buttons(folder: Path) -> Iterator[float]:
    """F3, a few letters, Return: Rest Pose of the add-on."""
    bone = armature().pose.bones[2]
    armature().animation_data.action = None
    bone.rotation_mode = "XYZ"
    bone.rotation_euler[0] = 0.5
    yield from rest_mouse()
    with over("WINDOW"):
        # What F3 is bound to: not every virtual keyboard has that key.
        bpy.ops.wm.search_menu("INVOKE_DEFAULT")
    yield 1.0
    yield from press(*"rest", "space", *"pose")
    yield 0.7
    yield from picture(folder / "search.png")
    yield from press("Return")
    yield from until(lambda: abs(armature().pose.bones[2].rotation_euler[0]) < 1e-6, 5, "F3 does not find Rest Pose")


def read_the_manual(_folder: Path) -> Iterator[float]:
    """The page that the help buttons open has an anchor for each section."""
    page = part("operators.help").manual_file().read_text(encoding="utf-8")
    headings = [getattr(bpy.types, f"FDDA_PT_{name}").bl_label for name in sidebar.SECTIONS]
    missing = [heading for heading in headings if f'id="{part("core.manual_page").anchor(heading)}"' not in page]
    check(not missing, f"the manual has no section {missing}")
    yield 0.1


def undo_past_training(folder: Path) -> Iterator[float]:
    """A model that was trained stays known where an undo has taken it off the list."""
    work = folder / "work" / "elsewhere"
    (work / "arm_model").mkdir(exist_ok=True)
    shutil.copy(folder / "work" / "arm_model" / "arm.away", work / "arm_model" / "arm.onnx")
    bpy.ops.fdda.unbind()
    arm().fdda.models.clear()
    yield 1.5
    yield from sidebar.open_section("playback")
    yield from sidebar.push("fdda.bind")
    yield from until(lambda: arm().fdda.is_bound, 20, "the trained model is not bound")


def close_the_file_while_it_trains(folder: Path) -> Iterator[float]:
    """Train, open another file, come back: the training goes on and is followed. Cancel it."""
    job = part("jobs.job")
    work = folder / "work" / "elsewhere"
    shutil.copytree(folder / "work" / "arm_recording", work / "arm_recording")
    arm().fdda.settings.epochs, arm().fdda.settings.model = LONG, "//long/arm.onnx"
    bpy.ops.wm.save_mainfile()
    yield 1.5
    yield from sidebar.open_section("training")
    yield from sidebar.push("fdda.train")
    yield from until(lambda: job.current() is not None, 10, "the button starts no training")
    yield from until(lambda: len(job.current().curves.get("training", ())) > 3, 90, "there are no epochs")
    yield from picture(folder / "curves.png")
    bpy.ops.wm.read_homefile(app_template="", load_ui=False)
    yield 1.0
    check(job.state_of("train") is None, "another file shows the training")
    bpy.ops.wm.open_mainfile(filepath=str(work / BLEND), load_ui=False)
    yield from until(lambda: job.current() is not None, 10, "the training is not followed")
    yield from until(lambda: len(job.current().curves.get("training", ())) > 3, 30, "its curves do not come back")
    bpy.context.view_layer.objects.active = arm()
    yield from sidebar.open_section("training")
    yield from sidebar.push("fdda.cancel", across=0.3)
    yield from until(lambda: job.current() is None, 30, "Cancel does not end it")
    check(not (work / "long" / "arm.onnx").exists(), "a canceled training has written a model")


def make_a_model_in_one_go(folder: Path) -> Iterator[float]:
    """A new file with the arm, saved; one button: it is recorded, trained and bound."""
    own = emptied(folder / "work" / "build_model")
    bpy.ops.wm.read_homefile(app_template="", load_ui=False)
    yield 0.5
    bpy.ops.fdda.add_sample_arm(density="1")
    settings = arm().fdda.settings
    settings.poses, settings.epochs = 60, 20
    bpy.ops.wm.save_as_mainfile(filepath=str(own / BLEND))
    yield from redraw()
    yield from sidebar.open_section("rig")
    yield from sidebar.push("fdda.build_model")
    job = part("jobs.job")
    yield from until(
        lambda: job.state_of("build_model") and job.state_of("build_model").curves, 90, "nothing is trained"
    )
    yield from picture(folder / "one_go_trains.png")
    yield from job_done("build_model", 180)
    check(arm().fdda.is_bound and arm().fdda.mode == "FDDA", f"it is not bound: {arm().fdda.status}")
    check(arm().fdda.packed is not None, "the model is not packed")
    check(np.isfinite(shape()).all(), "the arm has no shape")
    check(view_area() is not None, "the view is gone")


STEPS = (
    open_the_bound_file,
    bake_asks_each_time,
    add_model_asks_each_time,
    save_into_another_folder,
    select_bones_in_the_list,
    switch_all_meshes_in_pose_mode,
    evaluate_all_meshes,
    pick_a_partition,
    search_finds_the_buttons,
    read_the_manual,
    undo_past_training,
    close_the_file_while_it_trains,
    make_a_model_in_one_go,
)
