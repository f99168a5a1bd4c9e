# SPDX-License-Identifier: GPL-3.0-or-later
"""Compare the trainer with the published networks on the reference recordings of a Maya arm.

    python -m benchmarks.reference_recordings [DATA] [--json OUT.json] [--choose] [--listed] [training settings]

For each partition, the recordings list the joints that the reference work chose as inputs; these lists leave out some
joints. By default every network gets all recorded joints as inputs and learns which of them matter. With `--listed`,
each network gets only the joints of its list.

Trains on poses 0 to 699 of eight partitions and measures on poses 700 to 1000, which were not used to choose settings.
To choose settings, use `--choose`: it measures on a fifth of the 700 poses and trains on the rest. Errors are in
centimeters, as published. If the data is missing, prints that and exits with status 0.
"""

import argparse
import json
import sys
import time
from dataclasses import dataclass, fields, replace
from pathlib import Path

import numpy as np

sys.path.insert(0, str(Path(__file__).resolve().parents[1]))

from fdda_addon.core.mathematics.partition import Partition
from fdda_addon.core.rig import Fingerprint, Joint, Rig
from fdda_addon.core.settings import MAX_DETAIL_MM, automatic_passes
from trainer.config import TrainingConfig, add_options, config_from_arguments
from trainer.data.split import split_poses
from trainer.device import choose_device
from trainer.fits.joint_fit import joint_regression
from trainer.inputs.joints import JointFeatures
from trainer.inputs.network_inputs import NetworkInputs
from trainer.networks.loop import train
from trainer.networks.networks import TrainedPartition
from trainer.preparation import PartitionData, prepare_partition

DATA_FOLDER = Path(__file__).resolve().parents[2] / "shared" / "data" / "seed_arm"
TRAINING_POSES = 700
METERS_PER_CM = 0.01
SETTINGS = {
    "hidden": (256, 256),
    "batch_size": 32,
    "weight_decay": 1.0,
    "validation_fraction": 0.05,
}
"""Settings that differ from the defaults.

The hidden layers are those of the largest published networks. The poses are few and noisy, so weight decay is larger.
"""
PUBLISHED_ERRORS_CM = {
    "wrist": (0.0801, 0.4991),
    "index_1": (0.0594, 0.6329),
    "middle_2": (0.0188, 0.3216),
    "ring_0": (0.1040, 0.4937),
    "thumb_0": (0.0993, 0.4587),
    "thumb_1": (0.0486, 0.5844),
    "pinky_1": (0.0408, 0.7063),
    "thumb_2": (0.0060, 0.1011),
}
"""Errors of the published 2x128 ReLU networks: mean and largest distance over the held-out poses, cm."""


def parent_of(joint: str) -> str | None:
    """Return the parent of a joint of the Maya arm, derived from the joint's name."""
    if joint in ("elbow", "wrist"):
        return "elbow" if joint == "wrist" else None
    finger, number = joint.rsplit("_", 1)
    return f"{finger}_{int(number) - 1}" if int(number) else "wrist"


@dataclass(frozen=True)
class ReferencePartition:
    """A partition of the recordings.

    Attributes:
        name: name of the main joint.
        data: features and residuals in the form that the trainer reads.
        joint: index of the main joint.
        poses: (N, J, 4, 4) float64 pose matrices of all joints, meters.
    """

    name: str
    data: PartitionData
    joint: int
    poses: np.ndarray


def recorded_joints(arrays: dict, entries: list[dict]) -> dict[str, np.ndarray]:
    """Return the local matrices of all joints that any partition lists, by name: (N, 3, 4) float32, cm."""
    joints = {}
    for entry in entries:
        matrices = arrays[f"{entry['partition']}.local_matrices"]
        joints |= {joint: matrices[:, index] for index, joint in enumerate(entry["joints"])}
    return joints


