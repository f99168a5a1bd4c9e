# SPDX-License-Identifier: GPL-3.0-or-later
"""Arrays of a recording: untrusted `.npy` files, which are checked before they are memory-mapped."""

import io
import math
import mmap
import os
import tokenize
from collections.abc import Sequence
from pathlib import Path
from typing import BinaryIO

import numpy as np

from ..errors import RecordingError, os_error_text
from ..files.input_file import open_input
from ..mathematics.skinning import are_invertible
from ..rig import Rig

NPY_HEADER_ERRORS = (TypeError, SyntaxError, RecursionError, MemoryError, tokenize.TokenError)
"""Errors that numpy raises for a damaged header of a `.npy` file, apart from ValueError."""
MAX_VALUE = 1e12
"""Largest absolute value of an element; sums of squares of larger values may overflow."""
CHECK_CHUNK_BYTES = 8 << 20
"""Size of the chunks in which arrays are checked for invalid values."""
POSE_MATRICES, POSITIONS = "pose_matrices", "positions"
SINGULAR_JOINTS = "joints that have shrunk to nothing"
_VALUE_CHECKS = {
    "values that are not numbers": np.isfinite,
    "values beyond all bounds": lambda values: np.abs(values) <= MAX_VALUE,
    SINGULAR_JOINTS: are_invertible,
}
"""Checks of pose arrays; the key describes the values that fail the check."""


def array_shapes(
    poses: int, joints: int, vertices: int, influences: int, faces: int = 0, corners: int = 0, controls: int = 0
) -> dict[str, tuple[tuple, type]]:
    """Return shape and dtype of each array of a recording, by name.

    Args:
        poses, joints, vertices: counts.
        influences: number of skin weights of a vertex.
        faces, corners: counts; without faces their arrays are left out.
        controls: count; without controls their array is left out.
    """
    control_arrays = {"controls": ((poses, controls), np.float32)}
    face_arrays = {"face_starts": ((faces,), np.int32), "face_vertices": ((corners,), np.int32)}
    return {
        "rest_positions": ((vertices, 3), np.float32),
        "rest_matrices": ((joints, 4, 4), np.float32),
        "skin_joints": ((vertices, influences), np.int32),
        "skin_weights": ((vertices, influences), np.float32),
        POSE_MATRICES: ((poses, joints, 4, 4), np.float32),
        POSITIONS: ((poses, vertices, 3), np.float32),
        **(control_arrays if controls else {}),
        **(face_arrays if faces else {}),
    }


def rig_array_shapes(rig: Rig, poses: int) -> dict[str, tuple[tuple, type]]:
    """Return shape and dtype of each array of a recording of a rig, by name."""
    return array_shapes(
        *(poses, len(rig.joints), rig.vertex_count, rig.skin_joints.shape[1]),
        *(len(rig.face_starts), len(rig.face_vertices), len(rig.controls)),
    )


ARRAY_NAMES = tuple(array_shapes(1, 1, 1, 1, faces=1, corners=1, controls=1))
"""Names of all arrays of a recording."""
STREAMED_ARRAY_NAMES = (POSE_MATRICES, POSITIONS, "controls")
"""Names of the arrays with one row per pose."""


def open_array(path: Path, shape: tuple, dtype: type) -> np.ndarray:
    """Memory-map an array after its header and size are checked against the index.

    Args:
        shape, dtype: expected shape and dtype; arrays in `STREAMED_ARRAY_NAMES` may have more rows.

    Raises:
        RecordingError: the file is missing, not a regular file, or truncated, or has another shape or dtype.
    """
    try:
        with open_input(path, follow_links=False) as file:
            file_shape, file_dtype = read_array_header(file)
            # The arrays of an interrupted recording or extension have more poses than the index counts as complete.
            may_be_longer = (
                path.stem in STREAMED_ARRAY_NAMES and file_shape[:1] > shape[:1] and file_shape[1:] == shape[1:]
            )
            if not (file_shape == shape or may_be_longer) or file_dtype != np.dtype(dtype):
                raise ValueError(f"it holds {file_shape} {file_dtype}, not {shape} {np.dtype(dtype)}")
            data_start = file.tell()
            # Not numpy.prod: the counts are untrusted, and integers of numpy overflow.
            expected_bytes = data_start + math.prod(file_shape) * np.dtype(dtype).itemsize
            file_bytes = file.seek(0, os.SEEK_END)
            if file_bytes < expected_bytes:
                raise ValueError(f"it is truncated: {file_bytes} of {expected_bytes} bytes")
            return np.memmap(file, dtype, "r", data_start, shape)
    except OSError as error:
        raise RecordingError(f"'{path}' cannot be used: {os_error_text(error)}; record again.") from error
    except ValueError as error:
        raise RecordingError(f"'{path}' cannot be used: {error}; record again.") from error
    except NPY_HEADER_ERRORS as error:
        raise RecordingError(f"'{path}' cannot be used: its header is damaged; record again.") from error


