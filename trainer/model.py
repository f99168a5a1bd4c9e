# SPDX-License-Identifier: GPL-3.0-or-later
"""The result of a training, which is exported and evaluated."""

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from fdda_addon.core.mathematics.partition import Partition
from fdda_addon.core.recording.skinned import SkinnedRecording
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

    Attributes:
        rig, partitions: the rig, and the partitions of the recording.
        inputs: the features.
        parts: parts of the partitions (`preparation.make_parts`), as partitions with fewer vertices.
        prepared: the fit, the components and the network of each part.
        training_range: the range of the joints and controls.
    """

    rig: Rig
    partitions: tuple[Partition, ...]
    inputs: NetworkInputs
    parts: tuple[Partition, ...]
    prepared: tuple[TrainedPartition, ...]
    training_range: TrainingRange

    def partition_indices(self) -> list[int]:
        """Return the index of the partition of each part."""
        index_by_joint = {partition.joint: index for index, partition in enumerate(self.partitions)}
        return [index_by_joint[part.joint] for part in self.parts]

    def parts_of(self, partition: Partition) -> list[tuple[Partition, TrainedPartition]]:
        """Return the parts of a partition, with their fits and networks."""
        return [pair for pair in zip(self.parts, self.prepared, strict=True) if pair[0].joint == partition.joint]

    def half_rotation_joints(self) -> np.ndarray:
        """Return (H,) int64, ascending, the joints whose half-rotation matrices some partition is fitted to."""
        fitted = np.unique(np.concatenate([prepared.fit.joints for prepared in self.prepared]))
        return fitted[fitted >= len(self.rig.joints)] - len(self.rig.joints)

    def checkpoint(self, deformation: str, holdout: str, config: TrainingConfig, history: list[dict]) -> Checkpoint:
        """Return the state from which the training can be continued; other arguments as in `Checkpoint`."""
        partitions = [
            PartitionCheckpoint(
                joint=part.joint,
                vertices=part.vertices,
                columns=p.columns,
                feature_mean=p.feature_mean,
                feature_scale=p.feature_scale,
                basis_mean=p.basis.mean,
                basis_components=p.basis.components,
                network=p.network,
            )
            for part, p in zip(self.parts, self.prepared, strict=True)
        ]
        return Checkpoint(
            self.rig.meshes,
            tuple(control.name for control in self.rig.controls),
            deformation,
            holdout,
            config.hidden,
            config.activation,
            tuple(history),
            tuple(partitions),
            self.inputs.states,
        )


def make_trained_model(
    recording: SkinnedRecording,
    inputs: NetworkInputs,
    split: Split,
    parts: Sequence[Partition],
    prepared: Sequence[TrainedPartition],
) -> TrainedModel:
    """Put together the result of a training, and measure the range of its training poses; `parts` as in the model."""
    matrices, controls = (np.array(array[split.training]) for array in (recording.pose_matrices, recording.controls))
    features = inputs.compute_features(matrices, controls)
    return TrainedModel(
        recording.rig,
        recording.partitions,
        inputs,
        tuple(parts),
        tuple(prepared),
        measure_training_range(features, inputs.length_mask(), recording.rig, recording.partitions),
    )