def read_partition(name: str, joints: dict[str, np.ndarray], residuals: np.ndarray) -> ReferencePartition:
    """Compute the features of one partition as the trainer does for a recording.

    Args:
        name: name of the main joint.
        joints: (N, 3, 4) local matrices of each input joint, by name, cm.
        residuals: (N, Vp, 3) float32, cm.

    Not every joint was recorded. The motion of an unrecorded joint is unknown: its local matrix is the identity.
    """
    names = ["elbow"]
    for joint in [name, *joints]:
        chain = []
        while joint and joint not in names:
            chain.append(joint)
            joint = parent_of(joint)
        names += reversed(chain)
    poses = np.tile(np.eye(4), (len(residuals), len(names), 1, 1))
    for joint, local in joints.items():
        index = names.index(joint)
        poses[:, index, :3] = local
        poses[:, index, :3, 3] *= METERS_PER_CM
    hierarchy = tuple(Joint(joint, names.index(parent_of(joint)) if parent_of(joint) else -1) for joint in names)
    for index in range(1, len(names)):
        poses[:, index] = poses[:, hierarchy[index].parent] @ poses[:, index]
    # The rest pose is not known: the identity replaces it, and one vertex at the origin the mesh.
    rest_matrices, skin = np.tile(np.eye(4, dtype=np.float32), (len(names), 1, 1)), np.zeros((1, 1), np.int32)
    rig = Rig(hierarchy, np.zeros((1, 3), np.float32), rest_matrices, skin, 1.0 + skin, Fingerprint("", "", ""))
    partition = Partition(names.index(name), tuple(names.index(joint) for joint in joints), np.zeros(1, np.int32))
    inputs = NetworkInputs.of([JointFeatures.make(rig, [], {})], [partition])
    features = inputs.compute_features(poses.astype(np.float32), np.zeros((len(poses), 0)))
    residuals = residuals * np.float32(METERS_PER_CM)
    data = PartitionData(
        features[:, inputs.columns[0]],
        lambda: residuals,
        # The size of the character is not known: a meter replaces it.
        lambda: replace(joint_regression(rig, partition, poses), size=1.0),
    )
    return ReferencePartition(name, data, partition.joint, poses)


def measure(
    partition: ReferencePartition, prepared: TrainedPartition, measured: np.ndarray
) -> tuple[float, float, float]:
    """Return the mean and largest error over the measured poses and the mean length of their residuals, cm."""
    true_residuals, poses = partition.data.read_residuals()[measured], partition.poses[measured]
    coefficients = prepared.network.evaluate(prepared.inputs[measured])
    fitted = prepared.fit.compute_offsets(poses) @ np.linalg.inv(poses[:, partition.joint, :3, :3]).transpose(0, 2, 1)
    learned = prepared.basis.reconstruct(coefficients).reshape(true_residuals.shape)
    errors_cm = np.linalg.norm(fitted + learned - true_residuals, axis=2) / METERS_PER_CM
    linear_errors_cm = np.linalg.norm(true_residuals, axis=2) / METERS_PER_CM
    return float(errors_cm.mean()), float(errors_cm.max()), float(linear_errors_cm.mean())


def run(folder: Path, config: TrainingConfig, is_choosing: bool, only_listed: bool) -> dict:
    """Train and measure; return the comparison with the published errors, which `--json` writes."""
    entries = json.loads((folder / "recording.json").read_text(encoding="utf-8"))["partitions"]
    with np.load(folder / "recording.npz", allow_pickle=False) as arrays:
        arrays = dict(arrays)
    start_time = time.perf_counter()
    joint_matrices = recorded_joints(arrays, entries)
    partitions = []
    for entry in entries:
        name, listed_joints = entry["partition"], {joint: joint_matrices[joint] for joint in entry["joints"]}
        input_joints = listed_joints if only_listed else listed_joints | joint_matrices
        partitions.append(read_partition(name, input_joints, arrays[f"{name}.residuals"]))
    pose_count = len(partitions[0].poses)
    if is_choosing:
        order = np.random.default_rng(config.seed + 1000).permutation(TRAINING_POSES)
        measured, trained_on = np.sort(order[: TRAINING_POSES // 5]), np.sort(order[TRAINING_POSES // 5 :])
    else:
        measured, trained_on = np.arange(TRAINING_POSES, pose_count), np.arange(TRAINING_POSES)
    split = split_poses(trained_on, config.validation_fraction, config.seed)
    detail_mm = config.detail_mm or MAX_DETAIL_MM
    config = replace(config, passes=config.passes or automatic_passes(len(trained_on)))
    prepared = [prepare_partition(partition.data, split, detail_mm, config.seed) for partition in partitions]
    rows = []
    for partition, trained in zip(partitions, train(prepared, split, config, choose_device().device), strict=True):
        mean, largest, linear = measure(partition, trained, measured)
        published = PUBLISHED_ERRORS_CM[partition.name]
        rows.append(
            {
                "partition": partition.name,
                "components": len(trained.basis.components),
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
        "joints": "listed" if only_listed else "all",
        "poses": "a fifth of 0-699" if is_choosing else "700-1000",
        "partitions": rows,
        "all": totals,
        "mean_of_relu": totals["mean"] / totals["relu_mean"],
        "seconds": time.perf_counter() - start_time,
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
    parser = argparse.ArgumentParser("reference_recordings", description=__doc__.partition("\n")[0])
    parser.add_argument("data", type=Path, nargs="?", default=DATA_FOLDER, help="folder of recording.npz")
    parser.add_argument("--json", type=Path, help="write the result to this file")
    parser.add_argument("--choose", action="store_true", help="measure on a fifth of the 700 training poses")
    parser.add_argument("--listed", action="store_true", help="use only the joints that a partition lists as inputs")
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
