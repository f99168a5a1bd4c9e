# SPDX-License-Identifier: GPL-3.0-or-later
"""Reading of a model: one ONNX file that deforms a character. docs/formats.md describes the format."""

import json
from dataclasses import asdict, dataclass, field
from pathlib import Path

import numpy as np

from .controls import Control, read_controls
from .errors import ModelError, os_error_text
from .input_file import read_input
from .model_graph import Budget, check_graph, check_inputs_and_outputs, compute_budget
from .onnx_file import read_onnx
from .partition import Partition, make_partitions
from .poses import Channel
from .rig import Fingerprint, Joint, Rig, read_joints, rig_differences
from .skin_fit import skin_from_text
from .unit import read_unit, unit_to_json

VERSION = 1
METADATA_KEY = "fdda"
SKIN_KEY = "fdda_skin"
"""Metadata property of a model whose linear skinning has fitted skin weights."""
POSE_INPUT = "pose_matrices"
CONTROLS_INPUT = "controls"
POSITIONS_OUTPUT = "positions"
CONFIDENCE_OUTPUT = "confidence"
LIMITS_KEY = "limits"
"""Key in `ModelInfo.training` for the range of motion."""
OBJECT_KEY = "object"
"""Key in `ModelInfo.training` for the name of the recorded mesh object."""
MAX_BYTES = 768 << 20
MAX_METADATA_LENGTH = 16 << 20
"""Largest number of characters of the metadata."""
CHECKSUM_KEY = "fdda_checksum"
"""Metadata property with the SHA-256 of the graph."""


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
        vertex_count: number of vertices of the mesh.
        fingerprint: fingerprint of the recorded rig.
        partitions: partitions in ascending order of their main joints; the output `confidence` has the same order.
        feature_low, feature_high: (J, 12) float32, range of the joint features (core.features) in training.
        controls: controls with their ranges in training.
        held_out_mm: errors over the held-out poses, mm, by the names of `metrics.ErrorStatistics`.
        parity_mm: largest difference between ONNX Runtime and PyTorch, in mm.
        constant_bytes: size of the constants of the graph; 0 where unknown.
        training: settings and seed of the training.
        metres_per_unit: length of one unit of mesh-object space, as in `Rig`.
    """

    joints: tuple[Joint, ...]
    rest_matrices: np.ndarray
    vertex_count: int
    fingerprint: Fingerprint
    partitions: tuple[ModelPartition, ...]
    feature_low: np.ndarray
    feature_high: np.ndarray
    controls: tuple[Control, ...] = ()
    held_out_mm: dict[str, float] = field(default_factory=dict)
    parity_mm: float = 0.0
    training: dict = field(default_factory=dict)
    metres_per_unit: float = 1.0
    constant_bytes: int = 0

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

    def budget(self) -> Budget:
        """Compute the budget of the model's graph from the metadata."""
        partitions = [(p.vertices, p.basis, len(p.influencing) + len(p.controls)) for p in self.partitions]
        return compute_budget(len(self.joints), len(self.controls), partitions, self.training)

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
    def object_name(self) -> str:
        """Name of the recorded mesh object; empty where unknown."""
        name = self.training.get(OBJECT_KEY, "")
        return name if isinstance(name, str) else ""

    def to_json(self) -> str:
        """Return the text of the metadata property."""
        value = {
            "version": VERSION,
            "joints": [asdict(joint) for joint in self.joints],
            "rest_matrices": self.rest_matrices.reshape(-1, 16).tolist(),
            "vertices": self.vertex_count,
            "fingerprint": asdict(self.fingerprint),
            "partitions": [partition.to_json() for partition in self.partitions],
            **({"controls": [control.to_json() for control in self.controls]} if self.controls else {}),
            "training_ranges": {"low": self.feature_low.tolist(), "high": self.feature_high.tolist()},
            "held_out_mm": self.held_out_mm,
            "parity_mm": self.parity_mm,
            "training": self.training,
            **unit_to_json(self.metres_per_unit),
            **({"constant_bytes": self.constant_bytes} if self.constant_bytes else {}),
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
    joints = read_joints(value["joints"])
    partitions = tuple(
        ModelPartition(
            *(int(p["joint"]), tuple(map(int, p["influencing"])), int(p["vertices"]), int(p["basis"])),
            *(tuple(map(int, p.get(key, ()))) for key in ("controls", "merged")),
        )
        for p in value["partitions"]
    )
    controls = read_controls(value.get("controls", []))
    joint_count = len(joints)
    if not all(0 <= joint < joint_count for p in partitions for joint in (p.joint, *p.influencing, *p.merged)):
        raise ValueError("a partition names a joint that is none of its joints")
    if not all(0 <= control < len(controls) for p in partitions for control in p.controls):
        raise ValueError("a partition names a control that is none of its controls")
    if not partitions or not all(p.vertices > 0 and p.basis >= 0 for p in partitions):
        raise ValueError("it has no partitions, or one without vertices")
    if sum(p.vertices for p in partitions) != int(value["vertices"]):
        raise ValueError("the partitions do not add up to the vertices")
    rest_matrices = np.array(value["rest_matrices"], np.float32).reshape(joint_count, 4, 4)
    if not np.isfinite(rest_matrices).all():
        raise ValueError("its rest pose holds values that are not numbers")
    info = ModelInfo(
        joints,
        rest_matrices,
        int(value["vertices"]),
        Fingerprint.from_json(value["fingerprint"]),
        partitions,
        np.array(value["training_ranges"]["low"], np.float32).reshape(joint_count, 12),
        np.array(value["training_ranges"]["high"], np.float32).reshape(joint_count, 12),
        controls,
        {str(name): float(error) for name, error in value["held_out_mm"].items()},
        float(value["parity_mm"]),
        dict(value["training"]),
        read_unit(value),
        int(value.get("constant_bytes", 0)),
    )
    if info.constant_bytes < 0:
        raise ValueError(f"its constants are said to take {info.constant_bytes} bytes")
    if not isinstance(info.training.get(LIMITS_KEY, []), list) or not all(info.limits):
        raise ValueError("its range of motion cannot be read")
    if not np.isfinite([*info.held_out_mm.values()]).all():
        raise ValueError("its errors are not numbers")
    return info


def read_model(path: Path) -> tuple[ModelInfo, bytes]:
    """Read and check a model without running it.

    Returns:
        The metadata and the checked bytes. Only these bytes may be run, because the file may change.

    Raises:
        ModelError: the file cannot be read, or `check_model` refuses it.
    """
    try:
        data = read_input(path, MAX_BYTES)
    except OSError as error:
        raise ModelError(
            f"The model '{path}' cannot be read: {os_error_text(error)}; give one that train made, or train it first."
        ) from error
    return check_model(data, path), data


def check_model(data: bytes, name: Path | str) -> ModelInfo:
    """Check the bytes of a model without running it.

    Args:
        data: bytes of the file.
        name: name of the model in messages.

    Raises:
        ModelError: the bytes are not an ONNX file, not a model of this add-on, or damaged; or the graph has inputs,
            operators, external data or a cost that a model does not need.
    """
    if len(data) > MAX_BYTES:
        raise ModelError(f"'{name}' is larger than {MAX_BYTES >> 20} MB and cannot be a model.")
    try:
        contents = read_onnx(data)
    except ValueError as error:
        raise ModelError(f"'{name}' is not a model: {error}; give an .onnx file that train made.") from error
    if contents.external_files:
        raise ModelError(f"'{name}' keeps data in other files, which is refused; give a model that train made.")
    if contents.custom_operators:
        names = ", ".join(sorted(contents.custom_operators))
        raise ModelError(f"'{name}' uses custom operators ({names}), which is refused; give a model that train made.")
    if METADATA_KEY not in contents.metadata:
        raise ModelError(f"'{name}' is an ONNX file but not a model of this add-on; give one that train made.")
    try:
        info = ModelInfo.from_json(contents.metadata[METADATA_KEY])
    except ValueError as error:
        raise ModelError(f"The model '{name}' cannot be used: {error}; train it again.") from error
    control_inputs = {CONTROLS_INPUT: (len(info.controls),)} if info.controls else {}
    expected_inputs = {POSE_INPUT: (len(info.joints), 4, 4), **control_inputs}
    expected_outputs = {POSITIONS_OUTPUT: (info.vertex_count, 3), CONFIDENCE_OUTPUT: (len(info.partitions),)}
    if unknown_inputs := sorted(set(contents.inputs) - set(expected_inputs)):
        raise ModelError(f"'{name}' asks for inputs that no rig gives ({', '.join(unknown_inputs)}); train it again.")
    try:
        check_inputs_and_outputs(contents, expected_inputs, expected_outputs)
        check_graph(contents, info.budget(), len(data), expected_outputs, len(info.partitions))
    except ValueError as error:
        raise ModelError(f"The model '{name}' is refused: {error}; give one that train made.") from error
    if contents.metadata.get(CHECKSUM_KEY) != contents.checksum:
        raise ModelError(f"The model '{name}' is damaged: its checksum is not that of its weights; copy it again.")
    return info


def read_skin(data: bytes, info: ModelInfo, name: Path | str) -> tuple[np.ndarray, np.ndarray] | None:
    """Read the fitted skin weights of a model; return None where the model uses the skin weights of the rig.

    Args:
        data: bytes of a model that `check_model` has checked.
        info: metadata of the model.
        name: name of the model in messages.

    Returns:
        (V, I) int32 joints and (V, I) float32 weights, each row summing to 1.

    Raises:
        ModelError: the skin weights are damaged.
    """
    text = read_onnx(data).metadata.get(SKIN_KEY)
    if text is None:
        return None
    try:
        return skin_from_text(text, info.vertex_count, len(info.joints))
    except ValueError as error:
        raise ModelError(f"The model '{name}' cannot be used: {error}; train it again.") from error


def read_model_info(path: Path) -> ModelInfo:
    """Read the metadata of a model; raise the errors of `read_model`."""
    return read_model(path)[0]


def check_rig(path: Path, info: ModelInfo, rig: Rig) -> None:
    """Check that a model was trained for this rig.

    Raises:
        ModelError: the rigs differ.
    """
    differences = rig_differences(info.joints, info.rest_matrices, info.vertex_count, info.fingerprint, rig)
    if differences:
        raise ModelError(
            f"The model '{path}' was trained for another rig: {'; '.join(differences)}. Record and train this rig."
        )
