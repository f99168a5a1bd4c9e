# SPDX-License-Identifier: GPL-3.0-or-later
"""Builds the ONNX model, checks it against the trained networks, and measures its errors."""

import hashlib
from dataclasses import dataclass
from pathlib import Path

import numpy as np
import onnx
import onnxruntime
from onnx import TensorProto, helper

from fdda_addon.core.errors import TrainingError
from fdda_addon.core.formats.model import (
    CHECKSUM_KEY,
    CONFIDENCE_OUTPUT,
    CONTROLS_INPUT,
    METADATA_KEY,
    POSE_INPUT,
    POSITIONS_OUTPUT,
    SKIN_KEY,
    read_model_info,
)
from fdda_addon.core.formats.model_info import (
    FIT_KEY,
    KEY_JOINTS_KEY,
    LIMITS_KEY,
    ModelInfo,
    ModelPartition,
)
from fdda_addon.core.mathematics.blocks import block_slices
from fdda_addon.core.mathematics.features import FEATURES_PER_JOINT, FLOAT32_ROUNDING_RATIO
from fdda_addon.core.mathematics.metrics import distances, error_statistics
from fdda_addon.core.mathematics.skin_fit import skin_to_text
from fdda_addon.core.mathematics.skinning import LinearSkinning
from fdda_addon.core.mathematics.surface import Surface, SurfaceComparison, surface_errors, surface_json
from fdda_addon.core.recording.skinned import SkinnedRecording

from ..fits.half_rotations import regression_matrices
from ..graph_builder import GraphBuilder
from ..model import TrainedModel
from .network_nodes import add_networks
from .pose_nodes import add_features, add_range
from .skinning_nodes import add_skinning

OPSET = 17
IR_VERSION = 8
"""Supported by ONNX Runtime 1.17 and later."""
MAX_DIFFERENCE_METRES = 1e-5
"""Maximum difference of a position from the reference, meters. For rigs larger than a meter it is scaled by their size,
and the rounding error of float32 far from the origin is added."""
MAX_DIFFERENCE_RATIO = 0.01
"""Relative to the rms error in held-out poses, a difference that does not matter. Rigs that burst into pieces have
errors of meters, and residuals that float32 rounds by millimeters."""
MAX_ROUNDING_RATIO = 4e-4
"""Relative to the largest residual, a difference that the 16-bit integers of the constants explain.

Each rounds by at most 1.5e-5 of the largest value of its row, and a position sums dozens. The largest difference in a
model was 2.1e-4, of a clothed human."""
MAX_CONFIDENCE_DIFFERENCE = 1e-3
MAX_SURFACE_POSES = 50
"""Maximum number of poses in which normals are compared. At 50,000 vertices a pose takes a tenth of a second."""


def build_graph(trained_model: TrainedModel) -> onnx.ModelProto:
    """Build the ONNX model of a trained model, without metadata."""
    graph = GraphBuilder()
    features = add_features(graph, trained_model)
    clamped, outside = add_range(graph, features, trained_model)
    coefficients = add_networks(graph, features, clamped, trained_model)
    add_skinning(graph, features, coefficients, outside, trained_model)
    inputs = [helper.make_tensor_value_info(POSE_INPUT, TensorProto.FLOAT, ["N", len(trained_model.rig.joints), 4, 4])]
    if count := len(trained_model.rig.controls):
        inputs.append(helper.make_tensor_value_info(CONTROLS_INPUT, TensorProto.FLOAT, ["N", count]))
    outputs = [
        helper.make_tensor_value_info(POSITIONS_OUTPUT, TensorProto.FLOAT, ["N", trained_model.rig.vertex_count, 3]),
        helper.make_tensor_value_info(CONFIDENCE_OUTPUT, TensorProto.FLOAT, ["N", len(trained_model.partitions)]),
    ]
    proto = helper.make_graph(graph.nodes, "deformation", inputs, outputs, graph.constants)
    model = helper.make_model(proto, opset_imports=[helper.make_opsetid("", OPSET)], producer_name="fdda")
    model.ir_version = IR_VERSION
    return model


@dataclass(frozen=True)
class Measurement:
    """Errors of an exported model in n poses, meters.

    Attributes:
        fdda, linear: (n, V) float32, distances to the recorded positions, of the model and of linear skinning alone;
            with the vertices in mesh order.
        difference: largest distance from `reference_positions`; 0 if it was not measured.
    """

    fdda: np.ndarray
    linear: np.ndarray
    difference: float = 0.0


