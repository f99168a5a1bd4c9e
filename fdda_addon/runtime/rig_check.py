# SPDX-License-Identifier: GPL-3.0-or-later
"""Holds a rig to the model that plays on it, where the rig may have changed.

All that a fingerprint covers is read when a model starts to play, and again when Blender says that armature or mesh
were changed. Weights of 50,000 vertices take 0.2 s to read, so what is quickly read is compared first (`Form`).
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

SETTLED_MODES = ("OBJECT", "POSE")
"""Modes of an object in which its mesh is what it will be: in others it is being changed, or lies elsewhere."""

_BONES = (
    Element("matrix_local", np.float32, (16,)),
    Element("use_deform", np.bool_),
    Element("envelope_distance", np.float32),
    Element("envelope_weight", np.float32),
    Element("head_radius", np.float32),
    Element("tail_radius", np.float32),
    Element("use_envelope_multiply", np.bool_),
    Element("bbone_segments", np.int32),
)
_SEGMENTS = len(_BONES) - 1
_SETTINGS = ("use_vertex_groups", "use_bone_envelopes", "vertex_group", "invert_vertex_group")
"""Of an Armature modifier: what skin weights follow from."""

_passed: dict[int, tuple] = {}
"""What was found in order, by the session id of the mesh object: what its model asks for, and the form of its rig."""


@dataclass(frozen=True)
class Form:
    """What is quickly read of a rig. While it is the same, and no mesh was changed, so is all that a model asks for.

    Attributes:
        armature, mesh: session ids of the data.
        bones: names in their order, rest matrices, what skinning takes from them.
        parents: names of the bones' parents.
        skin: settings of the Armature modifier, and names of the vertex groups.
        rest: digest of the rest positions.
        deformation: what deforms the mesh besides.
    """

    armature: int
    mesh: int
    bones: tuple
    parents: tuple
    skin: tuple
    rest: str
    deformation: dict

    @staticmethod
    def of(scene_rig: SceneRig) -> "Form":
        """Read the form of a rig."""
        mesh_object, armature = scene_rig.mesh_object, scene_rig.armature_object.data
        return Form(
            armature.session_uid,
            mesh_object.data.session_uid,
            bones_of(armature),
            parents_of(armature),
            skin_of(mesh_object),
            rest_of(mesh_object.data),
            read_deformation(scene_rig),
        )


def bones_of(armature: bpy.types.Armature) -> tuple:
    """As in `Form`."""
    values = [read(armature.bones, element) for element in _BONES]
    # All else of a B-Bone takes long to read, and most armatures have none.
    b_bones = str(read_b_bones(armature)) if (values[_SEGMENTS] > 1).any() else ""
    return (*armature.bones.keys(), *(value.tobytes() for value in values), b_bones)


def parents_of(armature: bpy.types.Armature) -> tuple:
    """As in `Form`."""
    return tuple(bone.parent.name if bone.parent else "" for bone in armature.bones)


def skin_of(mesh_object: bpy.types.Object) -> tuple:
    """As in `Form`."""
    return settings_of(mesh_object), *mesh_object.vertex_groups.keys()


def settings_of(mesh_object: bpy.types.Object) -> tuple:
    """Settings of the Armature modifier that skin weights follow from, the first of `Form.skin`."""
    modifier = armature_modifier(mesh_object)
    return () if modifier is None else tuple(getattr(modifier, name) for name in _SETTINGS)


def rest_of(mesh: bpy.types.Mesh) -> str:
    """As in `Form`."""
    return Fingerprint.digest(rest_positions(mesh))


def check(scene_rig: SceneRig, network: Network, form: Form) -> None:
    """Fail when a rig is not, or no longer, the one that a model was trained for.

    Args:
        scene_rig: the rig; while its mesh is being edited it is not looked at.
        network: the model.
        form: of the rig.

    Raises:
        ModelError: says in what they differ.
        RigError: the rig cannot be read.
    """
    mesh_object, info = scene_rig.mesh_object, network.info
    if mesh_object.mode not in SETTLED_MODES:
        return
    asked = (info.joints, info.rest_matrices.tobytes(), info.fingerprint, form)
    if _passed.get(mesh_object.session_uid) == asked:
        return
    rig = read_model_rig(scene_rig, info)
    rig = replace(rig, rest_matrices=_beside(rig, info.joint_names, info.rest_matrices))
    found = rig_differences(info.joints, info.rest_matrices, info.vertex_count, info.fingerprint, rig)
    if found:
        raise ModelError(
            f"The rig of '{mesh_object.name}' is not the one that its model '{network.path.name}' was trained for: "
            f"{'; '.join(found)}; undo the change, or record and train again."
        )
    _passed[mesh_object.session_uid] = asked


def doubt(mesh: int) -> None:
    """Read the rigs of a mesh anew when they are checked next: its session id."""
    for uid in [uid for uid, (*_, form) in _passed.items() if form.mesh == mesh]:
        del _passed[uid]


def forget() -> None:
    """Read all rigs anew when they are checked next."""
    _passed.clear()


def _beside(rig: Rig, names: tuple[str, ...], rest_matrices: np.ndarray) -> np.ndarray:
    """The rest matrices of a rig, (J, 4, 4), as if mesh and armature stood to each other as in those of a model.

    Animation moves either of them on its own, which changes no rig. Where the relation is another, the first joint
    tells which.
    """
    moved = [place for place, name in enumerate(rig.joint_names) if name != STATIC_JOINT]
    if rig.joint_names != names or not moved or rest_matrices_match(rest_matrices, rig):
        return rig.rest_matrices
    ours, theirs = rig.rest_matrices.astype(np.float64), rest_matrices.astype(np.float64)
    ours[moved] = theirs[moved[0]] @ np.linalg.inv(ours[moved[0]]) @ ours[moved]
    return ours.astype(np.float32)
