# SPDX-License-Identifier: GPL-3.0-or-later
"""Many characters with one model."""

import bpy
import numpy as np
import pytest

from fdda_addon.runtime.network import Execution
from fdda_addon.scene.scene_rig import armature_modifier


def crowd_of(first: bpy.types.Object, count: int) -> list[bpy.types.Object]:
    """Return a bound object and copies of it, each with a separate armature in a different pose."""
    crowd = [first]
    for _ in range(count - 1):
        mesh_copy, armature_copy = first.copy(), armature_modifier(first).object.copy()
        for copy in (mesh_copy, armature_copy):
            bpy.context.scene.collection.objects.link(copy)
        armature_modifier(mesh_copy).object = armature_copy
        mesh_copy.parent = armature_copy if first.parent else None
        crowd.append(mesh_copy)
    bpy.context.view_layer.update()
    for number, mesh_object in enumerate(crowd):
        armature_modifier(mesh_object).object.pose.bones["lower"].rotation_euler[0] = 0.1 + 1.2 * number / count
    return crowd


def count_calls(monkeypatch: pytest.MonkeyPatch) -> list[int]:
    counted, real = [], Execution.run

    def run(execution: Execution) -> np.ndarray:
        counted.append(len(execution.poses))
        return real(execution)

    monkeypatch.setattr(Execution, "run", run)
    return counted


def animate(crowd: list[bpy.types.Object]) -> None:
    """Animate the elbow of each character, starting from its current angle."""
    for mesh_object in crowd:
        armature_object = armature_modifier(mesh_object).object
        armature_object.animation_data_clear()
        bone = armature_object.pose.bones["lower"]
        start = bone.rotation_euler[0]
        for frame, angle in ((1, start), (60, start + 0.5)):
            bone.rotation_euler[0] = angle
            bone.keyframe_insert("rotation_euler", index=0, frame=frame)
