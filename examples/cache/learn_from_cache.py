# SPDX-License-Identifier: GPL-3.0-or-later
"""Train a model from a cache file: `python learn_from_cache.py RIG.blend CACHE OUT --object NAME --action NAME`.

RIG.blend contains the rest mesh, its weights and the armature's action, but not the simulation. CACHE is an Alembic,
USD or .pc2 file of the mesh in the frames of that action, from Houdini or Maya for example. Writes OUT/target.blend,
the recording OUT/recording, the model OUT/model/NAME.onnx and OUT/errors.json. docs/simulations.md describes the
steps.
"""

import argparse
import subprocess
import sys
from pathlib import Path

import bpy

TARGET = "target"


def import_cache(path: Path, mesh_object: bpy.types.Object) -> bpy.types.Object:
    """Return an object that plays the cache: an imported object, or for a .pc2 file a copy of the mesh."""
    if path.suffix == ".pc2":
        cache_object = mesh_object.copy()
        cache_object.data = mesh_object.data.copy()
        cache_object.modifiers.clear()
        bpy.context.scene.collection.objects.link(cache_object)
        modifier = cache_object.modifiers.new("Cache", "MESH_CACHE")
        modifier.cache_format, modifier.filepath = "PC2", str(path)
        modifier.frame_start = bpy.context.scene.frame_start
        return cache_object
    objects_before = set(bpy.data.objects)
    importer = bpy.ops.wm.alembic_import if path.suffix == ".abc" else bpy.ops.wm.usd_import
    importer(filepath=str(path))
    vertex_count = len(mesh_object.data.vertices)
    candidates = [
        o
        for o in bpy.data.objects
        if o not in objects_before and o.type == "MESH" and len(o.data.vertices) == vertex_count
    ]
    if len(candidates) != 1:
        sys.exit(
            f"'{path}' contains {len(candidates)} meshes of {vertex_count} vertices; export only the mesh to train on."
        )
    return candidates[0]


def run_verb(*arguments: object) -> None:
    """Run a verb of the command line. If it fails, exit with its status; the verb prints the error."""
    process = subprocess.run([sys.executable, "-m", "fdda_addon", *map(str, arguments)], check=False)
    if process.returncode:
        sys.exit(process.returncode)


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
    target_file = out / "target.blend"
    bpy.ops.wm.save_as_mainfile(filepath=str(target_file))
    target_options = "--object", options.object, "--learn-from", TARGET, "--action", options.action
    run_verb("record", target_file, out / "recording", *target_options)
    run_verb("check-recording", out / "recording")
    model = out / "model" / f"{options.object}.onnx"
    run_verb("train", out / "recording", model)
    run_verb("evaluate", target_file, model, *target_options, "--poses", 0, "--json", out / "errors.json")


if __name__ == "__main__":
    main()
