# SPDX-License-Identifier: GPL-3.0-or-later
"""The metadata of a model: what it was trained for, on what, and how accurate it is."""

import json
from dataclasses import asdict, dataclass, field, replace

import numpy as np

from ..controls import Control, owners_from_mesh, read_controls
from ..json_check import COUNT, NUMBER, Interval, check_json
from ..mathematics.key_joints import KeyJointReport
from ..mathematics.partition import Partition, make_partitions
from ..mathematics.poses import CONTROL, Channel
from ..mathematics.skin_fit import SkinFit
from ..rig import IDENTITY, STATIC_JOINT, Joint, MeshPart, Rig, read_joints, read_meshes, read_unit, unit_to_json

VERSION = 1
MAX_METADATA_LENGTH = 16 << 20
"""Largest number of characters of the metadata."""
FLOAT32 = Interval(-1e30, 1e30)
"""Description of a number that float32 can hold."""
LIMITS_KEY = "limits"
"""Key in `ModelInfo.training` for the range of motion."""
FIT_KEY, KEY_JOINTS_KEY = "fit", "key_joints"
"""Keys in `ModelInfo.training` for the fit of the skin weights (`SkinFit`) and the choice of key joints
(`KeyJointReport`), where there was one."""


@dataclass(frozen=True)
class ModelPartition:
    """One partition in the metadata of a model.

    Attributes:
        joint, influencing, controls, merged: as in `Partition`.
        vertices: number of vertices.
        basis: number of components.
    """

    joint: int
    influencing: tuple[int, ...]
    vertices: int
    basis: int
    controls: tuple[int, ...] = ()
    merged: tuple[int, ...] = ()

    def to_json(self) -> dict:
        value = asdict(self)
        return {key: value[key] for key in value if value[key] or key not in ("controls", "merged")}


@dataclass(frozen=True)
class ModelInfo:
    """The metadata property `fdda` of a model.

    Attributes:
        joints: joints of the input `pose_matrices`, every parent before its children.
        rest_matrices: (J, 4, 4) float32, mesh-object space, mesh units.
        meshes: the recorded meshes, in the order of their vertices in the output `positions`.
        partitions: partitions in ascending order of their main joints; the output `confidence` has the same order.
        feature_low, feature_high: (J, 12) float32, range of the joint features (core.mathematics.features) in training.
        controls: controls with their ranges in training.
        held_out_mm: errors over the held-out poses, mm, by the names of `metrics.ErrorStatistics`.
        parity_mm: largest difference between ONNX Runtime and PyTorch, in mm.
        training: settings and seed of the training.
        metres_per_unit: length of one unit of mesh-object space, as in `Rig`.
    """

    joints: tuple[Joint, ...]
    rest_matrices: np.ndarray
    meshes: tuple[MeshPart, ...]
    partitions: tuple[ModelPartition, ...]
    feature_low: np.ndarray
    feature_high: np.ndarray
    controls: tuple[Control, ...] = ()
    held_out_mm: dict[str, float] = field(default_factory=dict)
    parity_mm: float = 0.0
    training: dict = field(default_factory=dict)
    metres_per_unit: float = 1.0

    @property
    def joint_names(self) -> tuple[str, ...]:
        return tuple(joint.name for joint in self.joints)

    def partitions_of(self, rig: Rig) -> tuple[Partition, ...]:
        """Make the partitions of the model for a rig that has the skin weights of the model."""
        return make_partitions(
            rig,
            {p.joint: p.influencing for p in self.partitions},
            {p.joint: p.controls for p in self.partitions},
            {joint: p.joint for p in self.partitions for joint in p.merged},
        )

    @property
    def limits(self) -> tuple[Channel, ...]:
        """Channels of the random poses with their range of motion; empty where there were none or they are unknown."""
        return tuple(Channel.from_json(channel) for channel in self.training.get(LIMITS_KEY, ()))

    @property
    def trained_poses(self) -> int:
        """Number of poses of the recording, including held-out poses; 0 where unknown."""
        counts = [self.training.get(f"{subset}_poses") for subset in ("training", "validation", "held_out")]
        return sum(counts) if all(type(count) is int for count in counts) else 0

    @property
    def skin_sentence(self) -> str:
        """Sentences about fitted skin weights and key joints; empty for the rig's own weights and all joints."""
        if FIT_KEY in self.training:
            return SkinFit.from_json(self.training[FIT_KEY]).sentence()
        if KEY_JOINTS_KEY in self.training:
            return KeyJointReport.from_json(self.training[KEY_JOINTS_KEY]).sentence()
        return ""

    @property
    def vertex_count(self) -> int:
        """Number of vertices of all meshes."""
        return sum(mesh.vertices for mesh in self.meshes)

    @property
    def has_key_joints(self) -> bool:
        """Whether the model reads fewer joints than those with skin weights."""
        return any(mesh.fingerprint.has_key_joints for mesh in self.meshes)

    def of_mesh(self, mesh: MeshPart) -> "ModelInfo":
        """Return the metadata for one of the meshes alone, in the space and the unit of its object.

        All joints, partitions and controls stay.
        """
        if len(self.meshes) == 1:
            return self
        mesh_matrices = np.linalg.inv(mesh.matrix) @ self.rest_matrices.astype(np.float64)
        is_static = np.array([name == STATIC_JOINT for name in self.joint_names])
        mesh_matrices[is_static] = np.eye(4)
        owners, training = owners_from_mesh(self.meshes[0].name, mesh.name), dict(self.training)
        if LIMITS_KEY in training:
            channels = []
            for channel in self.limits:
                owner, slash, path = channel.name.partition("/")
                name = f"{owners.get(owner, owner)}{slash}{path}" if channel.kind == CONTROL else channel.name
                channels.append(replace(channel, name=name).to_json())
            training[LIMITS_KEY] = channels
        return replace(
            self,
            training=training,
            rest_matrices=mesh_matrices.astype(np.float32),
            meshes=(replace(mesh, transform=IDENTITY),),
            controls=tuple(replace(c, owner=owners.get(c.owner, c.owner)) for c in self.controls),
            metres_per_unit=self.metres_per_unit * abs(np.linalg.det(mesh.matrix[:3, :3])) ** (1 / 3),
        )

    def to_json(self) -> str:
        """Return the text of the metadata property."""
        value = {
            "version": VERSION,
            "joints": [joint.to_json() for joint in self.joints],
            "rest_matrices": self.rest_matrices.reshape(-1, 16).tolist(),
            "meshes": [mesh.to_json() for mesh in self.meshes],
            "partitions": [partition.to_json() for partition in self.partitions],
            **({"controls": [control.to_json() for control in self.controls]} if self.controls else {}),
            "training_ranges": {"low": self.feature_low.tolist(), "high": self.feature_high.tolist()},
            "held_out_mm": self.held_out_mm,
            "parity_mm": self.parity_mm,
            "training": self.training,
            **unit_to_json(self.metres_per_unit),
        }
        return json.dumps(value, allow_nan=False)

    @staticmethod
    def from_json(text: str) -> "ModelInfo":
        """Read the metadata property.

        Raises:
            ValueError: the metadata is damaged or of another version; the message is a clause about the model.
        """
        try:
            if len(text) > MAX_METADATA_LENGTH:
                raise ValueError(f"its metadata has {len(text)} characters")
            return _read_info(json.loads(text))
        except json.JSONDecodeError as error:
            raise ValueError(f"its metadata is not JSON ({error})") from error
        except KeyError as error:
            raise ValueError(f"its metadata lacks {error}") from error
        except (TypeError, AttributeError, OverflowError, RecursionError) as error:
            raise ValueError(f"its metadata cannot be read ({error})") from error


