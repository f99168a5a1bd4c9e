# SPDX-License-Identifier: GPL-3.0-or-later
"""Take characters that others made through the whole path: `python benchmarks/third_party.py OUT [FOLDER]`.

Each .glb file of FOLDER is imported, and its largest skinned mesh gets Corrective Smooth; a .blend file is taken as it
is. Where importing leaves vertices on each other, a second row has the mesh with these merged, as the warning about
them advises. All actions but the last one by name are recorded, with random poses that remix their limbs. A model is
trained and bound, and the action left out is compared. Prints the table of docs/characters.md, and writes it there with
--write. A character that cannot be taken through has a row with the reason.
"""

import argparse
import json
import os
import subprocess
import sys
from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path

ROOT = Path(__file__).resolve().parent.parent
sys.path.insert(0, str(ROOT))

import bpy  # noqa: E402

import fdda_addon  # noqa: E402
from benchmarks.page_table import PageTable  # noqa: E402
from fdda_addon.core.errors import FDDAError  # noqa: E402
from fdda_addon.fast_rig.controls import animating_actions  # noqa: E402
from fdda_addon.scene.blend_file import save_copy, silenced_stdout  # noqa: E402
from fdda_addon.scene.scene_rig import SceneRig, find_rigs  # noqa: E402

FOLDER = ROOT / ".." / "shared" / "data" / "characters" / "third_party"
MAX_ACTIONS = 8
"""Largest number of recorded actions, evenly by name."""
MERGE_DISTANCE_RATIO = 1e-5
"""Largest distance of vertices that are merged, as a part of the size of the mesh."""
MIN_LINEAR_MM = 0.01
"""With a smaller mean error of linear skinning, errors have no meaningful ratio."""
TABLE = PageTable(
    ROOT / "docs" / "characters.md",
    "<!-- third_party.py --write writes this table -->",
    "<!-- end of the table of third_party.py -->",
)
AUTHORS = {
    "Knight": "KayKit (Kay Lousberg), CC0",
    "Fox": "PixelMannen, rigged by tomkranis, CC0 and CC-BY 4.0",
    "mannequiny": "GDQuest, CC-BY 4.0",
    "lumberjack": "PlayCanvas, CC-BY 4.0",
    "snail_leaf": "Blender Studio, Sprite Fright, CC-BY 4.0",
    "binoculars": "Blender Studio, Sprite Fright, CC-BY 4.0",
    "dirt_hill": "Blender Studio, Sprite Fright, CC-BY 4.0",
}


class VerbError(Exception):
    """A verb has failed; the text is its reason."""


@dataclass(frozen=True)
class Character:
    """A prepared character: its file, its mesh object, what it has, and its actions."""

    file: Path
    object_name: str
    vertices: int
    bones: int
    recorded: tuple[str, ...]
    held_out: str


