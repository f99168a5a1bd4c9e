# SPDX-License-Identifier: GPL-3.0-or-later
"""The arrays of a recording: `.npy` files that may be from anyone, mapped from disk after they have been checked."""

import math
import os
import tokenize
from pathlib import Path
from typing import BinaryIO

import numpy as np

from ..errors import RecordingError, os_error_text
from ..input_file import open_input
from ..skinning import are_invertible

HEADER_ERRORS = (TypeError, SyntaxError, RecursionError, MemoryError, tokenize.TokenError)
"""What numpy raises beside ValueError for a damaged header of an array, which is the text of a Python dictionary."""
LARGEST = 1e12
"""What is larger than this, whatever its unit, overflows when it is squared and summed up."""
CHECK_BYTES = 64 << 20
"""Recordings are searched for NaN in pieces of this size."""
POSE_MATRICES = "pose_matrices"
SHRUNK = "joints that have shrunk to nothing"
_CHECKS = {
    "values that are not numbers": np.isfinite,
    "values beyond all bounds": lambda values: np.abs(values) <= LARGEST,
    SHRUNK: are_invertible,
}
"""What poses are searched for, in this order."""


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
        POSE_MATRICES: ((poses, joints, 4, 4), np.float32),
        "residuals": ((poses, vertices, 3), np.float32),
        **(of_controls if controls else {}),
        **(of_faces if faces else {}),
    }


ARRAYS = tuple(array_shapes(1, 1, 1, 1, faces=1, corners=1, controls=1))
"""Every array that a recording may have."""
STREAMED = (POSE_MATRICES, "residuals", "controls")
"""The arrays that grow with the poses."""


def streamed_arrays(
    pose_matrices: np.ndarray, residuals: np.ndarray, controls: np.ndarray | None, count: int
) -> dict[str, np.ndarray]:
    """The arrays that poses are added to, by name; `count` is C, without controls there is no array of them."""
    of_controls = {"controls": controls} if count else {}
    return {POSE_MATRICES: pose_matrices, "residuals": residuals, **of_controls}


def open_array(path: Path, shape: tuple, dtype: type, rows: int | None = None) -> np.ndarray:
    """Map an array after its size has been checked against what the index says.

    Args:
        path: the file.
        shape, dtype: what its header must say; arrays that grow may have more rows.
        rows: how many, one or more, must be there and are mapped; all of `shape` when left out.

    Raises:
        RecordingError: it is missing, not a regular file, truncated, or something else.
    """
    try:
        with open_input(path, follow=False) as file:
            found_shape, found_dtype = _read_header(file)
            # More poses than the index counts are left by an extension that was interrupted.
            longer = path.stem in STREAMED and found_shape[:1] > shape[:1] and found_shape[1:] == shape[1:]
            if not (found_shape == shape or longer) or found_dtype != np.dtype(dtype):
                raise ValueError(f"it holds {found_shape} {found_dtype}, not {shape} {np.dtype(dtype)}")
            start, mapped = file.tell(), shape if rows is None else (rows, *shape[1:])
            # math.prod: the counts may be anything, and those of numpy wrap around.
            expected = start + math.prod(found_shape if rows is None else mapped) * np.dtype(dtype).itemsize
            size = file.seek(0, os.SEEK_END)
            if size < expected:
                raise ValueError(f"it is truncated: {size} of {expected} bytes")
            return np.memmap(file, dtype, "r", start, mapped)
    except OSError as error:
        raise RecordingError(f"'{path}' cannot be used: {os_error_text(error)}; record again.") from error
    except ValueError as error:
        raise RecordingError(f"'{path}' cannot be used: {error}; record again.") from error
    except HEADER_ERRORS as error:
        raise RecordingError(f"'{path}' cannot be used: its header is damaged; record again.") from error


def _read_header(file: BinaryIO) -> tuple[tuple, np.dtype]:
    if np.lib.format.read_magic(file) != (1, 0):
        raise ValueError("its npy version is not 1.0")
    shape, fortran, dtype = np.lib.format.read_array_header_1_0(file)
    if fortran:
        raise ValueError("its elements are in another order")
    return shape, dtype


def bad_pose(name: str, array: np.ndarray) -> tuple[int, str] | None:
    """Where the first of some poses is that no training can use, and what it holds, words; None where there is none.

    Args:
        name: of the array.
        array: (n, ...) of n poses.
    """
    step = max(1, CHECK_BYTES // max(1, array[:1].nbytes))
    for start in range(0, len(array), step):
        part = np.asarray(array[start : start + step])
        for words, check in _CHECKS.items():
            if words != SHRUNK or name == POSE_MATRICES:
                good = check(part)
                if not good.all():
                    return start + int(np.flatnonzero(~good.reshape(len(part), -1).all(axis=1))[0]), words
    return None
