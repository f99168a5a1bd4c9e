# SPDX-License-Identifier: GPL-3.0-or-later
"""The checkpoint of a training, kept beside the model, and a warm start from it on a recording that has grown.

A warm start computes linear fits, feature statistics and bases from the current poses. The first and the last layer of
each network absorb the differences in statistics and basis, so the network starts with nearly its former outputs.
"""

import json
import os
import zipfile
import zlib
from dataclasses import dataclass, fields
from itertools import pairwise
from pathlib import Path

import numpy as np

from fdda_addon.core.errors import TrainingError
from fdda_addon.core.input_file import open_input
from fdda_addon.core.partition import Partition
from fdda_addon.core.recording.arrays import MAX_VALUE, NPY_HEADER_ERRORS
from fdda_addon.core.rig import Fingerprint

from .borders import partition_of, recut
from .data import PreparedPartition
from .deformation import Deformation
from .deltas import Deltas
from .model import Network

VERSION = 1
READ_ERRORS = (
    *(OSError, ValueError, KeyError, AttributeError, OverflowError, EOFError, zipfile.BadZipFile, zlib.error),
    *(RuntimeError, IndexError, *NPY_HEADER_ERRORS),
)
"""What numpy and zipfile raise for a damaged file; RuntimeError where the archive is encrypted."""
OTHER_PARTITIONS = "The checkpoint is of other partitions; train without --warm-start."
CONTRADICTION = "its arrays contradict each other"
NOT_FINITE = "its arrays hold values that are not numbers"


@dataclass(frozen=True)
class PartitionCheckpoint:
    """The network of one partition, with the feature statistics and the basis that it was trained with.

    Attributes:
        columns: (F',) int64, indices of its features among all features of `Inputs`.
        feature_mean, feature_scale: (F',) float32.
        basis_mean: (3 Vp,) float32, mesh units.
        basis_shapes: (K, 3 Vp) float32, orthonormal rows, no unit.
        network: from standardized features to coefficients in mesh units.
    """

    columns: np.ndarray
    feature_mean: np.ndarray
    feature_scale: np.ndarray
    basis_mean: np.ndarray
    basis_shapes: np.ndarray
    network: Network


@dataclass(frozen=True)
class Checkpoint:
    """The state from which a training can be continued.

    Attributes:
        fingerprint: of the rig.
        controls: names of the rig's controls.
        held_back: fingerprint of the held-out and validation poses (`data.held_back_digest`).
        hidden, activation: of the networks.
        history: held-out errors of this training and its predecessors, oldest first: `{"poses", "p999"}`, in mm.
        partitions: in the order of the recording.
        deltas: inputs of the networks.
        partition_of: (V,) int64, index of the partition of each vertex.
    """

    fingerprint: Fingerprint
    controls: tuple[str, ...]
    held_back: str
    hidden: tuple[int, ...]
    activation: str
    history: tuple[dict, ...]
    partitions: tuple[PartitionCheckpoint, ...]
    deltas: Deltas
    partition_of: np.ndarray

    def cut(self, partitions: tuple[Partition, ...]) -> tuple[Partition, ...]:
        """Assign the vertices of a recording's partitions as the checkpoint does.

        Raises:
            TrainingError: the recording has other partitions.
        """
        vertex_count = sum(len(partition.vertices) for partition in partitions)
        if (len(self.partitions), len(self.partition_of)) != (len(partitions), vertex_count):
            raise TrainingError(OTHER_PARTITIONS)
        return recut(partitions, self.partition_of)