def prepare(source: Path, folder: Path, merge: bool = False) -> Character | None:
    """Import a character, and save it as a rig in `folder`.

    Returns:
        The character; None if there is nothing to merge.
    """
    with silenced_stdout():
        if source.suffix == ".blend":
            bpy.ops.wm.open_mainfile(filepath=str(source), load_ui=False)
        else:
            bpy.ops.wm.read_factory_settings(use_empty=True)
            bpy.ops.preferences.addon_enable(module="io_scene_gltf2")
            bpy.ops.import_scene.gltf(filepath=str(source), merge_vertices=True)
    fdda_addon.register()
    scene_rig = max(find_rigs(), key=lambda rig: len(rig.mesh_object.data.vertices))
    if merge and not _merge_vertices(scene_rig.mesh_object.data):
        return None
    if source.suffix != ".blend":
        _add_corrective_smooth(scene_rig)
    names = sorted(action.name for action in animating_actions(scene_rig.armature_object))
    if scene_rig.armature_object.animation_data is not None:
        scene_rig.armature_object.animation_data.use_nla = False
        scene_rig.armature_object.animation_data.action = None
    path = folder / "rig.blend"
    save_copy(path)
    step = max(1, -(-len(names[:-1]) // MAX_ACTIONS))
    return Character(
        path,
        scene_rig.mesh_object.name,
        len(scene_rig.mesh_object.data.vertices),
        len(scene_rig.armature_object.data.bones),
        tuple(names[:-1][::step]),
        names[-1] if len(names) > 1 else "",
    )


def _merge_vertices(mesh: bpy.types.Mesh) -> int:
    """Merge the vertices of a mesh that lie on each other; returns by how many it has fewer."""
    import bmesh  # bpy brings it, so it is there after bpy has loaded.

    edited, count = bmesh.new(), len(mesh.vertices)
    edited.from_mesh(mesh)
    size = max(max(axis) - min(axis) for axis in zip(*(vertex.co for vertex in edited.verts), strict=True))
    bmesh.ops.remove_doubles(edited, verts=edited.verts, dist=MERGE_DISTANCE_RATIO * size)
    edited.to_mesh(mesh)
    edited.free()
    return count - len(mesh.vertices)


def _add_corrective_smooth(scene_rig: SceneRig) -> None:
    modifier = scene_rig.mesh_object.modifiers.new("Corrective Smooth", "CORRECTIVE_SMOOTH")
    modifier.iterations, modifier.smooth_type = 10, "SIMPLE"
    for scene_object in bpy.context.scene.objects:
        if scene_object.type == "MESH" and scene_object != scene_rig.mesh_object:
            scene_object.hide_viewport = scene_object.hide_render = True


def run_verb(*arguments: object) -> str:
    """Run a verb in a process of its own, and return its output.

    Raises:
        VerbError: it has failed.
    """
    command = [sys.executable, "-m", "fdda_addon", *map(str, arguments)]
    result = subprocess.run(command, cwd=ROOT, capture_output=True, text=True, check=False)
    if result.returncode:
        errors = [line for line in result.stderr.splitlines() if line.startswith("Error: ")]
        raise VerbError(errors[-1].removeprefix("Error: ") if errors else " ".join(result.stderr[-200:].split()))
    return result.stdout


def measure(character: Character, folder: Path, poses: int, epochs: int) -> dict:
    """Record, train, bind and evaluate a character; return the JSON of the evaluation and of the benchmark."""
    rig, recording, model = character.file, folder / "recording", folder / "model.onnx"
    object_options = ("--object", character.object_name)
    actions = [option for name in character.recorded for option in ("--action", name)]
    actions += ["--bones-to-pose", "remix"] if actions else []
    run_verb("record", rig, recording, *object_options, "--poses", poses, *actions, "--overwrite")
    run_verb("train", recording, model, "--passes", epochs, "--overwrite")
    run_verb("bind", rig, model, folder / "bound.blend", *object_options, "--overwrite")
    held_out = ("--poses", 0, "--action", character.held_out) if character.held_out else ("--poses", 50)
    results = {}
    for verb, options in (("evaluate", held_out), ("benchmark", ())):
        path = folder / f"{verb}.json"
        run_verb(verb, rig, model, "--json", path, "--overwrite", *object_options, *options)
        results[verb] = json.loads(path.read_text(encoding="utf-8"))
    return results | {"model_mb": model.stat().st_size / 1e6}


def rows(source: Path, folder: Path, poses: int, epochs: int) -> Iterator[str]:
    """Take one character through, as it is and then with merged vertices, and yield its rows of the table."""
    author = AUTHORS.get(source.stem, "")
    for name, merge in ((source.stem, False), (f"{source.stem}, merged", True)):
        out = folder / name.replace(", ", "_")
        out.mkdir(parents=True, exist_ok=True)
        try:
            character = prepare(source, out, merge)
        except (FDDAError, RuntimeError) as error:
            if not merge:
                yield f"| {name} | {author} | | | refused: {' '.join(str(error).split())} | | | |"
            return
        if character is not None:
            results = _results(character, out, poses, epochs)
            yield f"| {name} | {author} | {character.vertices:,} | {character.bones} | {results}"
        if source.suffix == ".blend":
            return


def _results(character: Character, folder: Path, poses: int, epochs: int) -> str:
    """Return the other cells of a row."""
    try:
        results = measure(character, folder, poses, epochs)
    except VerbError as error:
        return f"refused: {error} | | | |"
    errors = results["evaluate"]
    if errors["linear"]["mean"] < MIN_LINEAR_MM:
        text = "linear skinning is the rig in this action"
    else:
        ratios = [100 * errors["fdda"][key] / errors["linear"][key] for key in ("mean", "max")]
        text = f"{ratios[0]:.1f} % ({ratios[1]:.0f} %)"
    held_out = f"*{character.held_out}*" if character.held_out else "50 random poses, as it has no two actions"
    return f"{text} | {held_out} | {results['benchmark']['ratio']:.1f} | {results['model_mb']:.1f} |"


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("out", type=Path)
    parser.add_argument("folder", type=Path, nargs="?", default=FOLDER)
    parser.add_argument("--poses", type=int, default=1000)
    parser.add_argument("--passes", type=int, default=200)
    # The table of some characters must not replace that of all.
    group = parser.add_mutually_exclusive_group()
    group.add_argument("--only", nargs="+", help="names of characters, without their extension")
    group.add_argument("--write", action="store_true", help="write the table to docs/characters.md")
    options = parser.parse_args()
    # The verbs run in another working directory, and Blender 4.5 takes the one of the shell for its own.
    out, folder = options.out.resolve(), options.folder.resolve()
    sources = sorted(path for path in folder.glob("*") if path.suffix in {".glb", ".gltf", ".blend"})
    if options.only:
        if unknown := sorted(set(options.only) - {source.stem for source in sources}):
            sys.exit(f"There is no character '{unknown[0]}' in '{options.folder}'.")
        sources = [path for path in sources if path.stem in options.only]
    if not sources:
        sys.exit(f"There are no characters in '{options.folder}': give a folder with .glb or .blend files.")
    if options.write:
        TABLE.check()
    lines = [
        f"{options.poses:,} random poses, {options.passes} passes, one seed, Blender {bpy.app.version_string}.",
        "",
        "| character | author, license | vertices | bones | mean (largest) error, part of linear skinning's "
        "| compared on | times as fast | model, MB |",
        "|---|---|---|---|---|---|---|---|",
    ]
    for source in sources:
        for line in rows(source, out, options.poses, options.passes):
            lines.append(line)
            print(line, flush=True)
    table = "\n".join(lines)
    print(table)
    if options.write:
        TABLE.write(table)
    sys.stdout.flush()
    # bpy 4.5 may hang at exit after an import.
    os._exit(0)


if __name__ == "__main__":
    main()
