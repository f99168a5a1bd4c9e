# SPDX-License-Identifier: GPL-3.0-or-later
"""Defines the joints of the arm: names, parents, rest pose and range of motion, without bpy.

The arm is a left arm in a T-pose, with the shoulder at the origin, the arm along +X, the palm down (-Z), and the thumb
and the elbow crease to the front (-Y). The forearm is half way between pronation and supination. Lengths are in meters,
angles in degrees.

Every bone lies along its local Y axis. Its local Z axis points in the direction in which it bends (to the elbow crease,
the palm or the pad of the thumb), so that a positive rotation about local X is always flexion.
"""

import math
from typing import NamedTuple

import numpy as np

# Every bone is posed with Euler angles in this order.
ROTATION_MODE = "XYZ"
ARM_OBJECT = "arm"
RIG_OBJECT = "arm_rig"
ACTION_NAME = "arm_drive"
BICEPS_KEY = "biceps"
# Full flexion of the elbow, degrees, at which the biceps key reaches 1.
ELBOW_FLEXION = 140.0

FINGERS = ("index", "middle", "ring", "pinky")

UPPER_ARM_LENGTH = 0.30
FOREARM_LENGTH = 0.26
WRIST_X = UPPER_ARM_LENGTH + FOREARM_LENGTH

LOCKED_RANGE = (0.0, 0.0)
Range = tuple[float, float]


class Joint(NamedTuple):
    """One bone in the rest pose.

    Attributes:
        head, tail: meters, armature space.
        bend: unit vector of the bone's local Z axis, armature space.
        limits: degrees about local X (flexion), Y (twist) and Z (sideways: positive towards the thumb, and for the
            thumb itself away from the back of the hand); `LOCKED_RANGE` for an axis that does not rotate.
    """

    name: str
    parent: str | None
    head: tuple[float, float, float]
    tail: tuple[float, float, float]
    bend: tuple[float, float, float]
    limits: tuple[Range, Range, Range]


class Finger(NamedTuple):
    """Measures of one finger.

    Attributes:
        base, knuckle: head and tail of the metacarpal, meters, armature space.
        heading: direction of the finger, degrees, positive towards the thumb.
        lengths: lengths of the three free bones, meters.
        bends: slight flexion of the three free joints in the rest pose, degrees.
    """

    base: tuple[float, float, float]
    knuckle: tuple[float, float, float]
    heading: float
    lengths: tuple[float, float, float]
    bends: tuple[float, float, float]


# Bone lengths have the usual proportions of a hand of 0.19 m; metacarpals and phalanges are as in radiographs.
FINGER_MEASURES: dict[str, Finger] = {
    "index": Finger((0.588, -0.0140, 0.0000), (0.6495, -0.0290, -0.0005), 6.0, (0.0435, 0.0250, 0.0208), (2, 5, 4)),
    "middle": Finger((0.590, -0.0035, 0.0020), (0.6530, -0.0080, 0.0020), 0.5, (0.0475, 0.0290, 0.0215), (2, 5, 4)),
    "ring": Finger((0.588, 0.0070, 0.0015), (0.6475, 0.0125, 0.0010), -4.5, (0.0440, 0.0278, 0.0213), (2, 6, 4)),
    "pinky": Finger((0.584, 0.0165, -0.0010), (0.6365, 0.0318, -0.0025), -13.0, (0.0350, 0.0205, 0.0192), (2, 6, 4)),
}

THUMB_BASE = (0.5760, -0.0205, -0.0080)
THUMB_LENGTHS = (0.0450, 0.0325, 0.0270)
# Heading and dip (downward angle) of the thumb's bones, degrees; the phalanges point more towards the fingers.
THUMB_HEADINGS = (43.0, 33.0, 30.0)
THUMB_DIPS = (21.0, 17.0, 17.0)
# The pad of the thumb faces across the palm: the bend direction is rotated about the bone by this angle, degrees.
THUMB_ROTATION = 62.0

