# SPDX-License-Identifier: GPL-3.0-or-later
"""Defines the shape of the arm as strokes of a field, in meters: muscles, bones under the skin, palm and fingers.

Arm space (see `joints`): +X along the arm, +Z the back of the hand, -Y the elbow crease and the thumb.
"""

from itertools import pairwise

import numpy as np

from .field import Ellipsoid, Field, HalfSpace, Loft, Stroke, axes_along
from .joints import FINGER_MEASURES, FINGERS, joint

_X, _Z = np.array([1.0, 0, 0]), np.array([0.0, 0, 1.0])

# Columns: x, center y, center z, half-width to +y (triceps, little finger), -y (biceps, thumb), +z (back), -z (palm).
_LIMB_STATIONS = [
    (-0.070, 0.000, -0.002, 0.048, 0.047, 0.046, 0.050),
    (0.020, 0.000, -0.002, 0.047, 0.045, 0.044, 0.050),
    (0.080, 0.000, -0.001, 0.041, 0.038, 0.038, 0.044),
    (0.150, 0.000, 0.000, 0.036, 0.035, 0.037, 0.040),
    (0.210, 0.001, 0.000, 0.035, 0.034, 0.037, 0.039),
    (0.255, 0.002, 0.000, 0.034, 0.033, 0.038, 0.040),
    (0.295, 0.003, 0.000, 0.034, 0.035, 0.040, 0.042),
    (0.330, 0.001, 0.000, 0.036, 0.038, 0.039, 0.039),
    (0.380, 0.000, 0.000, 0.037, 0.038, 0.036, 0.037),
    (0.430, 0.000, 0.000, 0.035, 0.035, 0.031, 0.032),
    (0.480, 0.000, 0.000, 0.0315, 0.0310, 0.0255, 0.0260),
    (0.525, 0.000, 0.000, 0.0290, 0.0290, 0.0215, 0.0220),
    (0.556, 0.000, 0.000, 0.0285, 0.0285, 0.0195, 0.0210),
    (0.585, 0.000, 0.000, 0.0305, 0.0295, 0.0180, 0.0190),
    (0.615, 0.000, 0.000, 0.0370, 0.0360, 0.0155, 0.0155),
    (0.640, 0.000, 0.000, 0.0390, 0.0395, 0.0120, 0.0130),
    (0.660, -0.006, -0.001, 0.0280, 0.0300, 0.0110, 0.0115),
]


def _spindle_muscle(start, end, width: float, thickness: float, out) -> Ellipsoid:
    """Make an ellipsoid from `start` to `end`, with half-width `width`, and half-thickness `thickness` along `out`."""
    start, end = np.asarray(start, float), np.asarray(end, float)
    radii = (np.linalg.norm(end - start) / 2, width, thickness)
    return Ellipsoid((start + end) / 2, radii, axes_along(end - start, out))


def _muscle_belly(start, end, width: float, thickness: float, out, peak: float = 0.45, ends=(0.30, 0.25)) -> Loft:
    """Make a muscle from `start` to `end`.

    Args:
        start, end: (3,) ends of the muscle.
        width, thickness: half-width, and half-thickness along `out`.
        out: direction of the thickness.
        peak: fraction of the length at which the muscle is thickest.
        ends: relative thickness at the start and the end.
    """
    start, end = np.asarray(start, float), np.asarray(end, float)
    length = float(np.linalg.norm(end - start))
    profile = [(0.0, ends[0]), (peak * 0.5, 0.5 * (1 + ends[0])), (peak, 1.0)]
    profile += [(peak + (1 - peak) * 0.5, 0.5 * (1 + ends[1])), (1.0, ends[1])]
    stations = [
        (position * length, 0, 0, width * ratio, width * ratio, thickness * ratio, thickness * ratio)
        for position, ratio in profile
    ]
    return Loft(start, axes_along(end - start, out), stations, caps=(0.012, 0.012))


def _ball(center, *radii) -> Ellipsoid:
    return Ellipsoid(center, radii if len(radii) == 3 else (radii[0],) * 3)


