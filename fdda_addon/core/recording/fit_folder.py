# SPDX-License-Identifier: GPL-3.0-or-later
"""Temporary folder of arrays in which `record` and the trainer exchange poses and fitted skin weights.

The arrays are untrusted and are checked when they are read.
"""

import math
import os
from collections.abc import Collection
from dataclasses import dataclass, replace
from pathlib import Path
from types import TracebackType

import numpy as np

from ..errors import OutputError, RecordingError, os_error_text
from ..files.input_file import open_input
from ..mathematics.skin_fit import INFLUENCES, are_skin_weights
from ..mathematics.skinning import are_invertible
from ..rig import Fingerprint, Joint, Rig
from .arrays import NPY_HEADER_ERRORS, array_header, check_pose_values, read_array_header

MIN_POSES = 10
"""Smallest number of poses of a fit, half of which are held out."""
ARRAY_SHAPES = {
    "pose_matrices": ("n", "J", 4, 4),
    "positions": ("n", "V", 3),
    "rest_matrices": ("J", 4, 4),
    "rest_positions": ("V", 3),
    "skin_joints": ("V", "I"),
    "skin_weights": ("V", "I"),
    "parents": ("J",),
    "is_dependency": ("J",),
    "is_sampled": ("J",),
    "controls": ("n", "C"),
}
"""Shapes of the arrays by name: n poses, J joints, V vertices, I skin weights per vertex, C controls; without controls
a column of zeros."""
INTEGER_ARRAYS = ("skin_joints", "parents", "is_dependency", "is_sampled")
STREAMED_ARRAY_NAMES = ("pose_matrices", "positions", "controls")
RIG_ARRAY_NAMES = ("rest_matrices", "rest_positions", "skin_joints", "skin_weights", "parents")


@dataclass(frozen=True)
class FitPoses:
    """Poses to which skin weights are fitted.

    Attributes:
        rig: the rig with its own skin weights; its joints have numbers for names.
        pose_matrices: (n, J, 4, 4) float32, mesh-object space, mesh units.
        positions: (n, V, 3) float32 positions that the rig evaluates, mesh-object space, mesh units; may be a
            memory map.
        controls: (n, C) float32 values of the controls; (n, 1) zeros without controls.
        is_dependency: (J,) bool, joints that move the mesh otherwise than by skin weights.
        is_sampled: (J,) bool, joints that random poses move by channels of their own.
    """

    rig: Rig
    pose_matrices: np.ndarray
    positions: np.ndarray
    controls: np.ndarray
    is_dependency: np.ndarray
    is_sampled: np.ndarray

    def subset(self, poses: slice) -> "FitPoses":
        """Return the poses of a slice."""
        arrays = self.pose_matrices, self.positions, self.controls
        return replace(self, **dict(zip(STREAMED_ARRAY_NAMES, (array[poses] for array in arrays), strict=True)))

    def with_joints(self, joints: np.ndarray) -> "FitPoses":
        """Return the poses of the joints with (K,) ascending indices; they have no parents, and their own weights."""
        indices = np.zeros(len(self.rig.joints), np.int32)
        indices[joints] = np.arange(len(joints))
        is_selected = np.isin(self.rig.skin_joints, joints)
        rig = replace(
            self.rig,
            joints=tuple(Joint(self.rig.joints[joint].name, -1) for joint in joints),
            rest_matrices=self.rig.rest_matrices[joints],
            skin_joints=np.where(is_selected, indices[self.rig.skin_joints], 0),
            skin_weights=np.where(is_selected, self.rig.skin_weights, 0),
        )
        matrices, roles = self.pose_matrices[:, joints], (self.is_dependency[joints], self.is_sampled[joints])
        return FitPoses(rig, matrices, self.positions, self.controls, *roles)


