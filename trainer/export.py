# SPDX-License-Identifier: GPL-3.0-or-later
"""Writes the model and compares it with what was trained."""

from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np
import onnx
import onnxruntime

from fdda_addon.core.errors import TrainingError
from fdda_addon.core.features import FEATURES_PER_JOINT, FLOAT32_ROUNDING_RATIO
from fdda_addon.core.metrics import distances, error_statistics
from fdda_addon.core.model import (
    CHECKSUM_KEY,
    CONTROLS_INPUT,
    LIMITS_KEY,
    METADATA_KEY,
    OBJECT_KEY,
    POSE_INPUT,
    POSITIONS_OUTPUT,
    SKIN_KEY,
    ModelInfo,
    ModelPartition,
    read_model_info,
)
from fdda_addon.core.onnx_file import read_onnx
from fdda_addon.core.recording.reader import Recording
from fdda_addon.core.skin_fit import skin_to_text
from fdda_addon.core.skinning import LinearSkinning
from fdda_addon.core.surface import Surface, SurfaceComparison, surface_errors, surface_json

from .deformation import Deformation
from .graph import build_graph
from .turns import fit_matrices

MAX_DIFFERENCE = 1e-5
"""Metres. An export that differs more from the reference fails; scaled up for rigs larger than a metre, and what
rounding makes far from the origin comes on top."""
MAX_SURFACES = 50
"""Normals are compared in so many poses: at 50,000 vertices a pose takes a tenth of a second."""
BLOCK_FLOATS = 1 << 24
"""Poses are evaluated in blocks of so many coordinates."""


@dataclass(frozen=True)
class Measured:
    """Distances to the recorded positions, in metres, vertices in mesh order.

    Attributes:
        fdda, linear: (n, V) float32, of the model and of linear skinning alone.
    """

    fdda: np.ndarray
    linear: np.ndarray


def reference_positions(
    deformation: Deformation, pose_matrices: np.ndarray, controls: np.ndarray
) -> tuple[np.ndarray, np.ndarray]:
    """What the model must play, computed by core's features and linear skinning, and the networks in PyTorch.

    Args:
        deformation: what was trained.
        pose_matrices: (N, J, 4, 4), mesh-object space, mesh units.
        controls: (N, C).

    Returns:
        (N, V, 3) float32 positions, mesh-object space, mesh units, and (N, P) float32 confidence.
    """
    rig, training_range = deformation.rig, deformation.training_range
    features = deformation.inputs.features(pose_matrices, rig.rest_matrices, controls)
    confidence = training_range.confidence(features)
    mean, scale = deformation.standardization()
    clamped = np.clip(features, training_range.low, training_range.high)
    inputs = ((clamped - mean) / scale).astype(np.float32)
    matrices = fit_matrices(pose_matrices, rig, len(deformation.turns()) > 0)
    local, offsets = (np.zeros((len(features), rig.vertex_count, 3), np.float32) for _ in range(2))
    for number, (partition, prepared, network) in enumerate(
        zip(deformation.partitions, deformation.prepared, deformation.networks, strict=True)
    ):
        coefficients = network.coefficients(inputs[:, deformation.seen_columns(number)], deformation.activation)
        residuals = prepared.basis.residuals(coefficients) * confidence[:, number, None]
        local[:, partition.vertices] = residuals.reshape(len(features), -1, 3)
        offsets[:, partition.vertices] = prepared.fit.offsets(matrices) * confidence[:, number, None, None]
    return LinearSkinning(rig, deformation.partitions).complex_positions(pose_matrices, local) + offsets, confidence


def open_session(model: bytes) -> onnxruntime.InferenceSession:
    """An ONNX Runtime session on the CPU.

    Raises:
        TrainingError: ONNX Runtime refuses the model.
    """
    options = onnxruntime.SessionOptions()
    options.log_severity_level = 3
    try:
        return onnxruntime.InferenceSession(model, options, providers=["CPUExecutionProvider"])
    except Exception as error:  # onnxruntime's exceptions share no base but this one
        raise TrainingError(f"ONNX Runtime {onnxruntime.__version__} refuses the exported model: {error}") from error


