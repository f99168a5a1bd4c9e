# SPDX-License-Identifier: GPL-3.0-or-later
"""Story: from adding the sample arm to a saved file with a bound model. Each function is a step.

The mouse presses the buttons of the add-on. Blender's own operators open and save files.
"""

import json
import os
import time
from collections.abc import Iterator
from pathlib import Path

import bpy
import numpy as np
import sidebar
from arm import (
    BENT_FRAME,
    BLEND_FILE_NAME,
    EXTENSION,
    arm_object,
    arm_positions,
    check_model_plays,
    extension_module,
    mean_distance_mm,
    wait_for_job,
)
from window import (
    StepError,
    click,
    colored_ratio,
    park_mouse,
    press_keys,
    redraw_window,
    region_override,
    require,
    save_screenshot,
    start_playback,
    stop_playback,
    view_area,
    view_region,
    wait_until,
)

SMALL_VERTICES, DEFAULT_VERTICES, BONE_COUNT, POSE_COUNT, FRAME_COUNT = 1476, 9960, 22, 100, 250
MODIFIERS = ["ARMATURE", "CORRECTIVE_SMOOTH"]
PLAY_SECONDS, EXTRA_PLAY_SECONDS = 4, 30
"""How long the action plays, and how much longer at most where the CPU renders the viewport."""
MIN_COLORED_RATIO = 0.01
"""Smallest ratio of colored pixels in the viewport when the arm has colors; without colors it is 0.001."""

_rig_positions: np.ndarray | None = None
_model_positions: np.ndarray | None = None


def extent_in_view() -> float:
    """Return the larger of the arm's width and height relative to the viewport; 2 if a part is outside of it."""
    from bpy_extras.view3d_utils import location_3d_to_region_2d
    from mathutils import Vector

    view, region3d = view_region("WINDOW"), view_area().spaces[0].region_3d
    points = [
        location_3d_to_region_2d(view, region3d, arm_object().matrix_world @ Vector(corner))
        for corner in arm_object().bound_box
    ]
    require(all(points), "a part of the arm is behind the viewer")
    is_in_view = all(0 <= p.x <= view.width and 0 <= p.y <= view.height for p in points)
    width, height = (np.ptp([p[axis] for p in points]) for axis in range(2))
    return float(max(width / view.width, height / view.height)) if is_in_view else 2.0


def modifier_visibility() -> list[tuple[str, bool, bool]]:
    """Return type, visibility in the viewport and visibility in renders of the rig's modifiers."""
    return [(m.type, m.show_viewport, m.show_render) for m in arm_object().modifiers if m.type in MODIFIERS]


def find_the_sidebar(_folder: Path) -> Iterator[float]:
    """Check that the installed extension is enabled, and open its tab in the sidebar."""
    require(EXTENSION in bpy.context.preferences.addons, f"{EXTENSION} is not enabled")
    module_path = Path(extension_module("jobs.job").__file__)
    user_folder = Path(os.environ["BLENDER_USER_RESOURCES"])
    require(
        module_path.is_relative_to(user_folder),
        f"the add-on comes from {module_path}, not from what was installed into {user_folder}",
    )
    yield from sidebar.open_tab()
    opened = yield from sidebar.list_open_sections()
    require(opened == {"rig"}, f"without a rig only the section Rig should be shown, not {sorted(opened)}")


