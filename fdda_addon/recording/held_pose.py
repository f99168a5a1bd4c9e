# SPDX-License-Identifier: GPL-3.0-or-later
"""Moves joints one by one, also those that constraints, drivers or control bones move otherwise."""

import re
from collections.abc import Iterator
from contextlib import contextmanager

import bpy
import numpy as np
from mathutils import Matrix

from ..core.errors import RigError
from ..core.rig import STATIC_JOINT, Joint
from ..scene.armature import PoseMatrixReader, rest_matrices
from ..scene.scene_rig import MIN_VOLUME, SceneRig, is_flat

_OF_POSE = re.compile(r'pose\.bones\["(?P<bone>(?:[^"\\]|\\.)*)"\]\.(?:location|rotation_\w+|scale)')
_CHAIN_CONSTRAINTS = {"IK", "SPLINE_IK"}
"""Constraints that move the bones above their own."""


class HeldPose:
    """Sets joints to poses that the rig was seen in, each joint by itself.

    Attributes:
        rest: (J, 4, 4) float64, rest pose of each joint relative to its parent joint, mesh units.
    """

    def __init__(self, scene_rig: SceneRig, joints: tuple[Joint, ...]):
        """Args:
        scene_rig: the rig.
        joints: J of them, every parent before its children.
        """
        self._armature_object = scene_rig.armature_object
        self._joints = joints
        names = tuple(joint.name for joint in joints)
        self._matrices = PoseMatrixReader(scene_rig.armature_object, names)
        self.rest = self._relative(rest_matrices(scene_rig.armature_object.data, names))

    def read(self) -> np.ndarray:
        """(J, 4, 4) float64, each joint relative to its parent joint as the scene is evaluated now.

        Raises:
            RigError: the armature, or a bone, has a scale of zero.
        """
        armature_object = self._armature_object.evaluated_get(bpy.context.evaluated_depsgraph_get())
        matrices = self._matrices.read(armature_object).astype(np.float64)
        flat = np.abs(np.linalg.det(matrices[:, :3, :3])) < MIN_VOLUME
        if is_flat(armature_object) or flat.any():
            name = armature_object.name if is_flat(armature_object) else self._joints[int(flat.argmax())].name
            raise RigError(f"'{name}' has a scale of zero in some pose; give it another there.")
        return self._relative(matrices)

    def _relative(self, matrices: np.ndarray) -> np.ndarray:
        parents = [joint.parent for joint in self._joints]
        return np.array(
            [np.linalg.solve(matrices[p], m) if p >= 0 else m for p, m in zip(parents, matrices, strict=True)]
        )

    def set(self, relative: np.ndarray) -> None:
        """Pose the joints, (J, 4, 4) as `read` gives them; inside `held_joints`. The graph is not evaluated."""
        wanted: dict[str, Matrix] = {}
        for joint, matrix in zip(self._joints, relative, strict=True):
            above = wanted[self._joints[joint.parent].name] if joint.parent >= 0 else Matrix()
            wanted[joint.name] = above @ Matrix(matrix)
        wanted.pop(STATIC_JOINT, None)
        reached: dict[str, Matrix] = {}
        for bone in self._armature_object.pose.bones:
            own = bone.bone
            parent = own.parent
            around = (
                {"parent_matrix": reached[parent.name], "parent_matrix_local": parent.matrix_local} if parent else {}
            )
            if own.name in wanted:
                reached[own.name] = wanted[own.name]
                bone.matrix_basis = own.convert_local_to_pose(wanted[own.name], own.matrix_local, invert=True, **around)
            else:
                reached[own.name] = own.convert_local_to_pose(Matrix(), own.matrix_local, **around)


@contextmanager
def held_joints(scene_rig: SceneRig, joints: tuple[Joint, ...], others_follow: bool = False) -> Iterator[HeldPose]:
    """Mute all that moves the bones of an armature but their own channels; given back afterwards.

    The pose is at rest when it begins (`armature.clear_pose`), and stays as it was set last.

    Args:
        scene_rig: the rig.
        joints: as for `HeldPose`.
        others_follow: leave what moves the bones that are no joints and carry none.
    """
    armature_object = scene_rig.armature_object
    animation = armature_object.animation_data
    names = {joint.name for joint in joints}
    bones = [bone for bone in armature_object.pose.bones if bone.name in names]
    carrying = {above.name for bone in bones for above in (bone, *bone.parent_recursive)}

    def is_held(name: str) -> bool:
        return not others_follow or name in carrying

    constraints = [
        constraint
        for bone in armature_object.pose.bones
        for constraint in bone.constraints
        if not constraint.mute and (is_held(bone.name) or constraint.type in _CHAIN_CONSTRAINTS)
    ]
    drivers = [
        curve
        for curve in (animation.drivers if animation else ())
        if (match := _OF_POSE.fullmatch(curve.data_path))
        and is_held(bpy.utils.unescape_identifier(match["bone"]))
        and not curve.mute
    ]
    held = HeldPose(scene_rig, joints)
    for muted in (*constraints, *drivers):
        muted.mute = True
    try:
        yield held
    finally:
        for muted in (*constraints, *drivers):
            muted.mute = False
        bpy.context.view_layer.update()
