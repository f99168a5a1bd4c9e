# SPDX-License-Identifier: GPL-3.0-or-later
"""The trainer on the reference recordings of a Maya arm, beside the published networks trained on the same poses.

    python -m benchmarks.reference_recordings [DATA] [--json OUT.json] [--choose] [--listed] [training settings]

The recordings list the joints that influence a partition, as the reference work found them, and leave some out. Here
every network is offered all joints that were recorded, and finds out which matter; with `--listed` those of its list
alone.

Trains on poses 0 to 699 of eight partitions and measures on poses 700 to 1000, which no setting was chosen on: with
`--choose` it measures on a fifth of the 700 instead, the rest of which it trains on. Errors are in centimeters, as
published. Exits with 0 and says so where the data is missing.
"""

import argparse
import json
import sys
import time
from dataclasses import dataclass, fields
from pathlib import Path

import numpy as np

sys.path.insert(0, str(Path(__file__).resolve().parents[1]))

from fdda_addon.core.partition import Partition
from trainer.config import TrainingConfig, add_options, config_from_arguments
from trainer.data import PartitionData, PreparedPartition, prepare_partition
from trainer.inputs import NetworkInputs, make_inputs
from trainer.joint_fit import make_joint_regression
from trainer.loop import train
from trainer.networks import Network
from trainer.splitting import split_poses

DATA = Path(__file__).resolve().parents[2] / "shared" / "data" / "seed_arm"
TRAINING_POSES = 700
CM = 0.01
SETTINGS = {
    "hidden": (256, 256),
    "batch_size": 32,
    "weight_decay": 1.0,
    "validation_fraction": 0.05,
}
"""Differences from the defaults: the largest published networks, and more regularization for few, noisy poses."""
RELU = {
    "wrist": (0.0801, 0.4991),
    "index_1": (0.0594, 0.6329),
    "middle_2": (0.0188, 0.3216),
    "ring_0": (0.1040, 0.4937),
    "thumb_0": (0.0993, 0.4587),
    "thumb_1": (0.0486, 0.5844),
    "pinky_1": (0.0408, 0.7063),
    "thumb_2": (0.0060, 0.1011),
}
"""Published 2x128 ReLU networks: mean and largest distance over the held-out poses, cm."""


def parent_of(joint: str) -> str | None:
    """The parent of a joint of that arm, by its name."""
    if joint in ("elbow", "wrist"):
        return "elbow" if joint == "wrist" else None
    finger, number = joint.rsplit("_", 1)
    return f"{finger}_{int(number) - 1}" if int(number) else "wrist"


@dataclass(frozen=True)
class ReferencePartition:
    """A partition of the recordings.

    Attributes:
        data: as the trainer takes it.
        joint: index of the main joint.
        poses: (N, J, 4, 4) float64 pose matrices of the joints that are known, meters.
    """

    data: PartitionData
    joint: int
    poses: np.ndarray


def recorded_joints(arrays: dict, entries: list[dict]) -> dict[str, np.ndarray]:
    """(N, 3, 4) float32 local matrices of all joints that are listed for any partition, cm."""
    joints = {}
    for entry in entries:
        matrices = arrays[f"{entry['partition']}.local_matrices"]
        joints |= {joint: matrices[:, number] for number, joint in enumerate(entry["joints"])}
    return joints


def read_partition(name: str, joints: dict[str, np.ndarray], residuals: np.ndarray) -> ReferencePartition:
    """One partition with the features that the trainer makes of a recording.

    Args:
        name: of the main joint.
        joints: the joints to see, and the (N, 3, 4) local matrices of each, cm.
        residuals: (N, Vp, 3) float32, cm.

    Not every joint was recorded. Those between others stay at the identity: their motion is unknown, and the inputs
    leave out every pair that depends on it.
    """
    names = ["elbow"]
    for joint in [name, *joints]:
        chain = []
        while joint and joint not in names:
            chain.append(joint)
            joint = parent_of(joint)
        names += reversed(chain)
    poses = np.tile(np.eye(4), (len(residuals), len(names), 1, 1))
    # Where the surface is was not recorded: three points, a centimeter from each joint, stand in for it.
    points = np.tile(np.eye(3) * CM, (len(names), 1, 1))
    for joint, local in joints.items():
        place = names.index(joint)
        poses[:, place, :3] = local
        poses[:, place, :3, 3] *= CM
        # Half-way to the joint that it carries is the middle of what a joint moves.
        points[names.index(parent_of(joint))] += local[0, :, 3] / 2 * CM
    parents = np.array([names.index(parent_of(joint)) if parent_of(joint) else -1 for joint in names])
    for place in range(1, len(names)):
        poses[:, place] = poses[:, parents[place]] @ poses[:, place]
    own = Partition(names.index(name), tuple(names.index(joint) for joint in joints), np.zeros(0, np.int32))
    inputs: NetworkInputs = make_inputs(parents, points, [own])
    features = inputs.features(poses.astype(np.float32), np.tile(np.eye(4, dtype=np.float32), (len(names), 1, 1)))
    residuals = residuals * np.float32(CM)
    data = PartitionData(
        name,
        features[:, inputs.columns[0]],
        lambda: residuals,
        residuals.shape[1],
        # The rest pose is not known: the identity stands in for it.
        lambda: make_joint_regression(parents, own, poses, np.zeros(3)),
    )
    return ReferencePartition(data, own.joint, poses)


