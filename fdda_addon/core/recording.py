# SPDX-License-Identifier: GPL-3.0-or-later
"""The recording: a folder of poses and local residuals. docs/recording.md describes the format.

`recording.json` says how many poses are complete: an array file may be longer than that, and what lies behind it is
never read. `recording_writer` writes it.
"""

import math
import tokenize
from dataclasses import dataclass
from pathlib import Path

import numpy as np

from .controls import read_controls
from .errors import RecordingError
from .partition import Partition, make_partitions
from .recording_index import INDEX, REFINED, RecordingInfo, Sampling, Source, read_index, read_info
from .rig import Fingerprint, Joint, Rig
from .skin_fit import are_skin_weights
from .surface import are_faces
from .unit import read_unit

__all__ = [
    "INDEX",
    "REFINED",
    "STREAMED",
    "Recording",
    "RecordingInfo",
    "Sampling",
    "Source",
    "array_shapes",
    "partitions_json",
    "read_index",
    "read_info",
    "read_partitions",
    "read_recorded_skin",
    "read_recording",
    "streamed_arrays",
]

CHECK_BYTES = 64 << 20
"""Recordings are searched for NaN in pieces of this size."""


@dataclass(frozen=True)
class Recording:
    """A complete recording, its large arrays mapped from disk.

    Attributes:
        path: the folder.
        info: counts and where it came from.
        rig: the rig it was made of.
        partitions: with their influencing joints.
        pose_matrices: (N, J, 4, 4) float32, mesh-object space, metres.
        residuals: (N, V, 3) float32, local residuals, metres.
        controls: (N, C) float32, values of the controls of the rig, each in the unit of its property.
    """

    path: Path
    info: RecordingInfo
    rig: Rig
    partitions: tuple[Partition, ...]
    pose_matrices: np.ndarray
    residuals: np.ndarray
    controls: np.ndarray


def array_shapes(
    poses: int, joints: int, vertices: int, influences: int, faces: int = 0, corners: int = 0, controls: int = 0
) -> dict[str, tuple[tuple, type]]:
    """Shape and dtype of each array of a recording, by name.

    Args:
        poses, joints, vertices: how many.
        influences: I of the skin weights.
        faces, corners: how many; without faces there are no arrays of them.
        controls: how many; without any there is no array of them.
    """
    of_controls = {"controls": ((poses, controls), np.float32)}
    of_faces = {"face_starts": ((faces,), np.int32), "face_vertices": ((corners,), np.int32)}
    return {
        "rest_positions": ((vertices, 3), np.float32),
        "rest_matrices": ((joints, 4, 4), np.float32),
        "skin_joints": ((vertices, influences), np.int32),
        "skin_weights": ((vertices, influences), np.float32),
        "pose_matrices": ((poses, joints, 4, 4), np.float32),
        "residuals": ((poses, vertices, 3), np.float32),
        **(of_controls if controls else {}),
        **(of_faces if faces else {}),
    }


STREAMED = ("pose_matrices", "residuals", "controls")
"""The arrays that grow with the poses."""


def streamed_arrays(
    pose_matrices: np.ndarray, residuals: np.ndarray, controls: np.ndarray | None, count: int
) -> dict[str, np.ndarray]:
    """The arrays that poses are added to, by name; `count` is C, without controls there is no array of them."""
    of_controls = {"controls": controls} if count else {}
    return {"pose_matrices": pose_matrices, "residuals": residuals, **of_controls}


HEADER_ERRORS = (TypeError, SyntaxError, RecursionError, MemoryError, tokenize.TokenError)
"""What numpy raises beside ValueError for a damaged header of an array, which is the text of a Python dictionary."""


def read_recording(path: Path) -> Recording:
    """Open a complete recording; the large arrays are memory maps.

    Raises:
        RecordingError: it is incomplete, truncated, of another version, holds values that are not numbers, or its
            files contradict each other.
    """
    index = read_index(path)
    if index["complete"] < index["poses"] or not index["poses"]:
        raise RecordingError(
            f"The recording '{path}' is incomplete: {index['complete']} of {index['poses']} poses; "
            "finish it with record --resume."
        )
    shapes = array_shapes(
        *(index["poses"], len(index["joints"]), index["vertices"], index["influences"]),
        *(index.get(key, 0) for key in ("faces", "corners")),
        len(index["controls"]),
    )
    arrays = {name: _open_array(path / f"{name}.npy", *what) for name, what in shapes.items()}
    joints = tuple(Joint(joint["name"], joint["parent"]) for joint in index["joints"])
    rig = Rig(
        joints,
        *(np.array(arrays[name]) for name in ("rest_positions", "rest_matrices", "skin_joints", "skin_weights")),
        Fingerprint(**index["rig"]["fingerprint"]),
        *(np.array(arrays.get(name, np.zeros(0, np.int32))) for name in ("face_starts", "face_vertices")),
        read_controls(index["controls"]),
        read_unit(index),
    )
    _check_skin(path, rig)
    if not are_faces(rig.face_starts, rig.face_vertices, rig.vertex_count):
        raise RecordingError(f"The faces of '{path}' are damaged; record again.")
    arrays.setdefault("controls", np.zeros((index["poses"], 0), np.float32))
    for name in STREAMED:
        _check_finite(path, name, arrays[name])
    partitions = read_partitions(rig, index["partitions"])
    if [p.joint for p in partitions] != [p["joint"] for p in index["partitions"]]:
        raise RecordingError(f"The partitions of '{path}' contradict its skin weights; record again.")
    info = read_info(index)
    if sum(source.poses for source in info.sampling.sources) != index["poses"]:
        raise RecordingError(
            f"The index of '{path}' is damaged: its sources do not add up to its {index['poses']} poses; record again."
        )
    return Recording(path, info, rig, partitions, *(arrays[name] for name in STREAMED))


