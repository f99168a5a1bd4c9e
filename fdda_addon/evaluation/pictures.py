# SPDX-License-Identifier: GPL-3.0-or-later
"""Draws the pictures of an evaluation: the partitions, and the rig, linear skinning and the model side by side."""

from dataclasses import dataclass
from pathlib import Path

import numpy as np

from ..core.mathematics.metrics import distances, heat_colors
from ..core.mathematics.partition import make_merged_partitions, partition_colors
from ..core.mathematics.skinning import LinearSkinning
from ..rig.reading import read_rig
from ..runtime.network import Network
from ..runtime.opened_model import open_model
from ..scene.mask import read_mask
from ..scene.scene_rig import SceneRig
from .picture import Cell, View, draw
from .results import PoseErrors

SURFACE_COLOR = (0.78, 0.64, 0.55)


class Deformations:
    """Computes linear skinning and a model, with the mask of a mesh, in poses.

    Attributes:
        metres_per_unit: meters per mesh unit.
    """

    def __init__(self, scene_rig: SceneRig, model: Path | Network):
        opened = open_model(scene_rig, model)
        self._network, self._skinning = opened.network, LinearSkinning(opened.linear_rig)
        self._mask, self.metres_per_unit = read_mask(scene_rig.mesh_object), opened.network.info.metres_per_unit

    def positions(self, pose_matrices: np.ndarray, controls: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """Return the positions of linear skinning and of the model, (V, 3) float32, mesh-object space, mesh units.

        Args:
            pose_matrices: (J, 4, 4) float32, mesh-object space, mesh units.
            controls: (C,) float32.
        """
        linear = self._skinning.positions(pose_matrices[None])[0]
        fdda = self._network.positions(pose_matrices[None], controls[None])[0].copy()
        return linear, fdda if self._mask is None else self._mask.blend(linear, fdda)


@dataclass(frozen=True)
class PicturedPose:
    """A pose to show in a picture.

    Attributes:
        name: name of the pose.
        pose_matrices: (J, 4, 4) float32, mesh-object space, mesh units.
        positions: (V, 3) float32, positions of the rig, mesh-object space, mesh units.
        controls: (C,) float32.
    """

    name: str
    pose_matrices: np.ndarray
    positions: np.ndarray
    controls: np.ndarray


def make_pictured_pose(errors: PoseErrors, index: int, name: str = "") -> PicturedPose:
    """Return one of the poses of an evaluation as a pose to show in a picture.

    Args:
        errors: the poses of the evaluation.
        index: index of the pose.
        name: name of the pose; empty for the name of the set and the index.
    """
    return PicturedPose(
        name or f"{errors.name} {index}", errors.pose_matrices[index], errors.positions[index], errors.controls[index]
    )


def representative_poses(errors: PoseErrors) -> list[PicturedPose]:
    """Return three poses: those with the median, the 90th percentile and the largest of the poses' mean errors."""
    indices_by_error = np.argsort(errors.fdda.mean(axis=1))
    ranks = {
        "median pose": len(indices_by_error) // 2,
        "90th percentile": int(len(indices_by_error) * 0.9),
        "worst pose": len(indices_by_error) - 1,
    }
    return [make_pictured_pose(errors, int(indices_by_error[rank]), name) for name, rank in ranks.items()]


def draw_partitions(scene_rig: SceneRig, path: Path, view: View = View()) -> None:  # noqa: B008 - frozen
    """Draw the rest pose with one color for each partition."""
    rig = read_rig(scene_rig)
    partitions = make_merged_partitions(rig)
    colors = partition_colors(partitions, rig.vertex_count)
    cell = Cell(rig.rest_positions, colors, f"{len(partitions)} partitions, {rig.vertex_count} vertices")
    draw(scene_rig.mesh_object, [[cell]], path, "Partitions by main joint", view)


def draw_comparison(
    scene_rig: SceneRig,
    model: Path,
    poses: list[PicturedPose],
    path: Path,
    is_heat_map: bool,
    title: str = "",
    view: View = View(),  # noqa: B008 - frozen
    reference_label: str = "true rig",
) -> None:
    """Draw the rig, linear skinning and the model side by side, with a row for each pose.

    Args:
        model: path of the model; it need not be bound.
        path: path of the PNG file.
        is_heat_map: whether to color each vertex by its distance from the rig.
        title: title of the picture; empty for a default.
        reference_label: label of the positions of the poses.
    """
    deformations, rows = Deformations(scene_rig, model), []
    for pose in poses:
        linear, fdda = deformations.positions(pose.pose_matrices, pose.controls)
        cells = [(pose.positions, f"{pose.name}: {reference_label}"), (linear, "linear skinning"), (fdda, "FDDA")]
        rows.append([])
        for positions, label in cells:
            errors = distances(positions, pose.positions, deformations.metres_per_unit)
            figures = f"  mean {errors.mean() * 1000:.2f} mm, max {errors.max() * 1000:.1f} mm" if errors.any() else ""
            colors = heat_colors(errors) if is_heat_map else np.tile(np.float32(SURFACE_COLOR), (len(positions), 1))
            rows[-1].append(Cell(positions, colors, label + figures))
    if not title:
        capitalized = f"{reference_label[0].upper()}{reference_label[1:]}"
        title = f"Distance from the {reference_label}" if is_heat_map else f"{capitalized}, linear skinning and FDDA"
    draw(scene_rig.mesh_object, rows, path, title, view, has_heat_scale=is_heat_map, is_sculpted=not is_heat_map)