def _inputs(recording: Recording, poses: np.ndarray) -> dict[str, np.ndarray]:
    """What a session takes of some poses of a recording."""
    inputs = {POSE_INPUT: np.array(recording.pose_matrices[poses])}
    if recording.rig.controls:
        inputs[CONTROLS_INPUT] = np.array(recording.controls[poses])
    return inputs


def measure(
    session: onnxruntime.InferenceSession, recording: Recording, deformation: Deformation, poses: np.ndarray
) -> Measured:
    """Errors of the exported model on poses of the recording, through the whole pipeline."""
    vertices = recording.rig.vertex_count
    fdda, linear = (np.empty((len(poses), vertices), np.float32) for _ in range(2))
    skinning = LinearSkinning(recording.rig, recording.partitions)
    for block in _blocks(len(poses), vertices):
        inputs = _inputs(recording, poses[block])
        matrices = inputs[POSE_INPUT]
        truth = skinning.complex_positions(matrices, np.array(recording.residuals[poses[block]]))
        (positions,) = session.run([POSITIONS_OUTPUT], inputs)
        fdda[block] = distances(positions, truth, recording.rig.metres_per_unit)
        linear[block] = distances(skinning.positions(matrices), truth, recording.rig.metres_per_unit)
    return Measured(fdda, linear)


