# SPDX-License-Identifier: GPL-3.0-or-later
"""The rig as arrays: joints, rest pose and skin weights of one mesh."""

import hashlib
from dataclasses import dataclass, field

import numpy as np

from .controls import Control
from .deformation import check_deformation, deformation_differences

STATIC_JOINT = ""
"""Name of the joint that never moves; no bone has it. What follows no bone follows this one.

Its rest and its pose matrix are the identity, its parent is -1."""
STATIC_JOINT_LABEL = "no bone"
"""What people read in place of that name."""

MAX_HASH_LENGTH = 128
REST_MATRIX_TOLERANCE = 1e-4
"""Largest difference of a rest matrix element (metres, or no unit) at which two rest poses count as the same.

Blender's versions compute a bone's matrix a few float32 steps apart, so the comparison cannot be exact."""


MAX_NAME_LENGTH = 1000
"""Letters of a name in a file; Blender's are at most a quarter of it."""


def read_name(value: object) -> str:
    """A name from a file; TypeError or ValueError where it is none."""
    if not isinstance(value, str):
        raise TypeError(f"{value!r} stands where a name belongs")
    if len(value) > MAX_NAME_LENGTH:
        raise ValueError(f"a name has {len(value)} letters")
    return value


@dataclass(frozen=True)
class Joint:
    """A joint: the bone's name and the index of its parent joint, -1 for a root."""

    name: str
    parent: int


def read_joints(values: list) -> tuple[Joint, ...]:
    """Read the joints of a recording or model.

    Raises:
        KeyError, TypeError, ValueError: they are damaged, two have one name, or one stands before its parent.
    """
    if not isinstance(values, list):
        raise TypeError("its joints are no list")
    joints = tuple(Joint(read_name(value["name"]), value["parent"]) for value in values)
    if not joints or len({joint.name for joint in joints}) != len(joints):
        raise ValueError("it has no joints, or two of one name")
    for number, joint in enumerate(joints):
        if type(joint.parent) is not int or not -1 <= joint.parent < number:
            raise ValueError(
                f"a joint stands before its parent: the parent of joint {joint.name!r} is {joint.parent!r}"
            )
    return joints


@dataclass(frozen=True)
class Fingerprint:
    """Tells two rigs apart and says in what they differ.

    Attributes:
        topology, rest_positions, skin_weights: hashes.
        deformation: what deforms the mesh besides (`core.deformation`); empty where nobody knows.
    """

    topology: str
    rest_positions: str
    skin_weights: str
    deformation: dict = field(default_factory=dict)

    @staticmethod
    def from_json(value: dict) -> "Fingerprint":
        """Read a fingerprint from a file; KeyError, TypeError or ValueError where it is damaged."""
        parts = [value[name] for name in ("topology", "rest_positions", "skin_weights")]
        if not all(isinstance(part, str) and len(part) <= MAX_HASH_LENGTH for part in parts):
            raise ValueError("its fingerprint holds no hashes")
        return Fingerprint(*parts, check_deformation(value.get("deformation", {})))

    @staticmethod
    def digest(*arrays: np.ndarray) -> str:
        """Hash arrays by dtype, shape and bytes; 16 hexadecimal digits."""
        digest = hashlib.sha256()
        for array in arrays:
            array = np.ascontiguousarray(array)
            digest.update(f"{array.dtype.str}{array.shape}".encode())
            digest.update(array.tobytes())
        return digest.hexdigest()[:16]

    @staticmethod
    def digest_text(text: str) -> str:
        """Hash a text; 16 hexadecimal digits."""
        return hashlib.sha256(text.encode()).hexdigest()[:16]


