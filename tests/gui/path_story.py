# SPDX-License-Identifier: GPL-3.0-or-later
"""The path of a rigger, from adding the sample arm to a saved file that plays: a function a step, with its checks.

Buttons are pressed with the mouse. What Blender itself offers for opening and saving is called.
"""

import json
import os
import time
from collections.abc import Iterator
from pathlib import Path

import bpy
import numpy as np
import sidebar
from arm import BLEND, EXTENSION, FRAME, arm, check_it_plays, distance_mm, job_done, part, shape
from window import (
    StepError,
    check,
    click,
    over,
    picture,
    play,
    press,
    redraw,
    region,
    rest_mouse,
    stop,
    until,
    view_area,
    vivid_part,
)

VERTICES, PAYING, JOINTS, POSES, FRAMES = 1476, 9960, 22, 100, 250
MODIFIERS = ["ARMATURE", "CORRECTIVE_SMOOTH"]
PLAY_SECONDS, SLOW_SECONDS = 4, 30
"""The second where the processor draws, and is busy."""
COLORED = 0.01
"""Part of the viewport that the arm takes, at least; without colors it is 0.001."""

_rig_shape: np.ndarray | None = None
_model_shape: np.ndarray | None = None


def extent_in_view() -> float:
    """How much of the viewport the arm takes, the larger of width and height as a part of the view's."""
    from bpy_extras.view3d_utils import location_3d_to_region_2d
    from mathutils import Vector

    view, region3d = region("WINDOW"), view_area().spaces[0].region_3d
    points = [
        location_3d_to_region_2d(view, region3d, arm().matrix_world @ Vector(corner)) for corner in arm().bound_box
    ]
    check(all(points), "a part of the arm is behind the viewer")
    inside = all(0 <= p.x <= view.width and 0 <= p.y <= view.height for p in points)
    width, height = (np.ptp([p[axis] for p in points]) for axis in range(2))
    return float(max(width / view.width, height / view.height)) if inside else 2.0


def switches() -> list[tuple[str, bool, bool]]:
    """The rig's modifiers and where they are shown."""
    return [(m.type, m.show_viewport, m.show_render) for m in arm().modifiers if m.type in MODIFIERS]


def find_the_sidebar(_folder: Path) -> Iterator[float]:
    """The extension was enabled by its installation; its tab is in the sidebar."""
    check(EXTENSION in bpy.context.preferences.addons, f"{EXTENSION} is not enabled")
    origin = Path(part("jobs.job").__file__)
    own = Path(os.environ["BLENDER_USER_RESOURCES"])
    check(origin.is_relative_to(own), f"the add-on comes from {origin}, not from what was installed into {own}")
    yield from sidebar.show()
    opened = yield from sidebar.open_sections()
    check(opened == {"rig"}, f"without a rig the section Rig alone is there, not {sorted(opened)}")


def add_the_arm(folder: Path) -> Iterator[float]:
    """Press Add Sample Arm, and save the file."""
    cube = bpy.data.objects["Cube"]
    cube.select_set(False)
    bpy.context.view_layer.objects.active = None
    yield from redraw()
    yield from sidebar.push("fdda.add_sample_arm")
    yield from until(lambda: "arm" in bpy.data.objects, 20, "no arm is added")
    check(not cube.visible_get(), "Blender's cube stands in the arm")
    check(len(arm().data.vertices) == PAYING, f"the arm has {len(arm().data.vertices)} vertices")
    yield from picture(folder / "framed.png")
    check(0.4 < extent_in_view() < 1.0, f"the arm takes {extent_in_view():.2f} of the view's height or width")
    # The small one is quicker for what follows.
    bpy.ops.ed.undo()
    yield 0.5
    bpy.ops.fdda.add_sample_arm(density="1")
    bpy.ops.ed.undo_push(message="arm")
    check(bpy.context.view_layer.objects.active == arm(), "the arm is not the active object")
    check(len(arm().data.vertices) == VERTICES, f"the arm has {len(arm().data.vertices)} vertices")
    check(len(bpy.data.objects["arm_rig"].pose.bones) == JOINTS, "the armature has other joints")
    check([m.type for m in arm().modifiers] == MODIFIERS, "the arm has other modifiers")
    with over("WINDOW"):
        bpy.ops.view3d.view_selected()
    yield 0.5
    bpy.ops.wm.save_as_mainfile(filepath=str(folder / "work" / BLEND))


def measure_the_rig(_folder: Path) -> Iterator[float]:
    """Press Measure Speed in the section Rig."""
    yield from sidebar.open_section("rig")
    yield from sidebar.push("fdda.measure()")
    yield from job_done("measure", 40)
    cost = part("operators.rig").measured_cost(arm())
    check(0 < cost.linear < cost.rig, f"the armature alone takes {cost.linear} ms and the whole rig {cost.rig}")


