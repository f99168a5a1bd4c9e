# SPDX-License-Identifier: GPL-3.0-or-later
"""The form of the arm: its muscles, bones under the skin, palm and fingers, as strokes of a field. Metres.

Arm space (see `joints`): +X along the arm, +Z the back of the hand, -Y the elbow crease and the thumb.
"""

import numpy as np

from .field import Ellipsoid, Field, Loft, Stroke, frame_along
from .joints import FINGERS, HAND, THUMB_BASE, joint

_X, _Z = np.array([1.0, 0, 0]), np.array([0.0, 0, 1.0])

# x, centre y, centre z, half-width to +y (triceps, little finger), -y (biceps, thumb), +z (back), -z (palm)
_LIMB = [
    (-0.040, 0.000, -0.002, 0.048, 0.047, 0.046, 0.050),
    (0.020, 0.000, -0.002, 0.047, 0.045, 0.044, 0.050),
    (0.080, 0.000, -0.001, 0.042, 0.038, 0.038, 0.043),
    (0.150, 0.000, 0.000, 0.037, 0.034, 0.036, 0.039),
    (0.210, 0.001, 0.000, 0.034, 0.033, 0.035, 0.037),
    (0.255, 0.002, 0.000, 0.032, 0.032, 0.036, 0.037),
    (0.295, 0.003, 0.000, 0.033, 0.034, 0.037, 0.039),
    (0.330, 0.001, 0.000, 0.034, 0.036, 0.036, 0.037),
    (0.380, 0.000, 0.000, 0.034, 0.035, 0.033, 0.034),
    (0.430, 0.000, 0.000, 0.032, 0.032, 0.028, 0.029),
    (0.480, 0.000, 0.000, 0.0295, 0.029, 0.0235, 0.0240),
    (0.525, 0.000, 0.000, 0.0275, 0.0275, 0.0200, 0.0205),
    (0.556, 0.000, 0.000, 0.0270, 0.0275, 0.0185, 0.0200),
    (0.585, 0.000, 0.000, 0.0300, 0.0290, 0.0175, 0.0185),
    (0.615, 0.000, 0.000, 0.0370, 0.0360, 0.0150, 0.0150),
    (0.640, 0.000, 0.000, 0.0390, 0.0395, 0.0130, 0.0125),
    (0.660, -0.006, -0.001, 0.0280, 0.0300, 0.0110, 0.0115),
]


def _spindle(start, end, width: float, thickness: float, out) -> Ellipsoid:
    """A muscle belly from `start` to `end`: half as wide as `width`, half as thick as `thickness` along `out`."""
    start, end = np.asarray(start, float), np.asarray(end, float)
    return Ellipsoid((start + end) / 2, (np.linalg.norm(end - start) / 2, width, thickness), frame_along(end - start, out))


def _ball(centre, *radii) -> Ellipsoid:
    return Ellipsoid(centre, radii if len(radii) == 3 else (radii[0],) * 3)


def _upper_arm() -> list[Stroke]:
    return [
        # Deltoid: front, middle and rear heads run together at its insertion half way down the outer side.
        Stroke(_spindle((-0.045, -0.036, 0.022), (0.135, -0.010, 0.036), 0.028, 0.024, (0, -1, 1)), 0.014),
        Stroke(_spindle((-0.050, 0.000, 0.036), (0.150, 0.000, 0.036), 0.032, 0.027, (0, 0, 1)), 0.014),
        Stroke(_spindle((-0.045, 0.036, 0.022), (0.135, 0.012, 0.036), 0.028, 0.024, (0, 1, 1)), 0.014),
        # Biceps: long head above, short head below.
        Stroke(_spindle((0.050, -0.020, 0.006), (0.285, -0.020, 0.004), 0.020, 0.027, (0, -1, 0.15)), 0.012),
        Stroke(_spindle((0.050, -0.018, -0.016), (0.275, -0.018, -0.010), 0.020, 0.026, (0, -1, -0.35)), 0.012),
        # Triceps: lateral head above, long head below, medial head near the elbow.
        Stroke(_spindle((0.045, 0.024, 0.014), (0.225, 0.022, 0.018), 0.021, 0.024, (0, 1, 0.5)), 0.012),
        Stroke(_spindle((0.030, 0.022, -0.020), (0.235, 0.022, -0.014), 0.024, 0.025, (0, 1, -0.5)), 0.012),
        Stroke(_spindle((0.170, 0.018, -0.014), (0.295, 0.014, -0.018), 0.020, 0.020, (0, 0.6, -1)), 0.014),
        # Brachialis shows on both sides under the biceps.
        Stroke(_spindle((0.150, -0.006, 0.024), (0.290, -0.012, 0.018), 0.018, 0.017, (0, -0.3, 1)), 0.012),
        Stroke(_spindle((0.170, -0.008, -0.024), (0.290, -0.012, -0.018), 0.018, 0.016, (0, -0.3, -1)), 0.012),
    ]


