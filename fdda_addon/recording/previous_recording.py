# SPDX-License-Identifier: GPL-3.0-or-later
"""What a folder already knows of a rig: weights and influences, of a recording that goes on or that was made for it."""

from dataclasses import replace
from pathlib import Path

from ..core.errors import RecordingError
from ..core.partition import Partition, make_merged_partitions
from ..core.recording.index import RecordingInfo, read_index, read_info
from ..core.recording.reader import read_partitions, read_recorded_skin
from ..core.recording.writer import find_different_keys
from ..core.rig import Fingerprint, Rig, read_joints, rig_differences
from ..core.skin_fit import SkinFit


def read_previous_weights(path: Path, rig: Rig, kind: str) -> tuple[Rig, SkinFit | None]:
    """The rig with the weights of linear skinning that a recording has, complete or not.

    Args:
        path: folder of the recording.
        rig: with the weights of its own.
        kind: of the weights that are asked for, empty for those of the rig.

    Raises:
        RecordingError: there is no recording, or its weights are of another kind, or damaged.
    """
    index = read_index(path)
    fit = read_info(index).fit
    recorded = fit.kind if fit else ""
    if recorded != kind:
        option = f"--fit-linear {recorded}" if recorded else "the rig's own weights"
        raise RecordingError(
            f"Cannot resume '{path}': it was recorded with {option}; give that, or record into another folder."
        )
    if fit is None or (index["vertices"], len(index["joints"])) != (rig.vertex_count, len(rig.joints)):
        # Of another rig: whoever writes into it refuses, and says in what they differ.
        return rig, fit
    joints, weights = read_recorded_skin(path, index)
    return replace(rig, skin_joints=joints, skin_weights=weights), fit


def read_previous_partitions(path: Path, rig: Rig, min_partition_vertices: int) -> tuple[Partition, ...] | None:
    """The partitions of a rig with the influences that a recording of it has; None where it has none for this rig.

    Args:
        path: folder of the recording.
        rig: with the weights of linear skinning.
        min_partition_vertices: as in `RecordingSettings`.

    Raises:
        RecordingError: there is no recording, or it is damaged.
    """
    index = read_index(path)
    joints = read_joints(index["joints"])
    controls = [control.to_json() for control in rig.controls]
    if joints != rig.joints or index["controls"] != controls or index["vertices"] != rig.vertex_count:
        return None
    cut = make_merged_partitions(rig, min_partition_vertices)
    own = [(partition.joint, list(partition.merged)) for partition in cut]
    if own != [(value["joint"], value.get("merged", [])) for value in index["partitions"]]:
        return None
    return read_partitions(rig, index["partitions"])


def check_influences_match(path: Path, rig: Rig, info: RecordingInfo) -> None:
    """Fail when the influences in a folder were found for other poses, or for another rig.

    Args:
        path: folder with the influences.
        rig: the rig at hand.
        info: of the recording that is to take them.

    Raises:
        RecordingError: says in what they differ.
    """
    index = read_index(path)
    found = read_info(index)
    joints = read_joints(index["joints"])
    different = rig_differences(
        joints, rig.rest_matrices, index["vertices"], Fingerprint.from_json(index["rig"]["fingerprint"]), rig
    )
    if found.blender != info.blender:
        different.append(f"Blender {found.blender} found them, and this is {info.blender}")
    keys = find_different_keys(found.sampling.to_json(), info.sampling.to_json())
    if found.shard is None or info.shard is None or found.shard.total != info.shard.total:
        keys.append("poses")
    if keys:
        different.append(f"they were found with other settings ({', '.join(keys)})")
    if different:
        raise RecordingError(
            f"The influences in '{path}' are not those of this recording: {'; '.join(different)}. Find them with the "
            "same rig and options (record --detect-influences)."
        )