def _upper_arm_strokes() -> list[Stroke]:
    return [
        # Deltoid: front, middle and rear head join at the insertion, half way down the outer side.
        Stroke(_muscle_belly((-0.040, -0.034, 0.020), (0.150, -0.006, 0.034), 0.025, 0.026, (0, -1, 0.8), 0.40), 0.018),
        Stroke(_muscle_belly((-0.045, 0.000, 0.032), (0.160, 0.000, 0.034), 0.030, 0.028, (0, 0, 1), 0.38), 0.018),
        Stroke(_muscle_belly((-0.040, 0.034, 0.020), (0.150, 0.008, 0.034), 0.025, 0.026, (0, 1, 0.8), 0.40), 0.018),
        # Biceps: long head above, short head below, a common tendon.
        Stroke(_muscle_belly((0.010, -0.022, 0.010), (0.290, -0.022, 0.000), 0.021, 0.027, (0, -1, 0.12), 0.55), 0.008),
        Stroke(
            _muscle_belly((0.010, -0.016, -0.018), (0.285, -0.020, -0.006), 0.021, 0.027, (0, -1, -0.30), 0.57), 0.008
        ),
        # Triceps: lateral head above, long head below, medial head near the elbow.
        Stroke(_muscle_belly((0.020, 0.022, 0.012), (0.250, 0.018, 0.016), 0.024, 0.030, (0, 1, 0.55), 0.48), 0.008),
        Stroke(_muscle_belly((0.000, 0.018, -0.018), (0.260, 0.018, -0.014), 0.026, 0.033, (0, 1, -0.55), 0.50), 0.008),
        Stroke(_muscle_belly((0.150, 0.016, -0.016), (0.300, 0.014, -0.018), 0.020, 0.023, (0, 0.5, -1), 0.5), 0.010),
        # Brachialis shows on both sides under the biceps.
        Stroke(_muscle_belly((0.130, -0.004, 0.020), (0.300, -0.014, 0.014), 0.018, 0.024, (0, -0.35, 1), 0.5), 0.008),
        Stroke(
            _muscle_belly((0.150, -0.006, -0.020), (0.295, -0.014, -0.014), 0.017, 0.023, (0, -0.35, -1), 0.5), 0.008
        ),
        # The furrow between biceps and triceps, on the lower side of the arm.
        Stroke(
            _muscle_belly((0.060, 0.002, -0.051), (0.230, 0.000, -0.045), 0.006, 0.005, (0, 0, 1)),
            0.012,
            is_subtracted=True,
        ),
    ]


def _forearm_strokes() -> list[Stroke]:
    return [
        Stroke(_ball((0.303, 0.028, -0.002), 0.024, 0.014, 0.015), 0.014),
        Stroke(_ball((0.289, 0.004, -0.036), 0.016, 0.013, 0.010), 0.016),
        Stroke(_ball((0.293, 0.006, 0.033), 0.015, 0.012, 0.010), 0.016),
        # Brachioradialis and the radial wrist extensors, from above the elbow to the thumb side.
        Stroke(_muscle_belly((0.215, -0.004, 0.026), (0.490, -0.024, 0.002), 0.022, 0.026, (0, -0.75, 1), 0.46), 0.010),
        # Finger extensors on the back, ulnar extensor beside the edge of the ulna.
        Stroke(_muscle_belly((0.270, 0.010, 0.024), (0.520, 0.004, 0.008), 0.020, 0.022, (0, 0.15, 1), 0.38), 0.009),
        Stroke(_muscle_belly((0.290, 0.020, 0.014), (0.515, 0.020, 0.006), 0.015, 0.020, (0, 0.9, 0.8), 0.38), 0.009),
        # Flexors on the inner side, ulnar flexor along the back edge.
        Stroke(
            _muscle_belly((0.265, -0.006, -0.022), (0.520, -0.010, -0.008), 0.028, 0.026, (0, -0.35, -1), 0.38), 0.010
        ),
        Stroke(_muscle_belly((0.275, 0.012, -0.022), (0.520, 0.020, -0.004), 0.018, 0.023, (0, 0.8, -1), 0.38), 0.010),
        # The crease of the elbow, between the muscles on both sides.
        Stroke(
            _spindle_muscle((0.275, -0.047, 0.002), (0.350, -0.050, 0.000), 0.012, 0.010, (0, 1, 0)),
            0.016,
            is_subtracted=True,
        ),
        # Heads of the ulna and the radius, and the tendons that protrude near the wrist.
        Stroke(_ball((0.541, 0.0185, 0.0115), 0.013, 0.0090, 0.0085), 0.010),
        Stroke(_ball((0.552, -0.0205, 0.0000), 0.018, 0.0095, 0.0120), 0.012),
        Stroke(
            _spindle_muscle((0.490, -0.0035, -0.0190), (0.575, -0.0030, -0.0160), 0.0030, 0.0045, (0, 0, -1)), 0.008
        ),
    ]


