# SPDX-License-Identifier: GPL-3.0-or-later
"""Learns a surface from files alone: `python learn_from_cache.py RIG.blend CACHE OUT [--object NAME] [--action NAME]`.

RIG.blend has the rest mesh, its weights and the armature's action; nothing in it computes the surface. CACHE is an
Alembic, USD or .pc2 file of the mesh in the frames of that action, from Houdini, Maya or a farm that simulates. Writes
OUT/target.blend, the recording OUT/recording, the model OUT/model/NAME.onnx and OUT/errors.json. docs/simulations.md
tells the steps.
"""

import argparse
import subprocess
import sys
from pathlib import Path

import bpy

TARGET = "target"


def import_cache(path: Path, mesh_object: bpy.types.Object) -> bpy.types.Object:
    """An object that shows the cache: imported, or a bare copy of the mesh that plays a .pc2 file."""
    if path.suffix == ".pc2":
        shown = mesh_object.copy()
        shown.data = mesh_object.data.copy()
        shown.modifiers.clear()
        bpy.context.scene.collection.objects.link(shown)
        modifier = shown.modifiers.new("Cache", "MESH_CACHE")
        modifier.cache_format, modifier.filepath = "PC2", str(path)
        modifier.frame_start = bpy.context.scene.frame_start
        return shown
    before = set(bpy.data.objects)
    importer = bpy.ops.wm.alembic_import if path.suffix == ".abc" else bpy.ops.wm.usd_import
    importer(filepath=str(path))
    count = len(mesh_object.data.vertices)
    found = [o for o in bpy.data.objects if o not in before and o.type == "MESH" and len(o.data.vertices) == count]
    if len(found) != 1:
        sys.exit(f"'{path}' holds {len(found)} meshes of {count} vertices; export the one that is to be learned.")
    return found[0]


def run(*arguments: object) -> None:
    """A verb of the command line; ends the program where it fails, after it has said why."""
    done = subprocess.run([sys.executable, "-m", "fdda_addon", *map(str, arguments)], check=False)
    if done.returncode:
        sys.exit(done.returncode)


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("rig", type=Path)
    parser.add_argument("cache", type=Path)
    parser.add_argument("out", type=Path)
    parser.add_argument("--object", required=True)
    parser.add_argument("--action", required=True)
    options = parser.parse_args()
    out = options.out.resolve()
    (out / "model").mkdir(parents=True, exist_ok=True)
    bpy.ops.wm.open_mainfile(filepath=str(options.rig))
    import_cache(options.cache.resolve(), bpy.data.objects[options.object]).name = TARGET
    with_target = out / "target.blend"
    bpy.ops.wm.save_as_mainfile(filepath=str(with_target))
    of_target = "--object", options.object, "--target", TARGET, "--action", options.action
    run("record", with_target, out / "recording", *of_target)
    run("check-recording", out / "recording")
    model = out / "model" / f"{options.object}.onnx"
    run("train", out / "recording", model)
    run("evaluate", with_target, model, *of_target, "--poses", 0, "--json", out / "errors.json")


if __name__ == "__main__":
    main()
