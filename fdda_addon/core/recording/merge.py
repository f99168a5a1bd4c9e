# SPDX-License-Identifier: GPL-3.0-or-later
"""Joins the shards of a recording: the result is bit for bit what one run would have recorded."""

import math
from collections.abc import Iterator, Sequence
from dataclasses import replace
from pathlib import Path

import numpy as np

from ..errors import RecordingError
from ..output import check_folder_writable
from ..progress import Progress
from .arrays import STREAMED, array_shapes, open_array
from .estimate import check_room, recording_bytes
from .folder import recordings_in
from .index import INDEX, read_index
from .place import FILES
from .reader import Recording, open_recording
from .writer import RecordingWriter, different_keys

PIECE_BYTES = 16 << 20
"""Poses are copied in pieces of at most this size."""
OF_EACH = ("poses", "complete", "shard", "unsettled")
"""Keys of the index that differ between the shards of one recording."""


def merge_recordings(shards: Sequence[Path], path: Path) -> Iterator[Progress]:
    """Join shards into a recording; a generator that does the work while it is iterated.

    Where a shard is a folder with a recording for each of several meshes, so are all of them and so is the result.
    A merge that was interrupted goes on where it stopped, and one that is complete is left as it is.

    Args:
        shards: folders of the shards, in any order; one that holds only influences may be among them.
        path: folder of the recording.

    Yields:
        Progress of the stage "merge", or "merge of NAME".

    Raises:
        RecordingError: a shard is missing, incomplete, given twice, or of another recording than the others.
        OutputError: the recording cannot be written, or the disk lacks the room.
    """
    names = _names_of_meshes(shards)
    plans = [(path / name, _ordered([shard / name for shard in shards])) for name in names]
    for own, _ in plans:
        check_folder_writable(own, (*FILES, INDEX))
    check_room([(own, recording_bytes(parts[0].rig, parts[0].info.shard.total)) for own, parts in plans])
    for name, (own, parts) in zip(names, plans, strict=True):
        yield from _merge(parts, own, f"merge of '{name}'" if name else "merge")


def _names_of_meshes(shards: Sequence[Path]) -> list[str]:
    """Folders of the meshes in each shard; one empty name where the shards are recordings themselves."""
    if not shards:
        raise RecordingError("There is nothing to merge; give the folders of the shards.")
    found = [[folder.name for folder in recordings_in(shard)] or [""] for shard in shards]
    for shard, names in zip(shards, found, strict=True):
        if names != found[0]:
            first, other = (", ".join(f"'{name}'" for name in own if name) or "one mesh" for own in (found[0], names))
            raise RecordingError(
                f"'{shards[0]}' holds recordings of {first} and '{shard}' of {other}; give shards of one recording."
            )
    return found[0]


def _ordered(paths: Sequence[Path]) -> list[Recording]:
    """The shards of one mesh with all poses of the plan, in their order.

    Raises:
        RecordingError: they do not make a recording.
    """
    for path in paths:
        if "shard" not in read_index(path):
            raise RecordingError(f"'{path}' is no shard, but a recording by itself; give what record --shard made.")
    parts = [open_recording(path) for path in paths]
    _check_alike(parts)
    total = parts[0].info.shard.total
    parts = sorted((part for part in parts if part.info.poses), key=lambda part: part.info.shard.first)
    done = 0
    for before, part in zip([None, *parts], parts, strict=False):
        first = part.info.shard.first
        if first < done:
            raise RecordingError(f"'{before.path}' and '{part.path}' have poses in common; give each shard once.")
        if first > done:
            break
        done += part.info.poses
    if done < total:
        there = [part for part in parts if part.info.shard.first > done]
        until = there[0].info.shard.first if there else total
        raise RecordingError(
            f"Poses {done:,} to {until - 1:,} of {total:,} are in none of the {len(paths)} shards; give all of them."
        )
    return parts


def _check_alike(parts: Sequence[Recording]) -> None:
    indexes = [{k: v for k, v in read_index(part.path).items() if k not in OF_EACH} for part in parts]
    for part, index in zip(parts, indexes, strict=True):
        different = different_keys(indexes[0], index)
        if part.info.shard.total != parts[0].info.shard.total:
            different.append("poses")
        if not different:
            fixed = [name for name in array_shapes(0, 0, 0, 0, faces=1) if name not in STREAMED]
            arrays = ([getattr(own.rig, name) for own in (parts[0], part)] for name in fixed)
            different = [name for name, pair in zip(fixed, arrays, strict=True) if not np.array_equal(*pair)]
        if different:
            raise RecordingError(
                f"'{parts[0].path}' and '{part.path}' are shards of different recordings: they were recorded "
                f"differently ({', '.join(different)}); record all shards with the same rig and options."
            )


def _merge(parts: Sequence[Recording], path: Path, stage: str) -> Iterator[Progress]:
    first = parts[0]
    total = first.info.shard.total
    info = replace(first.info, poses=total, complete=0, shard=None, unsettled=())
    with RecordingWriter(path, first.rig, first.partitions, info, resume=(path / INDEX).exists()) as writer:
        yield Progress(stage, writer.complete, total)
        for part in parts:
            start = writer.complete - part.info.shard.first
            for begin, arrays in _pieces(part, start):
                end = begin + len(arrays[0])
                writer.append(*arrays, [pose - begin for pose in part.info.unsettled if begin <= pose < end])
                yield Progress(stage, writer.complete, total)


def _pieces(part: Recording, start: int) -> Iterator[tuple[int, list[np.ndarray]]]:
    """The poses of a shard from number `start` of its own on, (n, ...) of each array that grows with the poses,
    and the number of the first of them.

    Each piece is mapped by itself: what is mapped counts to the memory of a process for as long as it is.
    """
    poses = part.info.poses
    rows = {name: getattr(part, name).shape[1:] for name in STREAMED}
    count = max(1, PIECE_BYTES // max(1, 4 * sum(math.prod(row) for row in rows.values())))
    for begin in range(start, poses, count):
        end = min(begin + count, poses)
        yield begin, [_read(part.path / f"{name}.npy", (poses, *row), begin, end) for name, row in rows.items()]


def _read(path: Path, shape: tuple[int, ...], begin: int, end: int) -> np.ndarray:
    if not math.prod(shape[1:]):
        return np.zeros((end - begin, *shape[1:]), np.float32)
    return np.array(open_array(path, shape, np.float32)[begin:end])
