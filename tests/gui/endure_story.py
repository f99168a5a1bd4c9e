# SPDX-License-Identifier: GPL-3.0-or-later
"""Story of five minutes, which runs only by name: random playback, posing, undo and redo, with Auto Run Scripts off.

After each action the mesh that Blender shows must equal the output of the model.
"""

import os
import time
from collections.abc import Iterator
from pathlib import Path

import bpy
import numpy as np
import sidebar
from arm import (
    arm_object,
    armature_object,
    check_model_plays,
    evaluated_positions,
    expected_positions,
    extension_module,
    open_copy_in,
)
from window import (
    click,
    move_mouse,
    park_mouse,
    press_keys,
    region_override,
    require,
    start_playback,
    stop_playback,
    view_region,
    wait_for_events,
)

DURATION_SECONDS, SEED = 300, 0
MAX_DISTANCE, MAX_MEMORY_GROWTH_MB = 1e-5, 60
"""Largest distance between the mesh and the output of the model, meters; and memory growth in the second half."""
BONES = ("shoulder", "elbow", "wrist", "index_1", "thumb_1")

_action_counts: dict[str, int] = {}


def open_the_bound_file(folder: Path) -> Iterator[float]:
    """Open a copy of the file with the bound model, in Pose Mode, with Auto Run Scripts off."""
    require(not bpy.context.preferences.filepaths.use_scripts_auto_execute, "Auto Run Scripts is on")
    yield from open_copy_in(folder / "work" / "endure", folder)
    yield from sidebar.open_tab()
    yield from sidebar.open_section("playback")
    with region_override("WINDOW"):
        bpy.context.view_layer.objects.active = armature_object()
        armature_object().select_set(True)
        bpy.ops.object.mode_set(mode="POSE")


def play_pose_and_undo(_folder: Path) -> Iterator[float]:
    """Do random actions until the time is over."""
    random, memory_mb, max_distance = np.random.default_rng(SEED), [], 0.0
    start, actions = time.monotonic(), (_play, _rotate_bone, _rotate_bone, _undo, _redo, _change_frame, _switch_mode)
    while time.monotonic() < start + DURATION_SECONDS:
        action = actions[random.integers(len(actions))]
        yield from action(random)
        _action_counts[action.__name__[1:]] = _action_counts.get(action.__name__[1:], 0) + 1
        require(not arm_object().fdda.status, f"after {action.__name__[1:]} its status is '{arm_object().fdda.status}'")
        if arm_object().fdda.mode == "FDDA":
            expected = expected_positions(arm_object(), armature_object())
            max_distance = max(max_distance, float(np.abs(evaluated_positions(arm_object()) - expected).max()))
            require(
                max_distance < MAX_DISTANCE, f"after {action.__name__[1:]} it is {max_distance:.2g} m from the model"
            )
        memory_mb.append(_resident_memory_mb())
    arm_object().fdda.mode = "FDDA"
    yield 0.5
    check_model_plays()
    middle_mb = memory_mb[len(memory_mb) // 2]
    print(
        f"{_action_counts}, largest distance {max_distance:.2g} m, "
        f"memory {memory_mb[0]:.0f}, {middle_mb:.0f}, {memory_mb[-1]:.0f} MB",
        flush=True,
    )
    require(
        memory_mb[-1] - middle_mb < MAX_MEMORY_GROWTH_MB, f"memory grew from {middle_mb:.0f} to {memory_mb[-1]:.0f} MB"
    )


def _play(random: np.random.Generator) -> Iterator[float]:
    yield from start_playback()
    yield float(random.uniform(0.5, 3))
    yield from stop_playback()


def _rotate_bone(random: np.random.Generator) -> Iterator[float]:
    """Rotate a bone with R, mouse moves and a click: Blender adds an undo step."""
    bones = armature_object().pose.bones
    chosen = bones[BONES[random.integers(len(BONES))]]
    for bone in bones:
        extension_module("scene.compatibility").select_bone(bone, bone == chosen)
    armature_object().data.bones.active = chosen.bone
    view = view_region("WINDOW")
    x, y = view.x + 0.4 * view.width, view.y + 0.2 * view.height
    move_mouse(x, y)
    yield from wait_for_events()
    yield from press_keys("r")
    for _ in range(5):
        move_mouse(x + random.uniform(-60, 60), y + random.uniform(-60, 60))
        yield 0.05
    yield from click(x + random.uniform(-60, 60), y + random.uniform(-60, 60))


def _undo(random: np.random.Generator) -> Iterator[float]:
    yield from park_mouse()
    yield from press_keys(*["ctrl+z"] * int(random.integers(1, 4)))
    yield 0.2


def _redo(random: np.random.Generator) -> Iterator[float]:
    yield from park_mouse()
    yield from press_keys(*["ctrl+shift+z"] * int(random.integers(1, 3)))
    yield 0.2


def _change_frame(random: np.random.Generator) -> Iterator[float]:
    yield from park_mouse()
    yield from press_keys(*[str(random.choice(["Right", "Left"]))] * int(random.integers(1, 8)))


def _switch_mode(random: np.random.Generator) -> Iterator[float]:
    arm_object().fdda.mode = str(random.choice(["RIG", "LINEAR", "FDDA", "FDDA", "FDDA"]))
    yield 0.2


def _resident_memory_mb() -> float:
    pages = int(Path("/proc/self/statm").read_text().split()[1])
    return pages * os.sysconf("SC_PAGE_SIZE") / 1e6


STEPS = (open_the_bound_file, play_pose_and_undo)
