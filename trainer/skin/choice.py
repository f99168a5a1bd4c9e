# SPDX-License-Identifier: GPL-3.0-or-later
"""Chooses the key joints of a recording, and finds what the motion of each vertex follows from."""

from collections.abc import Callable

import numpy as np

from fdda_addon.core.errors import RecordingError
from fdda_addon.core.joint_option import AUTO
from fdda_addon.core.mathematics.partition import joints_with_weight, make_partitions
from fdda_addon.core.mathematics.skinning import are_invertible, skin_matrices
from fdda_addon.core.rig import STATIC_JOINT

from .fit_poses import FitPoses
from .key_joints import LENGTH_RATIO, TOLERANCE_RATIO, InputBlocks, KeyJoints, KeyJointSearch, joint_moments
from .solver import fit_skin

MAX_PATCH_VERTICES = 16
"""Largest number of vertices that one fitted vertex represents."""


def choose_key_joints(
    all_poses: FitPoses, requested: str, on_progress: Callable[[int, int], None] = lambda done, total: None
) -> KeyJoints:
    """Choose key joints by random poses.

    Joints that only frames of actions move are kept, because random poses do not show what they would follow from.

    Args:
        all_poses: poses with J joints; random ones, every other of which measures errors, then frames of actions.
        requested: "auto", or the number of key joints.
        on_progress: called often, with the number of decided joints and of those that may be removed.

    Raises:
        RecordingError: a joint has a scale of zero in some random pose.
    """
    poses = all_poses.subset(slice(0, all_poses.random_count))
    if not are_invertible(poses.pose_matrices).all():
        raise RecordingError(
            "A bone has a scale of zero in some pose, so key joints cannot be chosen; look for the key, constraint or "
            "driver that sets it."
        )
    moments, acts = _measure_vertices(poses)
    blocks = InputBlocks(poses)
    # Measure how far frames of actions move joints from where random poses have them, relative to reference joints.
    is_usable = are_invertible(all_poses.pose_matrices).all(axis=1)
    is_usable[: all_poses.random_count] = True
    skin = skin_matrices(all_poses.pose_matrices[is_usable], all_poses.rig.rest_matrices).astype(np.float64)
    variances, axes = np.linalg.eigh(moments)
    moment_roots = axes * np.sqrt(np.maximum(variances, 0))[:, None]
    unseen_motions = np.zeros(len(moments))
    for joint, reference in enumerate(all_poses.rig.references.tolist()):
        relative = np.linalg.solve(skin[:, reference], skin[:, joint]) if reference >= 0 else skin[:, joint]
        motion = (relative @ moment_roots[joint])[:, :3]
        motion -= motion[: all_poses.random_count].mean(axis=0)
        unseen_motions[joint] = np.sqrt((motion**2).sum(axis=(1, 2))).max()
    is_unseen = (blocks.widths[: len(moments)] == 0) & (unseen_motions > TOLERANCE_RATIO * poses.rig.size)
    is_static = np.array([name == STATIC_JOINT for name in poses.rig.joint_names])
    search = KeyJointSearch(poses, moments, blocks, is_static, is_unseen)
    search.search(None if requested == AUTO else int(requested), on_progress)
    return search.result(requested, acts, poses.rig.metres_per_unit)


def _measure_vertices(poses: FitPoses) -> tuple[np.ndarray, np.ndarray]:
    """Find the vertices that each joint moves.

    The weights of a rig may be those of a cage, or none. So these are the vertices where either the rig has a weight,
    or a fit with all joints has one. The fit takes one vertex of each small patch of the mesh.

    Returns:
        (J, 4, 4) moments of the vertices of each joint, as of `joint_moments`, and (V, J) bool, whether a joint acts on
        a vertex.
    """
    rig, joint_count = poses.rig, len(poses.rig.joints)
    patches = [patch for partition in make_partitions(rig) for patch in _cut(rig.rest_positions, partition.vertices)]
    representatives = np.array([patch[0] for patch in patches])
    fitted_joints, fitted_weights = fit_skin(poses.subset(slice(0, None, 2)).of_vertices(representatives), "smooth")
    moments = joint_moments(rig.rest_positions, rig.skin_joints, rig.skin_weights, joint_count)
    fitted_moments = joint_moments(rig.rest_positions[representatives], fitted_joints, fitted_weights, joint_count)
    # The last element is the mean square weight.
    moments = np.where((moments[:, 3, 3] >= fitted_moments[:, 3, 3])[:, None, None], moments, fitted_moments)
    without_vertices = poses.is_dependency & (np.trace(moments, axis1=1, axis2=2) == 0)
    # Take points around the heads of joints that move the mesh without weights.
    offsets = LENGTH_RATIO * rig.size * np.array([(0, 0, 0), (1, 0, 0), (0, 1, 0), (0, 0, 1)])
    points = rig.rest_matrices[without_vertices][:, None, :3, 3] + offsets
    points = np.concatenate([points, np.ones((*points.shape[:2], 1))], axis=2)
    moments[without_vertices] = np.einsum("jpa,jpb->jab", points, points) / len(offsets)
    acts = joints_with_weight(rig.skin_joints, rig.skin_weights, joint_count)
    fitted_acts = joints_with_weight(fitted_joints, fitted_weights, joint_count)
    acts[np.concatenate(patches)] |= np.repeat(fitted_acts, [len(patch) for patch in patches], axis=0)
    return moments, acts


def _cut(rest_positions: np.ndarray, vertices: np.ndarray) -> list[np.ndarray]:
    """Cut vertices along their longest axis, until each patch has at most `MAX_PATCH_VERTICES`."""
    if len(vertices) <= MAX_PATCH_VERTICES:
        return [vertices]
    axis = int(np.argmax(np.ptp(rest_positions[vertices], axis=0)))
    ordered = vertices[np.argsort(rest_positions[vertices, axis], kind="stable")]
    halves = ordered[: len(ordered) // 2], ordered[len(ordered) // 2 :]
    return [patch for half in halves for patch in _cut(rest_positions, half)]
