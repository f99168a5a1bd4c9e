# SPDX-License-Identifier: GPL-3.0-or-later
"""The checkpoint of a training, a file beside the model: reading, writing and validation."""

import json
import os
import zipfile
import zlib
from dataclasses import dataclass
from itertools import pairwise
from pathlib import Path

import numpy as np

from fdda_addon.core.errors import TrainingError
from fdda_addon.core.files.input_file import open_input
from fdda_addon.core.recording.arrays import MAX_VALUE, NPY_HEADER_ERRORS
from fdda_addon.core.rig import MeshPart, read_meshes

from ..inputs.block import State
from .networks import Network

VERSION = 4
INPUTS_PREFIX = "inputs/"
"""Prefix of the arrays of input states: inputs/BLOCK/ARRAY."""
READ_ERRORS = (
    *(OSError, ValueError, KeyError, AttributeError, OverflowError, EOFError, zipfile.BadZipFile, zlib.error),
    *(RuntimeError, IndexError, *NPY_HEADER_ERRORS),
)
"""Errors that numpy and zipfile raise for a damaged file. RuntimeError is for an encrypted archive."""
CONTRADICTION_CLAUSE = "its arrays contradict each other"
NOT_FINITE_CLAUSE = "its arrays hold values that are not numbers"


@dataclass(frozen=True)
class PartitionCheckpoint:
    """The network of a part of a partition, with the feature statistics and the basis that it was trained with.

    Attributes:
        joint, vertices: main joint, and (Vp,) int32 vertices of the part, ascending.
        columns: (F',) int64, indices of the network's inputs among all features of `NetworkInputs`.
        feature_mean, feature_scale: (F',) float32, statistics of these features over the training poses.
        basis_mean: (3 Vp,) float32, mesh units.
        basis_components: (K, 3 Vp) float32, orthonormal rows, no unit.
        network: maps standardized features to coefficients in mesh units.
    """

    joint: int
    vertices: np.ndarray
    columns: np.ndarray
    feature_mean: np.ndarray
    feature_scale: np.ndarray
    basis_mean: np.ndarray
    basis_components: np.ndarray
    network: Network


@dataclass(frozen=True)
class Checkpoint:
    """The state from which a training can be continued.

    Attributes:
        meshes: meshes of the rig.
        controls: names of the rig's controls.
        deformation: digest of joints, partitions and influences (`data.skinned_recording.SkinnedRecording.digest`).
        holdout: fingerprint of the held-out and validation poses (`data.split.holdout_fingerprint`).
        hidden, activation: layers and activation of the networks, as in `TrainingConfig`.
        history: pose count and held-out error of this training and its predecessors, oldest first:
            `{"poses", "p999"}`, mm.
        partitions: state of each part of the partitions of the recording.
        input_states: state of each block of the inputs, by its name (`inputs.block`).
    """

    meshes: tuple[MeshPart, ...]
    controls: tuple[str, ...]
    deformation: str
    holdout: str
    hidden: tuple[int, ...]
    activation: str
    history: tuple[dict, ...]
    partitions: tuple[PartitionCheckpoint, ...]
    input_states: dict[str, State]


def write_checkpoint(path: Path, checkpoint: Checkpoint) -> None:
    """Write a checkpoint."""
    metadata = {"version": VERSION, **vars(checkpoint), "meshes": [m.to_json() for m in checkpoint.meshes]}
    metadata["partitions"] = len(checkpoint.partitions)
    del metadata["input_states"]
    arrays = {"about": np.frombuffer(json.dumps(metadata).encode(), np.uint8)}
    for block, state in checkpoint.input_states.items():
        arrays |= {f"{INPUTS_PREFIX}{block}/{name}": array for name, array in state.items()}
    for index, partition in enumerate(checkpoint.partitions):
        partition_arrays = {name: array for name, array in vars(partition).items() if name != "network"}
        partition_arrays |= {f"weight_{layer}": weight for layer, weight in enumerate(partition.network.weights)}
        partition_arrays |= {f"bias_{layer}": bias for layer, bias in enumerate(partition.network.biases)}
        arrays |= {f"{index}/{name}": array for name, array in partition_arrays.items()}
    with open(path, "wb") as file:
        np.savez(file, **arrays)