def measure(
    partition: ReferencePartition, prepared: PreparedPartition, network: Network, activation: str, chosen: np.ndarray
) -> tuple[float, float, float]:
    """Mean and largest distance over the chosen poses, and the mean of the residuals themselves, cm."""
    truth, poses = partition.data.read_residuals()[chosen], partition.poses[chosen]
    coefficients = network.coefficients(prepared.inputs[chosen], activation)
    turned = prepared.fit.offsets(poses) @ np.linalg.inv(poses[:, partition.joint, :3, :3]).transpose(0, 2, 1)
    errors = np.linalg.norm(turned + prepared.basis.residuals(coefficients).reshape(truth.shape) - truth, axis=2)
    return float(errors.mean() / CM), float(errors.max() / CM), float(np.linalg.norm(truth, axis=2).mean() / CM)


def run(folder: Path, config: TrainingConfig, choose: bool, listed: bool) -> dict:
    """Train, measure, and compare; what `--json` writes."""
    entries = json.loads((folder / "recording.json").read_text(encoding="utf-8"))["partitions"]
    with np.load(folder / "recording.npz", allow_pickle=False) as arrays:
        arrays = dict(arrays)
    started = time.perf_counter()
    known = recorded_joints(arrays, entries)
    every = []
    for entry in entries:
        name, own = entry["partition"], {joint: known[joint] for joint in entry["joints"]}
        every.append(read_partition(name, own if listed else own | known, arrays[f"{name}.residuals"]))
    poses = len(every[0].poses)
    if choose:
        order = np.random.default_rng(config.seed + 1000).permutation(TRAINING_POSES)
        measured, trained_on = np.sort(order[: TRAINING_POSES // 5]), np.sort(order[TRAINING_POSES // 5 :])
    else:
        measured, trained_on = np.arange(TRAINING_POSES, poses), np.arange(TRAINING_POSES)
    split = split_poses(trained_on, config.validation_fraction, config.seed)
    prepared = [prepare_partition(partition.data, split, config.tolerance_mm, config.seed) for partition in every]
    result = train(prepared, split, config)
    rows = []
    for partition, ready, network in zip(every, prepared, result.networks, strict=True):
        mean, largest, linear = measure(partition, ready, network, config.activation, measured)
        published = RELU[ready.name]
        rows.append(
            {
                "partition": ready.name,
                "components": len(ready.basis.components),
                "linear_mean": linear,
                "mean": mean,
                "max": largest,
                "relu_mean": published[0],
                "relu_max": published[1],
            }
        )
    totals = {key: float(np.mean([row[key] for row in rows])) for key in ("linear_mean", "mean", "relu_mean")}
    totals |= {key: max(row[key] for row in rows) for key in ("max", "relu_max")}
    return {
        "unit": "cm",
        "joints": "listed" if listed else "all",
        "poses": "a fifth of 0-699" if choose else "700-1000",
        "partitions": rows,
        "all": totals,
        "mean_of_relu": totals["mean"] / totals["relu_mean"],
        "seconds": time.perf_counter() - started,
        "settings": config.to_json(),
    }


def print_table(result: dict) -> None:
    print(f"Errors in cm over poses {result['poses']}; relu: the published 2x128 ReLU networks over 700-1000.")
    print(
        f"{'partition':10} {'components':>10} {'linear':>8} {'mean':>8} {'max':>8} "
        f"{'relu mean':>10} {'relu max':>9} {'':>6}"
    )
    for row in [*result["partitions"], {"partition": "all", "components": "", **result["all"]}]:
        print(
            f"{row['partition']:10} {row['components']:>10} "
            f"{row['linear_mean']:8.4f} {row['mean']:8.4f} {row['max']:8.4f} "
            f"{row['relu_mean']:10.4f} {row['relu_max']:9.4f} {100 * row['mean'] / row['relu_mean']:5.1f} %"
        )
    print(f"{result['seconds']:.1f} s")


def main() -> int:
    parser = argparse.ArgumentParser("reference_recordings", description="The trainer on the reference recordings.")
    parser.add_argument("data", type=Path, nargs="?", default=DATA, help="folder of recording.npz")
    parser.add_argument("--json", type=Path, help="write the result here")
    parser.add_argument("--choose", action="store_true", help="measure on a part of the 700 training poses")
    parser.add_argument("--listed", action="store_true", help="see the joints listed for a partition alone")
    add_options(parser)
    parser.set_defaults(**SETTINGS)
    options = parser.parse_args()
    if not (options.data / "recording.npz").exists():
        print(f"Skipped: the reference recordings are not at '{options.data}'; give their folder as an argument.")
        return 0
    assert set(SETTINGS) <= {field.name for field in fields(TrainingConfig)}
    result = run(options.data, config_from_arguments(options), options.choose, options.listed)
    print_table(result)
    if options.json:
        options.json.write_text(json.dumps(result, indent=1) + "\n", encoding="utf-8")
    return 0


if __name__ == "__main__":
    sys.exit(main())
