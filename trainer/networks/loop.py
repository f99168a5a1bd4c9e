# SPDX-License-Identifier: GPL-3.0-or-later
"""The training loop, which trains the networks of all partitions together."""

import math
from collections.abc import Callable, Iterable, Sequence
from dataclasses import replace

import numpy as np
import torch
from torch.nn.utils.rnn import pad_sequence

from fdda_addon.core.errors import TrainingError

from ..config import TrainingConfig
from ..data.split import Split
from ..preparation import PreparedPartition
from .networks import Curves, Network, PartitionNetworks, TrainedPartition

WARM_UP_FRACTION = 0.15
"""Part of the steps in which the learning rate rises."""
RELEVANCE_EPOCH_FRACTIONS = (0.1, 0.2)
"""Inputs are rescaled by relevance after these parts of the epochs (`_Loop.rescale_inputs_by_relevance`)."""
RELEVANCE_POSES = 1000
"""Approximate number of training poses on which relevance is measured."""
MIN_RELEVANCE = 1e-3
"""Minimum factor of an input. The root mean square of the factors of a partition's inputs is 1."""
LOSS_EPSILON = 1e-6
"""Added to squared relative errors, so that the loss, a distance, is smooth at zero."""
BETA_2 = 0.999
EPSILON = 1e-8
MIN_BETA_1, MAX_BETA_1 = 0.85, 0.95
"""Limits of beta 1, which falls while the learning rate rises, and rises while it falls."""
INITIAL_RATE_DIVISOR = 25.0
FINAL_RATE_DIVISOR = 25.0 * 1e4


class OneCycleAdamW:
    """The optimizer AdamW with a learning rate that rises to its maximum and falls to almost zero.

    Both parts of the cycle follow half a period of a cosine.

    References:
        Loshchilov and Hutter, Decoupled Weight Decay Regularization, 2019; Smith and Topin, Super-Convergence, 2018.
    """

    def __init__(
        self,
        parameters: Iterable[torch.nn.Parameter],
        learning_rate: float,
        weight_decay: float,
        total_steps: int,
        warm_up_fraction: float,
    ):
        """Prepare the first step.

        Args:
            parameters: the tensors to optimize; each must have a gradient at every step.
            learning_rate: the maximum of the cycle.
            weight_decay: factor of the weight decay; each step multiplies it by the learning rate.
            total_steps: number of steps of the cycle.
            warm_up_fraction: part of the steps in which the learning rate rises.
        """
        self._parameters = list(parameters)
        self._learning_rate, self._weight_decay = learning_rate, weight_decay
        self._total_steps, self._warm_up_fraction = total_steps, warm_up_fraction
        self._means, self._mean_squares = ([torch.zeros_like(p) for p in self._parameters] for _ in range(2))
        self._step_counts = [torch.zeros((), device=parameter.device) for parameter in self._parameters]
        self._step = 0

    def zero_grad(self) -> None:
        """Set all gradients to None."""
        for parameter in self._parameters:
            parameter.grad = None

    @torch.no_grad()
    def step(self) -> None:
        """Update the parameters with their gradients."""
        learning_rate, beta_1 = self.schedule(self._step)
        self._step += 1
        torch._foreach_add_(self._step_counts, 1)
        torch._fused_adamw_(
            self._parameters,
            [parameter.grad for parameter in self._parameters],
            self._means,
            self._mean_squares,
            [],
            self._step_counts,
            lr=learning_rate,
            beta1=beta_1,
            beta2=BETA_2,
            weight_decay=self._weight_decay,
            eps=EPSILON,
            amsgrad=False,
            maximize=False,
        )

    def schedule(self, step: int) -> tuple[float, float]:
        """Return the learning rate and beta 1 of a step; step 0 is the first."""
        peak_step, last_step = self._warm_up_fraction * self._total_steps - 1, self._total_steps - 1
        rates = (self._learning_rate / INITIAL_RATE_DIVISOR, self._learning_rate)
        betas = (MAX_BETA_1, MIN_BETA_1)
        fraction = step / peak_step if peak_step else 1.0
        if step > peak_step:
            rates, betas = (self._learning_rate, self._learning_rate / FINAL_RATE_DIVISOR), betas[::-1]
            fraction = (step - peak_step) / (last_step - peak_step)
        return _interpolate_cosine(*rates, fraction), _interpolate_cosine(*betas, fraction)