def show_a_random_pose(_folder: Path) -> Iterator[float]:
    """Type 2 into the field Preview Pose: the second random pose is shown."""
    rest = shape()
    yield from sidebar.open_section("poses")
    x, y = yield from sidebar.find("fdda.preview_pose", across=0.25)
    yield from click(x, y, times=2)
    yield from press("ctrl+a", "2", "Return")
    yield 0.3
    shown = arm().evaluated_get(bpy.context.evaluated_depsgraph_get()).data
    moved = np.empty_like(rest)
    shown.attributes["position"].data.foreach_get("vector", moved.reshape(-1))
    check(distance_mm(moved, rest) > 1, "the field shows no other pose")


def choose_what_moves(folder: Path) -> Iterator[float]:
    """Press Use Selected Bones, and look at a random pose: it moves that bone alone. Back to all bones."""
    bones, settings = bpy.data.objects["arm_rig"].pose.bones, arm().fdda.settings
    name = next(bone.name for bone in bones if len(bone.children) == 1)
    for bone in bones:
        (bone if hasattr(bone, "select") else bone.bone).select = bone.name == name
    settings.sample = "SELECTED"
    yield from redraw()
    yield from sidebar.push("fdda.use_selected_bones")
    check([bone.name for bone in settings.sampled_bones] == [name], f"not {name} alone is chosen")
    bpy.ops.fdda.preview_pose(step=1)
    moved = [bone.name for bone in bones if max(map(abs, bone.rotation_euler)) > 1e-6]
    check(moved == [name], f"the random pose moves {moved}, not {name} alone")
    yield from picture(folder / "chosen_bone.png")
    settings.sample = "WEIGHTS"
    yield from redraw()


def choose_a_hundred_poses(_folder: Path) -> Iterator[float]:
    """Back to the rest pose; type a number into the field of random poses."""
    yield from sidebar.push("fdda.rest_pose", across=0.85)
    turned = [b.name for b in bpy.data.objects["arm_rig"].pose.bones if max(map(abs, b.rotation_euler)) > 1e-6]
    check(not turned, f"{turned} are not at rest")
    x, y = yield from sidebar.find("settings.poses", across=0.7)
    yield from click(x, y, times=2)
    yield from press("ctrl+a", *str(POSES), "Return")
    poses = arm().fdda.settings.poses
    check(poses == POSES, f"typed {POSES}, and there are {poses} random poses")


def record(folder: Path) -> Iterator[float]:
    """Press Record and wait."""
    job = part("jobs.job")
    yield from sidebar.open_section("recording")
    yield from sidebar.push("fdda.record")
    yield from until(lambda: job.state_of("record") and job.state_of("record").done, 30, "nothing is recorded")
    yield from picture(folder / "recording.png")
    yield from job_done("record", 90)
    index = part("core.recording.index").read_index(folder / "work" / "arm_recording")
    check(index["complete"] == POSES, f"{index['complete']} poses are recorded")
    check(bpy.data.objects["arm_rig"].animation_data.action is not None, "the recording has not given the action back")


def check_the_trainer(_folder: Path) -> Iterator[float]:
    """Press Check Setup: the trainer's Python has torch."""
    session = part("training.environment.session")
    yield from sidebar.open_section("training")
    yield from sidebar.push("fdda.check_trainer", across=0.2)
    yield from until(lambda: session.check_result is not None, 60, "the check does not end")
    check(session.check_result.level == "INFO", f"the check says '{session.check_result.message}'")
    yield 0.3


def train(folder: Path) -> Iterator[float]:
    """Press Train, do something else meanwhile, and wait."""
    job = part("jobs.job")
    epochs = arm().fdda.settings.epochs
    yield from sidebar.push("fdda.train")
    yield from until(lambda: job.current() is not None, 10, "the button starts no training")
    longest, state = 0.0, job.current()
    while state.is_running and len(state.curves.get("validation", ())) < epochs // 2:
        before = time.monotonic()
        yield 0.05
        longest = max(longest, time.monotonic() - before)
    check(longest < 2, f"Blender did not answer for {longest:.1f} s while the trainer worked")
    if state.is_running:
        yield from picture(folder / "training.png")
    yield from job_done("train", 120)
    check(len(state.curves["training"]) == epochs, f"{len(state.curves['training'])} epochs have a loss")
    report = json.loads((folder / "work" / "arm_model" / "report.json").read_text(encoding="utf-8"))
    fdda, linear = (report[way]["held_out"]["mean"] for way in ("fdda", "linear"))
    check(fdda < linear, f"the held-out error is {fdda} mm and that of linear skinning {linear}")