def read_recorded_skin(path: Path, index: dict) -> tuple[np.ndarray, np.ndarray]:
    """The skin weights of a recording, complete or not; `index` is what `read_index` gave.

    Returns:
        (V, I) int32 joints and (V, I) float32 weights.

    Raises:
        RecordingError: they are missing or damaged.
    """
    shape = index["vertices"], index["influences"]
    joints, weights = (
        np.array(_open_array(path / f"{name}.npy", shape, dtype))
        for name, dtype in (("skin_joints", np.int32), ("skin_weights", np.float32))
    )
    if not are_skin_weights(joints, weights, len(index["joints"])):
        raise RecordingError(f"The skin weights of '{path}' are damaged; record again.")
    return joints, weights


def partitions_json(partitions: tuple[Partition, ...]) -> list[dict]:
    """Partitions as `recording.json` has them."""
    return [
        {
            "joint": partition.joint,
            "influencing": list(partition.influencing),
            **({"controls": list(partition.controls)} if partition.controls else {}),
            **({"merged": list(partition.merged)} if partition.merged else {}),
        }
        for partition in partitions
    ]


def read_partitions(rig: Rig, values: list[dict]) -> tuple[Partition, ...]:
    """The partitions of a rig with what `partitions_json` says of them."""
    return make_partitions(
        rig,
        {value["joint"]: tuple(value["influencing"]) for value in values},
        {value["joint"]: tuple(value.get("controls", ())) for value in values},
        {joint: value["joint"] for value in values for joint in value.get("merged", ())},
    )


def _open_array(path: Path, shape: tuple, dtype: type) -> np.ndarray:
    """Map an array after its size has been checked against what the index says."""
    try:
        with open(path, "rb") as file:
            if np.lib.format.read_magic(file) != (1, 0):
                raise ValueError("its npy version is not 1.0")
            found_shape, fortran, found_dtype = np.lib.format.read_array_header_1_0(file)
            # More poses than the index counts are left by an extension that was interrupted.
            longer = path.stem in STREAMED and found_shape[:1] > shape[:1] and found_shape[1:] == shape[1:]
            if not (found_shape == shape or longer) or fortran or found_dtype != np.dtype(dtype):
                raise ValueError(f"it holds {found_shape} {found_dtype}, not {shape} {np.dtype(dtype)}")
            # math.prod: the counts may be anything, and those of numpy wrap around.
            expected = file.tell() + math.prod(found_shape) * np.dtype(dtype).itemsize
        if path.stat().st_size < expected:
            raise ValueError(f"it is truncated: {path.stat().st_size} of {expected} bytes")
        return np.load(path, mmap_mode="r", allow_pickle=False)[: shape[0]]
    except (OSError, ValueError) as error:
        raise RecordingError(f"'{path}' cannot be used: {error}; record again.") from error
    except HEADER_ERRORS as error:
        raise RecordingError(f"'{path}' cannot be used: its header is damaged; record again.") from error


def _check_finite(path: Path, name: str, array: np.ndarray) -> None:
    step = max(1, CHECK_BYTES // max(1, array[0].nbytes))
    for start in range(0, len(array), step):
        if not np.isfinite(array[start : start + step]).all():
            raise RecordingError(
                f"The recording '{path}' holds values that are not numbers ({name}, poses {start} to "
                f"{min(start + step, len(array)) - 1}); record again."
            )


def _check_skin(path: Path, rig: Rig) -> None:
    good = (
        np.isfinite(rig.rest_positions).all()
        and np.isfinite(rig.rest_matrices).all()
        and (np.abs(np.linalg.det(rig.rest_matrices.astype(np.float64))) > 1e-12).all()
        and are_skin_weights(rig.skin_joints, rig.skin_weights, len(rig.joints))
    )
    if not good:
        raise RecordingError(f"The rest pose or skin weights of '{path}' are damaged; record again.")