def measure_surface(
    session: onnxruntime.InferenceSession, recording: Recording, deformation: Deformation, poses: np.ndarray
) -> dict:
    """What `surface_json` gives, of the exported model, on at most `MAX_SURFACES` of the poses."""
    rig, rows = recording.rig, []
    if not len(rig.face_starts):
        return surface_json(None, None)
    skinning = LinearSkinning(rig, recording.partitions)
    comparison = SurfaceComparison(
        Surface(rig.face_starts, rig.face_vertices), rig.rest_positions, deformation.partitions
    )
    for pose in poses[:: -(-len(poses) // MAX_SURFACES)]:
        inputs = _inputs(recording, np.array([pose]))
        matrices = inputs[POSE_INPUT]
        truth = skinning.complex_positions(matrices, np.array(recording.residuals[pose, None]))
        (positions,) = session.run([POSITIONS_OUTPUT], inputs)
        rows.append(comparison.compare(truth[0], (positions[0], skinning.positions(matrices)[0])))
    return surface_json(*(surface_errors(way) for way in zip(*rows, strict=True)))


def check_parity(
    session: onnxruntime.InferenceSession, recording: Recording, deformation: Deformation, poses: np.ndarray
) -> float:
    """Compare the exported model with `reference_positions`.

    Returns:
        The largest difference of a position, metres.

    Raises:
        TrainingError: it is too large, or the model gives values that are not numbers.
    """
    largest, metres_per_unit = 0.0, recording.rig.metres_per_unit
    for block in _blocks(len(poses), recording.rig.vertex_count):
        inputs = _inputs(recording, poses[block])
        positions, confidence = session.run(None, inputs)
        controls = np.array(recording.controls[poses[block]])
        expected, expected_confidence = reference_positions(deformation, inputs[POSE_INPUT], controls)
        difference = max(float(distances(positions, expected, metres_per_unit).max()), 0.0)
        if not np.isfinite(positions).all() or not np.isfinite(confidence).all():
            raise TrainingError("The exported model gives values that are not numbers; train with other settings.")
        if np.abs(confidence - expected_confidence).max(initial=0) > 1e-3:
            raise TrainingError(
                "The confidence of the exported model differs from PyTorch; this is a defect, report it."
            )
        largest = max(largest, difference)
    reach = float(np.abs(recording.rig.rest_positions).max() + np.abs(recording.pose_matrices[..., :3, 3]).max())
    allowed = (
        MAX_DIFFERENCE * max(1.0, recording.rig.size * metres_per_unit)
        + 2 * FLOAT32_ROUNDING_RATIO * reach * metres_per_unit
    )
    if largest > allowed:
        raise TrainingError(
            f"The exported model differs from PyTorch by {largest * 1000:.3g} mm, more than the allowed "
            f"{allowed * 1000:.3g} mm; train with a larger weight decay or a smaller learning rate."
        )
    return largest


def model_info(recording: Recording, deformation: Deformation, held_out: np.ndarray, training: dict) -> ModelInfo:
    """The metadata of a model; the parity is filled in when it has been measured.

    Args:
        recording, deformation: what was trained, on what.
        held_out: distances of the validation poses, metres.
        training: settings, versions and times.
    """
    rig, low, high = recording.rig, deformation.training_range.low, deformation.training_range.high
    partitions = zip(deformation.partitions, recording.partitions, deformation.shape_counts(), strict=True)
    return ModelInfo(
        rig.joints,
        rig.rest_matrices,
        rig.vertex_count,
        rig.fingerprint,
        tuple(
            ModelPartition(
                *(p.joint, p.influencing, len(p.vertices), shapes, p.controls, p.merged),
                tuple(np.setdiff1d(p.vertices, recorded.vertices).tolist()),
            )
            for p, recorded, shapes in partitions
        ),
        *(bound[: deformation.inputs.joint_columns].reshape(-1, FEATURES_PER_JOINT) for bound in (low, high)),
        deformation.training_range.controls,
        error_statistics(held_out).to_json(),
        0.0,
        {**training, OBJECT_KEY: recording.info.object_name, LIMITS_KEY: recording.info.sampling.to_json()["limits"]},
        rig.metres_per_unit,
    )


@dataclass(frozen=True)
class Exported:
    """A model that has passed its checks: the bytes of the file, its metadata, and its held-out errors."""

    content: bytes
    info: ModelInfo
    held_out: Measured
    session: onnxruntime.InferenceSession


def build_model(recording: Recording, deformation: Deformation, validation: np.ndarray, training: dict) -> Exported:
    """Build the model, compare it with what was trained, and measure it; nothing is written.

    Args:
        recording, deformation: what was trained, on what.
        validation: indices of the held-out poses.
        training: settings, versions and times for the metadata.

    Raises:
        TrainingError: the model does not agree with what was trained.
    """
    model = build_graph(deformation)
    onnx.checker.check_model(model)
    session = open_session(model.SerializeToString())
    parity = check_parity(session, recording, deformation, validation)
    measured = measure(session, recording, deformation, validation)
    info = replace(
        model_info(recording, deformation, measured.fdda, training),
        parity_mm=parity * 1000,
        constant_bytes=sum(onnx.numpy_helper.to_array(tensor).nbytes for tensor in model.graph.initializer),
    )
    # The first of them: what is cut off a file that is not complete is not the checksum.
    model.metadata_props.add(key=CHECKSUM_KEY, value=read_onnx(model.SerializeToString()).checksum)
    model.metadata_props.add(key=METADATA_KEY, value=info.to_json())
    if recording.info.fit:
        skin = skin_to_text(recording.rig.skin_joints, recording.rig.skin_weights)
        model.metadata_props.add(key=SKIN_KEY, value=skin)
    return Exported(model.SerializeToString(), info, measured, session)


def write_model(path: Path, content: bytes) -> None:
    """Write the model, and read it back as the add-on will. OSError when the file cannot be written."""
    path.write_bytes(content)
    read_model_info(path)


def _blocks(poses: int, vertices: int) -> list[slice]:
    step = max(1, BLOCK_FLOATS // (3 * vertices))
    return [slice(start, start + step) for start in range(0, poses, step)]