class FitPosesWriter:
    """Context manager that writes a fixed number of poses into a folder, one by one."""

    def __init__(
        self, folder: Path, rig: Rig, count: int, dependencies: Collection[str] = (), sampled: Collection[str] = ()
    ):
        """Args:
            folder: an empty folder.
            rig: the rig with its own skin weights.
            count: number of poses that will be appended.
            dependencies, sampled: names of joints for `FitPoses.is_dependency` and `FitPoses.is_sampled`.

        Raises:
            OutputError: the folder cannot be written.
        """
        self._folder, self._appended_count = folder, 0
        self._shapes = {
            "pose_matrices": (len(rig.joints), 4, 4),
            "positions": (rig.vertex_count, 3),
            "controls": (max(1, len(rig.controls)),),
        }
        self._files = {}
        try:
            arrays = {name: getattr(rig, name) for name in RIG_ARRAY_NAMES}
            for array_name, names in (("is_dependency", dependencies), ("is_sampled", sampled)):
                arrays[array_name] = np.array([name in names for name in rig.joint_names])
            for name, array in arrays.items():
                np.save(folder / f"{name}.npy", array.astype(_array_dtype(name)), allow_pickle=False)
            for name, shape in self._shapes.items():
                self._files[name] = open(folder / f"{name}.npy", "wb")  # noqa: SIM115 - __exit__
                self._files[name].write(array_header((count, *shape), np.float32))
        except OSError as error:
            self.close()
            raise self._write_error(error) from error

    def append(self, pose_matrices: np.ndarray, positions: np.ndarray, controls: np.ndarray | None = None) -> None:
        """Append a pose: (J, 4, 4) pose matrices, (V, 3) positions and (C,) values of controls, as in `FitPoses`.

        Raises:
            OutputError: the disk is full.
            RecordingError: a value is not finite.
        """
        if controls is None or not len(controls):
            controls = np.zeros(1, np.float32)
        arrays = {"pose_matrices": pose_matrices[None], "positions": positions[None], "controls": controls[None]}
        check_pose_values(arrays, self._appended_count)
        self._appended_count += 1
        try:
            for name, array in arrays.items():
                self._files[name].write(np.ascontiguousarray(array, np.float32).data)
        except OSError as error:
            raise self._write_error(error) from error

    def _write_error(self, error: OSError) -> OutputError:
        return OutputError(
            f"Cannot write the poses to fit into '{self._folder}': {os_error_text(error)}; make room there."
        )

    def close(self) -> None:
        """Close the files.

        Raises:
            OSError: the disk is full.
        """
        for file in self._files.values():
            file.close()

    def __enter__(self) -> "FitPosesWriter":
        return self

    def __exit__(self, kind: type | None, _error: BaseException | None, _trace: TracebackType | None) -> None:
        try:
            self.close()
        except OSError as error:
            if kind is None:
                raise self._write_error(error) from error


def read_fit_poses(folder: Path) -> FitPoses:
    """Read the poses that `FitPosesWriter` wrote; the positions are a memory map.

    Raises:
        RecordingError: an array is missing, damaged, or contradicts the others.
    """
    arrays = {
        name: _read_array(folder / f"{name}.npy", len(shape), _array_dtype(name))
        for name, shape in ARRAY_SHAPES.items()
    }
    sizes: dict[str, int] = {}
    for name, shape in ARRAY_SHAPES.items():
        for dimension, array_size in zip(shape, arrays[name].shape, strict=True):
            size = sizes.setdefault(dimension, array_size) if isinstance(dimension, str) else dimension
            if array_size != size or not array_size:
                raise _damaged_error(folder, f"{name} has the shape {arrays[name].shape}")
    if sizes["n"] < MIN_POSES:
        raise _damaged_error(folder, f"they are {sizes['n']}, and a fit takes {MIN_POSES}")
    for name in ARRAY_SHAPES.keys() - {"positions"}:
        arrays[name] = np.array(arrays[name])
    for name, array in arrays.items():
        if not all(np.isfinite(row).all() for row in array):
            raise _damaged_error(folder, f"{name} holds values that are not numbers")
    parents, joints, weights = arrays["parents"], arrays["skin_joints"], arrays["skin_weights"]
    if (parents < -1).any() or (parents >= np.arange(sizes["J"])).any():
        raise _damaged_error(folder, "a joint comes before its parent")
    if joints.min() < 0 or joints.max() >= sizes["J"] or weights.min() < 0:
        raise _damaged_error(folder, "the skin weights name no joints")
    if not are_invertible(arrays["rest_matrices"]).all():
        raise _damaged_error(folder, "a rest matrix is singular")
    rig = Rig(
        tuple(Joint(str(index), int(parent)) for index, parent in enumerate(parents)),
        *(arrays[name] for name in ("rest_positions", "rest_matrices", "skin_joints", "skin_weights")),
        Fingerprint("", "", ""),
    )
    roles = (np.array(arrays[name], bool) for name in ("is_dependency", "is_sampled"))
    return FitPoses(rig, *(arrays[name] for name in STREAMED_ARRAY_NAMES), *roles)


