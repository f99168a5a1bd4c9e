# SPDX-License-Identifier: GPL-3.0-or-later
"""Builds the arm as arrays, without bpy: rest positions, quads, bone of each vertex, and biceps."""

from dataclasses import dataclass, replace

import numpy as np

from .digits import grow_fingers, grow_thumb, nail_faces
from .field import Field
from .joints import FINGERS, JOINT_INDEX, UPPER_ARM_LENGTH, WRIST_X, joint
from .quads import DIVISIONS, Grid, GridBuilder, interpolate_guide_points
from .sculpt import arm_field
from .tube import Tube, add_tube


def build_neighbor_table(faces: np.ndarray, vertex_count: int) -> tuple[np.ndarray, np.ndarray]:
    """Return the neighbors of n vertices, (n, k) indices padded with the vertex itself, and their (n,) numbers."""
    edges = np.concatenate([faces[:, [corner, (corner + 1) % 4]] for corner in range(4)])
    edges = np.unique(np.sort(edges, axis=1), axis=0)
    directed_edges = np.concatenate([edges, edges[:, ::-1]])
    directed_edges = directed_edges[np.lexsort((directed_edges[:, 1], directed_edges[:, 0]))]
    valence = np.bincount(directed_edges[:, 0], minlength=vertex_count)
    table = np.repeat(np.arange(vertex_count)[:, None], valence.max(), axis=1)
    columns = np.arange(len(directed_edges)) - np.repeat(np.cumsum(valence) - valence, valence)
    table[directed_edges[:, 0], columns] = directed_edges[:, 1]
    return table, valence


def smooth_loose_points(grid: Grid) -> np.ndarray:
    """Return the (n, 3) float64 points, with each loose point at the mean of its neighbors.

    From these positions, relaxation reaches the surface without folds.
    """
    positions = grid.points.copy()
    neighbors, valence = build_neighbor_table(grid.faces, len(positions))
    loose_indices = np.flatnonzero(grid.loose)
    loose_neighbors, loose_valence = neighbors[loose_indices], valence[loose_indices, None]
    padding_count = neighbors.shape[1] - loose_valence
    for _ in range(60):
        positions[loose_indices] = (
            positions[loose_neighbors].sum(axis=1) - positions[loose_indices] * padding_count
        ) / loose_valence
    return positions


def relax(points: np.ndarray, grid: Grid, field: Field, rounds: int) -> np.ndarray:
    """Smooth points along the surface of a field for a number of rounds, and project them onto it; (n, 3) float64.

    The projection is a Newton step of at most 6 mm, in the plane of the vertex as far as the plane holds it.
    """
    positions = points.copy()
    neighbors, valence = build_neighbor_table(grid.faces, len(positions))
    padding_count = neighbors.shape[1] - valence
    plane_normals, plane_hold = grid.plane_normal, grid.plane_hold[:, None]
    surface_normals = np.zeros_like(positions)
    for round_index in range(rounds):
        # The last rounds only project the points onto the surface.
        if round_index < rounds - 3:
            neighbor_mean = (positions[neighbors].sum(axis=1) - positions * padding_count[:, None]) / valence[:, None]
            step = (neighbor_mean - positions) * 0.5
            step -= surface_normals * np.einsum("ij,ij->i", step, surface_normals)[:, None]
            positions += step
            plane_distance = np.einsum("ij,ij->i", positions - grid.plane_point, plane_normals)[:, None]
            positions -= plane_hold * plane_distance * plane_normals
        distance, gradient = field.distance_and_gradient(positions)
        gradient_length = np.linalg.norm(gradient, axis=1, keepdims=True)
        surface_normals = gradient / np.maximum(gradient_length, 1e-6)
        normal_component = np.einsum("ij,ij->i", gradient, plane_normals)[:, None]
        step_direction = gradient - plane_hold * normal_component * plane_normals
        squared_slope = np.einsum("ij,ij->i", step_direction, step_direction)
        # If the plane is almost tangential to the surface, no step in the plane reaches it, so use the gradient itself.
        step_direction = np.where((squared_slope < 0.1)[:, None], gradient, step_direction)
        squared_slope = np.maximum(np.einsum("ij,ij->i", step_direction, step_direction), 1e-6)
        positions -= step_direction * np.clip(distance / squared_slope, -0.006, 0.006)[:, None]
    return positions


