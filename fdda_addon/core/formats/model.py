# SPDX-License-Identifier: GPL-3.0-or-later
"""Reading of a model: one ONNX file that deforms a character. docs/formats.md describes the format."""

from pathlib import Path

import numpy as np

from ..errors import ModelError, os_error_text
from ..files.input_file import read_input
from ..mathematics.skin_fit import skin_from_text
from ..rig import Rig, rig_differences
from .model_info import ModelInfo
from .onnx_file import infer_shapes, read_onnx

METADATA_KEY = "fdda"
SKIN_KEY = "fdda_skin"
"""Metadata property of a model whose linear skinning has fitted skin weights."""
POSE_INPUT = "pose_matrices"
CONTROLS_INPUT = "controls"
POSITIONS_OUTPUT = "positions"
CONFIDENCE_OUTPUT = "confidence"
MAX_BYTES = 768 << 20
BATCH_POSES = 32
"""Number of poses for which the shapes of values are computed beside those of one pose."""
CHECKSUM_KEY = "fdda_checksum"
"""Metadata property with the SHA-256 of the graph."""


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
        if METADATA_KEY not in contents.metadata:
            raise ValueError("it is an ONNX file but not a model of this add-on")
        try:
            info = ModelInfo.from_json(contents.metadata[METADATA_KEY])
        except ValueError as error:
            raise ModelError(f"The model '{name}' cannot be used: {error}; train it again.") from error
        inputs = {POSE_INPUT: (len(info.joints), 4, 4)}
        if info.controls:
            inputs[CONTROLS_INPUT] = (len(info.controls),)
        if (found_inputs := {key: shape[1:] for key, shape in contents.inputs.items()}) != inputs:
            raise ValueError(f"it takes the inputs {found_inputs}, not {inputs}, which its metadata describe")
        if POSITIONS_OUTPUT not in contents.outputs:
            raise ValueError(f"it has no output '{POSITIONS_OUTPUT}'")
        outputs = {POSITIONS_OUTPUT: (info.vertex_count, 3), CONFIDENCE_OUTPUT: (len(info.partitions),)}
        # The size of values must not grow faster than the number of poses.
        for poses in (1, BATCH_POSES):
            shapes = infer_shapes(contents, {key: (poses, *shape) for key, shape in inputs.items()}, poses)
            for output in outputs.keys() & contents.outputs.keys():
                if shapes.get(output) != (poses, *outputs[output]):
                    raise ValueError(
                        f"its output '{output}' comes out as {shapes.get(output)}, not as {(poses, *outputs[output])}"
                    )
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
    differences = rig_differences(info.joints, info.rest_matrices, info.meshes, rig)
    if differences:
        raise ModelError(
            f"The model '{path}' was trained for another rig: {'; '.join(differences)}. Record and train this rig."
        )
