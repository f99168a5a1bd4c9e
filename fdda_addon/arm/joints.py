# SPDX-License-Identifier: GPL-3.0-or-later
"""Defines the joints of the arm: names, parents, rest pose and range of motion, without bpy.

The arm is a left arm in a T-pose, with the shoulder at the origin, the arm along +X, the palm down (-Z), and the thumb
and the elbow crease to the front (-Y). The forearm is half way between pronation and supination. Bone lengths have the
usual proportions of a hand of 0.19 m, as in radiographs. Lengths are in meters, angles in degrees.

Every bone lies along its local Y axis. Its local Z axis points in the direction in which it bends (to the elbow crease,
the palm or the pad of the thumb), so that a positive rotation about local X is always flexion.
"""

from collections.abc import Iterator
from typing import NamedTuple

# Every bone is posed with Euler angles in this order.
ROTATION_MODE = "XYZ"
ARM_OBJECT = "arm"
RIG_OBJECT = "arm_rig"
ACTION_NAME = "arm_drive"
BICEPS_KEY = "biceps"
# Full flexion of the elbow, degrees, at which the biceps key reaches 1.
ELBOW_FLEXION = 140.0
FINGERS = ("index", "middle", "ring", "pinky")
LOCKED_RANGE = (0.0, 0.0)
Range = tuple[float, float]
Vector = tuple[float, float, float]


class Joint(NamedTuple):
    """One bone in the rest pose.

    Attributes:
        head, tail: meters, armature space.
        bend: direction near that of the bone's local Z axis, armature space.
        limits: degrees about local X (flexion), Y (twist) and Z (sideways: positive towards the thumb, and for the
            thumb itself away from the back of the hand); `LOCKED_RANGE` for an axis that does not rotate.
    """

    name: str
    parent: str | None
    head: Vector
    tail: Vector
    bend: Vector
    limits: tuple[Range, Range, Range]


_CREASE, _PALM = (0.0, -1.0, 0.0), (0.0, 0.0, -1.0)
_ELBOW, _WRIST = (0.3, 0.0, 0.0), (0.56, 0.0, 0.0)
# Heads of the bones of each digit, and the tail of the last one.
_DIGITS: dict[str, tuple[Vector, ...]] = {
    "thumb": (
        *((0.576, -0.0205, -0.008), (0.606725, -0.049152, -0.024127), (0.632791, -0.066079, -0.033629)),
        (0.655152, -0.078989, -0.041523),
    ),
    "index": (
        *((0.588, -0.014, 0.0), (0.6495, -0.029, -0.0005), (0.692735, -0.033544, -0.002018)),
        *((0.717413, -0.036138, -0.005065), (0.737719, -0.038272, -0.009034)),
    ),
    "middle": (
        *((0.59, -0.0035, 0.002), (0.653, -0.008, 0.002), (0.700469, -0.008414, 0.000342)),
        *((0.729252, -0.008665, -0.003192), (0.750356, -0.00885, -0.007294)),
    ),
    "ring": (
        *((0.588, 0.007, 0.0015), (0.6475, 0.0125, 0.001), (0.691338, 0.01595, -0.000536)),
        *((0.718782, 0.01811, -0.004405), (0.739553, 0.019745, -0.008833)),
    ),
    "pinky": (
        *((0.584, 0.0165, -0.001), (0.6365, 0.0318, -0.0025), (0.670582, 0.039668, -0.003721)),
        *((0.690362, 0.044235, -0.006575), (0.708661, 0.04846, -0.010566)),
    ),
}
_THUMB_BENDS = ((0.479123, 0.760489, -0.438289), (0.365772, 0.815259, -0.448958), (0.322603, 0.833285, -0.448958))
_FINGER_LIMITS = (
    ((-20.0, 20.0), (-20.0, 20.0), (-20.0, 20.0)),
    ((-20.0, 90.0), LOCKED_RANGE, (-15.0, 15.0)),
    ((-5.0, 100.0), LOCKED_RANGE, (-5.0, 5.0)),
    ((-10.0, 80.0), LOCKED_RANGE, (-5.0, 5.0)),
)
_THUMB_LIMITS = (
    ((-20.0, 30.0), (-15.0, 15.0), (-25.0, 25.0)),
    ((-10.0, 55.0), LOCKED_RANGE, (-10.0, 10.0)),
    ((-15.0, 80.0), LOCKED_RANGE, (-5.0, 5.0)),
)


def _digit_joints() -> Iterator[Joint]:
    for name, points in _DIGITS.items():
        is_thumb = name == "thumb"
        bends, limits = (_THUMB_BENDS, _THUMB_LIMITS) if is_thumb else ((_PALM,) * 4, _FINGER_LIMITS)
        for index, (bend, ranges) in enumerate(zip(bends, limits, strict=True)):
            parent = f"{name}_{index - 1}" if index else "wrist"
            yield Joint(f"{name}_{index}", parent, points[index], points[index + 1], bend, ranges)


JOINTS: tuple[Joint, ...] = (
    Joint("shoulder", None, (0.0, 0.0, 0.0), _ELBOW, _CREASE, ((-90.0, 90.0),) * 3),
    Joint("elbow", "shoulder", _ELBOW, _WRIST, _CREASE, ((0.0, ELBOW_FLEXION), LOCKED_RANGE, LOCKED_RANGE)),
    Joint("wrist", "elbow", _WRIST, (0.59, 0.0, 0.0), _PALM, ((-70.0, 70.0), LOCKED_RANGE, (-30.0, 20.0))),
    *_digit_joints(),
)
JOINT_NAMES: tuple[str, ...] = tuple(joint.name for joint in JOINTS)