def write_checkpoint(
    path: Path, deformation: Deformation, held_back: str, hidden: tuple[int, ...], history: list[dict]
) -> None:
    """Write the checkpoint of a training.

    Args:
        path: of the file.
        deformation: the trained model.
        held_back, hidden, history: as in `Checkpoint`.

    Raises:
        OSError: the file cannot be written.
    """
    about = {
        "version": VERSION,
        "fingerprint": vars(deformation.rig.fingerprint),
        "controls": [control.name for control in deformation.rig.controls],
        "held_back": held_back,
        "hidden": list(hidden),
        "activation": deformation.activation,
        "history": history,
        "partitions": len(deformation.partitions),
    }
    arrays = {"about": np.frombuffer(json.dumps(about).encode(), np.uint8)}
    arrays |= {f"deltas/{name}": array for name, array in vars(deformation.inputs.deltas).items()}
    arrays["partition_of"] = partition_of(deformation.partitions)
    for index, (prepared, network) in enumerate(zip(deformation.prepared, deformation.networks, strict=True)):
        partition_arrays = {
            "columns": deformation.seen_columns(index),
            "feature_mean": prepared.feature_mean,
            "feature_scale": prepared.feature_scale,
            "basis_mean": prepared.basis.mean,
            "basis_shapes": prepared.basis.shapes,
            **{f"weight_{layer}": weight for layer, weight in enumerate(network.weights)},
            **{f"bias_{layer}": bias for layer, bias in enumerate(network.biases)},
        }
        arrays |= {f"{index}/{name}": array for name, array in partition_arrays.items()}
    with open(path, "wb") as file:
        np.savez(file, **arrays)


def read_checkpoint(path: Path) -> Checkpoint:
    """Read a checkpoint.

    Raises:
        TrainingError: there is none, or the file is damaged.
    """
    try:
        with open_input(path) as file:
            size = os.fstat(file.fileno()).st_size
            with zipfile.ZipFile(file) as archive:
                # Nothing is allocated that is larger than the file.
                if any(member.file_size > size for member in archive.infolist()):
                    raise ValueError("it is packed")
            file.seek(0)
            with np.load(file, allow_pickle=False) as arrays:
                return _read(arrays)
    except FileNotFoundError as error:
        raise TrainingError(
            f"There is no checkpoint '{path}' to start from; train without --warm-start first."
        ) from error
    except READ_ERRORS as error:
        raise TrainingError(f"The checkpoint '{path}' cannot be used ({error}); train without --warm-start.") from error


def _read(arrays: np.lib.npyio.NpzFile) -> Checkpoint:
    about = json.loads(arrays["about"].tobytes())
    if about["version"] != VERSION:
        raise ValueError(f"version {about['version']!r}")
    hidden = tuple(int(units) for units in about["hidden"])
    partitions = []
    for index in range(int(about["partitions"])):
        names = ("columns", "feature_mean", "feature_scale", "basis_mean", "basis_shapes")
        values = {name: arrays[f"{index}/{name}"] for name in names}
        layers = range(1 if not len(values["basis_shapes"]) else len(hidden) + 1)
        weights, biases = (tuple(arrays[f"{index}/{kind}_{layer}"] for layer in layers) for kind in ("weight", "bias"))
        partition = PartitionCheckpoint(**values, network=Network(weights, biases))
        _check_partition(partition, hidden)
        partitions.append(partition)
    return Checkpoint(
        Fingerprint.from_json(about["fingerprint"]),
        tuple(str(name) for name in about["controls"]),
        str(about["held_back"]),
        hidden,
        str(about["activation"]),
        tuple({"poses": int(entry["poses"]), "p999": float(entry["p999"])} for entry in about["history"]),
        tuple(partitions),
        _read_deltas(arrays),
        _read_partition_of(arrays["partition_of"], partitions),
    )


def _read_partition_of(partition_of: np.ndarray, partitions: list[PartitionCheckpoint]) -> np.ndarray:
    if partition_of.dtype != np.int64 or partition_of.ndim != 1 or partition_of.min(initial=0) < 0:
        raise ValueError(CONTRADICTION)
    sizes = [len(partition.basis_mean) for partition in partitions]
    if (3 * np.bincount(partition_of, minlength=len(sizes))).tolist() != sizes:
        raise ValueError(CONTRADICTION)
    return partition_of