@dataclass(frozen=True)
class Rig:
    """One mesh, its joints and its linear skinning.

    Attributes:
        joints: J joints, every parent before its children.
        rest_positions: (V, 3) float32, mesh-object space, mesh units (see `metres_per_unit`).
        rest_matrices: (J, 4, 4) float32, rest pose of the joints in mesh-object space, column vectors.
        skin_joints: (V, I) int32, indices of the joints that a vertex follows; unused places hold 0.
        skin_weights: (V, I) float32, their weights; each row sums to 1, unused places hold 0.
        fingerprint: of topology, rest positions and weights.
        face_starts: (F,) int32, where each face starts in `face_vertices`; empty when the faces are not known.
        face_vertices: (C,) int32, vertex indices of the corners, face by face.
        controls: the inputs beside the joints.
        metres_per_unit: length of one unit of mesh-object space. What is called metres above, in recordings and in
            models are such units; a distance in them times this is in metres.
    """

    joints: tuple[Joint, ...]
    rest_positions: np.ndarray
    rest_matrices: np.ndarray
    skin_joints: np.ndarray
    skin_weights: np.ndarray
    fingerprint: Fingerprint
    face_starts: np.ndarray = field(default_factory=lambda: np.zeros(0, np.int32))
    face_vertices: np.ndarray = field(default_factory=lambda: np.zeros(0, np.int32))
    controls: tuple[Control, ...] = ()
    metres_per_unit: float = 1.0

    @property
    def joint_names(self) -> tuple[str, ...]:
        return tuple(joint.name for joint in self.joints)

    @property
    def parents(self) -> np.ndarray:
        """(J,) int32, the parent index of each joint, -1 for a root."""
        return np.array([joint.parent for joint in self.joints], np.int32)

    @property
    def vertex_count(self) -> int:
        return len(self.rest_positions)

    @property
    def size(self) -> float:
        """Diagonal of the bounding box of the rest positions, units of mesh-object space."""
        return float(np.linalg.norm(np.ptp(self.rest_positions, axis=0)))


def rest_matrices_match(rest_matrices: np.ndarray, rig: Rig) -> bool:
    """Whether (J, 4, 4) rest matrices are those of a rig, to `REST_MATRIX_TOLERANCE`."""
    apart = np.abs(rest_matrices - rig.rest_matrices)
    apart[:, :3, 3] *= rig.metres_per_unit
    return bool(apart.max(initial=0) <= REST_MATRIX_TOLERANCE)


def rig_differences(
    joints: tuple[Joint, ...], rest_matrices: np.ndarray, vertex_count: int, fingerprint: Fingerprint, rig: Rig
) -> list[str]:
    """Say in what a rig differs from the one that a recording or model was made of.

    Args:
        joints, rest_matrices, vertex_count, fingerprint: what the file says, as in `Rig`.
        rig: the rig at hand.

    Returns:
        One clause a difference ("it has 1443 vertices, the mesh 1450"); empty when the rigs are the same.
    """
    found = []
    if vertex_count != rig.vertex_count:
        found.append(f"it has {vertex_count} vertices, the mesh has {rig.vertex_count}")
    theirs, ours = {j.name for j in joints}, set(rig.joint_names)
    if theirs != ours:
        if missing := sorted(theirs - ours):
            found.append(f"the armature lacks {_names(missing)}")
        if STATIC_JOINT in ours - theirs:
            found.append("some vertices follow no bone")
        if extra := sorted(ours - theirs - {STATIC_JOINT}):
            found.append(f"it does not know {_names(extra)}")
    elif joints != rig.joints:
        found.append("its joints have other parents")
    elif rest_matrices.shape != rig.rest_matrices.shape or (not rest_matrices_match(rest_matrices, rig)):
        found.append("the rest pose of the armature differs")
    if not found:
        for part, name in (
            ("topology", "the topology of the mesh"),
            ("rest_positions", "the rest pose of the mesh"),
            ("skin_weights", "the skin weights"),
        ):
            if getattr(fingerprint, part) != getattr(rig.fingerprint, part):
                found.append(f"{name} differ" + ("s" if part != "skin_weights" else ""))
        found += deformation_differences(fingerprint.deformation, rig.fingerprint.deformation, rig.controls)
    return found


def _names(names: list[str], most: int = 3) -> str:
    shown = ", ".join(f"'{name}'" for name in names[:most])
    return f"the {'joint' if len(names) == 1 else 'joints'} {shown}" + (
        f" and {len(names) - most} more" if len(names) > most else ""
    )