def add_the_arm(folder: Path) -> Iterator[float]:
    """Press Add Sample Arm, and save the file."""
    cube = bpy.data.objects["Cube"]
    cube.select_set(False)
    bpy.context.view_layer.objects.active = None
    yield from redraw_window()
    yield from sidebar.press_button("fdda.add_sample_arm")
    yield from wait_until(lambda: "arm" in bpy.data.objects, 20, "no arm is added")
    require(not cube.visible_get(), "the default cube is still visible")
    require(
        len(arm_object().data.vertices) == DEFAULT_VERTICES, f"the arm has {len(arm_object().data.vertices)} vertices"
    )
    yield from save_screenshot(folder / "framed.png")
    require(0.4 < extent_in_view() < 1.0, f"the arm takes {extent_in_view():.2f} of the view's height or width")
    # The following steps are faster with the small arm.
    bpy.ops.ed.undo()
    yield 0.5
    bpy.ops.fdda.add_sample_arm(density="1")
    bpy.ops.ed.undo_push(message="arm")
    require(bpy.context.view_layer.objects.active == arm_object(), "the arm is not the active object")
    require(
        len(arm_object().data.vertices) == SMALL_VERTICES, f"the arm has {len(arm_object().data.vertices)} vertices"
    )
    require(len(bpy.data.objects["arm_rig"].pose.bones) == BONE_COUNT, "the armature has other joints")
    require([m.type for m in arm_object().modifiers] == MODIFIERS, "the arm has other modifiers")
    with region_override("WINDOW"):
        bpy.ops.view3d.view_selected()
    yield 0.5
    bpy.ops.wm.save_as_mainfile(filepath=str(folder / "work" / BLEND_FILE_NAME))


def measure_the_rig(_folder: Path) -> Iterator[float]:
    """Press Measure Speed in the section Rig."""
    yield from sidebar.open_section("rig")
    yield from sidebar.press_button("fdda.measure()")
    yield from wait_for_job("measure", 40)
    cost = extension_module("operators.rig").measured_cost(arm_object())
    require(0 < cost.linear < cost.rig, f"the armature alone takes {cost.linear} ms and the whole rig {cost.rig}")


def preview_a_random_pose(_folder: Path) -> Iterator[float]:
    """Type 2 into the field Preview Pose: the second random pose is shown."""
    rest_positions = arm_positions()
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
    settings.sample = "SELECTED"
    yield from redraw_window()
    yield from sidebar.press_button("fdda.use_selected_bones")
    require(
        [bone.name for bone in settings.sampled_bones] == [bone_name], f"the bones to pose are not {bone_name} only"
    )
    bpy.ops.fdda.preview_pose(step=1)
    posed_bones = [bone.name for bone in bones if max(map(abs, bone.rotation_euler)) > 1e-6]
    require(posed_bones == [bone_name], f"the random pose moves {posed_bones}, not only {bone_name}")
    yield from save_screenshot(folder / "chosen_bone.png")
    settings.sample = "WEIGHTS"
    yield from redraw_window()


def set_the_number_of_poses(_folder: Path) -> Iterator[float]:
    """Press Rest Pose, and type a number into the field Random Poses."""
    yield from sidebar.press_button("fdda.rest_pose", across=0.85)
    rotated_bones = [b.name for b in bpy.data.objects["arm_rig"].pose.bones if max(map(abs, b.rotation_euler)) > 1e-6]
    require(not rotated_bones, f"{rotated_bones} are not at rest")
    x, y = yield from sidebar.find_button("settings.poses", across=0.7)
    yield from click(x, y, times=2)
    yield from press_keys("ctrl+a", *str(POSE_COUNT), "Return")
    poses = arm_object().fdda.settings.poses
    require(poses == POSE_COUNT, f"typed {POSE_COUNT}, and there are {poses} random poses")


def record(folder: Path) -> Iterator[float]:
    """Press Record, and wait for the end of the recording."""
    job = extension_module("jobs.job")
    yield from sidebar.open_section("recording")
    yield from sidebar.press_button("fdda.record")
    yield from wait_until(lambda: job.state_of("record") and job.state_of("record").done, 30, "nothing is recorded")
    yield from save_screenshot(folder / "recording.png")
    yield from wait_for_job("record", 90)
    index = extension_module("core.recording.index").read_index(folder / "work" / "arm_recording")
    require(index["complete"] == POSE_COUNT, f"{index['complete']} poses are recorded")
    require(bpy.data.objects["arm_rig"].animation_data.action is not None, "the recording has not restored the action")