def read_checkpoint(path: Path) -> Checkpoint:
    """Read a checkpoint.

    Raises:
        TrainingError: there is no checkpoint, or it is damaged.
    """
    try:
        with open_input(path) as file:
            size = os.fstat(file.fileno()).st_size
            with zipfile.ZipFile(file) as archive:
                # An array that is larger than the file is refused before memory is allocated for it.
                if any(member.file_size > size for member in archive.infolist()):
                    raise ValueError("it is packed")
            file.seek(0)
            with np.load(file, allow_pickle=False) as arrays:
                return _read_arrays(arrays)
    except FileNotFoundError as error:
        raise TrainingError(
            f"There is no checkpoint '{path}' to start from; train without --warm-start first."
        ) from error
    except READ_ERRORS as error:
        raise TrainingError(f"The checkpoint '{path}' cannot be used ({error}); train without --warm-start.") from error


def _read_arrays(arrays: np.lib.npyio.NpzFile) -> Checkpoint:
    metadata = json.loads(arrays["about"].tobytes())
    if metadata["version"] != VERSION:
        raise ValueError(f"version {metadata['version']!r}")
    hidden, activation = tuple(int(units) for units in metadata["hidden"]), str(metadata["activation"])
    partitions = []
    for index in range(int(metadata["partitions"])):
        names = ("vertices", "columns", "feature_mean", "feature_scale", "basis_mean", "basis_components")
        values = {name: arrays[f"{index}/{name}"] for name in names}
        layers = range(1 if not len(values["basis_components"]) else len(hidden) + 1)
        weights, biases = (tuple(arrays[f"{index}/{kind}_{layer}"] for layer in layers) for kind in ("weight", "bias"))
        partition = PartitionCheckpoint(
            int(arrays[f"{index}/joint"]), **values, network=Network(weights, biases, activation)
        )
        _check_partition(partition, hidden)
        partitions.append(partition)
    return Checkpoint(
        read_meshes(metadata["meshes"]),
        tuple(str(name) for name in metadata["controls"]),
        str(metadata["deformation"]),
        str(metadata["holdout"]),
        hidden,
        activation,
        tuple({"poses": int(entry["poses"]), "p999": float(entry["p999"])} for entry in metadata["history"]),
        tuple(partitions),
        _read_input_states(arrays),
    )


def _read_input_states(arrays: np.lib.npyio.NpzFile) -> dict[str, State]:
    states: dict[str, State] = {}
    for path in (path for path in arrays.files if path.startswith(INPUTS_PREFIX)):
        _, block, name = path.split("/")
        states.setdefault(block, {})[name] = array = arrays[path]
        if array.dtype not in (np.int64, np.float32, np.float64) or not (np.abs(array) <= MAX_VALUE).all():
            raise ValueError(NOT_FINITE_CLAUSE)
    return states


def _check_partition(partition: PartitionCheckpoint, hidden: tuple[int, ...]) -> None:
    """Check the dtypes, shapes and values of a partition's arrays."""
    network = partition.network
    arrays = [partition.feature_mean, partition.feature_scale, partition.basis_mean, partition.basis_components]
    for array in (*arrays, *network.weights, *network.biases):
        if array.dtype != np.float32 or not (np.abs(array) <= MAX_VALUE).all():
            raise ValueError(NOT_FINITE_CLAUSE)
    vertices = partition.vertices
    if partition.columns.dtype != np.int64 or partition.columns.ndim != 1:
        raise ValueError(CONTRADICTION_CLAUSE)
    if vertices.dtype != np.int32 or vertices.ndim != 1 or (np.diff(vertices) <= 0).any():
        raise ValueError(CONTRADICTION_CLAUSE)
    feature_count, component_count = len(partition.columns), len(partition.basis_components)
    sizes = (feature_count, *hidden, component_count) if component_count else (feature_count, 0)
    if (
        [weight.shape for weight in network.weights] != list(pairwise(sizes))
        or [bias.shape for bias in network.biases] != [(size,) for size in sizes[1:]]
        or partition.basis_components.shape != (component_count, len(partition.basis_mean))
        or len(partition.basis_mean) != 3 * len(vertices)
        or not (partition.feature_mean.shape == partition.feature_scale.shape == (feature_count,))
        or not (partition.feature_scale > 0).all()
    ):
        raise ValueError(CONTRADICTION_CLAUSE)
