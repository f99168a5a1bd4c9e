# SPDX-License-Identifier: GPL-3.0-or-later
"""Checks of units and axes in the rest pose: whether the joints of a rig lie inside of its mesh."""

import numpy as np

from ..mathematics.partition import main_joints
from ..rig import STATIC_JOINT, Rig
from .warning import RecordingWarning, format_length

MIN_SIZE_METRES, MAX_SIZE_METRES = 0.005, 100.0
"""Range of the size of a mesh; the unit of a smaller or larger mesh is probably wrong."""
MAX_SCALE_RATIO = 5.0
"""Largest ratio between the extents of joints and of the vertices that follow them."""
MIN_CORRELATION = 0.8
"""Correlation above which joint positions and vertex centers have the same arrangement."""
MAX_DISTANCE_RATIO = 0.1
"""Largest median distance of joints from the nearest vertices that follow them, as a ratio of the rig's size."""


def check_rest(rig: Rig) -> list[RecordingWarning]:
    """Return the warnings "units" and "axes"."""
    if not MIN_SIZE_METRES <= rig.size * rig.metres_per_unit <= MAX_SIZE_METRES:
        text = (
            f"The mesh is {format_length(rig, rig.size)} large, so errors and tolerances in mm mean little: set the "
            "unit scale of the scene to the unit that the character is built in (0.01 for centimeters), or scale it to "
            "its true size, and record again."
        )
        return [RecordingWarning("units", text)]
    main_joint_of_vertex = main_joints(rig.skin_joints, rig.skin_weights)
    joints = np.array(
        [joint for joint in np.unique(main_joint_of_vertex) if rig.joints[joint].name != STATIC_JOINT], np.int64
    )
    if len(joints) < 2:
        # A single joint may be anywhere, such as the hinge of a door.
        return []
    joint_positions = rig.rest_matrices[joints, :3, 3].astype(np.float64)
    vertices_by_joint = [rig.rest_positions[main_joint_of_vertex == joint].astype(np.float64) for joint in joints]
    vertex_centers = np.stack([vertices.mean(axis=0) for vertices in vertices_by_joint])
    centered = [points - points.mean(axis=0) for points in (joint_positions, vertex_centers)]
    correlation = np.vdot(*centered) / max(np.prod([np.linalg.norm(points) for points in centered]), 1e-12)
    extents = [float(np.linalg.norm(np.ptp(points, axis=0))) for points in (joint_positions, vertex_centers)]
    ratio = extents[1] / max(extents[0], 1e-9)
    if len(joints) > 2 and correlation > MIN_CORRELATION and not 1 / MAX_SCALE_RATIO < ratio < MAX_SCALE_RATIO:
        joint_extent, vertex_extent = (format_length(rig, extent) for extent in extents)
        text = (
            f"The {len(joints)} joints that skin the mesh lie {joint_extent} apart and their vertices "
            f"{vertex_extent}, {ratio:.3g} times as far: the scale of mesh or armature is not applied, or one was "
            "imported in another unit; give both one size in the rest pose and record again."
        )
        return [RecordingWarning("units", text)]
    distances = np.array(
        [
            np.linalg.norm(vertices - position, axis=1).min()
            for vertices, position in zip(vertices_by_joint, joint_positions, strict=True)
        ]
    )
    size = max(rig.size, float(np.linalg.norm(np.ptp(rig.rest_matrices[:, :3, 3], axis=0))))
    if np.median(distances) <= MAX_DISTANCE_RATIO * size:
        return []
    lower_bounds, upper_bounds = rig.rest_positions.min(axis=0), rig.rest_positions.max(axis=0)
    outside_count = int(((joint_positions < lower_bounds) | (joint_positions > upper_bounds)).any(axis=1).sum())
    offset = np.median(vertex_centers - joint_positions, axis=0)
    axis = int(np.abs(offset).argmax())
    text = (
        f"{outside_count} of the {len(joints)} joints that skin the mesh lie outside its bounds, and joints lie "
        f"{format_length(rig, float(np.median(distances)))} from the nearest vertex that follows them (median), "
        f"most of it along {'-' if offset[axis] < 0 else '+'}{'XYZ'[axis]}: mesh and armature do not match in the rest "
        "pose; bring them together, apply their transforms and record again."
    )
    return [RecordingWarning("axes", text)]