def _palm_strokes() -> list[Stroke]:
    strokes = [
        # Hypothenar along the little finger's side, thenar at the root of the thumb.
        Stroke(_spindle_muscle((0.570, 0.020, -0.009), (0.645, 0.033, -0.007), 0.014, 0.013, (0, 0.4, -1)), 0.010),
        Stroke(
            _spindle_muscle((0.558, -0.008, -0.011), (0.618, -0.045, -0.023), 0.0165, 0.0140, (0.2, -0.1, -1)), 0.010
        ),
        # The first interosseous fills the space between thumb and index finger.
        Stroke(_spindle_muscle((0.590, -0.022, -0.003), (0.645, -0.039, -0.004), 0.010, 0.012, (0, -1, 0)), 0.012),
    ]
    for name in FINGERS:
        knuckle = np.array(FINGER_MEASURES[name].knuckle)
        base = np.array(FINGER_MEASURES[name].base)
        relative_size = 0.88 if name == "pinky" else 1.0
        axes = axes_along(knuckle - base, _Z)
        # Metacarpal with its tendon, its head, and the pad under it.
        strokes.append(
            Stroke(
                _spindle_muscle(base, knuckle + axes[0] * 0.006, 0.0062 * relative_size, 0.0142 * relative_size, _Z),
                0.008,
            )
        )
        strokes.append(
            Stroke(
                Ellipsoid(
                    knuckle + _Z * 0.0050 * relative_size, np.array((0.0120, 0.0078, 0.0108)) * relative_size, axes
                ),
                0.005,
            )
        )
        pad_center = knuckle + axes[0] * 0.006 - _Z * 0.0060
        strokes.append(Stroke(Ellipsoid(pad_center, np.array((0.013, 0.0100, 0.0080)) * relative_size, axes), 0.007))
    # The skin of the webs, which extends further on the side of the palm.
    for finger, next_finger in pairwise(FINGERS):
        knuckles = [np.array(FINGER_MEASURES[name].knuckle) for name in (finger, next_finger)]
        web_center = sum(knuckles) / 2 + _X * (0.0085 if next_finger != "pinky" else 0.0110) - _Z * 0.0030
        strokes.append(Stroke(Ellipsoid(web_center, (0.0085, 0.0080, 0.0070), axes_along((1, 0, -0.25), _Z)), 0.006))
    # The hollow of the palm.
    strokes.append(Stroke(_ball((0.612, 0.004, -0.0290), 0.030, 0.017, 0.0140), 0.010, is_subtracted=True))
    return strokes