def reference_positions(
    trained_model: TrainedModel, pose_matrices: np.ndarray, controls: np.ndarray
) -> tuple[np.ndarray, np.ndarray]:
    """Compute the positions with the features and linear skinning of `core`, and with the networks in PyTorch.

    Args:
        trained_model: model with J joints, V vertices and P partitions.
        pose_matrices: (N, J, 4, 4), mesh-object space, mesh units.
        controls: (N, C) values of the controls.

    Returns:
        (N, V, 3) float32 positions, mesh-object space, mesh units, and (N, P) float32 confidence.
    """
    rig, training_range = trained_model.rig, trained_model.training_range
    features = trained_model.inputs.compute_features(pose_matrices, controls)
    confidence = training_range.compute_confidence(features)
    clamped = np.clip(features, training_range.low, training_range.high).astype(np.float64)
    matrices = regression_matrices(pose_matrices, rig, len(trained_model.half_rotation_joints()) > 0)
    local, offsets = (np.zeros((len(features), rig.vertex_count, 3), np.float32) for _ in range(2))
    parts = zip(trained_model.partition_indices(), trained_model.parts, trained_model.prepared, strict=True)
    for index, partition, prepared in parts:
        inputs = (clamped[:, prepared.columns] - prepared.feature_mean) / prepared.feature_scale
        coefficients = prepared.network.evaluate(inputs.astype(np.float32))
        residuals = prepared.basis.reconstruct(coefficients) * confidence[:, index, None]
        local[:, partition.vertices] = residuals.reshape(len(features), -1, 3)
        if len(prepared.fit.controls):
            local[:, partition.vertices] += prepared.fit.compute_key_residuals(controls)
        offsets[:, partition.vertices] = prepared.fit.compute_offsets(matrices) * confidence[:, index, None, None]
    return LinearSkinning(rig, trained_model.partitions).complex_positions(pose_matrices, local) + offsets, confidence


def open_session(model: bytes) -> onnxruntime.InferenceSession:
    """Create an ONNX Runtime session on the CPU.

    Raises:
        TrainingError: ONNX Runtime does not load the model.
    """
    options = onnxruntime.SessionOptions()
    options.log_severity_level = 3
    try:
        return onnxruntime.InferenceSession(model, options, providers=["CPUExecutionProvider"])
    except Exception as error:  # ONNX Runtime's exceptions have no narrower common base class.
        raise TrainingError(f"ONNX Runtime {onnxruntime.__version__} refuses the exported model: {error}") from error


def _evaluate(
    session: onnxruntime.InferenceSession, recording: SkinnedRecording, skinning: LinearSkinning, poses: np.ndarray
) -> tuple[np.ndarray, np.ndarray, np.ndarray, np.ndarray]:
    """Evaluate n poses of a recording.

    Returns:
        (n, V, 3) positions of the model, (n, P) confidence, and the positions of linear skinning alone and of the rig.
    """
    inputs = {POSE_INPUT: np.array(recording.pose_matrices[poses])}
    if recording.rig.controls:
        inputs[CONTROLS_INPUT] = np.array(recording.controls[poses])
    matrices = inputs[POSE_INPUT]
    outputs = session.run([POSITIONS_OUTPUT, CONFIDENCE_OUTPUT], inputs)
    return *outputs, skinning.positions(matrices), recording.read_positions(poses)


def measure(
    session: onnxruntime.InferenceSession,
    recording: SkinnedRecording,
    poses: np.ndarray,
    trained_model: TrainedModel | None = None,
) -> Measurement:
    """Measure the exported model and linear skinning on poses of the recording.

    Args:
        poses: indices of poses.
        trained_model: model whose `reference_positions` are compared with those of the exported model.

    Raises:
        TrainingError: the outputs are not finite, or their confidence differs from that of `trained_model`.
    """
    rig, difference = recording.rig, 0.0
    fdda, linear = (np.empty((len(poses), rig.vertex_count), np.float32) for _ in range(2))
    skinning = LinearSkinning(rig, recording.partitions)
    for block in block_slices(len(poses), 3 * rig.vertex_count):
        positions, confidence, skinned, truth = _evaluate(session, recording, skinning, poses[block])
        fdda[block] = distances(positions, truth, rig.metres_per_unit)
        linear[block] = distances(skinned, truth, rig.metres_per_unit)
        if trained_model:
            arrays = (np.array(array[poses[block]]) for array in (recording.pose_matrices, recording.controls))
            expected, expected_confidence = reference_positions(trained_model, *arrays)
            if not np.isfinite(positions).all() or not np.isfinite(confidence).all():
                raise TrainingError("The exported model gives values that are not numbers; train with other settings.")
            if np.abs(confidence - expected_confidence).max(initial=0) > MAX_CONFIDENCE_DIFFERENCE:
                raise TrainingError(
                    "The confidence of the exported model differs from PyTorch; this is a defect, report it."
                )
            difference = max(difference, float(distances(positions, expected, rig.metres_per_unit).max()))
    return Measurement(fdda, linear, difference)


