# SPDX-License-Identifier: GPL-3.0-or-later
"""Checks that a model was trained for the current state of its rig.

The rig is read when a model starts to play, and again when Blender reports a changed armature or mesh. Reading all skin
weights takes long, so a `RigSignature` is compared first, which is quick to read.
"""

from dataclasses import dataclass, replace

import bpy
import numpy as np

from ..core.errors import ModelError
from ..core.rig import STATIC_JOINT, Fingerprint, Rig, rest_matrices_match, rig_differences
from ..rig.deformation import read_b_bones, read_deformation
from ..rig.reading import read_model_rig
from ..scene.arrays import ElementProperty, read
from ..scene.mesh import rest_positions
from ..scene.scene_rig import SceneRig, armature_modifier
from .network import Network

STABLE_MODES = ("OBJECT", "POSE")
"""Modes of an object in which its mesh does not change; in the other modes the user is editing the mesh."""

_BONE_PROPERTIES = (
    ElementProperty("matrix_local", np.float32, (16,)),
    ElementProperty("use_deform", np.bool_),
    ElementProperty("envelope_distance", np.float32),
    ElementProperty("envelope_weight", np.float32),
    ElementProperty("head_radius", np.float32),
    ElementProperty("tail_radius", np.float32),
    ElementProperty("use_envelope_multiply", np.bool_),
    ElementProperty("bbone_segments", np.int32),
)
_SEGMENTS_INDEX = len(_BONE_PROPERTIES) - 1
_ARMATURE_MODIFIER_PROPERTIES = ("use_vertex_groups", "use_bone_envelopes", "vertex_group", "invert_vertex_group")
"""The properties of an Armature modifier that skin weights depend on."""

_passed_checks: dict[int, tuple] = {}
"""By the session id of a mesh object: the rig that its model requires, and the signature of the rig that passed."""


@dataclass(frozen=True)
class RigSignature:
    """The parts of a rig that are quick to read. If they and the mesh are unchanged, the whole rig is unchanged.

    Attributes:
        armature_uid, mesh_uid: session ids of the armature data and of the mesh.
        bones: names of the bones in their order, rest matrices, and the bone properties that skinning depends on.
        parents: name of the parent of each bone.
        skin: settings of the Armature modifier, and names of the vertex groups.
        rest_digest: digest of the rest positions.
        deformation: everything besides the armature that deforms the mesh (`rig.deformation`).
    """

    armature_uid: int
    mesh_uid: int
    bones: tuple
    parents: tuple
    skin: tuple
    rest_digest: str
    deformation: dict

    @staticmethod
    def read(scene_rig: SceneRig) -> "RigSignature":
        """Read the signature of a rig."""
        mesh_object, armature = scene_rig.mesh_object, scene_rig.armature_object.data
        return RigSignature(
            armature.session_uid,
            mesh_object.data.session_uid,
            bone_signature(armature),
            parent_names(armature),
            skin_signature(mesh_object),
            rest_digest(mesh_object.data),
            read_deformation(scene_rig),
        )


def bone_signature(armature: bpy.types.Armature) -> tuple:
    """Read `RigSignature.bones`."""
    values = [read(armature.bones, element) for element in _BONE_PROPERTIES]
    # The settings of B-Bones are slow to read, and most armatures have no B-Bones.
    b_bones = str(read_b_bones(armature)) if (values[_SEGMENTS_INDEX] > 1).any() else ""
    return (*armature.bones.keys(), *(value.tobytes() for value in values), b_bones)


def parent_names(armature: bpy.types.Armature) -> tuple:
    """Read `RigSignature.parents`."""
    return tuple(bone.parent.name if bone.parent else "" for bone in armature.bones)


def skin_signature(mesh_object: bpy.types.Object) -> tuple:
    """Read `RigSignature.skin`."""
    return armature_modifier_settings(mesh_object), *mesh_object.vertex_groups.keys()


def armature_modifier_settings(mesh_object: bpy.types.Object) -> tuple:
    """Read the settings of the Armature modifier that skin weights depend on, the first item of `RigSignature.skin`."""
    modifier = armature_modifier(mesh_object)
    return () if modifier is None else tuple(getattr(modifier, name) for name in _ARMATURE_MODIFIER_PROPERTIES)


def rest_digest(mesh: bpy.types.Mesh) -> str:
    """Read `RigSignature.rest_digest`."""
    return Fingerprint.digest(rest_positions(mesh))


def check(scene_rig: SceneRig, network: Network, signature: RigSignature) -> None:
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
    required = (info.joints, info.rest_matrices.tobytes(), info.fingerprint, signature)
    if _passed_checks.get(mesh_object.session_uid) == required:
        return
    rig = read_model_rig(scene_rig, info)
    rig = replace(rig, rest_matrices=_align_rest_matrices(rig, info.joint_names, info.rest_matrices))
    differences = rig_differences(info.joints, info.rest_matrices, info.vertex_count, info.fingerprint, rig)
    if differences:
        raise ModelError(
            f"The rig of '{mesh_object.name}' is not the one that its model '{network.path.name}' was trained for: "
            f"{'; '.join(differences)}; undo the change, or record and train again."
        )
    _passed_checks[mesh_object.session_uid] = required


def invalidate(mesh_uid: int) -> None:
    """Discard the passed checks of a mesh, given by its session id, so that the next check reads the whole rig."""
    for uid in [uid for uid, (*_, signature) in _passed_checks.items() if signature.mesh_uid == mesh_uid]:
        del _passed_checks[uid]


def invalidate_all() -> None:
    """Discard all passed checks, so that the next check of each rig reads the whole rig."""
    _passed_checks.clear()


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
