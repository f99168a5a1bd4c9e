# SPDX-License-Identifier: GPL-3.0-or-later
"""Train on a simulation and measure the errors: `python benchmarks/simulation.py OUT`, for docs/simulations.md.

Gives the arm flesh that sags and bulges: a soft body of Blender whose goal is the skinned surface. Records settled
poses and trains on them. Compares the model and linear skinning with held-out settled poses. Also measures the time of
a frame, and how repeatable a settled pose is. Writes OUT/simulation.json and the files of each step.
"""

import argparse
import json
import sys
import time
from collections.abc import Sequence
from pathlib import Path

ROOT = Path(__file__).resolve().parent.parent
sys.path.insert(0, str(ROOT))

import bpy  # noqa: E402

import fdda_addon  # noqa: E402
from blend_fixtures.characters.targets import TARGET, add_cloth, add_target_copy  # noqa: E402
from fdda_addon.arm.rig import build_arm  # noqa: E402
from fdda_addon.cli.main import main as run_verb  # noqa: E402
from fdda_addon.scene.blend_file import save_copy  # noqa: E402

SOFT_GROUPS = ("shoulder", "elbow")
"""Vertex groups of the upper arm and forearm. With `--kind whole-arm` the hand is soft as well."""
SOFT_GOAL = 0.9
"""Goal weight of the soft parts, 0 to 1: a lower goal lets the flesh sag more."""
TIMED_FRAMES = 60
PICTURED_POSES = 20
"""Number of held-out poses for the heat map, with a different seed; the three worst are drawn."""


def build(path: Path, kind: str) -> None:
    """Build the arm with only its Armature modifier, and a copy of it that is simulated flesh."""
    bpy.ops.wm.read_factory_settings(use_empty=True)
    build_arm()
    mesh_object = next(o for o in bpy.context.scene.objects if o.type == "MESH")
    for modifier in [m for m in mesh_object.modifiers if m.type != "ARMATURE"]:
        mesh_object.modifiers.remove(modifier)
    flesh = add_target_copy(mesh_object)
    if kind == "cloth":
        add_cloth(flesh, quality=5)
    else:
        make_soft_body(flesh, SOFT_GROUPS if kind == "soft-body" else [group.name for group in flesh.vertex_groups])
    bpy.context.scene.frame_set(1)
    save_copy(path)


def make_soft_body(flesh: bpy.types.Object, soft_bones: Sequence[str]) -> None:
    """Add a soft body with springs along the edges and across the faces, and with the skinned surface as its goal.

    Without springs across the faces, faces shear and edges buckle at random. The result then does not look like flesh,
    and it is not a function of the pose.
    """
    soft_group_indices = {flesh.vertex_groups[name].index for name in soft_bones}
    goal_group = flesh.vertex_groups.new(name="held")
    for vertex in flesh.data.vertices:
        weights = {element.group: element.weight for element in vertex.groups}
        softness = sum(weights.get(index, 0.0) for index in soft_group_indices) / sum(weights.values())
        goal_group.add([vertex.index], 1 - (1 - SOFT_GOAL) * softness, "REPLACE")
    flesh.modifiers.new("Softbody", "SOFT_BODY")
    soft_body = flesh.soft_body
    soft_body.use_goal, soft_body.goal_default, soft_body.vertex_group_goal = True, 1.0, goal_group.name
    soft_body.goal_spring, soft_body.goal_friction, soft_body.mass = SOFT_GOAL, 30.0, 0.3
    soft_body.use_edges, soft_body.pull, soft_body.push, soft_body.damping, soft_body.bend = True, 0.3, 0.3, 50.0, 0.2
    soft_body.use_stiff_quads, soft_body.shear = True, 0.5


def frame_ms(path: Path, shown: str, hidden: str) -> float:
    """Return the median time of a frame of the action with only one of two objects shown, ms; the cache is empty."""
    bpy.ops.wm.open_mainfile(filepath=str(path))
    bpy.data.objects[hidden].hide_viewport = True
    scene, times = bpy.context.scene, []
    scene.frame_set(1)
    for frame in range(2, TIMED_FRAMES + 2):
        start = time.perf_counter()
        scene.frame_set(frame)
        times.append((time.perf_counter() - start) * 1000)
    return sorted(times)[len(times) // 2]


def time_verb(*arguments: object) -> float:
    """Run a verb of the command line; return the seconds that it took."""
    start = time.perf_counter()
    if status := run_verb([str(argument) for argument in arguments], "fdda"):
        raise SystemExit(status)
    return time.perf_counter() - start


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("out", type=Path)
    parser.add_argument("--kind", choices=("soft-body", "whole-arm", "cloth"), default="soft-body")
    parser.add_argument("--poses", type=int, default=300)
    parser.add_argument("--held-out", type=int, default=50)
    parser.add_argument("--settle-frames", type=int, default=60)
    options = parser.parse_args()
    out = options.out
    out.mkdir(parents=True, exist_ok=True)
    rig, recording, model, bound, errors_path = (
        out / name for name in ("rig.blend", "recording", "model/arm.onnx", "bound.blend", "errors.json")
    )
    fdda_addon.register()
    build(rig, options.kind)
    target_options = ["--object", "arm", "--learn-from", TARGET, "--settle-frames", options.settle_frames]
    seconds = {"record": time_verb("record", rig, recording, *target_options, "--poses", options.poses, "--resume")}
    model.parent.mkdir(exist_ok=True)
    seconds["train"] = time_verb("train", recording, model)
    evaluate_options = [*target_options, "--poses", options.held_out, "--json", errors_path, "--overwrite"]
    seconds["evaluate"] = time_verb("evaluate", rig, model, *evaluate_options)
    picture_options = [
        *target_options,
        "--poses",
        PICTURED_POSES,
        "--json",
        out / "pictured.json",
        "--heatmap",
        out / "heat_map.png",
    ]
    time_verb("evaluate", rig, model, *picture_options, "--seed", 2, "--overwrite")
    time_verb("bind", rig, model, bound, "--object", "arm", "--overwrite")
    errors_mm = json.loads(errors_path.read_text(encoding="utf-8"))
    recording_info = json.loads((recording / "recording.json").read_text(encoding="utf-8"))
    result = {
        "blender": bpy.app.version_string,
        "kind": options.kind,
        "poses": options.poses,
        "unsettled": len(recording_info.get("unsettled", ())),
        "linear_mm": errors_mm["linear"],
        "fdda_mm": errors_mm["fdda"],
        "part": errors_mm["fdda"]["mean"] / errors_mm["linear"]["mean"],
        "repeatability_mm": recording_info.get("repeatability_mm"),
        "simulation_ms": frame_ms(rig, TARGET, "arm"),
        "model_ms": frame_ms(bound, "arm", TARGET),
        "seconds": seconds,
    }
    result["faster"] = result["simulation_ms"] / result["model_ms"]
    (out / "simulation.json").write_text(json.dumps(result, indent=1), encoding="utf-8")
    print(json.dumps(result, indent=1))


if __name__ == "__main__":
    main()