def _read_info(value: dict) -> ModelInfo:
    if value["version"] != VERSION:
        raise ValueError(f"it is of version {value['version']!r} and this add-on reads version {VERSION}")
    joints, controls = read_joints(value["joints"]), read_controls(value.get("controls", []))
    joint, control, ranges = range(len(joints)), range(len(controls)), [[FLOAT32]]
    partition_keys = {
        **{"joint": joint, "influencing": [joint], "vertices": COUNT[1:], "basis": COUNT},
        **{"controls?": [control], "merged?": [joint]},
    }
    keys = {
        **{"rest_matrices": ranges, "meshes": [{}], "partitions": [partition_keys]},
        **{"training_ranges": {"low": ranges, "high": ranges}, "held_out_mm": {str: NUMBER}, "parity_mm": NUMBER},
        **{"training": {f"{LIMITS_KEY}?": [{}]}},
    }
    check_json(value, keys)
    partitions = tuple(
        ModelPartition(
            *(p["joint"], tuple(p["influencing"]), p["vertices"], p["basis"]),
            *(tuple(p.get(key, ())) for key in ("controls", "merged")),
        )
        for p in value["partitions"]
    )
    meshes = read_meshes(value["meshes"])
    if sum(p.vertices for p in partitions) != sum(mesh.vertices for mesh in meshes):
        raise ValueError("the partitions do not add up to the vertices")
    info = ModelInfo(
        joints,
        np.array(value["rest_matrices"], np.float32).reshape(len(joints), 4, 4),
        meshes,
        partitions,
        *(np.array(value["training_ranges"][key], np.float32).reshape(len(joints), 12) for key in ("low", "high")),
        controls,
        value["held_out_mm"],
        value["parity_mm"],
        value["training"],
        read_unit(value),
    )
    _ = info.limits, info.skin_sentence  # raises an error if the metadata is damaged
    return info