def write_fitted_weights(folder: Path, joints: np.ndarray, weights: np.ndarray) -> None:
    """Write fitted skin weights: (V, 4) int32 joints and (V, 4) float32 weights.

    Raises:
        OutputError: the folder cannot be written.
    """
    try:
        np.save(folder / "fitted_joints.npy", joints, allow_pickle=False)
        np.save(folder / "fitted_weights.npy", weights, allow_pickle=False)
    except OSError as error:
        raise OutputError(f"Cannot write the fitted weights into '{folder}': {os_error_text(error)}.") from error


def read_fitted_weights(folder: Path, rig: Rig) -> tuple[np.ndarray, np.ndarray]:
    """Read fitted skin weights: (V, 4) int32 joints and (V, 4) float32 weights, each row summing to 1.

    Raises:
        RecordingError: the weights are missing, damaged, or of another rig.
    """
    joints, weights = (
        np.array(_read_array(folder / f"fitted_{name}.npy", 2, dtype))
        for name, dtype in (("joints", np.int32), ("weights", np.float32))
    )
    if not joints.shape == weights.shape == (rig.vertex_count, INFLUENCES):
        raise _damaged_error(folder, f"the fitted weights have the shapes {joints.shape} and {weights.shape}")
    if not are_skin_weights(joints, weights, len(rig.joints)):
        raise _damaged_error(folder, "the fitted weights are no weights")
    return joints, weights


def write_key_joints(folder: Path, joints: np.ndarray, needed_inputs: np.ndarray) -> None:
    """Write key joints: their (K,) indices, and the (V, K + C) bool key joints and controls that each vertex needs.

    Raises:
        OutputError: the folder cannot be written.
    """
    try:
        np.save(folder / "key_joints.npy", joints.astype(np.int32), allow_pickle=False)
        np.save(folder / "needed_inputs.npy", needed_inputs.astype(np.int32), allow_pickle=False)
    except OSError as error:
        raise OutputError(f"Cannot write the key joints into '{folder}': {os_error_text(error)}.") from error


def read_key_joints(folder: Path, rig: Rig) -> tuple[np.ndarray, np.ndarray]:
    """Read the arrays of `write_key_joints` of a rig with V vertices, J joints and C controls.

    Raises:
        RecordingError: the arrays are missing, damaged, or of another rig.
    """
    joints = np.array(_read_array(folder / "key_joints.npy", 1, np.int32))
    needed_inputs = np.array(_read_array(folder / "needed_inputs.npy", 2, np.int32), bool)
    if not len(joints) or (np.diff(joints) <= 0).any() or joints[0] < 0 or joints[-1] >= len(rig.joints):
        raise _damaged_error(folder, "the key joints are no joints")
    # Without controls, the poses have a column of zeros.
    if needed_inputs.shape != (rig.vertex_count, len(joints) + max(1, len(rig.controls))):
        raise _damaged_error(folder, f"the inputs of the vertices have the shape {needed_inputs.shape}")
    return joints, needed_inputs[:, : len(joints) + len(rig.controls)]


def _array_dtype(name: str) -> type:
    return np.int32 if name in INTEGER_ARRAYS else np.float32


def _read_array(path: Path, dimensions: int, dtype: type) -> np.ndarray:
    """Memory-map an array after its header and size are checked."""
    try:
        with open_input(path, follow_links=False) as file:
            shape, file_dtype = read_array_header(file)
            if len(shape) != dimensions or file_dtype != np.dtype(dtype):
                raise _damaged_error(path.parent, f"'{path.name}' holds something else")
            data_start = file.tell()
            # Otherwise Windows reports full memory when more is mapped than the file has.
            if min(shape) < 1 or file.seek(0, os.SEEK_END) < data_start + math.prod(shape) * file_dtype.itemsize:
                raise ValueError("empty or truncated")
            return np.memmap(file, dtype, "r", data_start, shape)
    except OSError as error:
        raise _damaged_error(path.parent, f"'{path.name}' cannot be read ({os_error_text(error)})") from error
    except (ValueError, *NPY_HEADER_ERRORS) as error:
        raise _damaged_error(path.parent, f"'{path.name}' is no array, or truncated") from error


def _damaged_error(folder: Path, reason: str) -> RecordingError:
    return RecordingError(f"The poses in '{folder}' cannot be fitted: {reason}; record again.")
