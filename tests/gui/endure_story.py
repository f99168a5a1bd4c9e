# SPDX-License-Identifier: GPL-3.0-or-later
"""Five minutes with a character, scripts of files not trusted: played, posed with mouse and keys, undone. After each of
these the shown mesh is the model's output. Run by name; its numbers come from a seed."""

import os
import time
from collections.abc import Iterator
from pathlib import Path

import bpy
import numpy as np
import sidebar
from arm import arm, armature, check_it_plays, open_in, part, positions
from window import check, click, move, over, play, press, region, rest_mouse, settle, stop

SECONDS, SEED = 300, 0
NEAR, FLAT_MB = 1e-5, 60
"""Metres between the mesh and the model's output, and how much more memory is held at the end than at the half."""
BONES = ("shoulder", "elbow", "wrist", "index_1", "thumb_1")

_counts: dict[str, int] = {}


def open_the_bound_file(folder: Path) -> Iterator[float]:
    """Open the file of the path, its scripts not trusted."""
    check(not bpy.context.preferences.filepaths.use_scripts_auto_execute, "scripts of files are run by themselves")
    yield from open_in(folder / "work" / "endure", folder)
    yield from sidebar.show()
    yield from sidebar.open_section("playback")
    with over("WINDOW"):
        bpy.context.view_layer.objects.active = armature()
        armature().select_set(True)
        bpy.ops.object.mode_set(mode="POSE")


def play_pose_and_undo(_folder: Path) -> Iterator[float]:
    """At random, until the time is over."""
    random, memory, farthest = np.random.default_rng(SEED), [], 0.0
    start, kinds = time.monotonic(), (_play, _turn, _turn, _undo, _redo, _frame, _switch)
    while time.monotonic() < start + SECONDS:
        kind = kinds[random.integers(len(kinds))]
        yield from kind(random)
        _counts[kind.__name__[1:]] = _counts.get(kind.__name__[1:], 0) + 1
        check(not arm().fdda.status, f"after {kind.__name__[1:]} its status is '{arm().fdda.status}'")
        if arm().fdda.mode == "FDDA":
            farthest = max(farthest, float(np.abs(positions(arm()) - _expected()).max()))
            check(farthest < NEAR, f"after {kind.__name__[1:]} it is {farthest:.2g} m from the model")
        memory.append(_resident_mb())
    arm().fdda.mode = "FDDA"
    yield 0.5
    check_it_plays()
    half = memory[len(memory) // 2]
    print(f"{_counts}, farthest {farthest:.2g} m, memory {memory[0]:.0f}, {half:.0f}, {memory[-1]:.0f} MB", flush=True)
    check(memory[-1] - half < FLAT_MB, f"memory grew from {half:.0f} to {memory[-1]:.0f} MB")


def _play(random: np.random.Generator) -> Iterator[float]:
    yield from play()
    yield float(random.uniform(0.5, 3))
    yield from stop()


def _turn(random: np.random.Generator) -> Iterator[float]:
    """R, a move of the mouse, a click: a bone turns, and Blender writes an undo step."""
    bones = armature().pose.bones
    chosen = bones[BONES[random.integers(len(BONES))]]
    for bone in bones:
        part("scene.compatibility").select_bone(bone, bone == chosen)
    armature().data.bones.active = chosen.bone
    view = region("WINDOW")
    x, y = view.x + 0.4 * view.width, view.y + 0.2 * view.height
    move(x, y)
    yield from settle()
    yield from press("r")
    for _ in range(5):
        move(x + random.uniform(-60, 60), y + random.uniform(-60, 60))
        yield 0.05
    yield from click(x + random.uniform(-60, 60), y + random.uniform(-60, 60))


def _undo(random: np.random.Generator) -> Iterator[float]:
    yield from rest_mouse()
    yield from press(*["ctrl+z"] * int(random.integers(1, 4)))
    yield 0.2


def _redo(random: np.random.Generator) -> Iterator[float]:
    yield from rest_mouse()
    yield from press(*["ctrl+shift+z"] * int(random.integers(1, 3)))
    yield 0.2


def _frame(random: np.random.Generator) -> Iterator[float]:
    yield from rest_mouse()
    yield from press(*[str(random.choice(["Right", "Left"]))] * int(random.integers(1, 8)))


def _switch(random: np.random.Generator) -> Iterator[float]:
    arm().fdda.mode = str(random.choice(["RIG", "LINEAR", "FDDA", "FDDA", "FDDA"]))
    yield 0.2


def _expected() -> np.ndarray:
    """(V, 3) metres: the model's output for the pose that Blender has evaluated."""
    network = part("runtime.model_files").network_of(arm())
    depsgraph, info = bpy.context.evaluated_depsgraph_get(), network.info
    scene_rig = part("scene.scene_rig").SceneRig(arm(), armature())
    reader = part("rig.reading").PoseReader(scene_rig, info.joint_names, info.rest_matrices)
    return network.positions(reader.read(arm().evaluated_get(depsgraph), armature().evaluated_get(depsgraph))[None])[0]


def _resident_mb() -> float:
    pages = int(Path("/proc/self/statm").read_text().split()[1])
    return pages * os.sysconf("SC_PAGE_SIZE") / 1e6


STEPS = (open_the_bound_file, play_pose_and_undo)
