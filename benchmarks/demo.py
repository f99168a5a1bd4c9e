# SPDX-License-Identifier: GPL-3.0-or-later
"""Build, record, train, evaluate and bind the arm with one command: `python benchmarks/demo.py FOLDER`."""

import math
import shutil
import sys
import time
from pathlib import Path

import bpy

sys.path.insert(0, str(Path(__file__).resolve().parent.parent))

from fdda_addon import register, unregister
from fdda_addon.arm.joints import ACTION_NAME, ELBOW_FLEXION, FINGERS
from fdda_addon.cli.evaluate import run_evaluations, table
from fdda_addon.cli.files import open_file
from fdda_addon.cli.main import main as run_verb
from fdda_addon.core.files.output import write_json
from fdda_addon.evaluation.picture import View
from fdda_addon.evaluation.pictures import draw_comparison, draw_partitions, make_pictured_pose
from fdda_addon.evaluation.results import Evaluation
from fdda_addon.evaluation.settings import EvaluationSettings
from fdda_addon.scene.scene_rig import find_rig

POSES, REFINED_POSES, HELD_OUT_POSES = 3000, 1000, 200
OVERSHOOT = 2.0
EPOCHS = 50
"""Four times the default number of poses for a quarter of the default epochs: as many training steps.

Recording the arm is cheap compared with training it.
"""
VIEW = View(azimuth=15, elevation=50)
PICTURED_FRAMES = {52: "reach", 110: "flex", 132: "fist", 190: "spread"}
METACARPAL_RANGE_DEGREES = 20.0


def _radians(*angles: float) -> tuple[float, float, float]:
    return tuple(math.radians(angle) for angle in angles)


def _metacarpal_rotations(factor: float) -> dict[str, tuple[float, float, float]]:
    """Rotate all four metacarpals by `factor` times their range; neighbors rotate in opposite directions."""
    angle = factor * METACARPAL_RANGE_DEGREES
    return {f"{finger}_0": _radians(angle * (-1) ** i, 0, angle * (-1) ** i) for i, finger in enumerate(FINGERS)}


EXTREME_POSES = {
    "elbow 3x its range, off its axis": {"elbow": _radians(70, 0, 3 * ELBOW_FLEXION)},
    "metacarpals 2.5x their range": _metacarpal_rotations(2.5),
}
"""Rotations of bones by name, in actions of one frame."""


def main(folder: Path) -> int:
    """Run the demo. It writes all its files to the folder and replaces those of an earlier run.

    Returns:
        The exit status.
    """
    rig, recording, model = folder / "arm.blend", folder / "recording", folder / "arm.onnx"
    evaluation_path, bound, pictures = folder / "evaluation.json", folder / "arm_bound.blend", folder / "pictures"
    folder.mkdir(parents=True, exist_ok=True)
    shutil.rmtree(recording, ignore_errors=True)
    start = time.monotonic()
    refine = ["record", rig, recording, "--refine", model]
    for title, arguments in (
        ("1. The rig", ["build-arm", rig]),
        ("2. Recording", ["record", rig, recording, "--poses", POSES, "--overshoot", OVERSHOOT]),
        ("3. Training", ["train", recording, model, "--passes", EPOCHS]),
        ("Refinement: more poses where the error is largest", [*refine, "--poses", REFINED_POSES]),
        ("", ["train", recording, model, "--passes", EPOCHS, "--warm-start"]),
    ):
        if title:
            print(f"\n== {title}", flush=True)
        if status := run_verb([str(argument) for argument in arguments], "python -m fdda_addon"):
            return status

    print("\n== 4. Evaluation", flush=True)
    evaluation = _evaluate(rig, model, evaluation_path, pictures)

    print("\n== 5. Runtime", flush=True)
    if status := run_verb(["bind", str(rig), str(model), str(bound)], "python -m fdda_addon"):
        return status
    print(f"\n{table(evaluation)}\n\nDone in {time.monotonic() - start:.0f} s:")
    for path, description in (
        (rig, "the rig"),
        (recording, f"{POSES + REFINED_POSES} poses and their residuals"),
        (model, "the model"),
        (folder / "report.json", "figures of the training"),
        (folder / "report.html", "a page with the training and the errors"),
        (evaluation_path, "the errors above and the errors of each partition"),
        (bound, "the character bound to the model: open it and play"),
        (pictures, "partitions, comparisons and heat maps"),
    ):
        print(f"  {path}{'/' if path.is_dir() else ''}  {description}")
    return 0


def _evaluate(rig: Path, model: Path, out: Path, pictures: Path) -> Evaluation:
    open_file(rig)
    scene_rig = find_rig()
    animation = scene_rig.armature_object.animation_data
    for name, rotations in EXTREME_POSES.items():
        animation.action = bpy.data.actions.new(name)
        for bone in scene_rig.armature_object.pose.bones:
            bone.rotation_euler = rotations.get(bone.name, (0, 0, 0))
            bone.keyframe_insert("rotation_euler", frame=1)
    animation.action = bpy.data.actions[ACTION_NAME]
    actions = (ACTION_NAME, *EXTREME_POSES)
    settings = EvaluationSettings(HELD_OUT_POSES, actions=actions, range_scales=(1.5, 2.0, 3.0))
    evaluation = run_evaluations({"": (scene_rig, model)}, settings)[""]
    write_json(out, evaluation.to_json())

    pictures.mkdir(exist_ok=True)
    action_errors = evaluation.actions[0]
    action_poses = [
        make_pictured_pose(action_errors, frame - 1, f"{name}, frame {frame}")
        for frame, name in PICTURED_FRAMES.items()
    ]
    outside_poses = [make_pictured_pose(errors, 0, errors.name) for errors in evaluation.actions[1:]]
    draw_partitions(scene_rig, pictures / "1_partitions.png", VIEW)
    for is_heat_map, prefix, kind in ((False, 2, "comparison"), (True, 3, "heat_map")):
        draw_comparison(scene_rig, model, action_poses, pictures / f"{prefix}_{kind}.png", is_heat_map, view=VIEW)
    for is_heat_map, prefix, kind in ((False, 4, "beyond"), (True, 5, "beyond_heat_map")):
        title = "Outside the range of motion" + (": distance from the rig" if is_heat_map else "")
        draw_comparison(scene_rig, model, outside_poses, pictures / f"{prefix}_{kind}.png", is_heat_map, title, VIEW)
    return evaluation


if __name__ == "__main__":
    register()
    try:
        status = main(*map(Path, sys.argv[1:]))
    finally:
        unregister()
    sys.exit(status)
