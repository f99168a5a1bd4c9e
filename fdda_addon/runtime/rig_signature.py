# SPDX-License-Identifier: GPL-3.0-or-later
"""Checks that a model was trained for the current state of its rig.

The rig is read when a model starts to play, and again when Blender reports a changed armature or mesh. Reading all skin
weights takes long, so a signature is compared first, which is quick to read (`read_signature`).
"""

from collections.abc import Iterable
from dataclasses import replace

import bpy
import numpy as np

from ..core.errors import ModelError
from ..core.rig import STATIC_JOINT, Fingerprint, Rig, rest_matrices_match, rig_differences
from ..rig.deformation import b_bone_values, read_modifiers_and_drivers, read_unread_bones
from ..rig.modifier_stack import find_shape_readers, replaced_range
from ..rig.reading import read_model_rig
from ..scene.arrays import ElementProperty, read
from ..scene.mesh import rest_positions
from ..scene.scene_rig import SceneRig, armature_modifier
from .network import Network
from .playback_modifier import REST_POSITION
from .session import session

STABLE_MODES = ("OBJECT", "POSE")
"""Modes of an object in which its mesh does not change; in the other modes the user is editing the mesh."""

_BONE_PROPERTIES = (
    ElementProperty("bbone_segments", np.int32),
    ElementProperty("matrix_local", np.float32, (16,)),
    ElementProperty("use_deform", np.bool_),
    ElementProperty("use_inherit_rotation", np.bool_),
    ElementProperty("use_local_location", np.bool_),
    ElementProperty("inherit_scale", np.int32),
)
_ENVELOPE_PROPERTIES = (
    ElementProperty("envelope_distance", np.float32),
    ElementProperty("envelope_weight", np.float32),
    ElementProperty("head_radius", np.float32),
    ElementProperty("tail_radius", np.float32),
    ElementProperty("use_envelope_multiply", np.bool_),
)

BONES, PARENTS, OBJECT, MESH = PARTS = ("bones", "parents", "object", "mesh")
"""Parts of a rig that Blender reports separately. Posing by hand is reported as a change of the bones."""


def read_signature(
    scene_rig: SceneRig, unread_bones: Iterable[str] = (), parts: Iterable[str] = PARTS
) -> dict[str, tuple]:
    """Read the signature of a rig: what is quick to read. If it and the mesh are unchanged, the whole rig is unchanged.

    Args:
        unread_bones: names of the bones whose effect the model learned from others (`rig.deformation`).
        parts: which parts to read.

    Returns:
        By part. Names, rest matrices, inheritance and skinning properties of all bones; their parents, and how unread
        bones follow the others; the vertex groups, modifiers and drivers of the object (`rig.deformation`) and its
        shape readers (`rig.modifier_stack`); a digest of the rest positions of the mesh, and whether it has the
        attribute `REST_POSITION`.
    """
    mesh_object, armature = scene_rig.mesh_object, scene_rig.armature_object.data
    modifier = armature_modifier(mesh_object)
    readers = {
        BONES: lambda: _read_bones_once(armature, modifier is not None and modifier.use_bone_envelopes),
        PARENTS: lambda: (
            *(bone.parent.name if bone.parent else "" for bone in armature.bones),
            str(read_unread_bones(scene_rig, unread_bones)),
        ),
        OBJECT: lambda: (
            *mesh_object.vertex_groups.keys(),
            str(read_modifiers_and_drivers(scene_rig)),
            tuple(modifier.name for modifier in find_shape_readers(mesh_object, *replaced_range(mesh_object))),
        ),
        MESH: lambda: (rest_digest(mesh_object.data), REST_POSITION in mesh_object.data.attributes),
    }
    return {part: readers[part]() for part in parts}


def _read_bones_once(armature: bpy.types.Armature, has_envelopes: bool) -> tuple:
    """Read the bones; in a check of several characters that share the armature only once."""
    read_bones = {} if session.read_bones is None else session.read_bones
    key = armature.session_uid, has_envelopes
    if key not in read_bones:
        read_bones[key] = bone_signature(armature, has_envelopes)
    return read_bones[key]


def bone_signature(armature: bpy.types.Armature, has_envelopes: bool) -> tuple:
    """Read names, rest matrices, inheritance and skinning properties of all bones, and envelopes where used."""
    properties = (*_BONE_PROPERTIES, *(_ENVELOPE_PROPERTIES if has_envelopes else ()))
    names, (segments, *values) = armature.bones.keys(), [read(armature.bones, element) for element in properties]
    # Few bones are B-Bones, whose settings are slow to read.
    b_bones = [armature.bones[names[index]] for index in np.flatnonzero(segments > 1)]
    b_bone_settings = b_bone_values(armature, b_bones) if b_bones else {}
    return (*names, *(value.tobytes() for value in values), b_bone_settings)


def rest_digest(mesh: bpy.types.Mesh) -> str:
    """Compute a digest of the rest positions of a mesh."""
    return Fingerprint.digest(rest_positions(mesh))


def check(scene_rig: SceneRig, network: Network, signature: dict[str, tuple]) -> None:
    """Check that a model was trained for a rig.

    Args:
        scene_rig: the rig. It is not checked while the user edits its mesh.
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
        (info.joints, info.rest_matrices.tobytes(), info.meshes),
    )
    if session.passed_checks.get(mesh_object.session_uid) == passed_check:
        return
    rig = read_model_rig(scene_rig, info)
    rig = replace(rig, rest_matrices=_align_rest_matrices(rig, info.joint_names, info.rest_matrices))
    differences = rig_differences(info.joints, info.rest_matrices, info.meshes, rig)
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
