# SPDX-License-Identifier: GPL-3.0-or-later
"""The rig as arrays: joints, rest pose and skin weights of the meshes of a character."""

import hashlib
from collections.abc import Iterable, Sequence
from dataclasses import asdict, dataclass, field

import numpy as np

from .controls import Control, controls_of_mesh
from .deformation import DEFORMATION_KEYS, deformation_differences
from .json_check import COUNT, NUMBER, POSITIVE, check_json
from .wording import format_with_noun

STATIC_JOINT = ""
"""Name of the static joint, which moves vertices without a bone; no bone has this name.

Its rest and pose matrices are the identity, its parent is -1."""
STATIC_JOINT_LABEL = "no bone"
"""Label of the static joint in messages."""

KEY_JOINTS_PREFIX = "key-joints-"
"""Start of `Fingerprint.skin_weights` if a model reads fewer joints than those with skin weights."""
REST_MATRIX_TOLERANCE = 1e-4
"""Largest difference of an element between two rest matrices that count as equal; meters for translations.

Versions of Blender compute a bone's matrix with different rounding, so the comparison cannot be exact."""

METRES_PER_UNIT = "metres_per_unit"
"""Key in `recording.json` and in a model's metadata; left out where a unit is one meter."""
UNIT_TOLERANCE = 1e-6
"""Largest difference in meters at which a unit counts as one meter."""


def unit_to_json(metres_per_unit: float) -> dict[str, float]:
    """Return the JSON entry of the unit; empty where a unit is one meter."""
    return {} if abs(metres_per_unit - 1) <= UNIT_TOLERANCE else {METRES_PER_UNIT: metres_per_unit}


def read_unit(value: dict) -> float:
    """Read the length of a unit in meters from the JSON of a file.

    Raises:
        ValueError: the entry is not a positive number.
    """
    check_json(value, {f"{METRES_PER_UNIT}?": POSITIVE})
    return float(value.get(METRES_PER_UNIT, 1.0))


@dataclass(frozen=True)
class Joint:
    """A joint.

    Attributes:
        name: name of its bone.
        parent: index of its parent joint; -1 for a root joint.
        reference: index of its reference joint, if that is not the parent (`references`). Rigs with different
            reference joints are equal.
    """

    name: str
    parent: int
    reference: int | None = field(default=None, compare=False)

    def to_json(self) -> dict:
        """Return the JSON for recordings and models."""
        value = {"name": self.name, "parent": self.parent}
        return value if self.reference is None else value | {"reference": self.reference}


def read_joints(values: list) -> tuple[Joint, ...]:
    """Read the joints of a recording or model.

    Raises:
        TypeError, ValueError: the joints are damaged, two have the same name, or a joint comes before its
            parent.
    """
    indices = range(-1, len(values))
    check_json(values, [{"name": str, "parent": indices, "reference?": indices[1:]}], "joints")
    joints = tuple(Joint(value["name"], value["parent"], value.get("reference")) for value in values)
    if not joints or len({joint.name for joint in joints}) != len(joints):
        raise ValueError("it has no joints, or two of one name")
    for index, joint in enumerate(joints):
        if joint.parent >= index:
            raise ValueError(f"a joint comes before its parent: the parent of joint {joint.name!r} is {joint.parent!r}")
    reference_order(joints)
    return joints


def reference_order(joints: tuple[Joint, ...]) -> list[int]:
    """Return the indices of joints in an order in which each joint comes after its reference joint.

    Raises:
        ValueError: reference joints form a cycle.
    """
    if all(joint.reference is None for joint in joints):
        return list(range(len(joints)))
    references = [joint.parent if joint.reference is None else joint.reference for joint in joints]
    depths = []
    for index in range(len(joints)):
        depth = 0
        while (index := references[index]) >= 0:
            depth += 1
            if depth > len(joints):
                raise ValueError("its reference joints form a cycle")
        depths.append(depth)
    return sorted(range(len(joints)), key=depths.__getitem__)