def check_the_trainer(_folder: Path) -> Iterator[float]:
    """Press Check Setup: the Python that trains has torch."""
    session = extension_module("training.environment.session")
    yield from sidebar.open_section("training")
    yield from sidebar.press_button("fdda.check_trainer", across=0.2)
    yield from wait_until(lambda: session.check_result is not None, 60, "the check does not end")
    require(session.check_result.level == "INFO", f"the check says '{session.check_result.message}'")
    yield 0.3


def train(folder: Path) -> Iterator[float]:
    """Press Train: Blender stays responsive, and the model is more accurate than linear skinning."""
    job = extension_module("jobs.job")
    epochs = arm_object().fdda.settings.epochs
    yield from sidebar.press_button("fdda.train")
    yield from wait_until(lambda: job.current() is not None, 10, "the button starts no training")
    longest_wait, state = 0.0, job.current()
    while state.is_running and len(state.curves.get("validation", ())) < epochs // 2:
        start = time.monotonic()
        yield 0.05
        longest_wait = max(longest_wait, time.monotonic() - start)
    require(longest_wait < 2, f"Blender did not answer for {longest_wait:.1f} s while the trainer worked")
    if state.is_running:
        yield from save_screenshot(folder / "training.png")
    yield from wait_for_job("train", 120)
    require(len(state.curves["training"]) == epochs, f"{len(state.curves['training'])} epochs have a loss")
    report = json.loads((folder / "work" / "arm_model" / "report.json").read_text(encoding="utf-8"))
    fdda, linear = (report[deformation]["held_out"]["mean"] for deformation in ("fdda", "linear"))
    require(fdda < linear, f"the held-out error is {fdda} mm and the error of linear skinning {linear} mm")


def bind(_folder: Path) -> Iterator[float]:
    """Press Bind in the section Model: the model deforms the mesh, and the rig's modifiers are off."""
    global _rig_positions, _model_positions
    _rig_positions = arm_positions()
    yield from sidebar.open_section("playback")
    yield from sidebar.press_button("fdda.bind")
    yield from wait_until(lambda: arm_object().fdda.is_bound, 20, "the button binds nothing")
    check_model_plays()
    require(
        not any(viewport for _, viewport, _ in modifier_visibility()),
        f"the rig's modifiers are still on: {modifier_visibility()}",
    )
    _model_positions = arm_positions()
    distance = mean_distance_mm(_model_positions, _rig_positions)
    require(1e-4 < distance < 5, f"at frame {BENT_FRAME} the model is {distance:.4f} mm from the rig")


def switch_the_deformation(folder: Path) -> Iterator[float]:
    """Press Rig, Skinning and Model, and compare the shapes."""
    positions = {}
    for mode, across in (("RIG", 0.15), ("LINEAR", 0.5), ("FDDA", 0.88)):
        yield from sidebar.press_button("fdda.mode", across)
        yield from wait_until(
            lambda mode=mode: arm_object().fdda.mode == mode, 5, f"the button does not switch to {mode}"
        )
        positions[mode] = arm_positions()
        yield from save_screenshot(folder / f"mode_{mode.lower()}.png")
    require(np.allclose(positions["RIG"], _rig_positions, atol=1e-6), "the rig is not shown as it was before binding")
    require(np.allclose(positions["FDDA"], _model_positions, atol=1e-6), "the model is not shown as before")
    linear, fdda = (mean_distance_mm(positions[mode], _rig_positions) for mode in ("LINEAR", "FDDA"))
    require(fdda < linear, f"the model is {fdda:.3f} mm from the rig, linear skinning {linear:.3f}")


def measure_the_model(_folder: Path) -> Iterator[float]:
    """Press Measure Speed in the section Model."""
    yield from sidebar.press_button("fdda.measure_model")
    yield from wait_until(
        lambda: extension_module("timing.frame_times").get(arm_object()) is not None, 60, "nothing is measured"
    )
    times = extension_module("timing.frame_times").get(arm_object())
    require(min(times.rig, times.linear, times.fdda) > 0, f"there are times of 0: {times}")


