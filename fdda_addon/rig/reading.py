# SPDX-License-Identifier: GPL-3.0-or-later
"""Reads the rig of a scene and its poses into arrays."""

from collections.abc import Iterable
from dataclasses import replace

import bpy
import numpy as np
from mathutils import Matrix

from ..core.errors import RigError
from ..core.formats.model_info import ModelInfo
from ..core.mathematics.features import FLOAT32_ROUNDING_RATIO
from ..core.mathematics.key_joints import select_joints
from ..core.rig import STATIC_JOINT, Fingerprint, Joint, MeshPart, Rig, join_faces, join_positions, join_weights
from ..core.wording import format_count
from ..scene import armature as armature_io
from ..scene import mesh as mesh_io
from ..scene.control_reader import ControlReader
from ..scene.scene_rig import (
    MIN_VOLUME,
    SceneRig,
    armature_modifier,
    is_flat,
)
from ..scene.skin import read_skin
from ..scene.unit import metres_per_unit
from .deformation import read_deformation, read_unread_bones
from .dependencies import read_dependencies
from .target import Target

MAX_MESH_MOTION_RATIO = 1e-4
"""Largest motion of a mesh object against the first one, as a part of the rig's size."""
IDENTITY_TOLERANCE = 1e-6
"""A matrix counts as the identity if no element differs from the identity by more than this."""


COINCIDENCE_TOLERANCE = 1e-5
"""Largest distance between the ends of two bones that coincide at rest, as a fraction of their length."""


def choose_joints(
    scene_rig: SceneRig,
    weighted_bones: Iterable[str],
    extra_joints: Iterable[str] | None = None,
    are_joints_complete: bool = False,
) -> tuple[Joint, ...]:
    """Choose the joints of a rig; every parent comes before its children.

    The parent of a joint is its nearest ancestor that is a joint or that coincides with a joint: in a control rig the
    deforming bones are children of other bones, each of which coincides with a deforming bone.

    Args:
        weighted_bones: names of the bones that have weights, `STATIC_JOINT` among them; if there are no bones, all
            deforming bones.
        extra_joints: names of further joints; names that the armature lacks are ignored. If they include all joints,
            they define the order. By default: the bones on which the mesh depends in other ways, and all ancestors
            of joints.
        are_joints_complete: a mesh without weights gets no deforming bones besides `extra_joints`, which are the joints
            of a recording or a model.
    """
    armature_object = scene_rig.armature_object
    bones = armature_object.data.bones
    names = set(weighted_bones)
    extra_joints = None if extra_joints is None else list(extra_joints)
    if not names - {STATIC_JOINT} and not are_joints_complete:
        names |= {bone.name for bone in bones if bone.use_deform}
    if extra_joints is not None:
        names |= {name for name in extra_joints if name in bones or name == STATIC_JOINT}
    else:
        names |= read_dependencies(scene_rig).bones
        names |= {ancestor.name for name in names - {STATIC_JOINT} for ancestor in bones[name].parent_recursive}
    joint_bones = [bone for bone in bones if bone.name in names]
    parents = _parents(joint_bones)
    depths = {bone.name: _depth(bone.name, parents) for bone in joint_bones}
    ordered_names = sorted((bone.name for bone in joint_bones), key=depths.__getitem__)
    extra_order = [name for name in extra_joints or () if name != STATIC_JOINT]
    if set(extra_order) == set(ordered_names):
        # The order of an armature's bones changes when other bones are added.
        indices = {name: index for index, name in enumerate(extra_order)}
        if all(indices.get(parents[name], -1) < indices[name] for name in extra_order):
            ordered_names = extra_order
    indices = {name: index for index, name in enumerate(ordered_names)}
    joints = [Joint(name, indices[parents[name]] if parents[name] else -1) for name in ordered_names]
    return (*joints, *([Joint(STATIC_JOINT, -1)] if STATIC_JOINT in names else []))


def _parents(joint_bones: list[bpy.types.Bone]) -> dict[str, str]:
    """Find the parent joint of each joint, by name; empty for a root."""
    names = {bone.name for bone in joint_bones}
    bone_ends = np.array([[*bone.head_local, *bone.tail_local] for bone in joint_bones]).reshape(-1, 6)
    parents = {bone.name: _parent(bone, names, joint_bones, bone_ends) for bone in joint_bones}
    # Two coincident bones may each find the other as its parent. Then only ancestors in the armature count.
    if any(_depth(name, parents) > len(joint_bones) for name in parents):
        parents = {bone.name: _parent(bone, names, [], bone_ends[:0]) for bone in joint_bones}
    return parents


