# SPDX-License-Identifier: GPL-3.0-or-later
"""Build and record one character for `ablation.py`: `ablation_recordings.py NAME FOLDER [--poses N]`.

NAME is `arm-1`, `arm-2` or `arm-3` (the arm at a density), `rigify` (a human on Rigify's control rig), or
`FILE[:ACTION]` with a .blend or .glb file. ACTION is held out; without it, the last action of the file is. Writes
FOLDER/recording, on which models train, and FOLDER/held_out, on which they are measured.
"""

import argparse
import subprocess
import sys
from pathlib import Path

import bpy

sys.path.insert(0, str(Path(__file__).resolve().parent.parent))

from blend_fixtures.characters.rigify import PERFORMANCE, REHEARSAL
from fdda_addon import register, unregister
from fdda_addon.cli.main import main as run_verb
from fdda_addon.core.files.output import write_json

POSES, HELD_OUT_POSES = 600, 160
HELD_OUT_SEED, HELD_OUT_OVERSHOOT = 1, 2.0
"""Of the random poses that are held out a quarter lies outside the range of motion, up to twice as wide."""
SMOOTHING_ITERATIONS = 10
MAX_FRAMES = 400
"""Frames of actions that are recorded beside the random poses."""


def build(name: str, rig: Path) -> tuple[list[str], str]:
    """Save a character with its range of motion as rotation limits.

    Returns:
        Names of the actions to record, and name of the action to hold out; empty without actions.
    """
    if name.startswith("arm-"):
        _run("build-arm", rig, "--density", name[-1])
        return [], ""
    if name == "rigify":
        command = [sys.executable, "-m", "blend_fixtures.characters.rigify", "HUMAN", str(rig)]
        subprocess.run(command, check=True, cwd=Path(__file__).parent.parent)
        return [REHEARSAL], PERFORMANCE
    file, _, held_out = name.partition(":")
    if file.endswith(".glb"):
        actions = _import_character(file, rig)
    else:
        bpy.ops.wm.open_mainfile(filepath=file)
        actions = sorted(action.name for action in bpy.data.actions)
        bpy.ops.wm.save_as_mainfile(filepath=str(rig), copy=True)
    if not actions:
        return [], ""
    held_out = held_out or actions[-1]
    actions.remove(held_out)
    options = [option for action in actions for option in ("--action", action)]
    _run("limits", rig, rig, "--overwrite", *options)
    return _within_max_frames(actions), held_out


def _import_character(file: str, rig: Path) -> list[str]:
    """Import the largest skinned mesh of a glTF file, add smoothing, save it, and return the names of its actions."""
    bpy.ops.wm.read_factory_settings(use_empty=True)
    bpy.ops.import_scene.gltf(filepath=file, merge_vertices=True)
    skinned = [o for o in bpy.data.objects if o.type == "MESH" and any(m.type == "ARMATURE" for m in o.modifiers)]
    largest = max(skinned, key=lambda mesh_object: len(mesh_object.data.vertices))
    largest.modifiers.new("Smooth", "CORRECTIVE_SMOOTH").iterations = SMOOTHING_ITERATIONS
    for other in [o for o in bpy.data.objects if o.type == "MESH" and o is not largest]:
        bpy.data.objects.remove(other)
    for armature in (o for o in bpy.data.objects if o.type == "ARMATURE" and o.animation_data):
        armature.animation_data.action = None
        for track in list(armature.animation_data.nla_tracks):
            armature.animation_data.nla_tracks.remove(track)
    for action in bpy.data.actions:
        action.use_fake_user = True
    bpy.ops.wm.save_as_mainfile(filepath=str(rig), copy=True)
    return sorted(action.name for action in bpy.data.actions)


def _within_max_frames(actions: list[str]) -> list[str]:
    """Return the first actions that have at most `MAX_FRAMES` frames together."""
    kept, frames = [], 0.0
    for name in actions:
        first, last = bpy.data.actions[name].frame_range
        if frames + last - first + 1 <= MAX_FRAMES:
            kept, frames = [*kept, name], frames + last - first + 1
    return kept


def record(name: str, folder: Path, poses: int = POSES) -> None:
    """Build and record a character; FOLDER/character.json, written last, says what was recorded."""
    folder.mkdir(parents=True, exist_ok=True)
    rig = folder / "rig.blend"
    actions, held_out = build(name, rig)
    sampled = [option for action in actions for option in ("--bones-to-pose", f"action:{action}")]
    recorded = [option for action in actions for option in ("--action", action)]
    _run("record", rig, folder / "recording", "--poses", poses, "--overwrite", *sampled, *recorded)
    options = ["--seed", HELD_OUT_SEED, "--overshoot", HELD_OUT_OVERSHOOT, *sampled]
    options += ["--action", held_out] if held_out else []
    _run("record", rig, folder / "held_out", "--poses", HELD_OUT_POSES, "--overwrite", *options)
    write_json(folder / "character.json", {"name": name, "poses": poses, "actions": actions, "held_out": held_out})


def _run(*arguments: object) -> None:
    if status := run_verb([str(argument) for argument in arguments], "python -m fdda_addon"):
        raise SystemExit(status)


if __name__ == "__main__":
    parser = argparse.ArgumentParser(description=__doc__.partition("\n")[0])
    parser.add_argument("name")
    parser.add_argument("folder", type=Path)
    parser.add_argument("--poses", type=int, default=POSES)
    options = parser.parse_args()
    register()
    try:
        record(options.name, options.folder, options.poses)
    finally:
        unregister()