def _is_past_joint_plane(points: np.ndarray, name_before: str, name_after: str) -> np.ndarray:
    """Return which points are past the plane that bisects the angle of two bones at their common joint, (n,) bool."""
    bone_before, bone_after = joint(name_before), joint(name_after)
    axes = [np.array(bone.tail) - np.array(bone.head) for bone in (bone_before, bone_after)]
    normal = sum(axis / np.linalg.norm(axis) for axis in axes)
    return (points - np.array(bone_after.head)) @ normal > 0.0


def _distance_to_bone(points: np.ndarray, name: str, start: float = 0.0) -> np.ndarray:
    """Compute (n,) distances in meters to a bone, from the fraction `start` (0 to 1) of its length to its tail."""
    head, tail = np.array(joint(name).head), np.array(joint(name).tail)
    head = head + (tail - head) * start
    axis = tail - head
    fraction = np.clip((points - head) @ axis / (axis @ axis), 0.0, 1.0)
    return np.linalg.norm(points - head - fraction[:, None] * axis, axis=1)


def assign_joints(points: np.ndarray, grid: Grid) -> np.ndarray:
    """Return the (n,) int32 index into `JOINTS` of the bone of each vertex, given (n, 3) rest points in meters.

    Fingers are divided at the planes of their joints, and no vertex of a finger follows another finger. A vertex of the
    palm follows the metacarpal of its finger column, and a vertex of the ball of the thumb follows that of the thumb.
    """
    joint_indices = np.full(len(points), JOINT_INDEX["shoulder"], np.int32)
    joint_indices[points[:, 0] >= UPPER_ARM_LENGTH] = JOINT_INDEX["elbow"]
    in_hand = (points[:, 0] >= WRIST_X) | (grid.digit >= 0)
    joint_indices[in_hand] = JOINT_INDEX["wrist"]
    for finger_number, name in enumerate(FINGERS, start=1):
        is_in_chain = in_hand & np.where(
            grid.digit >= 0, grid.digit == finger_number, grid.finger_column == finger_number
        )
        for bone_index in range(4):
            name_before = "wrist" if bone_index == 0 else f"{name}_{bone_index - 1}"
            is_in_chain = is_in_chain & (
                _is_past_joint_plane(points, name_before, f"{name}_{bone_index}")
                | (bone_index < 2) & (grid.digit == finger_number)
            )
            joint_indices[is_in_chain] = JOINT_INDEX[f"{name}_{bone_index}"]
    is_thumb = grid.digit == 0
    # The ball of the thumb is nearer to the thumb's metacarpal than to other bones, and not behind its joint.
    is_thumb_ball = in_hand & (grid.digit < 0) & (grid.finger_column <= 2) & (joint_indices != JOINT_INDEX["index_1"])
    distance_to_fingers = np.minimum(_distance_to_bone(points, "index_0"), _distance_to_bone(points, "middle_0"))
    is_thumb_ball &= _is_past_joint_plane(points, "wrist", "thumb_0")
    is_thumb_ball &= _distance_to_bone(points, "thumb_0", 0.25) < 0.95 * np.minimum(
        distance_to_fingers, _distance_to_bone(points, "wrist") + 0.002
    )
    joint_indices[is_thumb | is_thumb_ball] = JOINT_INDEX["thumb_0"]
    # The web of the thumb follows the metacarpal of the thumb.
    is_thumb &= _distance_to_bone(points, "thumb_1") < _distance_to_bone(points, "index_0") - 0.003
    for bone_index in (1, 2):
        is_thumb = is_thumb & _is_past_joint_plane(points, f"thumb_{bone_index - 1}", f"thumb_{bone_index}")
        joint_indices[is_thumb] = JOINT_INDEX[f"thumb_{bone_index}"]
    return joint_indices


# Height of the shape key over the relaxed arm, meters, by density. Corrective Smooth comes after the key and flattens
# it, more strongly on coarser quads, so that about 17 mm remain at any density.
PEAK_HEIGHTS = {1: 0.036, 2: 0.028, 3: 0.022}


def _bell_curve(x: np.ndarray, center: float, width_before: float, width_after: float) -> np.ndarray:
    """Evaluate a bell curve that is 1 at its center, with different widths before and after the center."""
    distance_ratio = (x - center) / np.where(x < center, width_before, width_after)
    return np.exp(-0.5 * distance_ratio * distance_ratio)


