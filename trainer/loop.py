# SPDX-License-Identifier: GPL-3.0-or-later
"""The training loop: all partitions at once."""

from collections.abc import Callable, Sequence
from dataclasses import dataclass, field

import numpy as np
import torch
from torch.func import functional_call

from fdda_addon.core.errors import TrainingError

from .config import TrainingConfig
from .data import PreparedPartition, Split
from .model import Network, PartitionNetworks
from .optimizer import OneCycleAdamW
from .process import Cancelled

WARM_UP = 0.15
"""Part of the steps in which the learning rate rises."""
WEIGHED_AFTER = (0.1, 0.2)
"""After these parts of the epochs, inputs are weighed by what they do (`_Loop.weigh_inputs`)."""
WEIGHED_BY = 1000
"""So many of the training poses say what inputs do."""
LEAST_WEIGHT = 1e-3
"""Of an input that does nothing, where their root mean square is 1."""

SMOOTHING = 1e-6
"""Added to squared relative errors: the loss is a distance, without the kink at zero."""


@dataclass
class Curves:
    """Errors of one partition by epoch: means over poses of the rms distance over vertices, mm.

    Those of training are of the weights as they move, those of validation of their running average. `worst_mm` is the
    largest of the validation poses, in place of their mean.
    """

    training_mm: list[float] = field(default_factory=list)
    validation_mm: list[float] = field(default_factory=list)
    worst_mm: list[float] = field(default_factory=list)
    best_epoch: int = 0


@dataclass(frozen=True)
class Progress:
    """What is known after an epoch, 1 is the first: means of the curves over all vertices, mm."""

    epoch: int
    epochs: int
    training_mm: float
    validation_mm: float


@dataclass(frozen=True)
class Trained:
    """Result of a training, a network and curves for each partition; a network without outputs for a constant one."""

    networks: tuple[Network, ...]
    curves: tuple[Curves, ...]


def choose_device() -> torch.device:
    """The GPU when torch sees one."""
    return torch.device("cuda" if torch.cuda.is_available() else "cpu")


def train(
    partitions: Sequence[PreparedPartition],
    split: Split,
    config: TrainingConfig,
    device: torch.device | None = None,
    progress: Callable[[Progress], None] | None = None,
    should_stop: Callable[[], bool] = lambda: False,
    initial: Sequence[Network | None] | None = None,
) -> Trained:
    """Train the networks of all partitions together.

    Args:
        partitions: their inputs and coefficients hold all poses of the split.
        split: which poses train and which validate.
        config: the settings; equal settings and data give equal weights on one machine.
        device: to train on; `choose_device()` when left out.
        progress: called after every epoch.
        should_stop: asked before every step.
        initial: for each partition the network to start from, None for random weights.

    Raises:
        Cancelled: `should_stop` said so.
        TrainingError: the training diverged.
    """
    device = device or choose_device()
    # Units that no pose moves any more leave the optimizer with denormal numbers, which take twice the time.
    torch.set_flush_denormal(True)
    learning = [number for number, partition in enumerate(partitions) if len(partition.basis.shapes)]
    curves = tuple(Curves() for _ in partitions)
    networks = [Network((np.zeros((len(p.columns), 0), np.float32),), (np.zeros(0, np.float32),)) for p in partitions]
    if learning:
        loop = _Loop([partitions[number] for number in learning], split, config, device)
        if initial is not None:
            loop.start_from([initial[number] for number in learning])
        loop.run([curves[number] for number in learning], progress, should_stop, partitions)
        for number, network in zip(learning, loop.best_networks(), strict=True):
            networks[number] = network
    return Trained(tuple(networks), curves)