def _parent(bone: bpy.types.Bone, names: set[str], joint_bones: list[bpy.types.Bone], bone_ends: np.ndarray) -> str:
    """Find the parent joint of a joint."""
    for ancestor in bone.parent_recursive:
        if ancestor.name in names:
            return ancestor.name
        distances = np.abs(bone_ends - [*ancestor.head_local, *ancestor.tail_local]).max(axis=1, initial=0)
        for index in np.flatnonzero(distances <= COINCIDENCE_TOLERANCE * ancestor.length):
            if joint_bones[index] != bone:
                return joint_bones[index].name
    return ""


def _depth(name: str, parents: dict[str, str]) -> int:
    """Count the ancestors of a joint; if the parents form a cycle, the count is larger than the number of joints."""
    depth = 0
    while (name := parents[name]) and depth <= len(parents):
        depth += 1
    return depth


def read_rig(
    scene_rig: SceneRig,
    extra_joints: Iterable[str] | None = None,
    include_static_joint: bool = False,
    are_joints_complete: bool = False,
) -> Rig:
    """Read a rig into arrays.

    Args:
        extra_joints: names of joints besides the bones with weights, such as those of a model or a recording; None as
            for `choose_joints`.
        include_static_joint: add the joint that never moves, which tells the networks the direction of gravity.
        are_joints_complete: as for `choose_joints`.

    Raises:
        RigError: there is no vertex, all vertices are at one point, an object or a bone has a scale of zero, or a rest
            position or a transform is not finite.
    """
    armature_object = scene_rig.armature_object
    # Check the armature first, because the meshes may be its children.
    for scene_object in (armature_object, *scene_rig.mesh_objects):
        if not np.isfinite(scene_object.matrix_world).all():
            raise RigError(
                f"'{scene_object.name}' is at no finite place; clear the location, rotation and scale of it and of its "
                "parents."
            )
        if is_flat(scene_object):
            raise RigError(f"'{scene_object.name}' has a scale of zero; give it another.")
    rest_positions = [mesh_io.rest_positions(mesh_object.data) for mesh_object in scene_rig.mesh_objects]
    for mesh_object, positions in zip(scene_rig.mesh_objects, rest_positions, strict=True):
        _check_rest_positions(mesh_object, positions)
    skins = [read_skin(o, armature_object, armature_modifier(o)) for o in scene_rig.mesh_objects]
    weighted_bones = {bone for skin in skins for bone in skin.bones}
    weighted_bones |= {STATIC_JOINT} if include_static_joint else set()
    joints = choose_joints(scene_rig, weighted_bones, extra_joints, are_joints_complete)
    names = tuple(joint.name for joint in joints)
    rest_matrices = armature_io.rest_matrices(armature_object.data, names)
    is_bone = np.array([name != STATIC_JOINT for name in names], bool)
    rest_matrices[is_bone] = (
        np.array(_armature_to_mesh_transform(scene_rig.mesh_object, armature_object), np.float64)
        @ rest_matrices[is_bone]
    )
    # Raise a RigError if a rest matrix, (J, 4, 4), has no inverse.
    for name, matrix in zip(names, rest_matrices, strict=True):
        if not np.isfinite(matrix).all() or np.abs(np.linalg.det(matrix[:3, :3])) < MIN_VOLUME:
            raise RigError(
                f"The bone '{name}' has no length or no finite place in the rest pose; give its head and its tail "
                "places in edit mode."
            )
    joint_indices = {name: index for index, name in enumerate(names)}
    weights = [skin.arrays(joint_indices) for skin in skins]
    faces = [mesh_io.topology(mesh_object.data) for mesh_object in scene_rig.mesh_objects]
    meshes = tuple(
        MeshPart(
            name or part.mesh_object.name,
            len(positions),
            Fingerprint(
                Fingerprint.digest(*mesh_faces),
                Fingerprint.digest(positions),
                Fingerprint.digest(*mesh_weights),
                read_deformation(part),
            ),
            tuple(mesh_to_mesh_matrix(scene_rig.mesh_object, part.mesh_object).ravel().tolist()),
        )
        for (name, part), positions, mesh_weights, mesh_faces in zip(
            scene_rig.parts, rest_positions, weights, faces, strict=True
        )
    )
    return Rig(
        joints,
        join_positions(rest_positions, meshes),
        rest_matrices.astype(np.float32),
        *join_weights(weights),
        meshes,
        *join_faces(faces, meshes),
        metres_per_unit=metres_per_unit(scene_rig.mesh_object),
    )