def _elbow_and_forearm() -> list[Stroke]:
    return [
        Stroke(_ball((0.303, 0.026, -0.002), 0.022, 0.013, 0.013), 0.012),
        Stroke(_ball((0.289, 0.004, -0.034), 0.014, 0.012, 0.010), 0.014),
        Stroke(_ball((0.293, 0.006, 0.031), 0.014, 0.012, 0.010), 0.014),
        # Brachioradialis and the radial wrist extensors, from above the elbow to the thumb side.
        Stroke(_spindle((0.235, -0.006, 0.026), (0.440, -0.020, 0.006), 0.021, 0.021, (0, -0.7, 1)), 0.014),
        # Finger extensors on the back.
        Stroke(_spindle((0.285, 0.010, 0.022), (0.465, 0.008, 0.012), 0.020, 0.018, (0, 0.25, 1)), 0.012),
        # Flexors on the inner side, ulnar flexor along the back edge.
        Stroke(_spindle((0.275, -0.010, -0.020), (0.470, -0.008, -0.011), 0.026, 0.021, (0, -0.3, -1)), 0.014),
        Stroke(_spindle((0.290, 0.014, -0.018), (0.480, 0.018, -0.006), 0.018, 0.018, (0, 0.7, -1)), 0.012),
        # Heads of the ulna and the radius.
        Stroke(_ball((0.540, 0.0190, 0.0105), 0.014, 0.0095, 0.0095), 0.010),
        Stroke(_ball((0.552, -0.0205, 0.0000), 0.018, 0.0095, 0.0120), 0.012),
    ]


def _palm() -> list[Stroke]:
    strokes = [
        # Hypothenar along the little finger's side, thenar at the root of the thumb.
        Stroke(_spindle((0.570, 0.020, -0.009), (0.645, 0.033, -0.007), 0.014, 0.013, (0, 0.4, -1)), 0.010),
        Stroke(_spindle((0.558, -0.008, -0.011), (0.618, -0.045, -0.023), 0.0165, 0.0140, (0.2, -0.1, -1)), 0.010),
        # The first interosseous fills the fork between thumb and index.
        Stroke(_spindle((0.590, -0.022, -0.003), (0.645, -0.039, -0.004), 0.010, 0.012, (0, -1, 0)), 0.012),
    ]
    for name in FINGERS:
        knuckle = np.array(HAND[name].knuckle)
        base = np.array(HAND[name].base)
        size = 0.88 if name == "pinky" else 1.0
        along = frame_along(knuckle - base, _Z)
        # Metacarpal with its tendon, its head, and the pad under it.
        strokes.append(Stroke(_spindle(base, knuckle + along[0] * 0.006, 0.0062 * size, 0.0145 * size, _Z), 0.010))
        strokes.append(
            Stroke(Ellipsoid(knuckle + _Z * 0.0050 * size, np.array((0.0115, 0.0080, 0.0100)) * size, along), 0.006)
        )
        pad = knuckle + along[0] * 0.006 - _Z * 0.0060
        strokes.append(Stroke(Ellipsoid(pad, np.array((0.013, 0.0100, 0.0080)) * size, along), 0.007))
    # The hollow of the palm.
    strokes.append(Stroke(_ball((0.612, 0.004, -0.0290), 0.030, 0.017, 0.0140), 0.010, carve=True))
    return strokes


