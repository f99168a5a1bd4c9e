# SPDX-License-Identifier: GPL-3.0-or-later
"""Writes a recording (docs/formats.md) so that an interruption at any moment leaves one that resumes."""

import contextlib
import io
import json
import math
import os
from collections.abc import Sequence
from dataclasses import asdict, replace
from pathlib import Path

import numpy as np

from ..errors import OutputError, RecordingError, os_error_text
from ..input_file import open_input
from ..open_files import remove_file
from ..output import atomic_write, to_json_text
from ..partition import Partition
from ..rig import Rig, rest_matrices_match
from ..unit import read_unit, unit_to_json
from .arrays import ARRAYS, STREAMED, array_shapes, bad_pose, open_array, streamed_arrays
from .index import FORMAT, INDEX, VERSION, RecordingInfo, read_index
from .lock import RecordingLock
from .place import check_place, remove_files, remove_left_over
from .reader import check_poses, partitions_json
from .target import Repeatability

GROWS = ("complete", "unsettled", "repeatability")
"""Keys of the index that change while poses are added."""


class RecordingWriter:
    """Writes a recording pose by pose; use as a context manager.

    Every `append` first brings the arrays to the disk, then the count of complete poses: an interruption at any
    moment leaves a recording that resumes and holds no torn pose. Plain writes, not memory maps: a full disk is then
    an error that can be reported. A new recording that fails before its first pose is complete leaves nothing.
    """

    def __init__(
        self,
        path: Path,
        rig: Rig,
        partitions: tuple[Partition, ...],
        info: RecordingInfo,
        resume: bool = False,
        overwrite: bool = False,
    ):
        """Start or resume a recording.

        Args:
            path: the folder; created when missing.
            rig, partitions: what is recorded.
            info: `complete` is ignored.
            resume: continue the recording at `path` where it stopped.
            overwrite: remove the recording at `path`.

        Raises:
            RecordingError: there is a recording already and neither is set, it is of something else, or another
                process writes it.
            OutputError: the folder cannot be written.
        """
        self.path, self.rig, self.partitions, self.info = path, rig, partitions, info
        self.complete = 0
        self.unsettled: list[int] = []
        self.repeatability: Repeatability | None = None
        self._faces, self._corners = len(rig.face_starts), len(rig.face_vertices)
        self._files: dict[str, io.BufferedRandom] = {}
        self._is_new = False
        self._new_folders = [folder for folder in (path, *path.parents) if not os.path.exists(folder)]
        check_place(path, resume, overwrite)
        self._lock = RecordingLock(path)
        try:
            path.mkdir(parents=True, exist_ok=True)
            self._lock.acquire()
            # Once more: before it was locked, another process may have recorded.
            check_place(path, resume, overwrite)
            if overwrite:
                remove_files(path)
            self._is_new = not os.path.exists(path / INDEX)
            remove_left_over(path)
            if not self._is_new:
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
        if different := [key for key in different_keys(previous, own) if key.partition(".")[0] not in GROWS]:
            raise RecordingError(
                f"Cannot resume '{self.path}': it was recorded differently ({', '.join(different)}); "
                "record with the same rig and options, or into another folder."
            )
        self.unsettled = list(previous.get("unsettled", ()))
        if "repeatability" in previous:
            self.repeatability = Repeatability.from_json(previous["repeatability"], previous["complete"])
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
            if not self.complete:
                # Not written through what might be a link.
                remove_file(path)
            if name not in STREAMED:
                array = getattr(self.rig, name).astype(dtype)
                if not self.complete:
                    np.save(path, array, allow_pickle=False)
                elif not self._is_own(name, open_array(path, shape, dtype), array):
                    raise RecordingError(
                        f"Cannot resume '{self.path}': '{path.name}' is not of this rig; remove the recording and "
                        "record again."
                    )
                continue
            header = array_header(shape, dtype)
            row = math.prod(shape[1:]) * np.dtype(dtype).itemsize
            end = len(header) + self.complete * row
            if self.complete:
                self._check_array(path, header, end)
                check_poses(self.path, name, open_array(path, shape, dtype, self.complete))
            self._files[name] = file = open_input(path, "r+b" if self.complete else "x+b", follow=False)
            file.write(header)
            file.truncate(end)
            file.seek(0, os.SEEK_END)
            # Ask for the whole space at once: a disk that is too small shows now, not an hour later.
            if hasattr(os, "posix_fallocate"):
                os.posix_fallocate(file.fileno(), 0, len(header) + self.info.poses * row)

    def _is_own(self, name: str, found: np.ndarray, own: np.ndarray) -> bool:
        """Whether an array that does not grow is that of the rig."""
        return rest_matrices_match(found, self.rig) if name == "rest_matrices" else np.array_equal(found, own)

    def _check_array(self, path: Path, header: bytes, end: int) -> None:
        """Fail when an array lacks what the index calls complete; to fill it up with zeros would make poses up."""
        try:
            with open_input(path, follow=False) as file:
                good = file.read(len(header)) == header and file.seek(0, os.SEEK_END) >= end
        except OSError:
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
            **({"shard": info.shard.to_json()} if info.shard else {}),
            "vertices": self.rig.vertex_count,
            "influences": int(self.rig.skin_joints.shape[1]),
            **({"faces": self._faces, "corners": self._corners} if self._faces else {}),
            "units": {"length": "m", "angle": "rad"},
            **unit_to_json(self.rig.metres_per_unit),
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
            **({"target": info.target.to_json()} if info.target else {}),
            **({"unsettled": list(self.unsettled)} if self.unsettled else {}),
            **({"repeatability": self.repeatability.to_json()} if self.repeatability else {}),
            # Through JSON and back, so that it compares equal with what was read.
            "sampling": json.loads(json.dumps(info.sampling.to_json())),
        }

    def _write_index(self) -> None:
        """Raises OSError, as all that `_failed` is for."""
        write_index(self.path, self._index())

    def append(
        self,
        pose_matrices: np.ndarray,
        residuals: np.ndarray,
        controls: np.ndarray | None = None,
        unsettled: Sequence[int] = (),
    ) -> None:
        """Add poses.

        Args:
            pose_matrices: (n, J, 4, 4), mesh-object space, mesh units.
            residuals: (n, V, 3), local residuals, mesh units.
            controls: (n, C), where the rig has controls.
            unsettled: which of them did not come to rest, counted from 0.

        Raises:
            OutputError: the disk is full or went away; the poses before stay complete.
            RecordingError: a value is not finite.
        """
        arrays = streamed_arrays(pose_matrices, residuals, controls, len(self.rig.controls))
        check_finite(arrays, self.complete)
        before = self.complete, self.unsettled
        try:
            for name, array in arrays.items():
                self._files[name].write(np.ascontiguousarray(array, np.float32).data)
                self._files[name].flush()
                os.fsync(self._files[name].fileno())
            self.unsettled = [*self.unsettled, *(self.complete + number for number in unsettled)]
            self.complete += len(pose_matrices)
            self._write_index()
        except OSError as error:
            self.complete, self.unsettled = before
            raise self._failed(error) from error

    def set_repeatability(self, repeatability: Repeatability) -> None:
        """Write what poses that were approached twice came to.

        Raises:
            OutputError: the disk is full or went away.
        """
        self.repeatability = repeatability
        try:
            self._write_index()
        except OSError as error:
            raise self._failed(error) from error

    def _failed(self, error: OSError) -> OutputError:
        kept = f"{self.complete} of {self.info.poses} poses are complete, continue with --resume"
        return OutputError(
            f"Cannot write the recording '{self.path}': {os_error_text(error)}; "
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
        for path in (self.path / INDEX, *(self.path / f"{name}.npy" for name in ARRAYS)):
            with contextlib.suppress(OSError):
                remove_file(path)
        self._lock.release()
        for folder in self._new_folders:
            with contextlib.suppress(OSError):
                folder.rmdir()


def write_index(path: Path, index: dict) -> None:
    """Replace the index of a recording.

    Raises:
        OSError: it cannot be written.
    """
    try:
        with atomic_write(path / INDEX, keep=False) as temporary:
            temporary.write_text(to_json_text(index), encoding="utf-8")
    except OutputError as error:
        raise error.__cause__ from None


def check_finite(arrays: dict[str, np.ndarray], first: int) -> None:
    """Fail when arrays of poses, by name, hold what `bad_pose` finds; `first` is the number of their first pose.

    Raises:
        RecordingError: names the pose.
    """
    for name, array in arrays.items():
        if (bad := bad_pose(name, array)) is not None:
            pose, words = bad
            raise RecordingError(
                f"Pose {first + pose} of the rig evaluates to {words} ({name}); look for a scale of zero or a broken "
                "driver."
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
