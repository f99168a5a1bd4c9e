# SPDX-License-Identifier: GPL-3.0-or-later
"""The result of a training, which is exported and evaluated."""

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from fdda_addon.core.mathematics.partition import Partition
from fdda_addon.core.recording.reader import Recording
from fdda_addon.core.rig import Rig

from .config import TrainingConfig
from .data.split import Split
from .inputs.network_inputs import NetworkInputs
from .networks.checkpoint import Checkpoint, PartitionCheckpoint
from .networks.confidence import TrainingRange, measure_training_range
from .networks.networks import TrainedPartition


@dataclass(frozen=True)
class TrainedModel:
    """A trained character with J joints, V vertices and P partitions.

    `prepared` has the fit, the components and the network of each partition.
    """

    rig: Rig
    partitions: tuple[Partition, ...]
    inputs: NetworkInputs
    prepared: tuple[TrainedPartition, ...]
    training_range: TrainingRange

    def half_rotation_joints(self) -> np.ndarray:
        """Return (H,) int64, ascending, the joints whose half-rotation matrices some partition is fitted to."""
        fitted = np.unique(np.concatenate([prepared.fit.joints for prepared in self.prepared]))
        return fitted[fitted >= len(self.rig.joints)] - len(self.rig.joints)

    def checkpoint(self, holdout: str, config: TrainingConfig, history: list[dict]) -> Checkpoint:
        """Return the state from which the training can be continued; other arguments as in `Checkpoint`."""
        partitions = [
            PartitionCheckpoint(p.columns, p.feature_mean, p.feature_scale, p.basis.mean, p.basis.components, p.network)
            for p in self.prepared
        ]
        return Checkpoint(
            self.rig.fingerprint,
            tuple(control.name for control in self.rig.controls),
            holdout,
            config.hidden,
            config.activation,
            tuple(history),
            tuple(partitions),
            self.inputs.states,
        )


def make_trained_model(
    recording: Recording, inputs: NetworkInputs, split: Split, prepared: Sequence[TrainedPartition]
) -> TrainedModel:
    """Put together the result of a training, and measure the range of its training poses."""
    matrices, controls = (np.array(array[split.training]) for array in (recording.pose_matrices, recording.controls))
    features = inputs.compute_features(matrices, controls)
    return TrainedModel(
        recording.rig,
        recording.partitions,
        inputs,
        tuple(prepared),
        measure_training_range(features, inputs.length_mask(), recording.rig, recording.partitions),
    )
