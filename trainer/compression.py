# SPDX-License-Identifier: GPL-3.0-or-later
"""Makes a trained model smaller: drops components that networks do not predict, and factorizes large partitions."""

from collections.abc import Sequence
from dataclasses import replace

import numpy as np

from .data.split import OVERSHOOT_POSE_WEIGHT, Split
from .fits.basis import Basis
from .fits.low_rank import factorize, may_factorize
from .networks.networks import Network, TrainedPartition
from .preparation import PartitionData

MIN_GAIN_RATIO = 0.1
"""A component stays if it lowers the mean error by more than this part of the error, times its part of the parameters
of all components. So the mean error grows by at most about a tenth, if nearly all components are dropped."""
MIN_DROPPED_PART = 0.1
"""If the dropped components have at least this part of the squared residuals, a remedy is suggested."""


def drop_components(prepared: Sequence[TrainedPartition], split: Split) -> list[TrainedPartition]:
    """Drop the components that lower the mean error too little, or raise it.

    The error is measured on the validation poses. Overshoot poses and refined poses also count, with a lower weight,
    because components may represent what only happens in extreme poses. These are all training poses. Errors are
    relative to those of the same mesh.

    A network cannot predict a component that depends on more than its inputs, or on details that the poses do not show.
    The components are first replaced by the principal components of the predictions, which are fewer than those of
    the residuals (reduced-rank regression: Izenman, 1975).

    Returns:
        The partitions with the remaining components; a partition may lose all.
    """
    measured = []
    errors, costs = np.zeros((2, 1 + max(partition.mesh for partition in prepared)))
    for partition in prepared:
        predicted = partition.network.evaluate(partition.inputs[split.training]).astype(np.float64)
        # The columns are the principal directions of the predictions, largest first.
        change = np.linalg.eigh(predicted.T @ predicted)[1][:, ::-1]
        error, gains = _component_gains(partition, change, split)
        cost = 3 * partition.vertex_count + len(partition.network.weights[-1]) + 1
        errors[partition.mesh] += error
        costs[partition.mesh] += cost * len(gains)
        measured.append((partition, change, gains, cost))
    min_gains = MIN_GAIN_RATIO * errors / np.maximum(costs, 1)
    return [
        _change_basis(partition, change[:, gains > min_gains[partition.mesh] * cost], split)
        for partition, change, gains, cost in measured
    ]


def dropped_components_sentence(prepared: Sequence[TrainedPartition], remaining: Sequence[TrainedPartition]) -> str:
    """Describe which components `drop_components` dropped, and what may help; empty if none was dropped."""
    count = sum(len(partition.basis.components) for partition in prepared)
    dropped_count = sum(partition.dropped_count for partition in remaining)
    if not dropped_count:
        return ""
    dropped_square = sum(partition.vertex_count * partition.dropped_rms**2 for partition in remaining)
    part = dropped_square / sum(partition.vertex_count * partition.residual_rms**2 for partition in prepared)
    text = f"The networks do not predict {dropped_count:,} of {count:,} components, which are left out"
    if part < MIN_DROPPED_PART:
        return f"{text}: {100 * part:.1f} % of what the linear fit leaves."
    return (
        f"{text}, although they are {100 * part:.0f} % of what the linear fit leaves: record more poses, or make what "
        "else moves the mesh a control; where the rig jumps, nothing helps."
    )