def play_the_action(_folder: Path) -> Iterator[float]:
    """Play the action: the arm changes its shape from frame to frame."""
    bpy.context.scene.frame_set(1)
    yield from start_playback()
    positions_by_frame, end_time = {}, time.monotonic() + PLAY_SECONDS
    while time.monotonic() < end_time or (
        len(positions_by_frame) < 4 and time.monotonic() < end_time + EXTRA_PLAY_SECONDS
    ):
        yield 0.1
        frame = bpy.context.scene.frame_current
        mesh = arm_object().evaluated_get(bpy.context.evaluated_depsgraph_get()).data
        frame_positions = np.empty((len(mesh.vertices), 3), np.float32)
        mesh.attributes["position"].data.foreach_get("vector", frame_positions.reshape(-1))
        positions_by_frame[frame] = frame_positions
    yield from stop_playback()
    require(
        len(positions_by_frame) > 2, f"in {PLAY_SECONDS} seconds the frames {sorted(positions_by_frame)} were shown"
    )
    first, last = positions_by_frame[min(positions_by_frame)], positions_by_frame[max(positions_by_frame)]
    require(
        mean_distance_mm(first, last) > 1,
        f"the arm has the same shape at frame {min(positions_by_frame)} and {max(positions_by_frame)}",
    )
    require(not arm_object().fdda.status, f"the model was switched off: {arm_object().fdda.status}")


def evaluate(_folder: Path) -> Iterator[float]:
    """Press Evaluate: the model is compared with the rig in each frame of the active action."""
    bpy.context.scene.frame_set(BENT_FRAME)
    yield from sidebar.open_section("evaluation")
    yield from sidebar.press_button("fdda.evaluate")
    evaluations = extension_module("evaluation.last_evaluation")
    yield from wait_until(lambda: evaluations.get(arm_object()) is not None, 90, "nothing is evaluated")
    last = evaluations.get(arm_object())
    require(last.poses == FRAME_COUNT, f"{last.poses} frames are compared")
    fdda, linear = last.total["fdda"].mean, last.total["linear"].mean
    require(0 < fdda < linear, f"the model is {fdda} mm from the rig and linear skinning {linear}")


def show_the_heat_map(folder: Path) -> Iterator[float]:
    """Press Heat Map: the arm shows the errors as colors."""
    yield from _show_colors("ERRORS", folder)


def show_the_partitions(folder: Path) -> Iterator[float]:
    """Press Body Parts: each body part has a color."""
    yield from _show_colors("PARTITIONS", folder)


def _show_colors(colors: str, folder: Path) -> Iterator[float]:
    across = {"ERRORS": 0.5, "PARTITIONS": 0.85}[colors]
    yield from sidebar.press_button(f"fdda.color_mesh(colors='{colors}')", across)
    yield from wait_until(
        lambda: extension_module("evaluation.heat_map").paint_kind(arm_object()) == colors,
        5,
        f"the button does not show {colors}",
    )
    with region_override("WINDOW"):
        bpy.ops.object.select_all(action="DESELECT")
    screenshot = folder / "colors.png"
    yield from save_screenshot(screenshot)
    ratio = colored_ratio(screenshot)
    screenshot.unlink()
    require(ratio > MIN_COLORED_RATIO, f"{100 * ratio:.2f} % of the viewport has a color")


def mark_the_worst_frames(_folder: Path) -> Iterator[float]:
    """Press Add Markers, jump to the worst frame, and show the errors of that frame only."""
    yield from sidebar.press_button("fdda.add_worst_markers", across=0.8)
    worst = extension_module("evaluation.last_evaluation").get(arm_object()).worst_poses(5)
    timeline_markers = extension_module("evaluation.markers").find(bpy.context.scene)
    require(
        {marker.frame for marker in timeline_markers} == {index + 1 for index, _ in worst},
        f"markers are at {sorted(marker.frame for marker in timeline_markers)}, the worst frames are {worst}",
    )
    yield from sidebar.press_button("fdda.jump_to_worst")
    yield 0.2
    frame = bpy.context.scene.frame_current
    require(frame == worst[0][0] + 1, f"it jumps to frame {frame}, the worst is {worst[0][0] + 1}")
    view = bpy.context.window_manager.fdda_view
    yield from sidebar.press_button("fdda_view.statistic", across=0.85)
    yield from wait_until(lambda: view.statistic == "pose", 5, f"the button shows '{view.statistic}', not this frame")
    initial_range_mm = view.range_mm
    yield from sidebar.press_button("fdda.fit_color_range", across=0.98)
    yield from wait_until(
        lambda: view.range_mm > initial_range_mm, 5, f"the range of the colors is still {view.range_mm} mm"
    )


