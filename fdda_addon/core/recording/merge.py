# SPDX-License-Identifier: GPL-3.0-or-later
"""Merging of the shards of a recording; the result has the same bytes as a recording made in one run."""

import math
from collections.abc import Iterator, Sequence
from dataclasses import replace
from pathlib import Path

import numpy as np

from ..errors import RecordingError
from ..output import check_folder_writable
from ..progress import Progress
from .arrays import STREAMED_ARRAY_NAMES, array_shapes, open_array
from .estimate import check_disk_space, recording_bytes
from .folder import recordings_in
from .folder_check import RECORDING_FILES
from .index import INDEX_NAME, find_different_keys, read_index
from .reader import Recording, open_recording
from .writer import RecordingWriter

COPY_CHUNK_BYTES = 16 << 20
"""Size of the chunks in which poses are copied."""
SHARD_KEYS = ("poses", "complete", "shard", "unsettled")
"""Keys of the index that differ between the shards of one recording."""


def merge_recordings(shards: Sequence[Path], path: Path) -> Iterator[Progress]:
    """Merge shards into a recording while the generator is iterated.

    Where shards have a subfolder per mesh, the result has the same subfolders. An interrupted merge is resumed, and a
    complete merge is left unchanged.

    Args:
        shards: folders of the shards, in any order; a shard with influences but no poses is permitted.
        path: folder of the recording.

    Yields:
        Progress of the stage "merge", or "merge of NAME".

    Raises:
        RecordingError: a shard is missing, incomplete, given twice, or of another recording than the others.
        OutputError: the recording cannot be written, or the disk has too little space.
    """
    names = _mesh_folders(shards)
    plans = [(path / name, _open_in_order([shard / name for shard in shards])) for name in names]
    for folder, _ in plans:
        check_folder_writable(folder, (*RECORDING_FILES, INDEX_NAME))
    check_disk_space(
        [
            (folder, recording_bytes(shards_in_order[0].rig, shards_in_order[0].info.shard.total))
            for folder, shards_in_order in plans
        ]
    )
    for name, (folder, shards_in_order) in zip(names, plans, strict=True):
        yield from _merge_mesh(shards_in_order, folder, f"merge of '{name}'" if name else "merge")


def _mesh_folders(shards: Sequence[Path]) -> list[str]:
    """Return the names of the subfolders that every shard has; one empty name where shards have no subfolders.

    Raises:
        RecordingError: there are no shards, or their subfolders differ.
    """
    if not shards:
        raise RecordingError("There is nothing to merge; give the folders of the shards.")
    names_by_shard = [[folder.name for folder in recordings_in(shard)] or [""] for shard in shards]
    for shard, names in zip(shards, names_by_shard, strict=True):
        if names != names_by_shard[0]:
            first, other = (
                ", ".join(f"'{name}'" for name in mesh_names if name) or "one mesh"
                for mesh_names in (names_by_shard[0], names)
            )
            raise RecordingError(
                f"'{shards[0]}' holds recordings of {first} and '{shard}' of {other}; give shards of one recording."
            )
    return names_by_shard[0]


def _open_in_order(paths: Sequence[Path]) -> list[Recording]:
    """Open the shards of one mesh in the order of their poses.

    Raises:
        RecordingError: they are not the complete shards of one recording.
    """
    for path in paths:
        if "shard" not in read_index(path):
            raise RecordingError(
                f"'{path}' is not a shard, but a recording of all poses; give folders that record --shard made."
            )
    recordings = [open_recording(path) for path in paths]
    _check_same_recording(recordings)
    total = recordings[0].info.shard.total
    shards_in_order = sorted(
        (recording for recording in recordings if recording.info.poses), key=lambda shard: shard.info.shard.first
    )
    covered_count = 0
    for previous_shard, shard in zip([None, *shards_in_order], shards_in_order, strict=False):
        first_pose = shard.info.shard.first
        if first_pose < covered_count:
            raise RecordingError(
                f"'{previous_shard.path}' and '{shard.path}' have poses in common; give each shard once."
            )
        if first_pose > covered_count:
            break
        covered_count += shard.info.poses
    if covered_count < total:
        later_shards = [shard for shard in shards_in_order if shard.info.shard.first > covered_count]
        gap_end = later_shards[0].info.shard.first if later_shards else total
        raise RecordingError(
            f"Poses {covered_count:,} to {gap_end - 1:,} of {total:,} are in none of the {len(paths)} shards; give all "
            "of them."
        )
    return shards_in_order


def _check_same_recording(shards: Sequence[Recording]) -> None:
    """Raise RecordingError where shards were recorded with different rigs or options."""
    first_shard = shards[0]
    indexes = [{k: v for k, v in read_index(shard.path).items() if k not in SHARD_KEYS} for shard in shards]
    for shard, index in zip(shards, indexes, strict=True):
        different_keys = find_different_keys(indexes[0], index)
        if shard.info.shard.total != first_shard.info.shard.total:
            different_keys.append("poses")
        if not different_keys:
            names = [name for name in array_shapes(0, 0, 0, 0, faces=1) if name not in STREAMED_ARRAY_NAMES]
            different_keys = [
                name for name in names if not np.array_equal(getattr(first_shard.rig, name), getattr(shard.rig, name))
            ]
        if different_keys:
            raise RecordingError(
                f"'{first_shard.path}' and '{shard.path}' are shards of different recordings: they were recorded "
                f"differently ({', '.join(different_keys)}); record all shards with the same rig and options."
            )


def _merge_mesh(shards_in_order: Sequence[Recording], path: Path, stage: str) -> Iterator[Progress]:
    first_shard = shards_in_order[0]
    total = first_shard.info.shard.total
    info = replace(first_shard.info, poses=total, complete=0, shard=None, unsettled=())
    with RecordingWriter(
        path, first_shard.rig, first_shard.partitions, info, resume=(path / INDEX_NAME).exists()
    ) as writer:
        yield Progress(stage, writer.complete, total)
        for shard in shards_in_order:
            start = writer.complete - shard.info.shard.first
            for begin, arrays in _iterate_chunks(shard, start):
                end = begin + len(arrays[0])
                writer.append(*arrays, [pose - begin for pose in shard.info.unsettled if begin <= pose < end])
                yield Progress(stage, writer.complete, total)


def _iterate_chunks(shard: Recording, start: int) -> Iterator[tuple[int, list[np.ndarray]]]:
    """Yield chunks of the poses of a shard, beginning at index `start`.

    Each chunk is mapped separately, because mapped pages count as memory of the process.

    Yields:
        The index of the first pose of the chunk, and (n, ...) of each streamed array.
    """
    poses = shard.info.poses
    row_shapes = {name: getattr(shard, name).shape[1:] for name in STREAMED_ARRAY_NAMES}
    chunk_poses = max(1, COPY_CHUNK_BYTES // max(1, 4 * sum(math.prod(row_shape) for row_shape in row_shapes.values())))
    for begin in range(start, poses, chunk_poses):
        end = min(begin + chunk_poses, poses)
        yield (
            begin,
            [
                _read_rows(shard.path / f"{name}.npy", (poses, *row_shape), begin, end)
                for name, row_shape in row_shapes.items()
            ],
        )


def _read_rows(path: Path, shape: tuple[int, ...], begin: int, end: int) -> np.ndarray:
    if not math.prod(shape[1:]):
        return np.zeros((end - begin, *shape[1:]), np.float32)
    return np.array(open_array(path, shape, np.float32)[begin:end])
