# SPDX-License-Identifier: GPL-3.0-or-later
"""The state of a scene as values that can be compared, to check that a job restores everything it changes."""

import bpy
import numpy as np

from fdda_addon.core.progress import Job, Result, run_job
from fdda_addon.scene.scene_rig import SceneRig, find_rig

TRANSFORM_PROPERTIES = ("location", "rotation_euler", "rotation_quaternion", "rotation_axis_angle", "scale")


def fresh_elbow() -> SceneRig:
    """Build an elbow in an empty scene."""
    from blend_fixtures.elbow import build_elbow

    bpy.ops.wm.read_factory_settings(use_empty=True)
    build_elbow()
    return find_rig()


def _properties(owner: object) -> dict:
    return {key: value for key, value in owner.items() if isinstance(value, int | float | str)}


def scene_state(rig: SceneRig) -> dict:
    """Return all that a job must restore: animation, frame, poses, modifiers, selection, datablocks, positions."""
    scene, armature_object, animation = bpy.context.scene, rig.armature_object, rig.armature_object.animation_data
    bpy.context.view_layer.update()
    evaluated = rig.mesh_object.evaluated_get(bpy.context.evaluated_depsgraph_get())
    return {
        "frame": (scene.frame_current, scene.frame_subframe),
        "animation": animation
        and (
            animation.action and animation.action.name,
            getattr(animation, "action_slot", None) and animation.action_slot.identifier,
            animation.use_nla,
            [track.name for track in animation.nla_tracks],
        ),
        "pose": {
            bone.name: (
                bone.rotation_mode,
                _properties(bone),
                *([*getattr(bone, name)] for name in TRANSFORM_PROPERTIES),
            )
            for bone in armature_object.pose.bones
        },
        "objects": {
            o.name: (
                o.mode,
                o.hide_viewport,
                o.select_get(),
                _properties(o),
                *([*getattr(o, n)] for n in TRANSFORM_PROPERTIES),
            )
            for o in scene.objects
        },
        "active": bpy.context.view_layer.objects.active and bpy.context.view_layer.objects.active.name,
        "modifiers": [(m.name, m.type, m.show_viewport, m.show_render) for m in rig.mesh_object.modifiers],
        "binding": (rig.mesh_object.fdda.is_bound, rig.mesh_object.fdda.mode, rig.mesh_object.fdda.status),
        "datablocks": [len(c) for c in (bpy.data.objects, bpy.data.meshes, bpy.data.actions, bpy.data.scenes)],
        "positions": [vertex.co[:] for vertex in evaluated.data.vertices],
    }


def drain(job: Job[Result], stop_after: int | None = None) -> Result:
    """Run a job to its end and return its result, or close it after a number of steps."""
    if stop_after is None:
        return run_job(job)
    for _ in zip(range(stop_after), job, strict=False):
        pass
    return job.close()


def assert_same_state(before: dict, after: dict) -> None:
    """Assert that two states are equal; a failure names the key that was not restored."""
    for key in before:
        if key == "positions":
            # The order of floating-point sums may differ. Another pose would differ by far more.
            np.testing.assert_allclose(after[key], before[key], atol=1e-6)
        else:
            assert after[key] == before[key], key
