# SPDX-License-Identifier: GPL-3.0-or-later
"""Steps of the story `path`: poses are previewed, chosen and recorded. Each function is a step."""

from collections.abc import Iterator
from pathlib import Path

import bpy
import numpy as np
import sidebar
from arm import (
    arm_object,
    arm_positions,
    extension_module,
    mean_distance_mm,
    pose_without_keyframe,
    require_unkeyed_pose,
    wait_for_job,
)
from window import (
    click,
    press_keys,
    redraw_window,
    require,
    save_screenshot,
    wait_until,
)

POSE_COUNT = 100


def preview_a_random_pose(_folder: Path) -> Iterator[float]:
    """Type 2 into the field Preview Pose: the second random pose is shown."""
    rest_positions = arm_positions()
    session = bpy.context.window_manager.fdda
    require(session.preview_pose == 0, f"before any preview the field has {session.preview_pose}")
    yield from sidebar.open_section("poses")
    x, y = yield from sidebar.find_button("fdda.preview_pose", across=0.25)
    yield from click(x, y, times=2)
    yield from press_keys("ctrl+a", "2", "Return")
    yield 0.3
    mesh = arm_object().evaluated_get(bpy.context.evaluated_depsgraph_get()).data
    posed_positions = np.empty_like(rest_positions)
    mesh.attributes["position"].data.foreach_get("vector", posed_positions.reshape(-1))
    require(mean_distance_mm(posed_positions, rest_positions) > 1, "the field shows no other pose")


def choose_the_bones_to_pose(folder: Path) -> Iterator[float]:
    """Press Use Selected Bones: a random pose then moves only the selected bone. Choose all bones again."""
    bones, settings = bpy.data.objects["arm_rig"].pose.bones, arm_object().fdda.settings
    bone_name = next(bone.name for bone in bones if len(bone.children) == 1)
    for bone in bones:
        (bone if hasattr(bone, "select") else bone.bone).select = bone.name == bone_name
    settings.bones_to_pose = "SELECTED"
    yield from redraw_window()
    yield from sidebar.press_button("fdda.use_selected_bones")
    require(
        [bone.name for bone in settings.sampled_bones] == [bone_name], f"the bones to pose are not {bone_name} only"
    )
    bpy.context.window_manager.fdda.preview_pose += 1
    posed_bones = [bone.name for bone in bones if max(map(abs, bone.rotation_euler)) > 1e-6]
    require(posed_bones == [bone_name], f"the random pose moves {posed_bones}, not only {bone_name}")
    yield from save_screenshot(folder / "chosen_bone.png")
    settings.bones_to_pose = "AUTO"
    yield from redraw_window()


def set_the_number_of_poses(_folder: Path) -> Iterator[float]:
    """Press Rest Pose, and type a number into the field Random Poses."""
    yield from sidebar.press_button("fdda.rest_pose", across=0.85)
    rotated_bones = [b.name for b in bpy.data.objects["arm_rig"].pose.bones if max(map(abs, b.rotation_euler)) > 1e-6]
    require(not rotated_bones, f"{rotated_bones} are not at rest")
    yield from sidebar.press_button("settings.auto_poses", across=0.7)
    x, y = yield from sidebar.find_button("settings.poses", across=0.6)
    yield from click(x, y, times=2)
    yield from press_keys("ctrl+a", *str(POSE_COUNT), "Return")
    poses = arm_object().fdda.settings.poses
    require(poses == POSE_COUNT, f"typed {POSE_COUNT}, and there are {poses} random poses")


def record(folder: Path) -> Iterator[float]:
    """Press Record, and wait for the end of the recording."""
    job = extension_module("jobs.job")
    yield from sidebar.open_section("recording")
    pose_without_keyframe()
    yield from sidebar.press_button("fdda.record")
    yield from wait_until(lambda: job.state_of("record") and job.state_of("record").done, 30, "nothing is recorded")
    yield from save_screenshot(folder / "recording.png")
    sentence = job.state_of("record").sentence
    require(sentence.startswith(("Recording", "Bones and inputs moved alone")), f"the progress is '{sentence}'")
    yield from wait_for_job("record", 90)
    yield from redraw_window()
    require_unkeyed_pose("Record")
    # The next step is offered where this one ends.
    yield from sidebar.find_button("fdda.train")
    index = extension_module("core.recording.index").read_index(folder / "work" / "arm_recording")
    poses = index["sampling"]["sources"][0]["poses"]
    require(poses == POSE_COUNT and index["complete"] == index["poses"], f"{poses} random poses are recorded")
    require(bpy.data.objects["arm_rig"].animation_data.action is not None, "the recording has not restored the action")