def biceps_offsets(points: np.ndarray, normals: np.ndarray, peak: float) -> np.ndarray:
    """Compute (n, 3) offsets in meters from (n, 3) rest `points` with unit outward `normals`, in arm space.

    The contracted muscle is highest past the middle of the upper arm, at `peak` meters. It falls off steeply to its
    tendon at the elbow, is thin at both ends, and has a furrow between its two heads. The triceps opposite becomes
    flatter.
    """
    # The arrays must be contiguous. NumPy does not always use vector instructions for strided arrays, so the last bit
    # of an angle would differ between machines, and between two builds on one machine.
    x, y, z = np.ascontiguousarray(points.T)
    angle = np.arctan2(z, -y)  # 0 on the side of the elbow crease, positive towards the back of the hand
    long_head = _bell_curve(x, 0.166, 0.045, 0.040) * np.exp(-0.5 * ((angle - 0.34) / 0.42) ** 2)
    short_head = 0.95 * _bell_curve(x, 0.178, 0.048, 0.036) * np.exp(-0.5 * ((angle + 0.38) / 0.42) ** 2)
    belly = np.maximum(long_head, short_head) + 0.20 * np.minimum(long_head, short_head)
    furrow = 0.30 * _bell_curve(x, 0.172, 0.050, 0.040) * np.exp(-0.5 * ((angle + 0.02) / 0.13) ** 2)
    thin_ends = 0.14 * _bell_curve(x, 0.256, 0.018, 0.020) + 0.10 * _bell_curve(x, 0.075, 0.022, 0.022)
    thin_ends *= np.exp(-0.5 * (angle / 0.7) ** 2)
    triceps_angle = np.abs(np.arctan2(z, y))
    triceps_flattening = 0.10 * _bell_curve(x, 0.150, 0.060, 0.050) * np.exp(-0.5 * (triceps_angle / 0.7) ** 2)
    heights = belly - furrow - thin_ends - triceps_flattening
    heights[np.abs(heights) < 1e-3] = 0.0
    # The muscle rises towards the front more than along the normals of the skin.
    directions = normals + np.array([0.0, -0.4, 0.0]) * (belly > 0)[:, None]
    directions /= np.linalg.norm(directions, axis=1, keepdims=True)
    return directions * (heights * peak / heights.max())[:, None]


# Rounds of relaxation. The guide starts far from the skin, and finer grids start on it.
_GUIDE_ROUNDS, _FINE_ROUNDS = 45, 11


@dataclass(frozen=True)
class Surface:
    """The surface of the arm.

    Attributes:
        points: (v, 3) float64, meters, arm space.
        faces: (f, 4) int32, oriented outwards.
        joints: (v,) int32, the index into `JOINTS` of the bone of each vertex.
        biceps: (v, 3) float64, offsets at full contraction, meters.
        nails: (f,) bool, whether a face is part of a nail.
    """

    points: np.ndarray
    faces: np.ndarray
    joints: np.ndarray
    biceps: np.ndarray
    nails: np.ndarray


def _build_grid(density: int) -> Grid:
    """Build the closed quad grid before sculpting: a tube from the shoulder to the webs, and five digits."""
    if density not in DIVISIONS:
        raise ValueError(f"The arm has densities 1, 2 and 3; {density!r} is none of them.")
    quads, tube = GridBuilder(), Tube(DIVISIONS[density])
    rings = add_tube(quads, tube)
    grow_fingers(quads, tube, rings[-1])
    grow_thumb(quads, tube, rings)
    return quads.build()


def sculpt_arm(density: int) -> Surface:
    """Build the arm at density 1, 2 or 3 (about 1,450, 10,000 and 50,000 vertices)."""
    grid = _build_grid(density)
    field = arm_field()
    guide = _build_grid(1)
    points = relax(smooth_loose_points(guide), guide, field, _GUIDE_ROUNDS)
    if density > 1:
        initial_points = interpolate_guide_points(grid, guide, points)
        # The rings keep the planes to which the relaxation of the guide has moved them.
        points = relax(initial_points, replace(grid, plane_point=initial_points), field, _FINE_ROUNDS)
    _, normals = field.distance_and_gradient(points)
    normals /= np.linalg.norm(normals, axis=1, keepdims=True)
    joints = assign_joints(points, grid)
    return Surface(points, grid.faces, joints, biceps_offsets(points, normals, PEAK_HEIGHTS[density]), nail_faces(grid))