def release_pages(array: np.ndarray) -> None:
    """Release the memory of the parts of a memory-mapped array that were read; they can be read again."""
    # Windows has no such call.
    if isinstance(array.base, mmap.mmap) and hasattr(array.base, "madvise"):
        array.base.madvise(mmap.MADV_DONTNEED)


def read_array_header(file: BinaryIO) -> tuple[tuple[int, ...], np.dtype]:
    """Read the header of a `.npy` file up to the first element; return shape and dtype.

    Raises:
        ValueError: the file has no such header, another version, or elements in Fortran order.
        NPY_HEADER_ERRORS: the header is damaged.
    """
    if np.lib.format.read_magic(file) != (1, 0):
        raise ValueError("its npy version is not 1.0")
    shape, is_fortran_order, dtype = np.lib.format.read_array_header_1_0(file)
    if is_fortran_order:
        raise ValueError("its elements are in another order")
    return shape, dtype


def find_invalid_pose(name: str, array: np.ndarray, alone_poses: range = range(0)) -> tuple[int, str] | None:
    """Find the first pose with values that cannot be trained on.

    Args:
        name: name of the array.
        array: (n, ...) values of n poses.
        alone_poses: indices of the poses in which one input moves alone; a rig may have no positions there.

    Returns:
        The index of the pose and a description of its values; None where all poses are valid.
    """
    chunk_poses = max(1, CHECK_CHUNK_BYTES // max(1, array[:1].nbytes))
    for start in range(0, len(array), chunk_poses):
        chunk = np.asarray(array[start : start + chunk_poses])
        for description, check in _VALUE_CHECKS.items():
            if description != SINGULAR_JOINTS or name == POSE_MATRICES:
                is_valid = check(chunk)
                if is_valid.all():
                    continue
                invalid = start + np.flatnonzero(~is_valid.reshape(len(chunk), -1).all(axis=1))
                if name == POSITIONS:
                    invalid = invalid[(invalid < alone_poses.start) | (invalid >= alone_poses.stop)]
                if len(invalid):
                    return int(invalid[0]), description
    return None


def check_pose_values(
    arrays: dict[str, np.ndarray], first_pose: int, joint_names: Sequence[str], alone_poses: range = range(0)
) -> None:
    """Check arrays of poses with `find_invalid_pose`.

    Args:
        first_pose: index of the first pose of the arrays.
        joint_names: names of the joints.
        alone_poses: indices of the poses in which one input moves alone.

    Raises:
        RecordingError: a pose has invalid values.
    """
    for name, array in arrays.items():
        alone = range(alone_poses.start - first_pose, alone_poses.stop - first_pose)
        if (invalid := find_invalid_pose(name, array, alone)) is not None:
            pose, description = invalid
            if description == SINGULAR_JOINTS:
                joint = int(are_invertible(array[pose]).argmin())
                raise RecordingError(
                    f"The bone '{joint_names[joint]}' has a scale of zero in pose {first_pose + pose}; look for the "
                    "key, constraint or driver that sets it."
                )
            raise RecordingError(
                f"Pose {first_pose + pose} of the rig evaluates to {description} ({name}); look for a scale of zero "
                "or a broken driver."
            )


def array_header(shape: tuple, dtype: type) -> bytes:
    """Return the header of a `.npy` file of version 1.0; its length is the same for any number of rows."""
    header = io.BytesIO()
    np.lib.format.write_array_header_1_0(header, {"descr": np.dtype(dtype).str, "fortran_order": False, "shape": shape})
    return header.getvalue()
