# SPDX-License-Identifier: GPL-3.0-or-later
"""Checks that a rig is still the one that its model was trained for.

Everything that a fingerprint covers is read when a model starts to play, and again when Blender reports that armature
or mesh were changed. Reading the weights of 50,000 vertices takes 0.2 s, so a quick `RigSignature` is compared first.
"""

from dataclasses import dataclass, replace

import bpy
import numpy as np

from ..core.errors import ModelError
from ..core.rig import STATIC_JOINT, Fingerprint, Rig, rest_matrices_match, rig_differences
from ..rig.deformation import read_b_bones, read_deformation
from ..rig.reading import read_model_rig
from ..scene.arrays import Element, read
from ..scene.mesh import rest_positions
from ..scene.scene_rig import SceneRig, armature_modifier
from .network import Network

STABLE_MODES = ("OBJECT", "POSE")
"""Modes of an object in which its mesh does not change; in the others the user is editing it."""

_BONE_PROPERTIES = (
    Element("matrix_local", np.float32, (16,)),
    Element("use_deform", np.bool_),
    Element("envelope_distance", np.float32),
    Element("envelope_weight", np.float32),
    Element("head_radius", np.float32),
    Element("tail_radius", np.float32),
    Element("use_envelope_multiply", np.bool_),
    Element("bbone_segments", np.int32),
)
_SEGMENTS_INDEX = len(_BONE_PROPERTIES) - 1
_ARMATURE_MODIFIER_PROPERTIES = ("use_vertex_groups", "use_bone_envelopes", "vertex_group", "invert_vertex_group")
"""The properties of an Armature modifier that skin weights depend on."""

_passed_checks: dict[int, tuple] = {}
"""By the session id of a mesh object: what its model requires, and the signature of the rig that passed the check."""


@dataclass(frozen=True)
class RigSignature:
    """The parts of a rig that are quick to read. While they and the mesh are unchanged, so is the whole rig.

    Attributes:
        armature, mesh: session ids of the data.
        bones: names in their order, rest matrices, and the properties that skinning depends on.
        parents: names of the bones' parents.
        skin: settings of the Armature modifier, and names of the vertex groups.
        rest: digest of the rest positions.
        deformation: what deforms the mesh besides the armature.
    """

    armature: int
    mesh: int
    bones: tuple
    parents: tuple
    skin: tuple
    rest: str
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
    # The other B-Bone settings are slow to read, and most armatures have no B-Bones.
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
    """Read `RigSignature.rest`."""
    return Fingerprint.digest(rest_positions(mesh))


def check(scene_rig: SceneRig, network: Network, signature: RigSignature) -> None:
    """Check that a rig is the one that a model was trained for.

    Args:
        scene_rig: the rig; not checked while its mesh is being edited.
        network: the model.
        signature: the signature of the rig.

    Raises:
        ModelError: names the differences.
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
    changes = rig_differences(info.joints, info.rest_matrices, info.vertex_count, info.fingerprint, rig)
    if changes:
        raise ModelError(
            f"The rig of '{mesh_object.name}' is not the one that its model '{network.path.name}' was trained for: "
            f"{'; '.join(changes)}; undo the change, or record and train again."
        )
    _passed_checks[mesh_object.session_uid] = required


def invalidate(mesh: int) -> None:
    """Read the rigs of a mesh, given by its session id, again at their next check."""
    for uid in [uid for uid, (*_, signature) in _passed_checks.items() if signature.mesh == mesh]:
        del _passed_checks[uid]


def invalidate_all() -> None:
    """Read all rigs again at their next check."""
    _passed_checks.clear()


def _align_rest_matrices(rig: Rig, joint_names: tuple[str, ...], rest_matrices: np.ndarray) -> np.ndarray:
    """Express the rest matrices of a rig as if its armature had the same transform relative to the mesh as in a model.

    Animation moves mesh and armature objects separately, which does not change the rig. The first joint gives the
    difference between the two transforms.

    Args:
        rig: the rig.
        joint_names: names of the joints of the model.
        rest_matrices: (J, 4, 4) float32, rest matrices of the model, mesh-object space.

    Returns:
        (J, 4, 4) float32, mesh-object space.
    """
    moving = [joint for joint, name in enumerate(rig.joint_names) if name != STATIC_JOINT]
    if rig.joint_names != joint_names or not moving or rest_matrices_match(rest_matrices, rig):
        return rig.rest_matrices
    aligned, expected = rig.rest_matrices.astype(np.float64), rest_matrices.astype(np.float64)
    aligned[moving] = expected[moving[0]] @ np.linalg.inv(aligned[moving[0]]) @ aligned[moving]
    return aligned.astype(np.float32)