def measure_surface(session: onnxruntime.InferenceSession, recording: SkinnedRecording, poses: np.ndarray) -> dict:
    """Measure normals and edge lengths on at most `MAX_SURFACE_POSES` poses; returns the JSON of `surface_json`."""
    rig, rows = recording.rig, []
    if not len(rig.face_starts):
        return surface_json(None, None)
    skinning = LinearSkinning(rig, recording.partitions)
    comparison = SurfaceComparison(
        Surface(rig.face_starts, rig.face_vertices), rig.rest_positions, recording.partitions
    )
    for pose in poses[:: -(-len(poses) // MAX_SURFACE_POSES)]:
        (positions,), _, (skinned,), (truth,) = _evaluate(session, recording, skinning, np.array([pose]))
        rows.append(comparison.compare(truth, (positions, skinned)))
    return surface_json(*(surface_errors(method_rows) for method_rows in zip(*rows, strict=True)))


def check_parity(recording: SkinnedRecording, held_out: Measurement) -> None:
    """Check how far the exported model is from `reference_positions` on the held-out poses.

    Raises:
        TrainingError: the difference is too large.
    """
    rig = recording.rig
    max_coordinate = float(np.abs(rig.rest_positions).max() + np.abs(recording.pose_matrices[..., :3, 3]).max())
    rounding = 2 * FLOAT32_ROUNDING_RATIO * max_coordinate * rig.metres_per_unit
    allowed = MAX_DIFFERENCE_METRES * max(1.0, rig.size * rig.metres_per_unit) + rounding
    error_rms, residual = float(np.sqrt(np.square(held_out.fdda).mean())), float(held_out.linear.max(initial=0))
    allowed = max(allowed, MAX_DIFFERENCE_RATIO * error_rms, MAX_ROUNDING_RATIO * residual)
    if held_out.difference > allowed:
        raise TrainingError(
            f"The exported model differs from PyTorch by {held_out.difference * 1000:.3g} mm, more than the allowed "
            f"{allowed * 1000:.3g} mm; look whether the rig bursts in recorded poses (Corrective Smooth may do that), "
            "or train with a larger weight decay."
        )


def _model_info(
    recording: SkinnedRecording,
    trained_model: TrainedModel,
    held_out: Measurement,
    training_info: dict,
) -> ModelInfo:
    """Create the metadata of a model; arguments as in `build_model`."""
    rig, low, high = recording.rig, trained_model.training_range.low, trained_model.training_range.high
    return ModelInfo(
        rig.joints,
        rig.rest_matrices,
        rig.meshes,
        tuple(
            ModelPartition(
                p.joint,
                p.influencing,
                len(p.vertices),
                sum(len(prepared.basis.components) for _, prepared in trained_model.parts_of(p)),
                p.controls,
                p.merged,
            )
            for p in trained_model.partitions
        ),
        *(bound[: len(rig.joints) * FEATURES_PER_JOINT].reshape(-1, FEATURES_PER_JOINT) for bound in (low, high)),
        trained_model.training_range.controls,
        error_statistics(held_out.fdda).to_json(),
        1000 * held_out.difference,
        {
            **training_info,
            LIMITS_KEY: recording.info.sampling.to_json()["limits"],
            **({FIT_KEY: recording.fit.to_json()} if recording.fit else {}),
            **({KEY_JOINTS_KEY: recording.key_joints.to_json()} if recording.key_joints else {}),
        },
        rig.metres_per_unit,
    )


@dataclass(frozen=True)
class ExportedModel:
    """A model that has passed its checks.

    Attributes:
        content: bytes of the model file.
        info: metadata of the model.
        held_out: errors on the held-out poses.
        session: ONNX Runtime session with the model.
    """

    content: bytes
    info: ModelInfo
    held_out: Measurement
    session: onnxruntime.InferenceSession


def build_model(
    recording: SkinnedRecording, trained_model: TrainedModel, held_out_poses: np.ndarray, training_info: dict
) -> ExportedModel:
    """Build the model, check it against the trained networks, and measure its errors; nothing is written.

    Args:
        held_out_poses: indices of the held-out poses.
        training_info: settings and versions for the metadata.
    """
    model = build_graph(trained_model)
    onnx.checker.check_model(model)
    session = open_session(model.SerializeToString())
    held_out = measure(session, recording, held_out_poses, trained_model)
    check_parity(recording, held_out)
    info = _model_info(recording, trained_model, held_out, training_info)
    # The checksum comes first, so that a truncated file still has it.
    model.metadata_props.add(key=CHECKSUM_KEY, value=hashlib.sha256(model.graph.SerializeToString()).hexdigest())
    model.metadata_props.add(key=METADATA_KEY, value=info.to_json())
    if recording.fit:
        skin = skin_to_text(recording.rig.skin_joints, recording.rig.skin_weights)
        model.metadata_props.add(key=SKIN_KEY, value=skin)
    return ExportedModel(model.SerializeToString(), info, held_out, session)


def write_model(path: Path, content: bytes) -> None:
    """Write the model file, and check that the add-on can read its metadata."""
    path.write_bytes(content)
    read_model_info(path)
