# SPDX-License-Identifier: GPL-3.0-or-later
"""Steps of the story `path`: a model is trained, bound, played, packed and unbound. Each function is a step."""

import json
import time
from collections.abc import Iterator
from pathlib import Path

import bpy
import numpy as np
import sidebar
from arm import (
    BENT_FRAME,
    BLEND_FILE_NAME,
    arm_object,
    arm_positions,
    armature_object,
    check_model_plays,
    extension_module,
    has_unkeyed_pose,
    mean_distance_mm,
    pose_without_keyframe,
    require_unkeyed_pose,
    wait_for_job,
)
from poses_steps import POSE_COUNT
from window import (
    park_mouse,
    press_keys,
    redraw_window,
    require,
    save_screenshot,
    start_playback,
    stop_playback,
    view_region,
    wait_until,
)

MODIFIERS = ["ARMATURE", "CORRECTIVE_SMOOTH"]
PLAY_SECONDS, EXTRA_PLAY_SECONDS = 4, 30
"""How long the action plays, and how much longer at most where the CPU renders the viewport."""

_rig_positions: np.ndarray | None = None
_model_positions: np.ndarray | None = None


def modifier_visibility() -> list[tuple[str, bool, bool]]:
    """Return type, visibility in the viewport and visibility in renders of the rig's modifiers."""
    return [(m.type, m.show_viewport, m.show_render) for m in arm_object().modifiers if m.type in MODIFIERS]


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
    epochs = extension_module("core.settings").automatic_passes(POSE_COUNT)
    yield from sidebar.press_button("fdda.train")
    yield from wait_until(lambda: job.current() is not None, 10, "the button starts no training")
    longest_wait, state = 0.0, job.current()
    while state.is_running and len(state.curves.get("validation", ())) < epochs // 2:
        start = time.monotonic()
        yield 0.05
        longest_wait = max(longest_wait, time.monotonic() - start)
    require(longest_wait < 2, f"Blender did not answer for {longest_wait:.1f} s while the trainer worked")
    if state.is_running:
        require(
            state.heading == "Step 3 of 3" and state.detail.startswith("Training"),
            f"the progress is '{state.sentence}'",
        )
        require(state.remaining_seconds is not None, "the remaining time is unknown in the middle of the training")
        yield from save_screenshot(folder / "training.png")
    yield from wait_for_job("train", 120)
    require(len(state.curves["training"]) == epochs, f"{len(state.curves['training'])} epochs have a loss")
    report = json.loads((folder / "work" / "arm_model" / "report.json").read_text(encoding="utf-8"))
    fdda, linear = (report[deformation]["held_out"]["mean"] for deformation in ("fdda", "linear"))
    require(fdda < linear, f"the held-out error is {fdda} mm and the error of linear skinning {linear} mm")
    assessment = extension_module("core.sentences.assessment").assess_training(report)
    require(assessment.sentence.startswith("arm, unseen poses: "), f"the verdict is '{assessment.sentence}'")
    yield from redraw_window()
    yield from sidebar.find_button("fdda.bind")


def bind(_folder: Path) -> Iterator[float]:
    """Press Bind in the section Model: the model deforms the mesh in its pose, and the rig's modifiers are off."""
    global _rig_positions, _model_positions
    _rig_positions = arm_positions()
    yield from sidebar.open_section("playback")
    pose_without_keyframe()
    yield from sidebar.press_button("fdda.bind")
    yield from wait_until(lambda: arm_object().fdda.is_bound, 20, "the button binds nothing")
    yield 0.3
    check_model_plays()
    require_unkeyed_pose("Bind")
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
    """Press Measure Speed in the section Model; the pose stays."""
    pose_without_keyframe()
    yield from sidebar.press_button("fdda.measure()")
    last = extension_module("timing.measurements").last
    yield from wait_until(lambda: last("measure", armature_object()) is not None, 60, "nothing is measured")
    yield 0.3
    require_unkeyed_pose("the measurement")
    times = last("measure", armature_object())
    require(min(map(times.median, ("rig", "linear", "fdda"))) > 0, f"there are times of 0: {times}")


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


def undo_while_posing(_folder: Path) -> Iterator[float]:
    """Press Ctrl Z while a model is bound: a pose without a keyframe stays."""
    pose_without_keyframe()
    bpy.ops.ed.undo_push(message="before")
    arm_object()["marker"] = 1
    bpy.ops.ed.undo_push(message="after")
    yield from park_mouse()
    yield from press_keys("ctrl+z")
    yield from wait_until(lambda: "marker" not in arm_object(), 5, "nothing is undone")
    yield 0.3
    check_model_plays()
    require_unkeyed_pose("the undo")
    bpy.context.scene.frame_set(BENT_FRAME)
    require(not has_unkeyed_pose(), "setting the frame does not remove the pose")


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
