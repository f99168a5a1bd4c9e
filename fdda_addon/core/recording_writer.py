# SPDX-License-Identifier: GPL-3.0-or-later
"""Writes a recording (docs/recording.md) so that an interruption at any moment leaves one that resumes."""

import contextlib
import io
import json
import math
import os
from dataclasses import asdict, replace
from pathlib import Path

import numpy as np

from .errors import OutputError, RecordingError
from .output import write_json
from .partition import Partition
from .recording import STREAMED, array_shapes, partitions_json, streamed_arrays
from .recording_index import FORMAT, INDEX, VERSION, RecordingInfo, read_index
from .recording_lock import LOCK, RecordingLock
from .rig import Rig
from .unit import read_unit, unit_json


class RecordingWriter:
    """Writes a recording pose by pose; use as a context manager.

    Every `append` first brings the arrays to the disk, then the count of complete poses: an interruption at any
    moment leaves a recording that resumes and holds no torn pose. Plain writes, not memory maps: a full disk is then
    an error that can be reported. A new recording that fails before its first pose is complete leaves nothing.
    """

    def __init__(
        self, path: Path, rig: Rig, partitions: tuple[Partition, ...], info: RecordingInfo, resume: bool = False
    ):
        """Start or resume a recording.

        Args:
            path: the folder; created when missing.
            rig, partitions: what is recorded.
            info: `complete` is ignored.
            resume: continue the recording at `path` where it stopped.

        Raises:
            RecordingError: there is a recording already and `resume` is not set, it is of something else, or another
                process writes it.
            OutputError: the folder cannot be written.
        """
        self.path, self.rig, self.partitions, self.info = path, rig, partitions, info
        self.complete = 0
        self._faces, self._corners = len(rig.face_starts), len(rig.face_vertices)
        self._files: dict[str, io.BufferedRandom] = {}
        self._is_new = not os.path.exists(path / INDEX)
        self._new_folders = [folder for folder in (path, *path.parents) if not os.path.exists(folder)]
        if self._is_new and os.path.exists(path) and (not os.path.isdir(path) or {*os.listdir(path)} - {LOCK}):
            raise OutputError(f"Cannot record into '{path}': it is not an empty folder; choose another.")
        self._lock = RecordingLock(path)
        try:
            path.mkdir(parents=True, exist_ok=True)
            self._lock.acquire()
            if not self._is_new:
                if not resume:
                    raise RecordingError(
                        f"'{path}' holds a recording already; continue it with --resume or choose another folder."
                    )
                self.complete = self._check_resumable()
            # The index first: a folder with arrays and no index could be neither resumed nor recorded into.
            self._write_index()
            self._open_arrays()
        except BaseException as error:
            self._close()
            self._remove_if_empty()
            self._lock.release()
            if isinstance(error, OSError):
                raise self._failed(error) from error
            raise

    def _check_resumable(self) -> int:
        """How many poses of the recording at `path` are complete, once it is sure that it is one of this rig."""
        previous = read_index(self.path)
        # A recording of a version that did not write the faces stays without them.
        if "faces" not in previous:
            self._faces = self._corners = 0
        # The scale of an object may be animated; no array depends on it.
        self.rig = replace(self.rig, metres_per_unit=read_unit(previous))
        own = self._index()
        if different := [key for key in different_keys(previous, own) if key != "complete"]:
            raise RecordingError(
                f"Cannot resume '{self.path}': it was recorded with another {', '.join(different)}; "
                "record with the same rig and options, or into another folder."
            )
        return previous["complete"]

    def _open_arrays(self) -> None:
        rig = self.rig
        shapes = array_shapes(
            *(self.info.poses, len(rig.joints), rig.vertex_count, rig.skin_joints.shape[1]),
            *(self._faces, self._corners),
            len(rig.controls),
        )
        for name, (shape, dtype) in shapes.items():
            path = self.path / f"{name}.npy"
            if name not in STREAMED:
                if not self.complete:
                    np.save(path, getattr(self.rig, name).astype(dtype), allow_pickle=False)
                continue
            header = array_header(shape, dtype)
            row = math.prod(shape[1:]) * np.dtype(dtype).itemsize
            end = len(header) + self.complete * row
            if self.complete:
                self._check_array(path, header, end)
            self._files[name] = file = open(path, "r+b" if self.complete else "w+b")  # noqa: SIM115 - _close
            file.write(header)
            file.truncate(end)
            file.seek(0, os.SEEK_END)
            # Ask for the whole space at once: a disk that is too small shows now, not an hour later.
            if hasattr(os, "posix_fallocate"):
                os.posix_fallocate(file.fileno(), 0, len(header) + self.info.poses * row)

    def _check_array(self, path: Path, header: bytes, end: int) -> None:
        """Fail when an array lacks what the index calls complete; to fill it up with zeros would make poses up."""
        try:
            with open(path, "rb") as file:
                good = file.read(len(header)) == header and path.stat().st_size >= end
        except FileNotFoundError:
            good = False
        if not good:
            raise RecordingError(
                f"Cannot resume '{self.path}': '{path.name}' does not hold the {self.complete} poses that are said to "
                "be complete; remove the recording and record again."
            )

    def _index(self) -> dict:
        info = self.info
        return {
            "format": FORMAT,
            "version": VERSION,
            "poses": info.poses,
            "complete": self.complete,
            "vertices": self.rig.vertex_count,
            "influences": int(self.rig.skin_joints.shape[1]),
            **({"faces": self._faces, "corners": self._corners} if self._faces else {}),
            "units": {"length": "m", "angle": "rad"},
            **unit_json(self.rig.metres_per_unit),
            "blender": info.blender,
            "rig": {
                "file": info.rig_file,
                "object": info.object_name,
                "fingerprint": asdict(self.rig.fingerprint),
            },
            "joints": [asdict(joint) for joint in self.rig.joints],
            "controls": [control.to_json() for control in self.rig.controls],
            "partitions": partitions_json(self.partitions),
            **({"fit": info.fit.to_json()} if info.fit else {}),
            # Through JSON and back, so that it compares equal with what was read.
            "sampling": json.loads(json.dumps(info.sampling.to_json())),
        }

    def _write_index(self) -> None:
        write_json(self.path / INDEX, self._index())

    def append(self, pose_matrices: np.ndarray, residuals: np.ndarray, controls: np.ndarray | None = None) -> None:
        """Add poses.

        Args:
            pose_matrices: (n, J, 4, 4), mesh-object space, metres.
            residuals: (n, V, 3), local residuals, metres.
            controls: (n, C), where the rig has controls.

        Raises:
            OutputError: the disk is full or went away; the poses before stay complete.
            RecordingError: a value is not finite.
        """
        arrays = streamed_arrays(pose_matrices, residuals, controls, len(self.rig.controls))
        check_finite(arrays, self.complete)
        try:
            for name, array in arrays.items():
                self._files[name].write(np.ascontiguousarray(array, np.float32).data)
                self._files[name].flush()
                os.fsync(self._files[name].fileno())
        except OSError as error:
            raise self._failed(error) from error
        self.complete += len(pose_matrices)
        self._write_index()

    def _failed(self, error: OSError) -> OutputError:
        kept = f"{self.complete} of {self.info.poses} poses are complete, continue with --resume"
        return OutputError(
            f"Cannot write the recording '{self.path}': {error.strerror or error}; "
            f"{kept if self.complete else 'make room or choose another folder'}."
        )

    def __enter__(self) -> "RecordingWriter":
        return self

    def __exit__(self, kind: type | None, *_: object) -> None:
        self._close()
        if kind is not None:
            self._remove_if_empty()
        self._lock.release()

    def _close(self) -> None:
        for file in self._files.values():
            # On a full disk closing tries once more to write what `append` could not, and has reported.
            with contextlib.suppress(OSError):
                file.close()

    def _remove_if_empty(self) -> None:
        """Remove a new recording without a pose, and the folders that were made for it."""
        if not self._is_new or self.complete or not self._lock.is_held:
            return
        shapes = array_shapes(0, 0, 0, 0, 1, 0, 1)
        for path in (self.path / INDEX, *(self.path / f"{name}.npy" for name in shapes)):
            with contextlib.suppress(OSError):
                path.unlink()
        self._lock.release()
        for folder in self._new_folders:
            with contextlib.suppress(OSError):
                folder.rmdir()