_METACARPAL = ((-20.0, 20.0), (-20.0, 20.0), (-20.0, 20.0))
_FINGER_LIMITS = (
    _METACARPAL,
    ((-20.0, 90.0), LOCKED_RANGE, (-15.0, 15.0)),
    ((-5.0, 100.0), LOCKED_RANGE, (-5.0, 5.0)),
    ((-10.0, 80.0), LOCKED_RANGE, (-5.0, 5.0)),
)
_THUMB_LIMITS = (
    ((-20.0, 30.0), (-15.0, 15.0), (-25.0, 25.0)),
    ((-10.0, 55.0), LOCKED_RANGE, (-10.0, 10.0)),
    ((-15.0, 80.0), LOCKED_RANGE, (-5.0, 5.0)),
)


def heading_vector(heading: float, dip: float) -> np.ndarray:
    """Return a (3,) unit vector in armature space: +X rotated towards the thumb (-Y) and down (-Z), degrees."""
    heading_radians, dip_radians = math.radians(heading), math.radians(dip)
    return np.array(
        [
            math.cos(heading_radians) * math.cos(dip_radians),
            -math.sin(heading_radians) * math.cos(dip_radians),
            -math.sin(dip_radians),
        ]
    )


def perpendicular(axis: np.ndarray, direction: np.ndarray) -> np.ndarray:
    """Return the (3,) unit vector perpendicular to the unit vector `axis` and nearest to `direction`."""
    projection = direction - axis * float(np.dot(axis, direction))
    return projection / np.linalg.norm(projection)


def _joint(name, parent, head, tail, bend_direction, limits) -> Joint:
    head, tail = np.asarray(head, float), np.asarray(tail, float)
    axis = (tail - head) / np.linalg.norm(tail - head)
    bend = perpendicular(axis, np.asarray(bend_direction, float))
    return Joint(name, parent, tuple(head.tolist()), tuple(tail.tolist()), tuple(bend.tolist()), limits)


def _arm_joints() -> list[Joint]:
    crease, palm = (0.0, -1.0, 0.0), (0.0, 0.0, -1.0)
    elbow, wrist = (UPPER_ARM_LENGTH, 0.0, 0.0), (WRIST_X, 0.0, 0.0)
    joints = [
        _joint("shoulder", None, (0.0, 0.0, 0.0), elbow, crease, ((-90.0, 90.0),) * 3),
        _joint("elbow", "shoulder", elbow, wrist, crease, ((0.0, ELBOW_FLEXION), LOCKED_RANGE, LOCKED_RANGE)),
        _joint("wrist", "elbow", wrist, (WRIST_X + 0.03, 0.0, 0.0), palm, ((-70.0, 70.0), LOCKED_RANGE, (-30.0, 20.0))),
    ]
    head, parent, angle = np.array(THUMB_BASE), "wrist", math.radians(THUMB_ROTATION)
    for index, length in enumerate(THUMB_LENGTHS):
        axis = heading_vector(THUMB_HEADINGS[index], THUMB_DIPS[index])
        down = perpendicular(axis, np.array(palm))
        bend = down * math.cos(angle) + np.cross(axis, down) * math.sin(angle)
        joints.append(_joint(f"thumb_{index}", parent, head, head + axis * length, bend, _THUMB_LIMITS[index]))
        head, parent = head + axis * length, f"thumb_{index}"
    for name, finger in FINGER_MEASURES.items():
        joints.append(_joint(f"{name}_0", "wrist", finger.base, finger.knuckle, palm, _FINGER_LIMITS[0]))
        head, dip = np.array(finger.knuckle), 0.0
        for index, (length, bend) in enumerate(zip(finger.lengths, finger.bends, strict=True), start=1):
            dip += bend
            tail = head + heading_vector(finger.heading, dip) * length
            joints.append(_joint(f"{name}_{index}", f"{name}_{index - 1}", head, tail, palm, _FINGER_LIMITS[index]))
            head = tail
    return joints


JOINTS: tuple[Joint, ...] = tuple(_arm_joints())
JOINT_NAMES: tuple[str, ...] = tuple(joint.name for joint in JOINTS)
JOINT_INDEX: dict[str, int] = {name: i for i, name in enumerate(JOINT_NAMES)}


def joint(name: str) -> Joint:
    """Return the joint with this name; raise KeyError if there is none."""
    return JOINTS[JOINT_INDEX[name]]
