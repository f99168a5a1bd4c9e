# SPDX-License-Identifier: GPL-3.0-or-later
"""Overrides joints: sets each joint alone, while constraints and drivers of bones are muted."""

from collections.abc import Iterator
from contextlib import contextmanager

import bpy
import numpy as np
from mathutils import Matrix

from ..core.errors import RigError
from ..core.rig import STATIC_JOINT, Joint, reference_order
from ..rig.references import is_transform_channel, split_bone_path
from ..scene.armature import PoseMatrixReader, rest_matrices
from ..scene.scene_rig import MIN_VOLUME, SceneRig, is_flat

_CHAIN_CONSTRAINTS = {"IK", "SPLINE_IK"}
"""Constraints that also move ancestors of their bone."""
_PARENT_CONSTRAINTS = {"CHILD_OF", "ARMATURE"}
"""Constraints that move a bone as a parent does."""


class JointOverride:
    """Reads joints of evaluated poses, and sets each joint alone.

    Attributes:
        rest: (J, 4, 4) float64, rest matrix of each joint relative to its reference joint, mesh units.
    """

    def __init__(self, scene_rig: SceneRig, joints: tuple[Joint, ...]):
        """Prepare to read and set joints.

        Args:
            scene_rig: the rig.
            joints: J joints, every parent before its children.
        """
        self._armature_object = scene_rig.armature_object
        self._joints, self._order = joints, reference_order(joints)
        self._carried_bones = {
            bone.name
            for bone in scene_rig.armature_object.pose.bones
            if not bone.parent and not any(constraint.type in _PARENT_CONSTRAINTS for constraint in bone.constraints)
        }
        names = tuple(joint.name for joint in joints)
        self._matrix_reader = PoseMatrixReader(scene_rig.armature_object, names)
        self.rest = self._to_relative_matrices(rest_matrices(scene_rig.armature_object.data, names))

    def read(self) -> np.ndarray:
        """Read the evaluated matrix of each joint relative to its reference joint; (J, 4, 4) float64, mesh units.

        Raises:
            RigError: the armature, or a bone, has a scale of zero.
        """
        armature_object = self._armature_object.evaluated_get(bpy.context.evaluated_depsgraph_get())
        matrices = self._matrix_reader.read(armature_object).astype(np.float64)
        is_singular = np.abs(np.linalg.det(matrices[:, :3, :3])) < MIN_VOLUME
        if is_flat(armature_object) or is_singular.any():
            name = armature_object.name if is_flat(armature_object) else self._joints[int(is_singular.argmax())].name
            raise RigError(
                f"'{name}' has a scale of zero in some pose; look for the key, constraint or driver that sets it."
            )
        return self._to_relative_matrices(matrices)

    def _to_relative_matrices(self, matrices: np.ndarray) -> np.ndarray:
        references = [joint.parent if joint.reference is None else joint.reference for joint in self._joints]
        return np.array(
            [np.linalg.solve(matrices[r], m) if r >= 0 else m for r, m in zip(references, matrices, strict=True)]
        )

    def set(self, relative_matrices: np.ndarray) -> None:
        """Set the joints to (J, 4, 4) matrices as `read` returns them, in `override_joints`, without an evaluation."""
        target_matrices: dict[str, Matrix] = {}
        for index in self._order:
            joint, matrix = self._joints[index], Matrix(relative_matrices[index])
            reference = joint.parent if joint.reference is None else joint.reference
            target_matrices[joint.name] = (
                target_matrices[self._joints[reference].name] @ matrix if reference >= 0 else matrix
            )
        target_matrices.pop(STATIC_JOINT, None)
        # The joint without a reference joint carries the whole rig, so bones that nothing else moves follow it.
        root = self._joints[self._order[0]].name
        root_motion = target_matrices[root] @ self._armature_object.data.bones[root].matrix_local.inverted()
        pose_matrices: dict[str, Matrix] = {}
        for bone in self._armature_object.pose.bones:
            bone_data = bone.bone
            parent = bone_data.parent
            parent_matrices = (
                {"parent_matrix": pose_matrices[parent.name], "parent_matrix_local": parent.matrix_local}
                if parent
                else {}
            )
            if bone_data.name in target_matrices:
                pose_matrices[bone_data.name] = target_matrices[bone_data.name]
                bone.matrix_basis = bone_data.convert_local_to_pose(
                    target_matrices[bone_data.name], bone_data.matrix_local, invert=True, **parent_matrices
                )
            elif bone_data.name in self._carried_bones:
                pose_matrices[bone_data.name] = root_motion @ bone_data.matrix_local
                bone.matrix_basis = bone_data.matrix_local.inverted() @ pose_matrices[bone_data.name]
            else:
                pose_matrices[bone_data.name] = bone_data.convert_local_to_pose(
                    Matrix(), bone_data.matrix_local, **parent_matrices
                )


@contextmanager
def override_joints(
    scene_rig: SceneRig, joints: tuple[Joint, ...], keep_other_bones: bool = False
) -> Iterator[JointOverride]:
    """Mute constraints and drivers of bones, so that only their channels move them; restore both afterwards.

    Clear the pose before (`armature.clear_pose`). The last pose that was set stays afterwards.

    Args:
        scene_rig: the rig.
        joints: as for `JointOverride`.
        keep_other_bones: do not mute constraints and drivers of bones that are neither joints nor ancestors of joints.
    """
    armature_object = scene_rig.armature_object
    animation = armature_object.animation_data
    names = {joint.name for joint in joints}
    bones = [bone for bone in armature_object.pose.bones if bone.name in names]
    joints_and_ancestors = {ancestor.name for bone in bones for ancestor in (bone, *bone.parent_recursive)}

    def is_overridden(name: str) -> bool:
        return not keep_other_bones or name in joints_and_ancestors

    constraints = [
        constraint
        for bone in armature_object.pose.bones
        for constraint in bone.constraints
        if not constraint.mute and (is_overridden(bone.name) or constraint.type in _CHAIN_CONSTRAINTS)
    ]
    drivers = [
        curve
        for curve in (animation.drivers if animation else ())
        for bone, channel_path in [split_bone_path(armature_object, curve.data_path)]
        if bone and is_transform_channel(channel_path) and is_overridden(bone) and not curve.mute
    ]
    override = JointOverride(scene_rig, joints)
    for constraint_or_driver in (*constraints, *drivers):
        constraint_or_driver.mute = True
    try:
        yield override
    finally:
        for constraint_or_driver in (*constraints, *drivers):
            constraint_or_driver.mute = False
        bpy.context.view_layer.update()