def check_finite(arrays: dict[str, np.ndarray], first: int) -> None:
    """Fail when arrays of poses, by name, hold values that are not numbers; `first` is the number of their first pose.

    Raises:
        RecordingError: names the pose.
    """
    for name, array in arrays.items():
        if not np.isfinite(array).all():
            bad = int(np.flatnonzero(~np.isfinite(array).reshape(len(array), -1).all(axis=1))[0])
            raise RecordingError(
                f"Pose {first + bad} of the rig evaluates to values that are not numbers ({name}); "
                "look for a scale of zero or a broken driver."
            )


def array_header(shape: tuple, dtype: type) -> bytes:
    """First bytes of a `.npy` file of version 1.0; as long for any number of rows, so that rows can be added."""
    header = io.BytesIO()
    np.lib.format.write_array_header_1_0(header, {"descr": np.dtype(dtype).str, "fortran_order": False, "shape": shape})
    return header.getvalue()


def different_keys(first: dict, second: dict, prefix: str = "") -> list[str]:
    """Dotted names of the keys whose values differ between two dictionaries."""
    found = []
    for key in sorted(first.keys() | second.keys()):
        values = first.get(key), second.get(key)
        if all(isinstance(value, dict) for value in values):
            found += different_keys(*values, f"{prefix}{key}.")
        elif key not in first or key not in second or values[0] != values[1]:
            found.append(f"{prefix}{key}")
    return found
