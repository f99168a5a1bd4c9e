# SPDX-License-Identifier: GPL-3.0-or-later
"""The mechanisms that `ablation.py` switches off: name, and how each is switched off in the process that trains."""

import importlib
from collections.abc import Iterator, Sequence
from contextlib import contextmanager
from dataclasses import dataclass, field

import numpy as np

from trainer.fits.basis import NEGLIGIBLE_RMS_RATIO
from trainer.fits.joint_fit import JointFit, JointRegression

ALL = "all mechanisms"
_fit_all_joints = JointRegression.fit


@dataclass(frozen=True)
class Mechanism:
    """How to train or export without one mechanism.

    Attributes:
        replacements: values by dotted name of what they replace in the trainer.
        is_export: whether the networks stay the same, and only the graph differs.
    """

    replacements: dict[str, object] = field(default_factory=dict)
    is_export: bool = False

    @contextmanager
    def switched_off(self) -> Iterator[None]:
        """Replace what the mechanism consists of, as long as the context lasts."""
        originals = []
        try:
            for dotted_name, value in self.replacements.items():
                owner_name, _, name = dotted_name.rpartition(".")
                owner = _find_owner(owner_name)
                originals.append((owner, name, getattr(owner, name)))
                setattr(owner, name, value)
            yield
        finally:
            for owner, name, original in originals:
                setattr(owner, name, original)


def _find_owner(dotted_name: str) -> object:
    """Return the module, or the class in a module, of a dotted name."""
    module_name, _, name = dotted_name.rpartition(".")
    if name[0].isupper():
        return getattr(importlib.import_module(module_name), name)
    return importlib.import_module(dotted_name)


def _allocate_equally(
    errors: Sequence[np.ndarray], vertex_counts: Sequence[int], tolerance: float, parameters_per_component: int
) -> list[int]:
    """Give each partition the components that it needs to meet the tolerance alone."""
    counts = []
    for partition_errors in errors:
        is_allowed = partition_errors <= max(tolerance, NEGLIGIBLE_RMS_RATIO * float(partition_errors[0]))
        counts.append(int(np.argmax(is_allowed)) if is_allowed.any() else len(partition_errors) - 1)
    return counts


def _fit_main_joint(
    regression: JointRegression, residuals: np.ndarray, training: np.ndarray, min_effect: float = 0.0
) -> tuple[JointFit, np.ndarray]:
    return _fit_all_joints(regression.main_joint_only(), residuals, training)


MECHANISMS = {
    ALL: Mechanism(),
    "linear fit": Mechanism({"trainer.fits.joint_fit.JointRegression.fit": _fit_main_joint}),
    "surface frames": Mechanism({"trainer.inputs.surface_frames.select_surface_frames": lambda *_: ()}),
    "half-rotation features": Mechanism({"trainer.train.half_rotations_help": lambda *_: False}),
    "input relevance": Mechanism({"trainer.networks.loop.RELEVANCE_EPOCH_FRACTIONS": ()}),
    "component allocation": Mechanism({"trainer.preparation.allocate_components": _allocate_equally}),
    "low-rank factors": Mechanism({"trainer.compression.may_factorize": lambda *_: False}),
    "dropped components": Mechanism({"trainer.compression.MIN_GAIN_RATIO": -np.inf}),
    "pieces of layers": Mechanism(
        {"trainer.export.network_nodes._chunk_size": lambda layer_sizes, *_: max(layer_sizes)}, is_export=True
    ),
    "vertex order in blocks": Mechanism({"trainer.export.skinning_nodes.MIN_BLOCK_VERTICES": np.inf}, is_export=True),
}
