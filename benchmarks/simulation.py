# SPDX-License-Identifier: GPL-3.0-or-later
"""What is learned of a simulation: `python benchmarks/simulation.py OUT`, the figures of docs/simulations.md.

Gives the arm flesh that sags and bulges, held to the skin of its bones: a soft body of Blender's own. Records settled
poses, trains, and compares model and linear skinning with settled poses that training never saw, beside how far two
ways to the same pose lie apart and what a frame costs. Writes OUT/simulation.json, and the files of each step.
"""

import argparse
import json
import sys
import time
from pathlib import Path

ROOT = Path(__file__).resolve().parent.parent
sys.path.insert(0, str(ROOT))

import bpy  # noqa: E402

import fdda_addon  # noqa: E402
from blend_fixtures.flesh import FLESH, add_flesh, make_cloth, make_soft_body  # noqa: E402
from fdda_addon.arm.rig import build_arm  # noqa: E402
from fdda_addon.cli.main import main as run_verb  # noqa: E402
from fdda_addon.scene.blend_file import save_copy  # noqa: E402

FLESHY = ("shoulder", "elbow")
"""Upper arm and forearm. There is little flesh on a hand; `--kind whole-arm` is soft there as well."""
FRAMES = 60
"""Frames that are timed."""
PICTURED = 20
"""Held-out poses, of another seed, of which three are drawn."""


def build(path: Path, kind: str) -> None:
    """The arm, which keeps its Armature modifier alone, and a copy of it that is flesh."""
    bpy.ops.wm.read_factory_settings(use_empty=True)
    build_arm()
    flesh = add_flesh(next(o for o in bpy.context.scene.objects if o.type == "MESH"))
    if kind == "cloth":
        make_cloth(flesh)
    else:
        make_soft_body(flesh, FLESHY if kind == "soft-body" else [group.name for group in flesh.vertex_groups])
    bpy.context.scene.frame_set(1)
    save_copy(path)


def frame_ms(path: Path, shown: str, hidden: str) -> float:
    """Median time of a frame of the action with one object shown, ms; its simulation is not cached yet."""
    bpy.ops.wm.open_mainfile(filepath=str(path))
    bpy.data.objects[hidden].hide_viewport = True
    scene, times = bpy.context.scene, []
    scene.frame_set(1)
    for frame in range(2, FRAMES + 2):
        start = time.perf_counter()
        scene.frame_set(frame)
        times.append((time.perf_counter() - start) * 1000)
    return sorted(times)[len(times) // 2]


def verb(*arguments: object) -> float:
    """Run a verb of the command line; returns its seconds."""
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
    parser.add_argument("--max-settle-frames", type=int, default=60)
    options = parser.parse_args()
    out = options.out
    out.mkdir(parents=True, exist_ok=True)
    rig, recording, model, bound, errors = (
        out / name for name in ("rig.blend", "recording", "model/arm.onnx", "bound.blend", "errors.json")
    )
    fdda_addon.register()
    build(rig, options.kind)
    of_target = ["--object", "arm", "--target", FLESH, "--max-settle-frames", options.max_settle_frames]
    seconds = {"record": verb("record", rig, recording, *of_target, "--poses", options.poses, "--resume")}
    model.parent.mkdir(exist_ok=True)
    seconds["train"] = verb("train", recording, model)
    evaluated = [*of_target, "--poses", options.held_out, "--json", errors, "--overwrite"]
    seconds["evaluate"] = verb("evaluate", rig, model, *evaluated)
    pictured = [*of_target, "--poses", PICTURED, "--json", out / "pictured.json", "--heatmap", out / "heat_map.png"]
    verb("evaluate", rig, model, *pictured, "--seed", 2, "--overwrite")
    verb("bind", rig, model, bound, "--object", "arm", "--overwrite")
    found = json.loads(errors.read_text(encoding="utf-8"))
    index = json.loads((recording / "recording.json").read_text(encoding="utf-8"))
    result = {
        "blender": bpy.app.version_string,
        "kind": options.kind,
        "poses": options.poses,
        "unsettled": len(index.get("unsettled", ())),
        "linear_mm": found["linear"],
        "fdda_mm": found["fdda"],
        "part": found["fdda"]["mean"] / found["linear"]["mean"],
        "repeatability": index.get("repeatability"),
        "simulation_ms": frame_ms(rig, FLESH, "arm"),
        "model_ms": frame_ms(bound, "arm", FLESH),
        "seconds": seconds,
    }
    result["faster"] = result["simulation_ms"] / result["model_ms"]
    (out / "simulation.json").write_text(json.dumps(result, indent=1), encoding="utf-8")
    print(json.dumps(result, indent=1))


if __name__ == "__main__":
    main()