def unpack_and_pack_the_model(_folder: Path) -> Iterator[float]:
    """Press Unpack Model and Pack in the section Model Library; the model was packed when it was bound."""
    require(arm_object().fdda.packed is not None, "the bound model is not packed")
    yield from sidebar.open_section("models")
    yield from sidebar.press_button("fdda.unpack_model")
    yield from wait_until(lambda: arm_object().fdda.packed is None, 5, "the button unpacks nothing")
    yield from redraw_window()
    yield from sidebar.press_button("fdda.pack_model")
    yield from wait_until(lambda: arm_object().fdda.packed is not None, 5, "the button packs nothing")
    require(mean_distance_mm(arm_positions(), _model_positions) < 1e-3, "the packed model gives another shape")


def unbind(_folder: Path) -> Iterator[float]:
    """Press Unbind: the modifiers of the rig are restored."""
    extension_module("evaluation.heat_map").clear_all()
    yield from sidebar.open_section("playback")
    yield from sidebar.press_button("fdda.unbind")
    yield from wait_until(lambda: not arm_object().fdda.is_bound, 5, "the button does not unbind")
    require(
        modifier_visibility() == [(kind, True, True) for kind in MODIFIERS],
        f"the rig's modifiers are {modifier_visibility()}",
    )
    require([m.type for m in arm_object().modifiers] == MODIFIERS, "binding has left a modifier behind")
    require(np.allclose(arm_positions(), _rig_positions, atol=1e-6), "the rig is not as it was before binding")


def undo(_folder: Path) -> Iterator[float]:
    """Press Ctrl Z over the viewport: the model is bound again and plays."""
    yield from park_mouse()
    yield from press_keys("ctrl+z")
    yield from wait_until(lambda: arm_object().fdda.is_bound, 5, "undo does not bind the model again")
    yield 0.3
    distance = mean_distance_mm(arm_positions(), _model_positions)
    require(distance < 1e-3, f"after the undo the model is {distance:.4f} mm from where it was")


def save_and_open_again(folder: Path) -> Iterator[float]:
    """Save and open the file without the model file next to it: the packed model plays."""
    bpy.ops.wm.save_mainfile()
    model = folder / "work" / "arm_model" / "arm.onnx"
    model.rename(model.with_suffix(".away"))
    bpy.ops.wm.read_homefile(app_template="")
    require("arm" not in bpy.data.objects, "the file is still open")
    yield 0.5
    bpy.ops.wm.open_mainfile(filepath=str(folder / "work" / BLEND_FILE_NAME))
    yield 1.0
    require(arm_object().fdda.is_bound and arm_object().fdda.mode == "FDDA", "the model is not bound any more")
    distance = mean_distance_mm(arm_positions(), _model_positions)
    require(
        distance < 1e-3 and not arm_object().fdda.status,
        f"opened again it is {distance:.4f} mm off; {arm_object().fdda.status}",
    )
    require(view_region("UI").active_panel_category == "FDDA", "the sidebar has another tab")


STEPS = (
    find_the_sidebar,
    add_the_arm,
    measure_the_rig,
    preview_a_random_pose,
    choose_the_bones_to_pose,
    set_the_number_of_poses,
    record,
    check_the_trainer,
    train,
    bind,
    switch_the_deformation,
    measure_the_model,
    play_the_action,
    evaluate,
    show_the_partitions,
    show_the_heat_map,
    mark_the_worst_frames,
    unpack_and_pack_the_model,
    unbind,
    undo,
    save_and_open_again,
)

__all__ = ["STEPS", "StepError"]
