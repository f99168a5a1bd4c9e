# SPDX-License-Identifier: GPL-3.0-or-later
"""Evaluates the confidence of a bound model in the current pose, by partition."""

import bpy

from ..core.errors import FDDAError
from ..core.rig import STATIC_JOINT
from ..rig.reading import PoseReader
from ..scene.controls import ControlReader
from ..scene.scene_rig import SceneRig, armature_of
from . import model_files

_cached_call: tuple[object, bytes, list[tuple[str, float]] | None] | None = None
"""The model, its inputs and the result of the last call that ran a model."""


def partition_confidence(mesh_object: bpy.types.Object) -> list[tuple[str, float]] | None:
    """Evaluate the confidence of each partition in the evaluated pose; runs the model once for each pose.

    Returns:
        Name of the main joint and confidence, 0 to 1, of each partition, in ascending order of confidence; None if the
        model has no such output, or the pose cannot be read.
    """
    global _cached_call
    armature_object = armature_of(mesh_object)
    if armature_object is None or not mesh_object.fdda.is_bound:
        return None
    try:
        network = model_files.network_of(mesh_object)
        names = tuple(joint.name for joint in network.info.joints)
        if any(name not in armature_object.data.bones for name in names if name != STATIC_JOINT):
            return None
        depsgraph = bpy.context.evaluated_depsgraph_get()
        evaluated = [o.evaluated_get(depsgraph) for o in (mesh_object, armature_object)]
        if not all(o.is_evaluated for o in evaluated):
            return None
        scene_rig = SceneRig(mesh_object, armature_object)
        pose_matrices = PoseReader(scene_rig, names, network.info.rest_matrices).read(*evaluated)
        controls = ControlReader(scene_rig, network.info.controls).read(scene_rig, depsgraph)
        inputs = pose_matrices.tobytes() + controls.tobytes()
        if _cached_call is None or _cached_call[0] is not network or _cached_call[1] != inputs:
            confidence = network.confidence(pose_matrices[None], controls[None])
            values = None
            if confidence is not None:
                partitions = zip(network.info.partitions, confidence[0].tolist(), strict=True)
                values = sorted(((names[p.joint], value) for p, value in partitions), key=lambda pair: pair[1])
            _cached_call = (network, inputs, values)
        return _cached_call[2]
    except FDDAError:
        # Playback reports the error itself.
        return None