def _check_rest_positions(mesh_object: bpy.types.Object, rest_positions: np.ndarray) -> None:
    """Raise a RigError if rest positions, (V, 3), are not finite or have no extent."""
    object_name, vertex_count, is_finite = (
        mesh_object.name,
        len(rest_positions),
        np.isfinite(rest_positions).all(axis=1),
    )
    if not is_finite.all():
        raise RigError(
            f"{vertex_count - is_finite.sum():,} of {vertex_count:,} vertices of '{object_name}' have coordinates that "
            f"are not finite, the first is vertex {is_finite.argmin()}; delete them, or give them others in edit mode."
        )
    size = np.ptp(rest_positions, axis=0).max() if vertex_count else 0.0
    if size <= FLOAT32_ROUNDING_RATIO * np.abs(rest_positions).max(initial=0.0):
        raise RigError(
            f"'{object_name}' has no size: {format_count(vertex_count, 'vertex', 'vertices')} at one point in the rest "
            "pose; give the mesh, or its Basis shape key, its shape, or choose another object."
        )


def read_model_rig(scene_rig: SceneRig, info: ModelInfo) -> Rig:
    """Read a rig with the joints, controls and unit of a model, so that `formats.model.check_rig` can compare them.

    A fast rig lacks modifiers and bones of the rig that the model was trained for. So its skin weights and deformation
    count as those of the model. If the model reads key joints, the rig has these alone.
    """
    rig = read_rig(scene_rig, info.joint_names, are_joints_complete=True)
    if info.has_key_joints:
        names = [name for name in info.joint_names if name in rig.joint_names]
        is_complete = len(names) == len(info.joints)
        selected = select_joints(rig, info.joints if is_complete else choose_joints(scene_rig, names, names))
        recorded_bones = info.meshes[0].fingerprint.deformation.get("unread_bones", {})
        unread_bones = {"unread_bones": read_unread_bones(scene_rig, recorded_bones)}
        fingerprints = [
            replace(mesh.fingerprint, deformation=mesh.fingerprint.deformation | unread_bones)
            for mesh in selected.meshes
        ]
        meshes = zip(selected.meshes, fingerprints, strict=True)
        rig = replace(selected, meshes=tuple(replace(mesh, fingerprint=each) for mesh, each in meshes))
    if scene_rig.mesh_object.fdda.is_fast_rig:
        (mesh,), recorded = rig.meshes, info.meshes[0].fingerprint
        fingerprint = replace(mesh.fingerprint, skin_weights=recorded.skin_weights, deformation=recorded.deformation)
        rig = replace(rig, meshes=(replace(mesh, fingerprint=fingerprint),))
    return replace(rig, controls=info.controls, metres_per_unit=info.metres_per_unit)


def _armature_to_mesh_transform(mesh_object: bpy.types.Object, armature_object: bpy.types.Object) -> Matrix:
    return mesh_object.matrix_world.inverted_safe() @ armature_object.matrix_world


def mesh_to_mesh_matrix(first_mesh_object: bpy.types.Object, mesh_object: bpy.types.Object) -> np.ndarray:
    """Return the matrix from the space of a mesh object to that of the first, (4, 4) float64."""
    if mesh_object.matrix_world == first_mesh_object.matrix_world:
        return np.eye(4)
    return np.array(first_mesh_object.matrix_world.inverted_safe() @ mesh_object.matrix_world, np.float64)