def _finger_form(name: str) -> list[Stroke]:
    """The free finger as a loft along its first phalanx, the centre line bending with the bones."""
    bones = [joint(f"{name}_{i}") for i in (1, 2, 3)]
    heads = [np.array(bone.head) for bone in bones] + [np.array(bones[-1].tail)]
    frame = frame_along(heads[1] - heads[0], _Z)
    along = [(point - heads[0]) @ frame[0] for point in heads]
    up = [(point - heads[0]) @ frame[2] for point in heads]
    tip = along[3] + 0.0035
    size = {"index": 1.0, "middle": 1.02, "ring": 0.96, "pinky": 0.84}[name]

    def at(i: int, part: float) -> tuple[float, float]:
        return along[i] + (along[i + 1] - along[i]) * part, up[i] + (up[i + 1] - up[i]) * part

    # place, half-width, half-thickness of the back, of the palm side; millimetres
    profile = [
        (at(0, -0.10), 9.0, 8.0, 8.0),
        (at(0, 0.25), 9.2, 8.6, 9.0),
        (at(0, 0.65), 9.2, 8.4, 9.6),
        (at(0, 0.90), 9.5, 8.8, 8.6),
        (at(1, 0.05), 9.5, 9.0, 8.2),
        (at(1, 0.30), 8.9, 7.8, 8.8),
        (at(1, 0.60), 8.5, 7.2, 8.8),
        (at(1, 0.92), 8.5, 7.4, 7.6),
        (at(2, 0.08), 8.4, 7.4, 7.4),
        (at(2, 0.40), 8.2, 6.6, 8.2),
        (at(2, 0.75), 7.7, 5.6, 8.0),
        ((tip, up[3]), 6.9, 4.8, 6.4),
    ]
    stations = [(s, 0.0, u, *(np.array((w, w, b, p)) * size * 1e-3)) for (s, u), w, b, p in profile]
    return [Stroke(Loft(heads[0], frame, stations, caps=(0.006, 0.0095 * size), power=2.1), 0.005)]


def _thumb_form() -> list[Stroke]:
    bones = [joint(f"thumb_{i}") for i in range(3)]
    heads = [np.array(bone.head) for bone in bones] + [np.array(bones[-1].tail)]
    frame = frame_along(heads[3] - heads[1], -np.array(bones[1].bend))
    origin = heads[1]
    flat = [(point - origin) @ frame.T for point in heads]
    tip = flat[3][0] + 0.003

    def at(i: int, part: float) -> np.ndarray:
        return flat[i] + (flat[i + 1] - flat[i]) * part

    profile = [
        (at(0, 0.05), 10.0, 10.0, 12.0),
        (at(0, 0.55), 11.0, 10.5, 13.0),
        (at(0, 0.92), 11.4, 10.8, 11.5),
        (at(1, 0.08), 11.2, 10.6, 11.0),
        (at(1, 0.50), 10.0, 9.2, 10.6),
        (at(1, 0.94), 10.8, 9.2, 9.2),
        (at(2, 0.12), 10.8, 9.0, 9.4),
        (at(2, 0.45), 10.6, 7.6, 10.0),
        (at(2, 0.75), 9.6, 6.2, 9.4),
        (np.array([tip, flat[3][1], flat[3][2]]), 7.8, 5.0, 7.0),
    ]
    stations = [(p[0], p[1], p[2], *(np.array((w, w, b, d)) * 1e-3)) for p, w, b, d in profile]
    return [Stroke(Loft(origin, frame, stations, caps=(0.008, 0.012), power=2.1), 0.011)]


def arm_field() -> Field:
    """The whole arm, shoulder to finger tips; a round cut closes the shoulder end."""
    limb = Loft((0, 0, 0), frame_along(_X, _Z), _LIMB, caps=(0.030, 0.010), power=2.2)
    strokes = [Stroke(limb, 0.01)] + _upper_arm() + _elbow_and_forearm() + _palm() + _thumb_form()
    for name in FINGERS:
        strokes += _finger_form(name)
    return Field(strokes)


THUMB_ROOT = np.array(THUMB_BASE)
