# SPDX-License-Identifier: GPL-3.0-or-later
"""The errors that an evaluation has found, and their statistics."""

from dataclasses import dataclass, field

import numpy as np

from ..core.mathematics.metrics import ErrorStatistics, error_statistics
from ..core.mathematics.partition import Partition
from ..core.mathematics.poses import Channel
from ..core.mathematics.surface import SurfaceErrors, surface_json


@dataclass
class PoseErrors:
    """The errors on one set of poses.

    Attributes:
        name: name of the set.
        pose_matrices: (N, J, 4, 4) float32, mesh-object space, mesh units.
        positions: (N, V, 3) float32, positions of the rig, mesh-object space, mesh units.
        controls: (N, C) float32, values of the controls.
        fdda, linear: (N, V) float32, distances of the model and of linear skinning from the rig, meters.
        fdda_surface, linear_surface: errors of normals and edges; None for a mesh without faces, or if the surface was
            not compared.
        frozen: number of poses in which the target stands still while the rig moves.
    """

    name: str
    pose_matrices: np.ndarray
    positions: np.ndarray
    controls: np.ndarray
    fdda: np.ndarray
    linear: np.ndarray
    fdda_surface: SurfaceErrors | None = None
    linear_surface: SurfaceErrors | None = None
    frozen: int = 0

    def to_json(self) -> dict:
        """Return the statistics of the errors as JSON, described in docs/formats.md."""
        return {
            "name": self.name,
            "poses": len(self.fdda),
            "frozen": self.frozen,
            "fdda": error_statistics(self.fdda).to_json(),
            "linear": error_statistics(self.linear).to_json(),
            **surface_json(self.fdda_surface, self.linear_surface),
        }


@dataclass
class Evaluation:
    """The errors of a model on all sets of poses.

    Attributes:
        partitions: partitions of the model.
        joints: names of the joints.
        held_out: errors on the random poses; without random poses, on the first action or strip.
        actions: errors on each action and strip.
        scaled_ranges: errors on the random poses of each scaled range of motion.
        channels: channels of the random poses.
    """

    partitions: tuple[Partition, ...]
    joints: tuple[str, ...]
    held_out: PoseErrors
    actions: list[PoseErrors] = field(default_factory=list)
    scaled_ranges: list[PoseErrors] = field(default_factory=list)
    channels: tuple[Channel, ...] = ()

    @property
    def fdda(self) -> ErrorStatistics:
        """Return the statistics of the model's errors on the held-out poses."""
        return error_statistics(self.held_out.fdda)

    @property
    def linear(self) -> ErrorStatistics:
        """Return the statistics of the errors of linear skinning on the held-out poses."""
        return error_statistics(self.held_out.linear)

    def to_json(self) -> dict:
        """Return the evaluation as JSON, described in docs/formats.md; lengths in mm, angles in degrees."""
        return {
            "unit": "mm",
            "poses": len(self.held_out.fdda),
            "frozen": self.held_out.frozen,
            "vertices": self.held_out.fdda.shape[1],
            "fdda": self.fdda.to_json(),
            "linear": self.linear.to_json(),
            "partitions": [
                {
                    "joint": self.joints[partition.joint],
                    "vertices": len(partition.vertices),
                    "fdda": error_statistics(self.held_out.fdda[:, partition.vertices]).to_json(),
                    "linear": error_statistics(self.held_out.linear[:, partition.vertices]).to_json(),
                }
                for partition in self.partitions
            ],
            "actions": [errors.to_json() for errors in self.actions],
            "scaled_ranges": [errors.to_json() for errors in self.scaled_ranges],
            **surface_json(self.held_out.fdda_surface, self.held_out.linear_surface),
        }
