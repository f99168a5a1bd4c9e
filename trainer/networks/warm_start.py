# SPDX-License-Identifier: GPL-3.0-or-later
"""A warm start: continues a training from its checkpoint, on a recording that may have grown.

Linear fits, feature statistics and bases are computed from the current poses. The first and the last layer of each
network absorb the differences in statistics and basis, so the network starts with nearly its former outputs.
"""

from dataclasses import replace
from pathlib import Path

import numpy as np

from fdda_addon.core.errors import TrainingError
from fdda_addon.core.formats.report import checkpoint_path
from fdda_addon.core.mathematics.partition import Partition
from fdda_addon.core.recording.skinned import SkinnedRecording

from ..config import TrainingConfig
from ..inputs.network_inputs import check_states
from ..preparation import PreparedPartition
from .checkpoint import Checkpoint, PartitionCheckpoint, read_checkpoint
from .networks import Network

WARM_START_EPOCHS_RATIO, WARM_START_RATE_RATIO = 0.5, 0.3
"""Epochs and learning rate of a warm start, as parts of the settings."""


def read_initial_checkpoint(
    model_path: Path, recording: SkinnedRecording, holdout: str, config: TrainingConfig
) -> Checkpoint:
    """Read the checkpoint beside a model, and check that it fits; `holdout` as in `Checkpoint`.

    Raises:
        TrainingError: there is no checkpoint, or its rig, controls, networks or split differ.
    """
    path = checkpoint_path(model_path)
    checkpoint = read_checkpoint(path)
    if checkpoint.meshes != recording.rig.meshes:
        raise TrainingError(f"The checkpoint '{path}' is of another rig; train without --warm-start.")
    if checkpoint.controls != tuple(control.name for control in recording.rig.controls):
        raise TrainingError(f"The checkpoint '{path}' is of other controls; train without --warm-start.")
    try:
        check_states(checkpoint.input_states, recording.rig)
    except (ValueError, KeyError) as error:
        raise TrainingError(f"The checkpoint '{path}' is damaged ({error}); train without --warm-start.") from error
    if checkpoint.deformation != recording.digest():
        raise TrainingError(
            f"The checkpoint '{path}' is of other skin weights, joints or partitions; train with the same "
            "--base-skinning, --bones-to-read, --min-vertices-per-part and --influence-tolerance, or without "
            "--warm-start."
        )
    if checkpoint.holdout != holdout:
        raise TrainingError(
            f"The checkpoint '{path}' is of another recording or seed, and may have been trained on poses that are "
            "held out now; train with the same, or without --warm-start."
        )
    if (checkpoint.hidden, checkpoint.activation) != (config.hidden, config.activation):
        raise TrainingError(
            f"The checkpoint '{path}' is of networks --hidden {' '.join(map(str, checkpoint.hidden))} --activation "
            f"{checkpoint.activation}; train with the same, or without --warm-start."
        )
    return checkpoint


def warm_start_config(config: TrainingConfig) -> TrainingConfig:
    """Return the settings of a warm start: fewer epochs at a lower learning rate."""
    return replace(
        config,
        passes=max(1, round(config.passes * WARM_START_EPOCHS_RATIO)),
        learning_rate=config.learning_rate * WARM_START_RATE_RATIO,
    )


def checkpoint_parts(checkpoint: Checkpoint, recording: SkinnedRecording) -> list[Partition]:
    """Return the parts of a checkpoint, which has the same rig.

    Raises:
        TrainingError: the checkpoint is of other partitions.
    """
    by_joint = {partition.joint: partition for partition in recording.partitions}
    parts, vertices = checkpoint.partitions, {joint: [] for joint in by_joint}
    for part in parts:
        vertices.setdefault(part.joint, []).append(part.vertices)
    if vertices.keys() != by_joint.keys() or not all(
        np.array_equal(np.sort(np.concatenate(vertices[joint] or [[]])), by_joint[joint].vertices) for joint in by_joint
    ):
        raise TrainingError("The checkpoint is of other partitions; train without --warm-start.")
    return [replace(by_joint[part.joint], vertices=part.vertices) for part in parts]


def initial_networks(checkpoint: Checkpoint, prepared: list[PreparedPartition]) -> list[Network | None]:
    """Convert the networks of a checkpoint to the features and bases of the current training.

    The checkpoint is of the same rig, controls, parts, hidden layers and activation.

    Returns:
        For each partition a network with nearly the former outputs; None where the partition has no network now or had
        none before.
    """
    return [_convert_network(*partitions) for partitions in zip(checkpoint.partitions, prepared, strict=True)]


def _convert_network(former: PartitionCheckpoint, prepared: PreparedPartition) -> Network | None:
    if not len(former.basis_components) or not len(prepared.basis.components):
        return None
    weights, biases = (
        [array.astype(np.float64) for array in arrays] for arrays in (former.network.weights, former.network.biases)
    )
    # A feature that was constant before gets weight 0. A feature that is constant now stays at its mean.
    first_weights = np.zeros((len(prepared.columns), weights[0].shape[1]))
    _, new_rows, former_rows = np.intersect1d(prepared.columns, former.columns, return_indices=True)
    unscaled = weights[0][former_rows] / former.feature_scale[former_rows, None]
    first_weights[new_rows] = unscaled * prepared.feature_scale[new_rows, None]
    biases[0] = biases[0] + (prepared.feature_mean[new_rows] - former.feature_mean[former_rows]) @ unscaled
    weights[0] = first_weights
    components = prepared.basis.components.T.astype(np.float64)
    change_of_basis = former.basis_components @ components
    weights[-1] = weights[-1] @ change_of_basis
    biases[-1] = biases[-1] @ change_of_basis + (former.basis_mean - prepared.basis.mean) @ components
    layers = (tuple(array.astype(np.float32) for array in arrays) for arrays in (weights, biases))
    return Network(*layers, former.network.activation)