def _interpolate_cosine(start: float, end: float, fraction: float) -> float:
    """Interpolate along half a period of a cosine; `fraction` 0 gives `start`, 1 gives `end`."""
    return end + (start - end) / 2.0 * (1 + math.cos(math.pi * fraction))


def train(
    partitions: Sequence[PreparedPartition],
    split: Split,
    config: TrainingConfig,
    device: str,
    on_epoch: Callable[[int, float, float], None] = lambda *_: None,
    initial: Sequence[Network | None] | None = None,
) -> list[TrainedPartition]:
    """Train the networks of all partitions together.

    Args:
        partitions: partitions with the inputs and coefficients of all poses.
        config: settings of the training. Equal settings and data give equal weights on one machine.
        device: device to train on.
        on_epoch: called after every epoch with its number and the training and validation error: means over all
            partitions, weighted by their vertices, mm. Epoch 1 is the first.
        initial: for each partition the network to start from, or None for random weights.

    Returns:
        The partitions with their networks and learning curves. The network of a constant partition has no outputs.
    """
    # Inactive units lead to denormal numbers in the optimizer, which take twice the time.
    torch.set_flush_denormal(True)
    learning_indices = [index for index, partition in enumerate(partitions) if len(partition.basis.components)]
    networks = [Network.without_outputs(len(p.columns), config.activation) for p in partitions]
    trained = [
        TrainedPartition(**vars(p), network=n, curves=Curves()) for p, n in zip(partitions, networks, strict=True)
    ]
    if learning_indices:
        loop = _Loop([trained[index] for index in learning_indices], split, config, device)
        if initial is not None:
            loop.start_from([initial[index] for index in learning_indices])
        loop.run(on_epoch, [partition for partition in partitions if not len(partition.basis.components)])
        for index, network in zip(learning_indices, loop.best_networks(), strict=True):
            trained[index] = replace(trained[index], network=network)
    return trained


