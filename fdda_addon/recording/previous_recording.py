# SPDX-License-Identifier: GPL-3.0-or-later
"""Reads weights and influences of a recording, which it reuses when it is resumed."""

from dataclasses import replace
from pathlib import Path

from ..core.errors import RecordingError
from ..core.mathematics.partition import Partition, make_merged_partitions
from ..core.mathematics.skin_fit import DEFAULT_KIND, SkinFit, weights_match
from ..core.recording.index import read_index, read_info
from ..core.recording.reader import read_partitions, read_recorded_skin
from ..core.rig import Rig, read_joints
from ..rig.reading import read_key_joints_rig
from ..scene.scene_rig import SceneRig
from .plan import RecordingSettings
from .weight_fitting import FittedWeights


def read_previous_weights(path: Path, scene_rig: SceneRig, rig: Rig, settings: RecordingSettings) -> FittedWeights:
    """Return the rig with the joints and skin weights of a recording, complete or not.

    Args:
        path: folder of the recording.
        scene_rig, rig: the rig with its own skin weights.
        settings: settings of the recording; `joints` and `fit_linear` have to be those of the recording at `path`.

    Raises:
        RecordingError: there is no recording, or its weights are of another kind or damaged.
    """
    index = read_index(path)
    fit = read_info(index).fit
    if not weights_match(fit, settings.fit_linear, settings.joints):
        raise RecordingError(
            f"Cannot resume '{path}': it was recorded with {_describe_weights(fit)}; give that, or record into "
            "another folder."
        )
    if fit is not None and fit.key_joints:
        rig = read_key_joints_rig(scene_rig, rig, [joint.name for joint in read_joints(index["joints"])])
    if fit is None or (index["vertices"], len(index["joints"])) != (rig.vertex_count, len(rig.joints)):
        # If the recording is of another rig, the writer raises an error that names the differences.
        return FittedWeights(rig, fit)
    joints, weights = read_recorded_skin(path, index)
    return FittedWeights(replace(rig, skin_joints=joints, skin_weights=weights), fit)


def _describe_weights(fit: SkinFit | None) -> str:
    """Return the options of `record` with which weights were fitted."""
    if fit is None:
        return "the rig's own weights"
    joints = f"--joints {fit.key_joints.requested}" if fit.key_joints else ""
    kind = "" if joints and fit.kind == DEFAULT_KIND else f"--fit-linear {fit.kind}"
    return " ".join(filter(None, (joints, kind)))


def read_previous_partitions(path: Path, rig: Rig, min_partition_vertices: int) -> tuple[Rig, tuple[Partition, ...]]:
    """Return a rig with the reference joints of a recording, and its partitions with the influences of the recording.

    If the recording is of another rig, returns the rig unchanged, and no partitions.

    Args:
        path: folder of the recording.
        rig: the rig with the skin weights of linear skinning.
        min_partition_vertices: as in `RecordingSettings`.

    Raises:
        RecordingError: there is no recording, or it is damaged.
    """
    index = read_index(path)
    joints = read_joints(index["joints"])
    controls = [control.to_json() for control in rig.controls]
    if joints != rig.joints or index["controls"] != controls or index["vertices"] != rig.vertex_count:
        return rig, ()
    current_partitions = make_merged_partitions(rig, min_partition_vertices)
    current_partition_joints = [(partition.joint, list(partition.merged)) for partition in current_partitions]
    if current_partition_joints != [(value["joint"], value.get("merged", [])) for value in index["partitions"]]:
        return rig, ()
    return replace(rig, joints=joints), read_partitions(rig, index["partitions"])
