# SPDX-License-Identifier: GPL-3.0-or-later
"""Evaluates the confidence of a bound model in the current pose, by partition of a mesh."""

import bpy

from ..core.errors import FDDAError
from ..core.rig import STATIC_JOINT
from ..rig.reading import PoseReader, read_model_rig
from ..scene.control_reader import ControlReader
from ..scene.scene_rig import SceneRig, armature_of
from . import model_files


def partition_confidence(mesh_object: bpy.types.Object) -> list[tuple[str, float]] | None:
    """Evaluate the confidence of each partition with vertices of a mesh in the evaluated pose. The model runs once.

    Returns:
        For each of these partitions the name of its main joint and its confidence, 0 to 1, in ascending order of
        confidence. None if the model has no such output, or if the pose cannot be read.
    """
    armature_object = armature_of(mesh_object)
    if armature_object is None or not mesh_object.fdda.is_bound:
        return None
    try:
        network = model_files.network_of(mesh_object)
        joint_names = network.info.joint_names
        if any(name not in armature_object.data.bones for name in joint_names if name != STATIC_JOINT):
            return None
        depsgraph = bpy.context.evaluated_depsgraph_get()
        evaluated_objects = [o.evaluated_get(depsgraph) for o in (mesh_object, armature_object)]
        if not all(o.is_evaluated for o in evaluated_objects):
            return None
        scene_rig = SceneRig(mesh_object, armature_object)
        pose_matrices = PoseReader(scene_rig, joint_names, network.info.rest_matrices).read(*evaluated_objects)
        controls = ControlReader(scene_rig, network.info.controls).read(scene_rig, depsgraph)
        confidence = network.confidence(pose_matrices[None], controls[None])
        if confidence is None:
            return None
        if network.own_partitions is None:
            rig = network.linear_rig(read_model_rig(scene_rig, network.info))
            joints = {partition.joint for partition in network.info.partitions_of(rig) if len(partition.vertices)}
            network.own_partitions = [i for i, p in enumerate(network.info.partitions) if p.joint in joints]
        values = confidence[0].tolist()
        pairs = [(joint_names[network.info.partitions[i].joint], values[i]) for i in network.own_partitions]
        return sorted(pairs, key=lambda pair: pair[1])
    except FDDAError:
        # Playback reports this error too, where the user sees it.
        return None