def _finger_strokes(name: str) -> list[Stroke]:
    """Return the free part of a finger as a loft along its first phalanx, which follows the bones."""
    bones = [joint(f"{name}_{bone_index}") for bone_index in (1, 2, 3)]
    heads = [np.array(bone.head) for bone in bones] + [np.array(bones[-1].tail)]
    axes = axes_along(heads[1] - heads[0], _Z)
    axis_positions = [(point - heads[0]) @ axes[0] for point in heads]
    up_positions = [(point - heads[0]) @ axes[2] for point in heads]
    tip_position = axis_positions[3] + 0.0035
    relative_size = {"index": 1.0, "middle": 1.02, "ring": 0.96, "pinky": 0.84}[name]

    def point_on_bone(bone_index: int, fraction: float) -> tuple[float, float]:
        return axis_positions[bone_index] + (
            axis_positions[bone_index + 1] - axis_positions[bone_index]
        ) * fraction, up_positions[bone_index] + (up_positions[bone_index + 1] - up_positions[bone_index]) * fraction

    # Position (meters), half-width, half-thickness towards the back and towards the palm (millimeters).
    profile = [
        (point_on_bone(0, -0.25), 8.6, 8.5, 8.6),
        (point_on_bone(0, 0.25), 8.8, 8.9, 9.4),
        (point_on_bone(0, 0.62), 8.9, 8.3, 9.8),
        (point_on_bone(0, 0.90), 9.5, 8.8, 8.7),
        (point_on_bone(1, 0.05), 9.5, 9.0, 8.2),
        (point_on_bone(1, 0.30), 8.9, 7.8, 8.8),
        (point_on_bone(1, 0.60), 8.5, 7.2, 8.8),
        (point_on_bone(1, 0.92), 8.5, 7.4, 7.6),
        (point_on_bone(2, 0.08), 8.4, 7.4, 7.4),
        (point_on_bone(2, 0.40), 8.2, 6.6, 8.2),
        (point_on_bone(2, 0.75), 7.7, 5.6, 8.0),
        ((tip_position, up_positions[3]), 6.9, 4.8, 6.4),
    ]
    stations = [(s, 0.0, u, *(np.array((w, w, b, p)) * relative_size * 1e-3)) for (s, u), w, b, p in profile]
    return [Stroke(Loft(heads[0], axes, stations, caps=(0.010, 0.0095 * relative_size), power=2.1), 0.0055)]


def _thumb_strokes() -> list[Stroke]:
    bones = [joint(f"thumb_{bone_index}") for bone_index in range(3)]
    heads = [np.array(bone.head) for bone in bones] + [np.array(bones[-1].tail)]
    axes = axes_along(heads[3] - heads[1], -np.array(bones[1].bend))
    origin = heads[1]
    local_points = [(point - origin) @ axes.T for point in heads]
    tip_position = local_points[3][0] + 0.003

    def point_on_bone(bone_index: int, fraction: float) -> np.ndarray:
        return local_points[bone_index] + (local_points[bone_index + 1] - local_points[bone_index]) * fraction

    profile = [
        (point_on_bone(0, 0.05), 10.0, 10.0, 12.0),
        (point_on_bone(0, 0.55), 11.0, 10.5, 13.0),
        (point_on_bone(0, 0.90), 11.6, 11.6, 11.8),
        (point_on_bone(1, 0.08), 11.4, 11.4, 11.2),
        (point_on_bone(1, 0.50), 9.8, 9.2, 10.8),
        (point_on_bone(1, 0.92), 10.6, 9.6, 9.4),
        (point_on_bone(2, 0.12), 10.8, 9.2, 9.2),
        (point_on_bone(2, 0.45), 10.8, 7.8, 10.4),
        (point_on_bone(2, 0.75), 10.0, 6.4, 10.0),
        (np.array([tip_position, local_points[3][1], local_points[3][2]]), 8.4, 5.2, 7.4),
    ]
    stations = [(p[0], p[1], p[2], *(np.array((w, w, b, d)) * 1e-3)) for p, w, b, d in profile]
    return [Stroke(Loft(origin, axes, stations, caps=(0.008, 0.012), power=2.1), 0.011)]


def arm_field() -> Field:
    """Return the field of the arm, which is cut off at the shoulder with a rounded edge."""
    limb = Loft((0, 0, 0), axes_along(_X, _Z), _LIMB_STATIONS, caps=(0.030, 0.010), power=2.2)
    cut = Stroke(HalfSpace((-0.034, 0, 0), (1, 0, 0)), 0.040, is_subtracted=True)
    strokes = [Stroke(limb, 0.01), *_upper_arm_strokes(), cut, *_forearm_strokes(), *_palm_strokes(), *_thumb_strokes()]
    for name in FINGERS:
        strokes += _finger_strokes(name)
    return Field(strokes)