class _Loop:
    """State of one training."""

    def __init__(self, partitions: list[PreparedPartition], split: Split, config: TrainingConfig, device: torch.device):
        self.partitions, self.config, self.device = partitions, config, device
        # Each partition's coefficients in units of its own residual, so that one loss and one rate suit all.
        self.scales = [partition.residual_rms * np.sqrt(partition.vertices) for partition in partitions]
        inputs = [p.inputs for p in partitions]
        targets = [p.coefficients / scale for p, scale in zip(partitions, self.scales, strict=True)]
        self.x, self.y = (_padded(arrays, split.training, device) for arrays in (inputs, targets))
        self.x_validation, self.y_validation = (
            _padded(arrays, split.validation, device) for arrays in (inputs, targets)
        )
        self.to_mm = torch.tensor([p.residual_rms * p.mm_per_unit for p in partitions], device=device)[:, None]
        self.truncation_mm = torch.tensor(
            np.stack([p.validation_truncation * p.mm_per_unit for p in partitions]),
            dtype=torch.float32,
            device=device,
        )
        self.left_mm = torch.tensor([p.basis.truncation * p.mm_per_unit for p in partitions], device=device)[:, None]
        self.model = PartitionNetworks(
            [a.shape[1] for a in inputs],
            [a.shape[1] for a in targets],
            config.hidden,
            config.activation,
            config.dropout,
            torch.Generator().manual_seed(config.seed),
        ).to(device)
        self._start_average()
        self.best = [average.clone() for average in self.averaged]
        self.best_mm = torch.full((len(partitions),), torch.inf, device=device)
        # (P, F): what the standardized features have been multiplied by.
        self.input_weights = torch.ones_like(self.x[:, 0])

    @torch.enable_grad()
    def weigh_inputs(self) -> torch.Tensor:
        """Multiply each input by how far it moves the outputs now, and give these (P, 1, F) factors.

        What a partition hardly depends on is hardly seen from then on, and nothing is read out of what it has in common
        with the residuals by chance. Such a weight for each input is what automatic relevance determination finds for
        a kernel (MacKay, 1994); here the networks themselves say it, by their root mean square gradients.
        """
        generator = torch.Generator().manual_seed(self.config.seed + 3)
        inputs = self.x[:, :: -(-self.x.shape[1] // WEIGHED_BY)].clone().requires_grad_(True)
        outputs = self._averaged_outputs(inputs)
        # Along random directions: the mean square over poses is that of all outputs together.
        directions = torch.randn(outputs.shape, generator=generator).to(self.device)
        (gradients,) = torch.autograd.grad(outputs, inputs, directions)
        squared = gradients.square().mean(dim=1, keepdim=True)
        used = torch.tensor([p.inputs.shape[1] for p in self.partitions], device=self.device)[:, None, None]
        mean = squared.sum(dim=2, keepdim=True) / used
        weights = torch.where(mean > 0, (squared / mean).sqrt(), 1.0).clamp(min=LEAST_WEIGHT)
        self.x *= weights
        self.x_validation *= weights
        self.input_weights *= weights[:, 0]
        # The best answers so far stay what they are.
        self.best[0] /= weights.transpose(1, 2)
        return weights

    @torch.no_grad()
    def start_from(self, networks: list[Network | None]) -> None:
        """Take the initial weights from networks, as `best_networks` gives them, where there are any.

        Inputs are weighed once, and the networks answer as before: this is no time to change what they know.
        """
        for number, (network, scale) in enumerate(zip(networks, self.scales, strict=True)):
            if network is None:
                continue
            last = len(network.weights) - 1
            for layer, (weight, bias) in enumerate(zip(network.weights, network.biases, strict=True)):
                factor = np.float32(1 / scale) if layer == last else np.float32(1)
                rows, columns = weight.shape
                self.model.weights[layer][number, :rows, :columns] = torch.from_numpy(weight * factor)
                self.model.biases[layer][number, 0, :columns] = torch.from_numpy(bias * factor)
        self._start_average()
        weights = self.weigh_inputs()
        for first_layer in (self.model.weights[0], self.averaged[0]):
            first_layer /= weights.transpose(1, 2)

    def _start_average(self) -> None:
        self.averaged = [parameter.detach().clone() for parameter in self.model.parameters()]

    def run(
        self,
        curves: list[Curves],
        progress: Callable[[Progress], None] | None,
        should_stop: Callable[[], bool],
        everything: Sequence[PreparedPartition],
    ) -> None:
        config, poses = self.config, self.x.shape[1]
        steps = -(-poses // config.batch_size)
        optimizer = OneCycleAdamW(
            self.model.parameters(), config.learning_rate, config.weight_decay, config.epochs * steps, WARM_UP
        )
        order_generator = torch.Generator().manual_seed(config.seed + 1)
        drop_generator = torch.Generator(self.device).manual_seed(config.seed + 2)
        vertices = np.array([p.vertices for p in everything])
        constant = [p for p in everything if not len(p.basis.shapes)]
        constant_mm = sum(float(p.validation_truncation.mean()) * p.mm_per_unit * p.vertices for p in constant)
        learning_vertices = np.array([p.vertices for p in self.partitions])
        weighed = {round(part * config.epochs) for part in WEIGHED_AFTER} - {0}
        for epoch in range(1, config.epochs + 1):
            if epoch - 1 in weighed:
                self.weigh_inputs()
            order = torch.randperm(poses, generator=order_generator).to(self.device)
            training_mm = torch.zeros(len(self.partitions), device=self.device)
            for step in range(steps):
                if should_stop():
                    raise Cancelled
                batch = order[step * config.batch_size : (step + 1) * config.batch_size]
                errors = self._step(optimizer, batch, drop_generator)
                self._average((epoch - 1) * steps + step)
                training_mm += (errors * self.to_mm.square() + self.left_mm.square()).sqrt().sum(dim=1)
            validation_mm, worst_mm = self._validate()
            self._keep_best(validation_mm, epoch, curves)
            validation = validation_mm.cpu().numpy()
            if not np.isfinite(validation).all():
                raise TrainingError(
                    f"The training diverged in epoch {epoch}: errors are not numbers; use a smaller learning rate than "
                    f"{config.learning_rate:g}."
                )
            learned = (training_mm / poses).tolist()
            for curve, train_mm, own_mm, most_mm in zip(curves, learned, validation, worst_mm.tolist(), strict=True):
                curve.training_mm.append(train_mm)
                curve.validation_mm.append(float(own_mm))
                curve.worst_mm.append(most_mm)
            if progress:
                means = [
                    (float(errors @ learning_vertices) + constant_mm) / vertices.sum()
                    for errors in (np.array(learned), validation)
                ]
                progress(Progress(epoch, config.epochs, *means))
            if config.patience and epoch - max(curve.best_epoch for curve in curves) >= config.patience:
                break

    def _step(self, optimizer: OneCycleAdamW, batch: torch.Tensor, generator: torch.Generator) -> torch.Tensor:
        """One step; returns (P, n) squared errors of the poses relative to the partition's residual."""
        optimizer.zero_grad()
        difference = self.model(self.x[:, batch], generator) - self.y[:, batch]
        errors = difference.square().sum(dim=2)
        # The mean distance, not its square: it is what the error is measured by, and a few odd poses do not rule it.
        # Summed over partitions: each network then has the gradient that it would have alone.
        loss = (errors + SMOOTHING).sqrt().mean(dim=1).sum()
        if self.config.l1:
            loss = loss + self.config.l1 * sum(weight.abs().sum() for weight in self.model.weights)
        if self.config.l2:
            loss = loss + self.config.l2 * sum(weight.square().sum() for weight in self.model.weights)
        loss.backward()
        optimizer.step()
        return errors.detach()

    @torch.no_grad()
    def _average(self, step: int) -> None:
        """Move the running average of the weights; fast in the first steps, where they change most."""
        decay = min(self.config.averaging, (1 + step) / (10 + step)) if self.config.averaging else 0.0
        torch._foreach_lerp_(self.averaged, list(self.model.parameters()), 1 - decay)

    def _averaged_outputs(self, inputs: torch.Tensor) -> torch.Tensor:
        names = [name for name, _ in self.model.named_parameters()]
        return functional_call(self.model, dict(zip(names, self.averaged, strict=True)), (inputs,))

    @torch.no_grad()
    def _validate(self) -> tuple[torch.Tensor, torch.Tensor]:
        """(P,) mean error of the validation poses with the averaged weights, and that of the worst of them, mm."""
        difference = self._averaged_outputs(self.x_validation) - self.y_validation
        squared = difference.square().sum(dim=2) * self.to_mm.square()
        errors = (squared + self.truncation_mm.square()).sqrt()
        return errors.mean(dim=1), errors.max(dim=1).values

    def _keep_best(self, validation_mm: torch.Tensor, epoch: int, curves: list[Curves]) -> None:
        better = validation_mm < self.best_mm
        self.best_mm = torch.where(better, validation_mm, self.best_mm)
        for best, average in zip(self.best, self.averaged, strict=True):
            best[better] = average[better]
        for number in torch.nonzero(better).flatten().tolist():
            curves[number].best_epoch = epoch

    def best_networks(self) -> list[Network]:
        """The best weights of each partition without padding, the coefficients in mesh units again."""
        layers = len(self.model.weights)
        weights, biases = ([t.cpu().numpy() for t in self.best[i * layers : (i + 1) * layers]] for i in range(2))
        input_weights = self.input_weights.cpu().numpy()
        networks = []
        for number, (partition, scale) in enumerate(zip(self.partitions, self.scales, strict=True)):
            own_weights, own_biases = ([a[number].copy() for a in arrays] for arrays in (weights, biases))
            outputs = len(partition.basis.shapes)
            inputs = partition.inputs.shape[1]
            own_weights[0] = own_weights[0][:inputs] * input_weights[number, :inputs, None]
            own_weights[-1] = own_weights[-1][:, :outputs] * np.float32(scale)
            own_biases[-1] = own_biases[-1][:, :outputs] * np.float32(scale)
            networks.append(Network(tuple(own_weights), tuple(bias[0] for bias in own_biases)))
        return networks


def _padded(arrays: list[np.ndarray], poses: np.ndarray, device: torch.device) -> torch.Tensor:
    """(n, width) arrays of the chosen poses as one (P, n, widest) float32 tensor."""
    out = np.zeros((len(arrays), len(poses), max(array.shape[1] for array in arrays)), np.float32)
    for number, array in enumerate(arrays):
        out[number, :, : array.shape[1]] = array[poses]
    return torch.from_numpy(out).to(device)
