# SPDX-License-Identifier: GPL-3.0-or-later
"""Take a clothed character from a recording to a fast rig: `heavy_character.py OUT RIG.blend --action NAME`.

Records, trains and binds all meshes, and makes a fast rig. Random poses are drawn within the ranges of an action; its
own poses are not recorded. In these it measures the errors of each mesh, and the vertices of the clothes inside the
body with their depth, with the rig and with the model. It times frames in turns. Prints the table of
docs/characters.md, and writes it there with --write. What OUT has already is used again.
"""

import argparse
import json
import re
import sys
import time
from collections.abc import Iterator
from pathlib import Path

ROOT = Path(__file__).resolve().parent.parent
sys.path.insert(0, str(ROOT))

import bpy  # noqa: E402
import numpy as np  # noqa: E402
from mathutils.bvhtree import BVHTree  # noqa: E402

import fdda_addon  # noqa: E402
from benchmarks.page_table import PageTable  # noqa: E402
from benchmarks.third_party import run_verb  # noqa: E402
from fdda_addon.poses.action_range import action_frames  # noqa: E402
from fdda_addon.scene.scene_rig import armature_of  # noqa: E402
from fdda_addon.scene.unit import metres_per_unit  # noqa: E402

RIG = ROOT / ".." / "shared" / "data" / "characters" / "vitruvian" / "vitruvian.blend"
TABLE = PageTable(
    ROOT / "docs" / "characters.md",
    "<!-- heavy_character.py --write writes this table -->",
    "<!-- end of the table of heavy_character.py -->",
)
FRAME_STEP = 4
"""Every how many frames of the action vertices inside the body are counted."""
FRAME_RATIO = re.compile(r"([\d.,]+) ms \([^)]*\) with the full rig, ([\d.,]+) ms .*: ([\d.]+) times as fast")


def measure_inside(bound: Path, action: str) -> dict[str, list[list[float]]]:
    """Find the vertices of the other meshes inside the mesh with the most vertices; its openings must be covered.

    Args:
        bound: the bound file.
        action: name of the action that is played.

    Returns:
        By mesh, with the rig and with the model: the average number of vertices in a frame, and two figures of their
        depths in all frames, mm. These are the median and the 99th percentile.
    """
    bpy.ops.wm.open_mainfile(filepath=str(bound), load_ui=False)
    fdda_addon.register()
    meshes = [o for o in bpy.context.scene.objects if o.type == "MESH" and o.fdda.is_bound]
    body = max(meshes, key=lambda o: len(o.data.vertices))
    clothes = [o for o in meshes if o != body]
    armature_object = armature_of(body)
    armature_object.animation_data_create().action = bpy.data.actions[action]
    frames = action_frames(bpy.data.actions[action])[::FRAME_STEP]
    depths = {o.name: ([], []) for o in clothes}
    for index, mode in enumerate(("RIG", "FDDA")):
        for mesh_object in meshes:
            mesh_object.fdda.mode = mode
        for frame in frames:
            bpy.context.scene.frame_set(frame)
            for name, depth_mm in _inside(body, clothes):
                depths[name][index].append(depth_mm)
    return {
        name: [[len(mm) / len(frames), *np.percentile(mm or [0.0], (50, 99)).tolist()] for mm in pair]
        for name, pair in depths.items()
    }


def _inside(body: bpy.types.Object, clothes: list[bpy.types.Object]) -> Iterator[tuple[str, float]]:
    """Yield the piece and the depth in mm of each vertex that lies behind its nearest point of the body."""
    depsgraph = bpy.context.evaluated_depsgraph_get()
    evaluated_body = body.evaluated_get(depsgraph)
    tree = BVHTree.FromObject(body, depsgraph)
    to_body = evaluated_body.matrix_world.inverted()
    unit_mm = 1000 * metres_per_unit(body)
    for piece in clothes:
        evaluated = piece.evaluated_get(depsgraph)
        matrix = to_body @ evaluated.matrix_world
        for vertex in evaluated.data.vertices:
            point = matrix @ vertex.co
            nearest, normal, _, _ = tree.find_nearest(point)
            if (point - nearest).dot(normal) < 0:
                yield piece.name, unit_mm * (point - nearest).length