@dataclass(frozen=True)
class Fingerprint:
    """Hashes and settings of a rig, from which the differences between two rigs are found.

    Attributes:
        topology, rest_positions, skin_weights: hashes; that of skin weights may start with `KEY_JOINTS_PREFIX`.
        deformation: what deforms the mesh beside skin weights (`core.deformation`); empty where unknown.
    """

    topology: str
    rest_positions: str
    skin_weights: str
    deformation: dict = field(default_factory=dict)

    @property
    def has_key_joints(self) -> bool:
        """Return whether the model reads fewer joints than those with skin weights."""
        return self.skin_weights.startswith(KEY_JOINTS_PREFIX)

    @staticmethod
    def from_json(value: dict) -> "Fingerprint":
        """Read a fingerprint from a file; raise ValueError where it is damaged."""
        names = ("topology", "rest_positions", "skin_weights")
        check_json(value, {**dict.fromkeys(names, str), "deformation?": DEFORMATION_KEYS}, "fingerprint")
        return Fingerprint(*(value[name] for name in names), value.get("deformation", {}))

    @staticmethod
    def digest(*arrays: np.ndarray) -> str:
        """Hash arrays by dtype, shape and bytes to 16 hexadecimal digits."""
        digest = hashlib.sha256()
        for array in arrays:
            array = np.ascontiguousarray(array)
            digest.update(f"{array.dtype.str}{array.shape}".encode())
            digest.update(array.tobytes())
        return digest.hexdigest()[:16]

    @staticmethod
    def digest_text(text: str) -> str:
        """Hash a text to 16 hexadecimal digits."""
        return hashlib.sha256(text.encode()).hexdigest()[:16]


IDENTITY = tuple(np.eye(4).ravel().tolist())


@dataclass(frozen=True)
class MeshPart:
    """One of the meshes of a rig, whose vertices follow those of the meshes before it.

    Attributes:
        name: name of the mesh object.
        vertices: number of vertices.
        fingerprint: fingerprint of the mesh alone.
        transform: (16,) 4x4 matrix, row by row, from the space of this mesh object to that of the first.
    """

    name: str = field(compare=False)
    vertices: int
    fingerprint: Fingerprint
    transform: tuple[float, ...] = IDENTITY

    @property
    def matrix(self) -> np.ndarray:
        """(4, 4) float64, from the space of this mesh object to that of the first."""
        return np.array(self.transform).reshape(4, 4)

    def to_json(self) -> dict:
        """Return the JSON for recordings and models."""
        value = {"name": self.name, "vertices": self.vertices, "fingerprint": asdict(self.fingerprint)}
        return value if self.transform == IDENTITY else value | {"transform": list(self.transform)}


def read_meshes(values: list) -> tuple[MeshPart, ...]:
    """Read the meshes of a recording or model.

    Raises:
        ValueError: the meshes are damaged, or two have the same name.
    """
    check_json(values, [{"name": str, "vertices": COUNT[1:], "fingerprint": {}, "transform?": [NUMBER]}], "meshes")
    meshes = tuple(
        MeshPart(
            value["name"],
            value["vertices"],
            Fingerprint.from_json(value["fingerprint"]),
            tuple(map(float, value.get("transform", IDENTITY))),
        )
        for value in values
    )
    if not meshes or len({mesh.name for mesh in meshes}) != len(meshes):
        raise ValueError("it has no meshes, or two of one name")
    for mesh in meshes:
        if len(mesh.transform) != 16 or not np.linalg.det(mesh.matrix[:3, :3]):
            raise ValueError(f"the transform of the mesh {mesh.name!r} is {mesh.transform}")
    if meshes[0].transform != IDENTITY:
        raise ValueError("its first mesh has a transform")
    return meshes


def mesh_slices(meshes: Sequence[MeshPart]) -> list[slice]:
    """Return the vertices of each mesh."""
    ends = np.cumsum([mesh.vertices for mesh in meshes]).tolist()
    return [slice(end - mesh.vertices, end) for end, mesh in zip(ends, meshes, strict=True)]


def join_positions(positions: Sequence[np.ndarray], meshes: Sequence[MeshPart]) -> np.ndarray:
    """Join the (V, 3) float32 positions of meshes, each in the space of its object, in the space of the first."""
    if len(meshes) == 1:
        return positions[0]
    return np.concatenate(
        [
            array
            if mesh.transform == IDENTITY
            else (array @ mesh.matrix[:3, :3].T + mesh.matrix[:3, 3]).astype(np.float32)
            for array, mesh in zip(positions, meshes, strict=True)
        ]
    )