def bind(_folder: Path) -> Iterator[float]:
    """Press Bind in the section Model: the mesh moves as the rig does, without its modifiers."""
    global _rig_shape, _model_shape
    _rig_shape = shape()
    yield from sidebar.open_section("playback")
    yield from sidebar.push("fdda.bind")
    yield from until(lambda: arm().fdda.is_bound, 20, "the button binds nothing")
    check_it_plays()
    check(not any(viewport for _, viewport, _ in switches()), f"the rig's modifiers are still on: {switches()}")
    _model_shape = shape()
    apart = distance_mm(_model_shape, _rig_shape)
    check(1e-4 < apart < 5, f"at frame {FRAME} the model is {apart:.4f} mm from the rig")


def switch_the_deformation(folder: Path) -> Iterator[float]:
    """Press Rig, Skinning and Model, and compare the shapes."""
    shapes = {}
    for mode, across in (("RIG", 0.15), ("LINEAR", 0.5), ("FDDA", 0.88)):
        yield from sidebar.push("fdda.mode", across)
        yield from until(lambda mode=mode: arm().fdda.mode == mode, 5, f"the button does not switch to {mode}")
        shapes[mode] = shape()
        yield from picture(folder / f"mode_{mode.lower()}.png")
    check(np.allclose(shapes["RIG"], _rig_shape, atol=1e-6), "the true rig is not shown as it was before binding")
    check(np.allclose(shapes["FDDA"], _model_shape, atol=1e-6), "the model is not shown as before")
    linear, fdda = (distance_mm(shapes[mode], _rig_shape) for mode in ("LINEAR", "FDDA"))
    check(fdda < linear, f"the model is {fdda:.3f} mm from the rig, linear skinning {linear:.3f}")


def measure_the_model(_folder: Path) -> Iterator[float]:
    """Press Measure Speed in the section Model."""
    yield from sidebar.push("fdda.measure_model")
    yield from until(lambda: part("timing.frame_times").get(arm()) is not None, 60, "nothing is measured")
    times = part("timing.frame_times").get(arm())
    check(min(times.rig, times.linear, times.fdda) > 0, f"there are times of 0: {times}")


def play_the_action(_folder: Path) -> Iterator[float]:
    """Press space over the viewport: the arm moves, frame by frame."""
    bpy.context.scene.frame_set(1)
    yield from play()
    seen, end = {}, time.monotonic() + PLAY_SECONDS
    while time.monotonic() < end or (len(seen) < 4 and time.monotonic() < end + SLOW_SECONDS):
        yield 0.1
        frame = bpy.context.scene.frame_current
        mesh = arm().evaluated_get(bpy.context.evaluated_depsgraph_get()).data
        positions = np.empty((len(mesh.vertices), 3), np.float32)
        mesh.attributes["position"].data.foreach_get("vector", positions.reshape(-1))
        seen[frame] = positions
    yield from stop()
    check(len(seen) > 2, f"in {PLAY_SECONDS} seconds the frames {sorted(seen)} were shown")
    first, last = seen[min(seen)], seen[max(seen)]
    check(distance_mm(first, last) > 1, f"the arm has the same shape at frame {min(seen)} and {max(seen)}")
    check(not arm().fdda.status, f"the model was switched off: {arm().fdda.status}")


def evaluate(_folder: Path) -> Iterator[float]:
    """Press Evaluate: the active action, frame by frame."""
    bpy.context.scene.frame_set(FRAME)
    yield from sidebar.open_section("evaluation")
    yield from sidebar.push("fdda.evaluate")
    evaluations = part("evaluation.last_evaluation")
    yield from until(lambda: evaluations.get(arm()) is not None, 90, "nothing is evaluated")
    last = evaluations.get(arm())
    check(last.poses == FRAMES, f"{last.poses} frames are compared")
    fdda, linear = last.total["fdda"].mean, last.total["linear"].mean
    check(0 < fdda < linear, f"the model is {fdda} mm from the rig and linear skinning {linear}")


def show_the_heat_map(folder: Path) -> Iterator[float]:
    """Press Heat Map: the errors as colors on the arm."""
    yield from _paint("ERRORS", folder)


def show_the_partitions(folder: Path) -> Iterator[float]:
    """Press Body Parts."""
    yield from _paint("PARTITIONS", folder)