class PoseReader:
    """Reads the pose matrices of a rig for recordings and models.

    A pose matrix is P_j = S_j B_j, with B_j the rest matrix and S_j the skin matrix of Blender's Armature modifier.
    If mesh and armature have the same relative transform as in the rest pose, it is the bone's pose matrix in
    mesh-object space. It stays correct if one of the objects moves alone.

    Attributes:
        transform: the matrix from armature space to the space of the pose matrices in the last pose; None before.
    """

    def __init__(
        self,
        scene_rig: SceneRig,
        names: tuple[str, ...],
        rest_matrices: np.ndarray,
        mesh_to_model: np.ndarray | None = None,
    ):
        """Prepare to read joints.

        Args:
            names: names of J joints.
            rest_matrices: (J, 4, 4), rest matrices of the joints, mesh-object space.
            mesh_to_model: (4, 4), from the space of the mesh object to that of another object, in which rest and pose
                matrices are; None for the identity.
        """
        self._matrix_reader = armature_io.PoseMatrixReader(scene_rig.armature_object, names)
        self._rest_matrices = rest_matrices.astype(np.float64)
        self._inverse_bone_rest = np.linalg.inv(armature_io.rest_matrices(scene_rig.armature_object.data, names))
        self._mesh_to_model = None if mesh_to_model is None else Matrix(mesh_to_model)
        self.transform: Matrix | None = None
        self._left_factor: np.ndarray | None = None
        self._right_factor: np.ndarray | None = None

    def fits(self, armature_object: bpy.types.Object) -> bool:
        """Return whether the armature still has the same number of bones."""
        return self._matrix_reader.fits(armature_object)

    def read_transform(self, mesh_object: bpy.types.Object, armature_object: bpy.types.Object) -> Matrix:
        """Read the matrix from armature space to the space of the pose matrices, of evaluated objects."""
        armature_to_mesh = _armature_to_mesh_transform(mesh_object, armature_object)
        return armature_to_mesh if self._mesh_to_model is None else self._mesh_to_model @ armature_to_mesh

    def read(self, mesh_object: bpy.types.Object, armature_object: bpy.types.Object) -> np.ndarray:
        """Read the pose matrices of evaluated objects.

        Returns:
            (J, 4, 4) float32, mesh-object space, mesh units.

        Raises:
            RigError: an object has a scale of zero.
        """
        transform = self.read_transform(mesh_object, armature_object)
        if transform != self.transform:
            for scene_object in (mesh_object, armature_object):
                if is_flat(scene_object):
                    raise RigError(
                        f"'{scene_object.name}' has a scale of zero in some pose; look for the key, constraint or "
                        "driver that sets it."
                    )
            # The factors of P = T pose inv(T bone_rest) rest, with T from armature to mesh; None for identity.
            self.transform = transform
            left_factor = np.array(transform, np.float64)
            # Compute one inverse per frame instead of one per joint, because rounding changes T in each frame if an
            # animated parent moves both objects.
            right_factor = self._inverse_bone_rest @ (np.linalg.inv(left_factor) @ self._rest_matrices)
            self._left_factor, self._right_factor = (
                None if np.abs(factor - np.eye(4)).max() < IDENTITY_TOLERANCE else factor
                for factor in (left_factor, right_factor)
            )
        matrices = self._matrix_reader.read(armature_object)
        if self._left_factor is not None:
            matrices = self._left_factor @ matrices
        if self._right_factor is not None:
            matrices = matrices @ self._right_factor
        return np.array(matrices, np.float32, order="C")


class PoseEvaluator:
    """Evaluates the current pose of a scene and reads pose matrices, positions and controls.

    Attributes:
        scene_rig, rig: the rig.
        target: the target whose positions replace those of the rig; None without one.
    """

    def __init__(self, scene_rig: SceneRig, rig: Rig, target: Target | None = None):
        """Prepare to read a rig; arguments as in the class."""
        self.scene_rig, self.rig, self.target = scene_rig, rig, target
        self._reader = PoseReader(scene_rig, rig.joint_names, rig.rest_matrices)
        self._controls = ControlReader(scene_rig, rig.controls)

    def evaluate(self) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
        """Evaluate the current pose.

        Returns:
            pose_matrices (J, 4, 4) and positions (V, 3), both float32, mesh-object space, mesh units, and the values of
            the controls, (C,) float32.
        """
        depsgraph = bpy.context.evaluated_depsgraph_get()
        mesh_object = self.scene_rig.mesh_object.evaluated_get(depsgraph)
        armature_object = self.scene_rig.armature_object.evaluated_get(depsgraph)
        if self.target is not None:
            positions = self.target.positions(depsgraph)
        else:
            mesh_objects = self.scene_rig.mesh_objects
            positions = join_positions(
                [mesh_io.evaluated_positions(each, depsgraph) for each in mesh_objects], self.rig.meshes
            )
            for part, other in zip(self.rig.meshes[1:], mesh_objects[1:], strict=True):
                self._check_transform(part, mesh_object, other.evaluated_get(depsgraph))
        controls = self._controls.read(self.scene_rig, depsgraph)
        return self._reader.read(mesh_object, armature_object), positions, controls

    def _check_transform(self, part: MeshPart, first: bpy.types.Object, mesh_object: bpy.types.Object) -> None:
        """Raise a RigError if an evaluated mesh object has moved against the first."""
        difference = mesh_to_mesh_matrix(first, mesh_object) - part.matrix
        if not difference.any():
            return
        corners = np.array([[*corner, 1.0] for corner in mesh_object.bound_box])
        moves = (corners @ difference.T)[:, :3]
        if np.linalg.norm(moves, axis=1).max() > MAX_MESH_MOTION_RATIO * self.rig.size:
            raise RigError(
                f"The object '{mesh_object.name}' moves against '{first.name}', and meshes of one recording move "
                f"together; record '{mesh_object.name}' by itself."
            )