def _read_deltas(arrays: np.lib.npyio.NpzFile) -> Deltas:
    deltas = Deltas(**{field.name: arrays[f"deltas/{field.name}"] for field in fields(Deltas)})
    _, count, corners = deltas.lengths.shape
    shapes = {"vertices": (count,), "seen_from": (count,), "tangents": (2, count, corners, *deltas.tangents.shape[3:4])}
    for name, array in vars(deltas).items():
        is_index = name in ("vertices", "seen_from")
        if array.dtype != (np.int64 if is_index else np.float64) or array.shape != shapes.get(
            name, (3, count, corners)
        ):
            raise ValueError(CONTRADICTION)
        if not (np.abs(array) <= MAX_VALUE).all() or (is_index and array.min(initial=0) < 0):
            raise ValueError(NOT_FINITE)
    if deltas.tangents.ndim != 4 or not (deltas.least > 0).all():
        raise ValueError(CONTRADICTION)
    return deltas


def _check_partition(partition: PartitionCheckpoint, hidden: tuple[int, ...]) -> None:
    """Check the dtypes, shapes and values of a partition's arrays.

    Raises:
        ValueError: arrays contradict each other, or hold values that are not numbers.
    """
    network = partition.network
    arrays = [partition.feature_mean, partition.feature_scale, partition.basis_mean, partition.basis_shapes]
    for array in (*arrays, *network.weights, *network.biases):
        if array.dtype != np.float32 or not (np.abs(array) <= MAX_VALUE).all():
            raise ValueError(NOT_FINITE)
    if partition.columns.dtype != np.int64 or partition.columns.ndim != 1:
        raise ValueError(CONTRADICTION)
    feature_count, component_count = len(partition.columns), len(partition.basis_shapes)
    sizes = (feature_count, *hidden, component_count) if component_count else (feature_count, 0)
    if (
        [weight.shape for weight in network.weights] != list(pairwise(sizes))
        or [bias.shape for bias in network.biases] != [(size,) for size in sizes[1:]]
        or partition.basis_shapes.shape != (component_count, len(partition.basis_mean))
        or not (partition.feature_mean.shape == partition.feature_scale.shape == (feature_count,))
        or not (partition.feature_scale > 0).all()
    ):
        raise ValueError(CONTRADICTION)


def initial_networks(
    checkpoint: Checkpoint, prepared: list[PreparedPartition], columns: list[np.ndarray]
) -> list[Network | None]:
    """Convert the networks of a checkpoint to the features and bases of the current training.

    Args:
        checkpoint: of the same rig, controls, hidden layers and activation.
        prepared: the partitions of the current training.
        columns: for each partition, (F',) indices of its features among all features of `Inputs`.

    Returns:
        For each partition a network with nearly the former outputs; None where the partition has no network now or had
        none before.

    Raises:
        TrainingError: the checkpoint is of other partitions.
    """
    sizes = [3 * partition.vertices for partition in prepared]
    if sizes != [len(partition.basis_mean) for partition in checkpoint.partitions]:
        raise TrainingError(OTHER_PARTITIONS)
    return [_converted(*each) for each in zip(checkpoint.partitions, prepared, columns, strict=True)]


def _converted(former: PartitionCheckpoint, prepared: PreparedPartition, columns: np.ndarray) -> Network | None:
    """Convert the network of one partition; arguments and result as in `initial_networks`."""
    if not len(former.basis_shapes) or not len(prepared.basis.shapes):
        return None
    weights, biases = (
        [array.astype(np.float64) for array in arrays] for arrays in (former.network.weights, former.network.biases)
    )
    # A feature that was constant before gets weight 0; one that is constant now stays at its mean.
    first_weight = np.zeros((len(columns), weights[0].shape[1]))
    _, now, before = np.intersect1d(columns, former.columns, return_indices=True)
    unscaled = weights[0][before] / former.feature_scale[before, None]
    first_weight[now] = unscaled * prepared.feature_scale[now, None]
    biases[0] = biases[0] + (prepared.feature_mean[now] - former.feature_mean[before]) @ unscaled
    weights[0] = first_weight
    components = prepared.basis.shapes.T.astype(np.float64)
    change_of_basis = former.basis_shapes @ components
    weights[-1] = weights[-1] @ change_of_basis
    biases[-1] = biases[-1] @ change_of_basis + (former.basis_mean - prepared.basis.mean) @ components
    return Network(*(tuple(array.astype(np.float32) for array in arrays) for arrays in (weights, biases)))