def _paint(colors: str, folder: Path) -> Iterator[float]:
    across = {"ERRORS": 0.5, "PARTITIONS": 0.85}[colors]
    yield from sidebar.push(f"fdda.color_mesh(colors='{colors}')", across)
    yield from until(
        lambda: part("evaluation.heat_map").painted(arm()) == colors, 5, f"the button does not show {colors}"
    )
    with over("WINDOW"):
        bpy.ops.object.select_all(action="DESELECT")
    shown = folder / "colors.png"
    yield from picture(shown)
    vivid = vivid_part(shown)
    shown.unlink()
    check(vivid > COLORED, f"{100 * vivid:.2f} % of the viewport has a color")


def mark_the_worst_frames(_folder: Path) -> Iterator[float]:
    """Press Add Markers, then the first of the worst frames, and look at its errors alone."""
    yield from sidebar.push("fdda.add_worst_markers", across=0.8)
    worst = part("evaluation.last_evaluation").get(arm()).worst(5)
    found = part("evaluation.markers").find(bpy.context.scene)
    check(
        {marker.frame for marker in found} == {index + 1 for index, _ in worst},
        f"markers are at {sorted(marker.frame for marker in found)}, the worst frames are {worst}",
    )
    yield from sidebar.push("fdda.jump_to_worst")
    yield 0.2
    frame = bpy.context.scene.frame_current
    check(frame == worst[0][0] + 1, f"it jumps to frame {frame}, the worst is {worst[0][0] + 1}")
    view = bpy.context.window_manager.fdda_view
    yield from sidebar.push("fdda_view.statistic", across=0.85)
    yield from until(lambda: view.statistic == "pose", 5, f"the button shows '{view.statistic}', not this frame")
    before = view.range_mm
    yield from sidebar.push("fdda.fit_color_range", across=0.98)
    yield from until(lambda: view.range_mm > before, 5, f"red begins at {view.range_mm} mm as before")


def unpack_and_pack_the_model(_folder: Path) -> Iterator[float]:
    """The model was packed when it was bound. Press Unpack Model, and Pack, in the section Model Library."""
    check(arm().fdda.packed is not None, "the bound model is not packed")
    yield from sidebar.open_section("models")
    yield from sidebar.push("fdda.unpack_model")
    yield from until(lambda: arm().fdda.packed is None, 5, "the button unpacks nothing")
    yield from redraw()
    yield from sidebar.push("fdda.pack_model")
    yield from until(lambda: arm().fdda.packed is not None, 5, "the button packs nothing")
    check(distance_mm(shape(), _model_shape) < 1e-3, "packed, the model has another shape")


def unbind(_folder: Path) -> Iterator[float]:
    """Press Unbind: the rig has its modifiers back."""
    part("evaluation.heat_map").clear_all()
    yield from sidebar.open_section("playback")
    yield from sidebar.push("fdda.unbind")
    yield from until(lambda: not arm().fdda.is_bound, 5, "the button does not unbind")
    check(switches() == [(kind, True, True) for kind in MODIFIERS], f"the rig's modifiers are {switches()}")
    check([m.type for m in arm().modifiers] == MODIFIERS, "binding has left a modifier behind")
    check(np.allclose(shape(), _rig_shape, atol=1e-6), "the rig is not as it was before binding")


def undo(_folder: Path) -> Iterator[float]:
    """Press Ctrl Z over the viewport: the model is bound again, and plays."""
    yield from rest_mouse()
    yield from press("ctrl+z")
    yield from until(lambda: arm().fdda.is_bound, 5, "undo does not bind the model again")
    yield 0.3
    apart = distance_mm(shape(), _model_shape)
    check(apart < 1e-3, f"after the undo the model is {apart:.4f} mm from where it was")


def save_and_open_again(folder: Path) -> Iterator[float]:
    """The file that was saved plays, with the model inside it alone."""
    bpy.ops.wm.save_mainfile()
    model = folder / "work" / "arm_model" / "arm.onnx"
    model.rename(model.with_suffix(".away"))
    bpy.ops.wm.read_homefile(app_template="")
    check("arm" not in bpy.data.objects, "the file is still open")
    yield 0.5
    bpy.ops.wm.open_mainfile(filepath=str(folder / "work" / BLEND))
    yield 1.0
    check(arm().fdda.is_bound and arm().fdda.mode == "FDDA", "the model is not bound any more")
    apart = distance_mm(shape(), _model_shape)
    check(apart < 1e-3 and not arm().fdda.status, f"opened again it is {apart:.4f} mm off; {arm().fdda.status}")
    check(region("UI").active_panel_category == "FDDA", "the sidebar has another tab")


STEPS = (
    find_the_sidebar,
    add_the_arm,
    measure_the_rig,
    show_a_random_pose,
    choose_what_moves,
    choose_a_hundred_poses,
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