def timed_verb(times: dict[str, float], out: Path, *arguments: object) -> str:
    """Run a verb unless its output exists, and note the seconds."""
    record = out.with_name(f"{out.name}.txt")
    if not record.exists():
        start = time.monotonic()
        output = run_verb(*arguments)
        record.write_text(f"{time.monotonic() - start:.1f}\n{output}", encoding="utf-8")
    seconds, _, output = record.read_text(encoding="utf-8").partition("\n")
    times[str(arguments[0])] = float(seconds)
    return output


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("out", type=Path)
    parser.add_argument("rig", type=Path, nargs="?", default=RIG)
    parser.add_argument("--action", default="rehearsal", help="the action to measure, which is not recorded")
    parser.add_argument("--poses", type=int, default=1000)
    parser.add_argument("--bones", help="as --bones-to-pose of record (default: those that the action moves)")
    parser.add_argument("--write", action="store_true", help="write the table to docs/characters.md")
    options = parser.parse_args()
    if not options.rig.exists():
        sys.exit(f"There is no '{options.rig}': give the .blend file of a clothed character.")
    if options.write:
        TABLE.check()
    out, rig = options.out.resolve(), options.rig.resolve()
    out.mkdir(parents=True, exist_ok=True)
    recording, model, bound, fast = (out / n for n in ("recording", "model.onnx", "bound.blend", "fast.blend"))
    times: dict[str, float] = {}
    # Without it, random poses would combine limbs of the action.
    bones = options.bones or f"action:{options.action}"
    sampling = ("--poses", options.poses, "--bones-to-pose", bones)
    timed_verb(times, recording, "record", rig, recording, "--all", *sampling)
    timed_verb(times, model, "train", recording, model)
    timed_verb(times, bound, "bind", rig, model, bound)
    fast_text = timed_verb(times, fast, "fast-rig", rig, model, fast)
    errors_path, times_path = out / "errors.json", out / "times.json"
    held_out = ("--poses", 0, "--action", options.action)
    timed_verb(times, errors_path, "evaluate", rig, model, "--json", errors_path, *held_out)
    timed_verb(times, times_path, "benchmark", rig, model, "--json", times_path)
    inside_path = out / "inside.json"
    if not inside_path.exists():
        inside_path.write_text(json.dumps(measure_inside(bound, options.action)), encoding="utf-8")
    errors, benchmark, inside = (json.loads(p.read_text()) for p in (errors_path, times_path, inside_path))
    lines = [
        f"{options.poses:,} random poses (`--bones-to-pose {bones}`), one seed, Blender {bpy.app.version_string}; "
        f"errors on the action *{options.action}*, whose poses are not recorded.",
        "",
        "| mesh | vertices | mean / 99.9 % / largest error, mm | part of linear skinning's mean "
        "| vertices inside the body, and median / 99 % of their depth in mm: rig; model |",
        "|---|---|---|---|---|",
    ]
    for mesh in benchmark["meshes"]:
        fdda, linear = (errors["objects"][mesh["name"]][kind] for kind in ("fdda", "linear"))
        cells = " / ".join(f"{fdda[key]:.3g}" for key in ("mean", "p999", "max"))
        pair = inside.get(mesh["name"])
        inside_text = "; ".join(f"{count:.1f}, {median:.2f} / {p99:.2f}" for count, median, p99 in pair or ())
        ratio = 100 * fdda["mean"] / linear["mean"]
        lines.append(f"| {mesh['name']} | {mesh['vertices']:,} | {cells} | {ratio:.1f} % | {inside_text} |")
    low, high = benchmark["ratio_quartiles"]
    full, fast_ms, fast_ratio = FRAME_RATIO.search(fast_text).groups()
    lines += [
        "",
        f"A frame takes {benchmark['rig']['median']:.1f} ms with the rig and {benchmark['fdda']['median']:.1f} ms with "
        f"the model: {benchmark['ratio']:.1f} times as fast (quartiles {low:.1f} to {high:.1f}). As a fast rig it is "
        f"{fast_ratio} times as fast ({full} and {fast_ms} ms). `record` took {times['record']:.0f} s, `train` "
        f"{times['train']:.0f} s. The model has {model.stat().st_size / 1e6:.1f} MB.",
    ]
    table = "\n".join(lines)
    print(table)
    if options.write:
        TABLE.write(table)


if __name__ == "__main__":
    main()
