# SPDX-License-Identifier: GPL-3.0-or-later
"""The last weights of a training, kept beside the model, and a start from them on a recording that has grown.

Fit, means, scales and basis shapes are made anew from the poses at hand; the first and the last layer of each network
take up what changed of the last three, so that a network starts with nearly the answers it gave before.
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
from fdda_addon.core.recording.arrays import HEADER_ERRORS, LARGEST
from fdda_addon.core.rig import Fingerprint

from .borders import partition_of, recut
from .data import PreparedPartition
from .deformation import Deformation
from .deltas import NO_DELTAS, Deltas
from .model import Network

VERSION, WITHOUT_BORDERS, WITHOUT_DELTAS = 5, 4, 2
DAMAGE = (
    *(OSError, ValueError, KeyError, AttributeError, OverflowError, EOFError, zipfile.BadZipFile, zlib.error),
    *(RuntimeError, IndexError, *HEADER_ERRORS),
)
"""What numpy and zipfile raise for a damaged file: a RuntimeError where it asks for a password."""
OTHER_PARTITIONS = "The last weights are of other partitions; train without --warm-start."


@dataclass(frozen=True)
class LastPartition:
    """The network of one partition as it was left, with what its numbers mean.

    Attributes:
        columns: (F',) int64, the features that it saw, among all features of `Inputs`.
        feature_mean, feature_scale: (F',) float32.
        basis_mean: (3 Vp,) float32, mesh units. basis_shapes: (K, 3 Vp) float32, orthonormal rows.
        network: of standardised features, coefficients in mesh units.
    """

    columns: np.ndarray
    feature_mean: np.ndarray
    feature_scale: np.ndarray
    basis_mean: np.ndarray
    basis_shapes: np.ndarray
    network: Network


@dataclass(frozen=True)
class LastWeights:
    """What a training left.

    Attributes:
        fingerprint: of the rig.
        controls: names of its controls.
        held_back: digest of the poses that chose weights or measured the error (`data.held_back_digest`).
        hidden, activation: of the networks.
        history: held-out errors of this training and those before it, oldest first: `{"poses", "p999"}`, in mm.
        partitions: in the order of the recording.
        deltas: that the networks saw.
        partition_of: (V,) int64, the number of each vertex's partition; None in files of before these could differ from
            the recording's.
    """

    fingerprint: Fingerprint
    controls: tuple[str, ...]
    held_back: str
    hidden: tuple[int, ...]
    activation: str
    history: tuple[dict, ...]
    partitions: tuple[LastPartition, ...]
    deltas: Deltas = NO_DELTAS
    partition_of: np.ndarray | None = None

    def cut(self, partitions: tuple[Partition, ...]) -> tuple[Partition, ...]:
        """The partitions of a recording as they were cut.

        Raises:
            TrainingError: they are not those of the last training.
        """
        if self.partition_of is None:
            return partitions
        vertices = sum(len(partition.vertices) for partition in partitions)
        if (len(self.partitions), len(self.partition_of)) != (len(partitions), vertices):
            raise TrainingError(OTHER_PARTITIONS)
        return recut(partitions, self.partition_of)


def write_weights(
    path: Path, deformation: Deformation, held_back: str, hidden: tuple[int, ...], history: list[dict]
) -> None:
    """Keep the weights of a training; `held_back`, `hidden` and `history` as in `LastWeights`.

    OSError when the file cannot be written.
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
    for number, (prepared, network) in enumerate(zip(deformation.prepared, deformation.networks, strict=True)):
        own = {
            "columns": deformation.seen_columns(number),
            "feature_mean": prepared.feature_mean,
            "feature_scale": prepared.feature_scale,
            "basis_mean": prepared.basis.mean,
            "basis_shapes": prepared.basis.shapes,
            **{f"weight_{layer}": weight for layer, weight in enumerate(network.weights)},
            **{f"bias_{layer}": bias for layer, bias in enumerate(network.biases)},
        }
        arrays |= {f"{number}/{name}": array for name, array in own.items()}
    with open(path, "wb") as file:
        np.savez(file, **arrays)


def read_weights(path: Path) -> LastWeights:
    """Read the weights that a training left.

    Raises:
        TrainingError: there are none, or the file is damaged.
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
            f"There are no last weights '{path}' to start from; train without --warm-start first."
        ) from error
    except DAMAGE as error:
        raise TrainingError(
            f"The last weights '{path}' cannot be used ({error}); train without --warm-start."
        ) from error


def _read(arrays: np.lib.npyio.NpzFile) -> LastWeights:
    about = json.loads(arrays["about"].tobytes())
    if about["version"] not in (VERSION, WITHOUT_BORDERS, WITHOUT_DELTAS):
        raise ValueError(f"version {about['version']!r}")
    hidden = tuple(int(units) for units in about["hidden"])
    partitions = []
    for number in range(int(about["partitions"])):
        own = {name: arrays[f"{number}/{name}"] for name in ("columns", "feature_mean", "feature_scale")}
        own |= {name: arrays[f"{number}/{name}"] for name in ("basis_mean", "basis_shapes")}
        layers = range(1 if not len(own["basis_shapes"]) else len(hidden) + 1)
        weights, biases = (tuple(arrays[f"{number}/{kind}_{layer}"] for layer in layers) for kind in ("weight", "bias"))
        partition = LastPartition(**own, network=Network(weights, biases))
        _check(partition, hidden)
        partitions.append(partition)
    history = tuple({"poses": int(entry["poses"]), "p999": float(entry["p999"])} for entry in about["history"])
    return LastWeights(
        Fingerprint.from_json(about["fingerprint"]),
        tuple(str(name) for name in about.get("controls", ())),
        str(about["held_back"]),
        hidden,
        str(about["activation"]),
        history,
        tuple(partitions),
        NO_DELTAS if about["version"] == WITHOUT_DELTAS else _read_deltas(arrays),
        _read_cut(arrays["partition_of"], partitions) if about["version"] == VERSION else None,
    )


def _read_cut(partition_of: np.ndarray, partitions: list[LastPartition]) -> np.ndarray:
    if partition_of.dtype != np.int64 or partition_of.ndim != 1 or partition_of.min(initial=0) < 0:
        raise ValueError("its arrays contradict each other")
    sizes = [len(partition.basis_mean) for partition in partitions]
    if (3 * np.bincount(partition_of, minlength=len(sizes))).tolist() != sizes:
        raise ValueError("its arrays contradict each other")
    return partition_of


def _read_deltas(arrays: np.lib.npyio.NpzFile) -> Deltas:
    deltas = Deltas(**{field.name: arrays[f"deltas/{field.name}"] for field in fields(Deltas)})
    _, count, corners = deltas.lengths.shape
    shapes = {"vertices": (count,), "seen_from": (count,), "tangents": (2, count, corners, *deltas.tangents.shape[3:4])}
    for name, array in vars(deltas).items():
        integers = name in ("vertices", "seen_from")
        known = array.dtype == (np.int64 if integers else np.float64)
        if not known or array.shape != shapes.get(name, (3, count, corners)):
            raise ValueError("its arrays contradict each other")
        if not (np.abs(array) <= LARGEST).all() or (integers and array.min(initial=0) < 0):
            raise ValueError("its arrays hold values that are not numbers")
    if deltas.tangents.ndim != 4 or not (deltas.least > 0).all():
        raise ValueError("its arrays contradict each other")
    return deltas


def _check(partition: LastPartition, hidden: tuple[int, ...]) -> None:
    """ValueError where arrays contradict each other, or hold what is no number."""
    network = partition.network
    numbers = [partition.feature_mean, partition.feature_scale, partition.basis_mean, partition.basis_shapes]
    for array in (*numbers, *network.weights, *network.biases):
        if array.dtype != np.float32 or not (np.abs(array) <= LARGEST).all():
            raise ValueError("its arrays hold values that are not numbers")
    if partition.columns.dtype != np.int64 or partition.columns.ndim != 1:
        raise ValueError("its arrays contradict each other")
    features, shapes = len(partition.columns), len(partition.basis_shapes)
    sizes = (features, *hidden, shapes) if shapes else (features, 0)
    found = [weight.shape for weight in partition.network.weights]
    if (
        found != list(pairwise(sizes))
        or [bias.shape for bias in partition.network.biases] != [(size,) for size in sizes[1:]]
        or partition.basis_shapes.shape != (shapes, len(partition.basis_mean))
        or not (partition.feature_mean.shape == partition.feature_scale.shape == (features,))
        or not (partition.feature_scale > 0).all()
    ):
        raise ValueError("its arrays contradict each other")


def initial_networks(
    last: LastWeights, prepared: list[PreparedPartition], columns: list[np.ndarray]
) -> list[Network | None]:
    """Networks to start from that answer as the last ones did.

    Args:
        last: the same rig, controls, hidden layers and activation.
        prepared: the partitions as they are now.
        columns: for each, the features that its network sees now, among all features of `Inputs`.

    Returns:
        For each partition a network of its features and shapes as they are now; None where there was none or there
        is nothing to learn.

    Raises:
        TrainingError: the partitions are not those of the last training.
    """
    sizes = [3 * partition.vertices for partition in prepared]
    if sizes != [len(partition.basis_mean) for partition in last.partitions]:
        raise TrainingError(OTHER_PARTITIONS)
    return [_carried_over(*each) for each in zip(last.partitions, prepared, columns, strict=True)]


def _carried_over(last: LastPartition, prepared: PreparedPartition, columns: np.ndarray) -> Network | None:
    if not len(last.basis_shapes) or not len(prepared.basis.shapes):
        return None
    weights, biases = ([array.astype(np.float64) for array in a] for a in (last.network.weights, last.network.biases))
    # A feature that did not vary before starts without a weight; one that no longer varies stays at its mean.
    first = np.zeros((len(columns), weights[0].shape[1]))
    _, now, before = np.intersect1d(columns, last.columns, return_indices=True)
    own = weights[0][before] / last.feature_scale[before, None]
    first[now] = own * prepared.feature_scale[now, None]
    biases[0] = biases[0] + (prepared.feature_mean[now] - last.feature_mean[before]) @ own
    weights[0] = first
    shapes = prepared.basis.shapes.T.astype(np.float64)
    turned = last.basis_shapes @ shapes
    weights[-1] = weights[-1] @ turned
    biases[-1] = biases[-1] @ turned + (last.basis_mean - prepared.basis.mean) @ shapes
    return Network(*(tuple(array.astype(np.float32) for array in arrays) for arrays in (weights, biases)))