class _Loop:
    """The state of a training of P partitions; each epoch adds its errors to their curves."""

    def __init__(self, partitions: list[TrainedPartition], split: Split, config: TrainingConfig, device: str):
        self.partitions, self.config, self.device = partitions, config, device
        # Coefficients are divided by the residual of their partition, so that one loss and one learning rate suit all.
        self.target_scales = [partition.residual_rms * np.sqrt(partition.vertex_count) for partition in partitions]
        inputs = [p.inputs for p in partitions]
        targets = [p.coefficients / scale for p, scale in zip(partitions, self.target_scales, strict=True)]
        self.inputs, self.targets = (_padded(arrays, split.training, device) for arrays in (inputs, targets))
        self.validation_inputs, self.validation_targets = (
            _padded(arrays, split.validation, device) for arrays in (inputs, targets)
        )
        self.to_mm = torch.tensor([p.residual_rms * p.mm_per_unit for p in partitions], device=device)[:, None]
        validation_truncation_mm = np.stack([p.validation_truncation * p.mm_per_unit for p in partitions])
        self.validation_truncation_mm = torch.tensor(validation_truncation_mm, dtype=torch.float32, device=device)
        truncation_rms_mm = [p.basis.truncation_rms * p.mm_per_unit for p in partitions]
        self.truncation_mm = torch.tensor(truncation_rms_mm, device=device)[:, None]
        self.model = PartitionNetworks(
            [array.shape[1] for array in inputs],
            [array.shape[1] for array in targets],
            config.hidden,
            config.activation,
            torch.Generator().manual_seed(config.seed),
        ).to(device)
        self.best_parameters = [parameter.detach().clone() for parameter in self.model.parameters()]
        self.best_mm = torch.full((len(partitions),), torch.inf, device=device)
        # (P, F) product of all factors by which the standardized features were rescaled.
        self.input_scales = torch.ones_like(self.inputs[:, 0])

    @torch.enable_grad()
    def rescale_inputs_by_relevance(self) -> torch.Tensor:
        """Multiply each input by its relevance, the root mean square gradient of the outputs with respect to it.

        Inputs with little effect become small, so that the networks do not fit chance correlations with them. Automatic
        relevance determination finds such factors for a kernel (MacKay, 1994).

        Returns:
            (P, 1, F) factors of the inputs.
        """
        generator = torch.Generator().manual_seed(self.config.seed + 3)
        inputs = self.inputs[:, :: -(-self.inputs.shape[1] // RELEVANCE_POSES)].clone().requires_grad_(True)
        outputs = self.model(inputs)
        # Along random directions the mean square over poses estimates the sum over all outputs.
        directions = torch.randn(outputs.shape, generator=generator).to(self.device)
        (gradients,) = torch.autograd.grad(outputs, inputs, directions)
        mean_squares = gradients.square().mean(dim=1, keepdim=True)
        input_counts = torch.tensor([p.inputs.shape[1] for p in self.partitions], device=self.device)[:, None, None]
        mean_over_inputs = mean_squares.sum(dim=2, keepdim=True) / input_counts
        factors = torch.where(mean_over_inputs > 0, (mean_squares / mean_over_inputs).sqrt(), 1.0).clamp(
            min=MIN_RELEVANCE
        )
        self.inputs *= factors
        self.validation_inputs *= factors
        self.input_scales *= factors[:, 0]
        # The best weights are divided by the factors, so that their outputs stay the same.
        self.best_parameters[0] /= factors.transpose(1, 2)
        return factors

    @torch.no_grad()
    def start_from(self, networks: list[Network | None]) -> None:
        """Replace the random weights with the weights of trained networks. None keeps random weights.

        Inputs are rescaled once, and the first layer inversely, so that the outputs stay the same.
        """
        for index, (network, scale) in enumerate(zip(networks, self.target_scales, strict=True)):
            if network is None:
                continue
            last_layer = len(network.weights) - 1
            for layer, (weight, bias) in enumerate(zip(network.weights, network.biases, strict=True)):
                factor = np.float32(1 / scale) if layer == last_layer else np.float32(1)
                rows, columns = weight.shape
                self.model.weights[layer][index, :rows, :columns] = torch.from_numpy(weight * factor)
                self.model.biases[layer][index, 0, :columns] = torch.from_numpy(bias * factor)
        self.model.weights[0] /= self.rescale_inputs_by_relevance().transpose(1, 2)

    def run(self, on_epoch: Callable[[int, float, float], None], constant: list[PreparedPartition]) -> None:
        """Train for all epochs; `on_epoch` as in `train`, `constant` are the partitions without components."""
        config, step_count = self.config, -(-self.inputs.shape[1] // self.config.batch_size)
        optimizer = OneCycleAdamW(
            self.model.parameters(),
            config.learning_rate,
            config.weight_decay,
            config.passes * step_count,
            WARM_UP_FRACTION,
        )
        order_generator = torch.Generator().manual_seed(config.seed + 1)
        vertex_counts = [partition.vertex_count for partition in (*self.partitions, *constant)]
        constant_mm = (
            [partition.basis.truncation_rms * partition.mm_per_unit for partition in constant],
            [partition.validation_truncation.mean() * partition.mm_per_unit for partition in constant],
        )
        rescaling_epochs = {round(fraction * config.passes) for fraction in RELEVANCE_EPOCH_FRACTIONS} - {0}
        for epoch in range(1, config.passes + 1):
            if epoch - 1 in rescaling_epochs:
                self.rescale_inputs_by_relevance()
            training_mm = self._train_epoch(optimizer, order_generator)
            validation_mm, worst_mm = self._validate()
            self._update_best(validation_mm)
            if not torch.isfinite(validation_mm).all():
                raise TrainingError(
                    f"The training diverged in epoch {epoch}: errors are not numbers; use a smaller learning rate than "
                    f"{config.learning_rate:g}."
                )
            errors_mm = (training_mm.tolist(), validation_mm.tolist(), worst_mm.tolist())
            for partition, training, validation, worst in zip(self.partitions, *errors_mm, strict=True):
                partition.curves.training_mm.append(training)
                partition.curves.validation_mm.append(validation)
                partition.curves.worst_mm.append(worst)
            means = (
                float(np.average(errors + constant_errors, weights=vertex_counts))
                for errors, constant_errors in zip(errors_mm[:2], constant_mm, strict=True)
            )
            on_epoch(epoch, *means)

    def _train_epoch(self, optimizer: OneCycleAdamW, order_generator: torch.Generator) -> torch.Tensor:
        """Train on all poses once, in random order; returns (P,) mean errors, mm."""
        pose_count, total_mm = self.inputs.shape[1], torch.zeros(len(self.partitions), device=self.device)
        pose_order = torch.randperm(pose_count, generator=order_generator).to(self.device)
        for batch_poses in pose_order.split(self.config.batch_size):
            squared_errors = self._step(optimizer, batch_poses)
            total_mm += (squared_errors * self.to_mm.square() + self.truncation_mm.square()).sqrt().sum(dim=1)
        return total_mm / pose_count

    def _step(self, optimizer: OneCycleAdamW, poses: torch.Tensor) -> torch.Tensor:
        """Take one optimization step; returns (P, n) squared errors in units of each partition's residual."""
        optimizer.zero_grad()
        differences = self.model(self.inputs[:, poses]) - self.targets[:, poses]
        squared_errors = differences.square().sum(dim=2)
        # The loss is a mean distance, like the reported error. Unlike a mean square, it is robust to outliers.
        # The sum over partitions gives each network the same gradient as if it were trained alone.
        loss = (squared_errors + LOSS_EPSILON).sqrt().mean(dim=1).sum()
        loss.backward()
        optimizer.step()
        return squared_errors.detach()

    @torch.no_grad()
    def _validate(self) -> tuple[torch.Tensor, torch.Tensor]:
        """Return (P,) mean and (P,) maximum error of the validation poses, mm."""
        differences = self.model(self.validation_inputs) - self.validation_targets
        squared = differences.square().sum(dim=2) * self.to_mm.square()
        errors = (squared + self.validation_truncation_mm.square()).sqrt()
        return errors.mean(dim=1), errors.max(dim=1).values

    def _update_best(self, validation_mm: torch.Tensor) -> None:
        is_better = validation_mm < self.best_mm
        self.best_mm = torch.where(is_better, validation_mm, self.best_mm)
        for best_parameter, parameter in zip(self.best_parameters, self.model.parameters(), strict=True):
            best_parameter[is_better] = parameter.detach()[is_better]

    def best_networks(self) -> list[Network]:
        """Return the best weights of each partition without padding, for coefficients in mesh units."""
        layer_count = len(self.model.weights)
        all_weights, all_biases = (
            [tensor.cpu().numpy() for tensor in self.best_parameters[half * layer_count : (half + 1) * layer_count]]
            for half in range(2)
        )
        input_scales = self.input_scales.cpu().numpy()
        networks = []
        for index, (partition, scale) in enumerate(zip(self.partitions, self.target_scales, strict=True)):
            weights, biases = ([array[index].copy() for array in arrays] for arrays in (all_weights, all_biases))
            output_count, input_count = len(partition.basis.components), partition.inputs.shape[1]
            weights[0] = weights[0][:input_count] * input_scales[index, :input_count, None]
            weights[-1] = weights[-1][:, :output_count] * np.float32(scale)
            biases[-1] = biases[-1][:, :output_count] * np.float32(scale)
            networks.append(Network(tuple(weights), tuple(bias[0] for bias in biases), self.config.activation))
        return networks


def _padded(arrays: list[np.ndarray], poses: np.ndarray, device: str) -> torch.Tensor:
    """Stack (n, width) arrays of the selected poses into one (P, n, max width) float32 tensor, padded with 0."""
    columns = [torch.as_tensor(array[poses].T, dtype=torch.float32) for array in arrays]
    return pad_sequence(columns, batch_first=True).transpose(1, 2).contiguous().to(device)
