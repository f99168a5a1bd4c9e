# SPDX-License-Identifier: GPL-3.0-or-later
"""Reading of a recording, a folder of poses and positions. docs/formats.md describes the format.

`recording.json` has the number of complete poses. An array file may have more rows; the further rows are never read.
"""

from dataclasses import dataclass
from pathlib import Path

import numpy as np

from ..controls import read_controls
from ..errors import RecordingError
from ..mathematics.skin_fit import are_skin_weights
from ..mathematics.skinning import are_invertible
from ..mathematics.surface import are_faces
from ..rig import Rig, read_joints, read_meshes, read_unit
from .arrays import MAX_VALUE, STREAMED_ARRAY_NAMES, array_shapes, find_invalid_pose, open_array, release_pages
from .index import RecordingInfo, read_index, read_info

CHECK_BLOCK_VERTICES = 1 << 16
"""Number of vertices whose skin weights are checked at once, which limits the use of memory."""


@dataclass(frozen=True)
class Recording:
    """A complete recording with memory-mapped arrays.

    Attributes:
        path: the folder.
        info: pose counts and origin.
        rig: the recorded rig, with its own skin weights and all joints.
        pose_matrices: (N, J, 4, 4) float32, mesh-object space, mesh units.
        positions: (N, V, 3) float32, mesh-object space, mesh units. They may be not finite in `info.alone_poses`.
        controls: (N, C) float32, values of the controls of the rig, each in the unit of its property.
    """

    path: Path
    info: RecordingInfo
    rig: Rig
    pose_matrices: np.ndarray
    positions: np.ndarray
    controls: np.ndarray


def read_recording(path: Path) -> Recording:
    """Open a complete recording; the large arrays are memory maps.

    Raises:
        RecordingError: the recording is incomplete, truncated, or of another version, has values that are not numbers,
            or its files contradict each other.
    """
    recording = open_recording(path)
    poses = recording.info.poses
    if not poses:
        raise _incomplete_error(path, 0, 0)
    for name in STREAMED_ARRAY_NAMES:
        check_poses(path, name, getattr(recording, name), recording.info.alone_poses)
    if sum(source.poses for source in recording.info.sampling.sources) != poses:
        raise RecordingError(
            f"The index of '{path}' is damaged: its sources do not add up to its {poses} poses; record again."
        )
    return recording


def open_recording(path: Path) -> Recording:
    """Open a recording, possibly without poses, without reading its large arrays.

    Raises:
        RecordingError: as for `read_recording`, but the values of poses are not checked.
    """
    index = read_index(path)
    if index["complete"] < index["poses"]:
        raise _incomplete_error(path, index["complete"], index["poses"])
    arrays = {
        name: open_array(path / f"{name}.npy", *shape_and_dtype)
        for name, shape_and_dtype in _index_array_shapes(index).items()
    }
    joints = read_joints(index["joints"])
    rest_matrices, rest_positions = arrays["rest_matrices"], arrays["rest_positions"]
    is_valid = bool((np.abs(rest_matrices) <= MAX_VALUE).all()) and bool(are_invertible(rest_matrices).all())
    for start in range(0, len(rest_positions), CHECK_BLOCK_VERTICES):
        block = slice(start, start + CHECK_BLOCK_VERTICES)
        is_valid = is_valid and bool((np.abs(rest_positions[block]) <= MAX_VALUE).all())
        is_valid = is_valid and are_skin_weights(
            arrays["skin_joints"][block], arrays["skin_weights"][block], len(joints)
        )
    if not is_valid:
        raise RecordingError(f"The rest pose or skin weights of '{path}' are damaged; record again.")
    rig = Rig(
        joints,
        *(np.array(arrays[name]) for name in ("rest_positions", "rest_matrices", "skin_joints", "skin_weights")),
        read_meshes(index["meshes"]),
        *(np.array(arrays.get(name, np.zeros(0, np.int32))) for name in ("face_starts", "face_vertices")),
        read_controls(index["controls"]),
        read_unit(index),
    )
    if not are_faces(rig.face_starts, rig.face_vertices, rig.vertex_count):
        raise RecordingError(f"The faces of '{path}' are damaged; record again.")
    arrays.setdefault("controls", np.zeros((index["poses"], 0), np.float32))
    return Recording(path, read_info(index), rig, *(arrays[name] for name in STREAMED_ARRAY_NAMES))


def _incomplete_error(path: Path, complete: int, poses: int) -> RecordingError:
    return RecordingError(
        f"The recording '{path}' is incomplete: {complete} of {poses} poses; finish it with record --resume."
    )


def check_poses(path: Path, name: str, array: np.ndarray, alone_poses: range) -> None:
    """Check an array of poses with `find_invalid_pose`, which describes the arguments.

    Raises:
        RecordingError: a pose has invalid values.
    """
    invalid = find_invalid_pose(name, array, alone_poses)
    release_pages(array)
    if invalid is not None:
        pose, description = invalid
        raise RecordingError(f"The recording '{path}' holds {description} ({name}, pose {pose}); record again.")


def check_resumable(path: Path) -> None:
    """Check before a long job that a recording, complete or not, can be resumed.

    Raises:
        RecordingError: as for `read_recording`; only the complete poses are checked.
    """
    index = read_index(path)
    if not index["complete"]:
        return
    alone_poses = read_info(index).alone_poses
    for name, (shape, dtype) in _index_array_shapes(index).items():
        if name in STREAMED_ARRAY_NAMES:
            shape = (index["complete"], *shape[1:])
            check_poses(path, name, open_array(path / f"{name}.npy", shape, dtype), alone_poses)
        else:
            open_array(path / f"{name}.npy", shape, dtype)


def _index_array_shapes(index: dict) -> dict[str, tuple[tuple, type]]:
    return array_shapes(
        *(index["poses"], len(index["joints"]), sum(mesh["vertices"] for mesh in index["meshes"]), index["influences"]),
        *(index.get(key, 0) for key in ("faces", "corners")),
        len(index["controls"]),
    )
