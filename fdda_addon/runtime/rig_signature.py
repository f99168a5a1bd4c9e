# SPDX-License-Identifier: GPL-3.0-or-later
"""Checks that a model was trained for the current state of its rig.

The rig is read when a model starts to play, and again when Blender reports a changed armature or mesh. Reading all skin
weights takes long, so a signature is compared first, which is quick to read (`read_signature`).
"""

from collections.abc import Iterable
from dataclasses import replace
from operator import attrgetter

import bpy
import numpy as np

from ..core.errors import ModelError
from ..core.rig import STATIC_JOINT, Fingerprint, Rig, rest_matrices_match, rig_differences
from ..rig.deformation import b_bone_values, read_modifiers_and_drivers
from ..rig.reading import read_model_rig
from ..scene.mesh import rest_positions
from ..scene.scene_rig import SceneRig, armature_modifier
from .network import Network
from .session import session

STABLE_MODES = ("OBJECT", "POSE")
"""Modes of an object in which its mesh does not change; in the other modes the user is editing the mesh."""

_read_bone = attrgetter(
    "use_deform",
    "envelope_distance",
    "envelope_weight",
    "head_radius",
    "tail_radius",
    "use_envelope_multiply",
    "bbone_segments",
)

BONES, PARENTS, OBJECT, MESH = PARTS = ("bones", "parents", "object", "mesh")
"""Parts of a rig that Blender reports separately. Posing by hand is reported as a change of the bones."""


def read_signature(scene_rig: SceneRig, joint_names: Iterable[str], parts: Iterable[str] = PARTS) -> dict[str, tuple]:
    """Read the signature of a rig: what is quick to read. If it and the mesh are unchanged, the whole rig is unchanged.

    Args:
        scene_rig: the rig.
        joint_names: names of the joints of the model.
        parts: which parts to read.

    Returns:
        By part. Rest matrices and skinning properties of the bones that are joints or can have weights; the parents of
        all bones; the vertex groups, modifiers and drivers of the object (`rig.deformation`); a digest of the rest
        positions of the mesh.
    """
    mesh_object, armature = scene_rig.mesh_object, scene_rig.armature_object.data
    readers = {
        BONES: lambda: _read_bones_once(armature, _weighted_names(scene_rig, joint_names)),
        PARENTS: lambda: tuple((bone.name, bone.parent.name if bone.parent else "") for bone in armature.bones),
        OBJECT: lambda: (*mesh_object.vertex_groups.keys(), str(read_modifiers_and_drivers(scene_rig))),
        MESH: lambda: (rest_digest(mesh_object.data),),
    }
    return {part: readers[part]() for part in parts}


def _weighted_names(scene_rig: SceneRig, joint_names: Iterable[str]) -> tuple[str, ...]:
    """Return the names of the joints and of the bones that can have weights: a control rig has many other bones."""
    modifier = armature_modifier(scene_rig.mesh_object)
    if modifier is not None and modifier.use_bone_envelopes:
        return tuple(scene_rig.armature_object.data.bones.keys())
    return tuple(dict.fromkeys((*joint_names, *scene_rig.mesh_object.vertex_groups.keys())))


def _read_bones_once(armature: bpy.types.Armature, names: tuple[str, ...]) -> tuple:
    """Read bones; in a check of several characters that share armature and names only once."""
    read_bones = {} if session.read_bones is None else session.read_bones
    key = armature.session_uid, names
    if key not in read_bones:
        read_bones[key] = bone_signature(armature, names)
    return read_bones[key]


def bone_signature(armature: bpy.types.Armature, names: Iterable[str]) -> tuple:
    """Read rest matrices and skinning properties of the bones with these names; other names are left out."""
    bones = [bone for bone in map(armature.bones.get, names) if bone is not None]
    # Most armatures have no B-Bones, whose settings are slow to read.
    b_bones = b_bone_values(armature, bones) if any(bone.bbone_segments > 1 for bone in bones) else {}
    return tuple((bone.name, bone.matrix_local.copy(), _read_bone(bone)) for bone in bones), b_bones


def rest_digest(mesh: bpy.types.Mesh) -> str:
    """Compute a digest of the rest positions of a mesh."""
    return Fingerprint.digest(rest_positions(mesh))


def check(scene_rig: SceneRig, network: Network, signature: dict[str, tuple]) -> None:
    """Check that a model was trained for a rig.

    Args:
        scene_rig: the rig. It is not checked while the user edits its mesh.
        network: the model.
        signature: the signature of the rig.

    Raises:
        ModelError: the model was trained for another rig; the message lists the differences.
        RigError: the rig cannot be read.
    """
    mesh_object, info = scene_rig.mesh_object, network.info
    if mesh_object.mode not in STABLE_MODES:
        return
    passed_check = (
        mesh_object.data.session_uid,
        signature,
        (info.joints, info.rest_matrices.tobytes(), info.fingerprint),
    )
    if session.passed_checks.get(mesh_object.session_uid) == passed_check:
        return
    rig = read_model_rig(scene_rig, info)
    rig = replace(rig, rest_matrices=_align_rest_matrices(rig, info.joint_names, info.rest_matrices))
    differences = rig_differences(info.joints, info.rest_matrices, info.vertex_count, info.fingerprint, rig)
    if differences:
        raise ModelError(
            f"The rig of '{mesh_object.name}' is not the one that its model '{network.path.name}' was trained for: "
            f"{'; '.join(differences)}; undo the change, or record and train again."
        )
    session.passed_checks[mesh_object.session_uid] = passed_check


def _align_rest_matrices(rig: Rig, joint_names: tuple[str, ...], rest_matrices: np.ndarray) -> np.ndarray:
    """Transform the rest matrices of a rig so that its armature lies relative to the mesh as it did in the recording.

    Animation may move the mesh object and the armature object separately, which does not change the rig. The first
    joint defines the difference between the two transforms.

    Args:
        rig: the rig.
        joint_names: names of the joints of the model.
        rest_matrices: (J, 4, 4) float32, rest matrices of the model, mesh-object space.

    Returns:
        (J, 4, 4) float32, mesh-object space.
    """
    bone_joints = [joint for joint, name in enumerate(rig.joint_names) if name != STATIC_JOINT]
    if rig.joint_names != joint_names or not bone_joints or rest_matrices_match(rest_matrices, rig):
        return rig.rest_matrices
    rig_matrices, model_matrices = rig.rest_matrices.astype(np.float64), rest_matrices.astype(np.float64)
    first = bone_joints[0]
    rig_matrices[bone_joints] = model_matrices[first] @ np.linalg.inv(rig_matrices[first]) @ rig_matrices[bone_joints]
    return rig_matrices.astype(np.float32)