def join_weights(weights: Sequence[tuple[np.ndarray, np.ndarray]]) -> tuple[np.ndarray, np.ndarray]:
    """Join the skin joints and skin weights of meshes, which have the same joints."""
    columns = max(joints.shape[1] for joints, _ in weights)
    return tuple(
        np.concatenate([np.pad(array, ((0, 0), (0, columns - array.shape[1]))) for array in arrays])
        for arrays in zip(*weights, strict=True)
    )


def join_faces(
    faces: Sequence[tuple[np.ndarray, np.ndarray]], meshes: Sequence[MeshPart]
) -> tuple[np.ndarray, np.ndarray]:
    """Join the starts and vertices of the faces of meshes."""
    corners = np.cumsum([0, *(len(vertices) for _, vertices in faces)])
    starts = [starts + corner for (starts, _), corner in zip(faces, corners.tolist(), strict=False)]
    vertices = [vertices + part.start for (_, vertices), part in zip(faces, mesh_slices(meshes), strict=True)]
    return np.concatenate(starts).astype(np.int32), np.concatenate(vertices).astype(np.int32)


@dataclass(frozen=True, eq=False)
class Rig:
    """The meshes of a character, their joints and their linear skinning.

    Mesh-object space and mesh units are those of the first mesh.

    Attributes:
        joints: J joints, every parent before its children.
        rest_positions: (V, 3) float32, mesh-object space, mesh units (see `metres_per_unit`).
        rest_matrices: (J, 4, 4) float32, rest pose of the joints in mesh-object space, column vectors.
        skin_joints: (V, I) int32, indices of the joints with a weight on each vertex; unused entries are 0.
        skin_weights: (V, I) float32, weights of these joints; each row sums to 1, unused entries are 0.
        meshes: the meshes, in the order of their vertices.
        face_starts: (F,) int32, first corner of each face in `face_vertices`; empty where faces are unknown.
        face_vertices: (C,) int32, vertex indices of the corners, face by face.
        controls: the inputs beside the joints.
        metres_per_unit: length in meters of a unit of mesh-object space (a mesh unit).
    """

    joints: tuple[Joint, ...]
    rest_positions: np.ndarray
    rest_matrices: np.ndarray
    skin_joints: np.ndarray
    skin_weights: np.ndarray
    meshes: tuple[MeshPart, ...]
    face_starts: np.ndarray = field(default_factory=lambda: np.zeros(0, np.int32))
    face_vertices: np.ndarray = field(default_factory=lambda: np.zeros(0, np.int32))
    controls: tuple[Control, ...] = ()
    metres_per_unit: float = 1.0

    @property
    def joint_names(self) -> tuple[str, ...]:
        return tuple(joint.name for joint in self.joints)

    @property
    def parents(self) -> np.ndarray:
        """(J,) int32, index of the parent of each joint; -1 for a root joint."""
        return np.array([joint.parent for joint in self.joints], np.int32)

    @property
    def references(self) -> np.ndarray:
        """(J,) int32, index of the reference joint of each joint, usually its parent; -1 for mesh-object space."""
        return np.array([j.parent if j.reference is None else j.reference for j in self.joints], np.int32)

    @property
    def vertex_count(self) -> int:
        return len(self.rest_positions)

    @property
    def mesh_slices(self) -> list[slice]:
        """Vertices of each mesh."""
        return mesh_slices(self.meshes)

    @property
    def has_weights(self) -> bool:
        """Whether vertices follow other joints than the static joint."""
        return bool(self.follows_bones.any())

    @property
    def unweighted_vertices(self) -> np.ndarray:
        """(n,) int64, vertices of the meshes without skin weights, which are fitted; none if no mesh has weights."""
        parts = [part for part in self.mesh_slices if not self.follows_bones[part].any()]
        if len(parts) in (0, len(self.meshes)):
            return np.zeros(0, np.int64)
        return np.concatenate([np.arange(part.start, part.stop) for part in parts])

    @property
    def follows_bones(self) -> np.ndarray:
        """(V,) bool, whether vertices follow other joints than the static joint."""
        is_bone = np.array([name != STATIC_JOINT for name in self.joint_names])
        return (is_bone[self.skin_joints] & (self.skin_weights > 0)).any(axis=1)

    @property
    def size(self) -> float:
        """Diagonal of the bounding box of the rest positions, units of mesh-object space."""
        return float(np.linalg.norm(np.ptp(self.rest_positions, axis=0)))


