# SPDX-License-Identifier: GPL-3.0-or-later
"""Take characters that others made through the whole path: `python benchmarks/third_party.py OUT [FOLDER]`.

Each .glb file of FOLDER is imported, and its largest skinned mesh gets Corrective Smooth; a .blend file is taken as it
is. The range of motion comes from all actions but the last one by name. These actions and random poses are recorded, a
model is trained and bound, and the action left out is compared. Prints the table of docs/characters.md, and writes it
there with --write. A character that cannot be taken through has a row with the reason.
"""

import argparse
import json
import os
import re
import subprocess
import sys
from dataclasses import dataclass
from pathlib import Path

ROOT = Path(__file__).resolve().parent.parent
sys.path.insert(0, str(ROOT))

import bpy  # noqa: E402

import fdda_addon  # noqa: E402
from fdda_addon.core.errors import FDDAError  # noqa: E402
from fdda_addon.fast_rig.controls import animating_actions  # noqa: E402
from fdda_addon.scene.blend_file import save_copy, silenced_stdout  # noqa: E402
from fdda_addon.scene.scene_rig import SceneRig, find_rigs  # noqa: E402

FOLDER = ROOT / ".." / "shared" / "data" / "characters" / "third_party"
MAX_ACTIONS = 8
"""Largest number of recorded actions, evenly by name; the ranges come from all of them."""
PAGE = ROOT / "docs" / "characters.md"
START, END = "<!-- make third-party writes this table -->", "<!-- end of the table of make third-party -->"
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


def prepare(source: Path, folder: Path) -> Character:
    """Import a character, and save it as a rig in `folder`.

    Raises:
        FDDAError: it has no rig.
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
        raise VerbError(errors[-1].removeprefix("Error: ") if errors else result.stderr.strip()[-200:])
    return result.stdout


def measure(character: Character, folder: Path, poses: int, epochs: int) -> dict:
    """Record, train, bind and evaluate a character; return the JSON of the evaluation and of the benchmark.

    Raises:
        VerbError: a verb has failed.
    """
    limited, recording, model = folder / "limited.blend", folder / "recording", folder / "model.onnx"
    object_options = ("--object", character.object_name)
    actions = [option for name in character.recorded for option in ("--action", name)]
    if actions:
        run_verb("limits", character.file, limited, *actions, *object_options)
    else:
        limited = character.file
    run_verb("record", limited, recording, *object_options, "--poses", poses, *actions, "--overwrite")
    run_verb("train", recording, model, "--epochs", epochs, "--overwrite")
    run_verb("bind", limited, model, folder / "bound.blend", *object_options)
    held_out = ("--poses", 0, "--action", character.held_out) if character.held_out else ("--poses", 50)
    results = {}
    for verb, options in (("evaluate", held_out), ("benchmark", ())):
        path = folder / f"{verb}.json"
        run_verb(verb, limited, model, "--json", path, *object_options, *options)
        results[verb] = json.loads(path.read_text(encoding="utf-8"))
    return results | {"model_mb": model.stat().st_size / 1e6}


def row(source: Path, folder: Path, poses: int, epochs: int) -> str:
    """Take one character through, and return its row of the table."""
    folder.mkdir(parents=True, exist_ok=True)
    author = AUTHORS.get(source.stem, "")
    try:
        character = prepare(source, folder)
    except (FDDAError, RuntimeError) as error:
        return f"| {source.stem} | {author} | | | refused: {' '.join(str(error).split())} | | |"
    head = f"| {source.stem} | {author} | {character.vertices:,} | {character.bones} |"
    try:
        results = measure(character, folder, poses, epochs)
    except VerbError as error:
        return f"{head} refused: {error} | | |"
    errors = results["evaluate"]
    ratios = [100 * errors["fdda"][key] / max(errors["linear"][key], 1e-9) for key in ("mean", "max")]
    held_out = f"*{character.held_out}*" if character.held_out else "50 random poses, as it has no two actions"
    text = f"{ratios[0]:.0f} % ({ratios[1]:.0f} %)"
    return f"{head} {text} | {held_out} | {results['benchmark']['ratio']:.1f} |"


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("out", type=Path)
    parser.add_argument("folder", type=Path, nargs="?", default=FOLDER)
    parser.add_argument("--poses", type=int, default=1000)
    parser.add_argument("--epochs", type=int, default=200)
    # The table of some characters must not replace that of all.
    group = parser.add_mutually_exclusive_group()
    group.add_argument("--only", nargs="+", help="names of characters, without their extension")
    group.add_argument("--write", action="store_true", help="write the table to docs/characters.md")
    options = parser.parse_args()
    sources = sorted(path for path in options.folder.glob("*") if path.suffix in {".glb", ".gltf", ".blend"})
    if options.only:
        sources = [path for path in sources if path.stem in options.only]
    if not sources:
        sys.exit(f"There are no characters in '{options.folder}': give a folder with .glb or .blend files.")
    lines = [
        f"{options.poses:,} random poses, {options.epochs} epochs, one seed, Blender {bpy.app.version_string}.",
        "",
        "| character | author, license | vertices | bones | mean (largest) error, part of linear skinning's "
        "| compared on | times as fast |",
        "|---|---|---|---|---|---|---|",
    ]
    for source in sources:
        lines.append(row(source, options.out / source.stem, options.poses, options.epochs))
        print(lines[-1], flush=True)
    table = "\n".join(lines)
    print(table)
    if options.write:
        text = PAGE.read_text(encoding="utf-8")
        pattern = re.compile(f"{re.escape(START)}.*?{re.escape(END)}", re.DOTALL)
        PAGE.write_text(pattern.sub(lambda _: f"{START}\n\n{table}\n\n{END}", text), encoding="utf-8")
    sys.stdout.flush()
    # bpy 4.5 may hang at exit after an import.
    os._exit(0)


if __name__ == "__main__":
    main()