def _component_gains(partition: TrainedPartition, change: np.ndarray, split: Split) -> tuple[float, np.ndarray]:
    """Measure what each component of a changed basis gains on the validation poses, and on extreme poses.

    Args:
        change: (K, K) orthonormal columns, the new components.

    Returns:
        The mean over the poses of the sum of all vertices' errors, mesh units. Then (K,) by how much it would grow
        without each of the components.
    """
    coefficients = partition.network.evaluate(partition.inputs[partition.validation])
    errors = partition.validation_residuals - partition.basis.reconstruct(coefficients)
    error, gains = _gains_in_poses(partition, coefficients, errors, change)
    extremes = np.union1d(split.overshoot, split.refined)
    if len(extremes):
        poses = extremes[:: -(-len(extremes) // len(partition.validation))]
        coefficients = partition.network.evaluate(partition.inputs[poses])
        # What the components do not represent is small in these poses, and left out.
        errors = (partition.coefficients[poses] - coefficients) @ partition.basis.components
        extreme_error, extreme_gains = _gains_in_poses(partition, coefficients, errors, change)
        ratio = OVERSHOOT_POSE_WEIGHT * len(extremes) / (len(split.training) - len(extremes))
        error, gains = error + ratio * extreme_error, gains + ratio * extreme_gains
    return error, gains


def _gains_in_poses(
    partition: TrainedPartition, coefficients: np.ndarray, errors: np.ndarray, change: np.ndarray
) -> tuple[float, np.ndarray]:
    """Measure what components gain in n poses; other arguments and result as in `_component_gains`.

    Args:
        coefficients: (n, K) predicted coefficients.
        errors: (n, 3 Vp) residuals minus predicted residuals, mesh units.
    """

    def summed_error(errors: np.ndarray) -> float:
        return float(np.linalg.norm(errors.reshape(len(errors), -1, 3), axis=2).sum(axis=1, dtype=np.float64).mean())

    error, change = summed_error(errors), change.astype(np.float32)
    products = zip((coefficients @ change).T, change.T @ partition.basis.components, strict=True)
    without = [summed_error(errors + column[:, None] * component) for column, component in products]
    return error, np.array(without) - error


def _change_basis(partition: TrainedPartition, change: np.ndarray, split: Split) -> TrainedPartition:
    """Replace the K components of a partition by K' orthonormal combinations of them.

    Args:
        change: (K, K') float64, orthonormal columns.
    """
    basis = partition.basis
    coefficients = partition.coefficients @ change
    squares, former_squares = (
        np.average(values[split.training].astype(np.float64) ** 2, axis=0, weights=split.weights())
        for values in (coefficients, partition.coefficients)
    )
    # Rounding may make the squares of all components slightly larger than before.
    dropped_square = max(0.0, float(former_squares.sum() - squares.sum())) / partition.vertex_count
    left_square = basis.truncation_rms**2 + dropped_square
    squares_by_count = np.append(np.cumsum(squares[::-1])[::-1], 0) / partition.vertex_count
    return replace(
        partition,
        basis=Basis(
            basis.mean, (change.T @ basis.components).astype(np.float32), np.sqrt(squares_by_count + left_square)
        ),
        coefficients=coefficients.astype(np.float32),
        dropped_count=len(change) - change.shape[1],
        dropped_rms=float(np.sqrt(dropped_square)),
        network=_change_outputs(partition.network, change),
    )


def _change_outputs(network: Network, change: np.ndarray) -> Network:
    """Return a network with other outputs, (K, K') combinations; without outputs it has one layer."""
    weights, biases = network.weights, network.biases
    if not change.shape[1]:
        return Network.without_outputs(len(weights[0]), network.activation)
    change = change.astype(np.float32)
    return Network((*weights[:-1], weights[-1] @ change), (*biases[:-1], biases[-1] @ change), network.activation)


def factorize_partition(
    prepared: TrainedPartition, partition: PartitionData, split: Split, tolerance: float
) -> TrainedPartition:
    """Factorize a trained partition if that saves parameters; `tolerance` as in `factorize`."""
    fit, basis, coefficients = prepared.fit, prepared.basis, prepared.coefficients
    if not may_factorize(fit, basis):
        return prepared
    weights, regression = split.weights(), partition.read_regression()
    factors = factorize(fit, basis, coefficients, regression, split.training, weights, tolerance)
    if factors is None:
        return prepared
    return replace(
        prepared,
        fit=factors.fit,
        basis=factors.basis,
        coefficients=(coefficients @ factors.change_of_basis.T).astype(np.float32),
        vertex_factors=factors.vertex_factors,
        network=_change_outputs(prepared.network, factors.change_of_basis.T),
    )