def rest_matrices_match(rest_matrices: np.ndarray, rig: Rig) -> bool:
    """Return whether (J, 4, 4) rest matrices equal those of a rig within `REST_MATRIX_TOLERANCE`."""
    return _matrices_match(rest_matrices, rig.rest_matrices, rig.metres_per_unit)


def _matrices_match(first: np.ndarray, second: np.ndarray, metres_per_unit: float) -> bool:
    difference = np.abs(first - second)
    difference[..., :3, 3] *= metres_per_unit
    return bool(difference.max(initial=0) <= REST_MATRIX_TOLERANCE)


def rig_differences(
    joints: tuple[Joint, ...], rest_matrices: np.ndarray, meshes: Sequence[MeshPart], rig: Rig
) -> list[str]:
    """List the differences between a rig and the rig of a recording or model.

    Args:
        joints, rest_matrices, meshes: of the recording or model, as in `Rig`.

    Returns:
        One clause per difference ("it has 1443 vertices, the mesh 1450"); empty when the rigs are the same.
    """
    clauses = []
    if len(meshes) != len(rig.meshes):
        names, rig_names = (", ".join(f"'{mesh.name}'" for mesh in each) for each in (meshes, rig.meshes))
        return [f"it has the meshes {names}, the rig has {rig_names}"]
    for mesh, rig_mesh in zip(meshes, rig.meshes, strict=True):
        if mesh.vertices != rig_mesh.vertices:
            noun = "the mesh" if len(meshes) == 1 else f"the mesh '{rig_mesh.name}'"
            clauses.append(f"it has {mesh.vertices} vertices, {noun} has {rig_mesh.vertices}")
    file_joints, rig_joints = {j.name for j in joints}, set(rig.joint_names)
    if file_joints != rig_joints:
        if missing := sorted(file_joints - rig_joints):
            clauses.append(f"the armature lacks {format_with_noun(missing, 'joint')}")
        if STATIC_JOINT in rig_joints - file_joints:
            clauses.append("some vertices follow no bone")
        if extra := sorted(rig_joints - file_joints - {STATIC_JOINT}):
            clauses.append(f"it does not know {format_with_noun(extra, 'joint')}")
    elif joints != rig.joints:
        clauses.append("its joints have other parents")
    elif rest_matrices.shape != rig.rest_matrices.shape or (not rest_matrices_match(rest_matrices, rig)):
        clauses.append("the rest pose of the armature differs")
    if not clauses:
        for index, (mesh, rig_mesh) in enumerate(zip(meshes, rig.meshes, strict=True)):
            controls = controls_of_mesh(rig.controls, mesh.name if index else "")
            mesh_clauses = _mesh_differences(mesh, rig_mesh, controls, rig.metres_per_unit)
            clauses += [f"{clause} ('{rig_mesh.name}')" for clause in mesh_clauses] if len(meshes) > 1 else mesh_clauses
    return clauses


def _mesh_differences(
    mesh: MeshPart, rig_mesh: MeshPart, controls: Iterable[Control], metres_per_unit: float
) -> list[str]:
    """List the differences between a mesh of a recording or model and the mesh of a rig with the given controls."""
    clauses, (fingerprint, rig_fingerprint) = [], (mesh.fingerprint, rig_mesh.fingerprint)
    for attribute, label in (
        ("topology", "the topology of the mesh"),
        ("rest_positions", "the rest pose of the mesh"),
        ("skin_weights", "the skin weights"),
    ):
        if getattr(fingerprint, attribute) != getattr(rig_fingerprint, attribute):
            clauses.append(f"{label} differ" + ("s" if attribute != "skin_weights" else ""))
    if not _matrices_match(mesh.matrix, rig_mesh.matrix, metres_per_unit):
        clauses.append("the mesh has moved against the others")
    return clauses + deformation_differences(fingerprint.deformation, rig_fingerprint.deformation, controls)
