# SPDX-License-Identifier: GPL-3.0-or-later
"""The command line of a skin fit: `python -m trainer.skin RECORDING OUT.npz`. Exit statuses are those of the trainer.

OUT.npz has the joints (V, I) int32 and weights (V, I) float32 of the vertices, the indices `held_out` (n,) of the poses
that were held out, and those of held-out actions, `action_NAME`.
"""

import argparse
import sys
from dataclasses import replace
from pathlib import Path

from fdda_addon.core.files.stop_signals import exit_on_stop_signal

if __name__ == "__main__":
    exit_on_stop_signal()

import numpy as np

from fdda_addon.core.errors import RecordingError
from fdda_addon.core.formats.messages import MessageType
from fdda_addon.core.mathematics.metrics import distances
from fdda_addon.core.mathematics.skinning import LinearSkinning
from fdda_addon.core.recording.index import ALONE, REFINED
from fdda_addon.core.recording.reader import read_recording
from fdda_addon.core.rig import STATIC_JOINT

from ..blocks import block_slices
from ..process import StopRequest, missing_package_error, run_with_messages
from ..progress import JsonMessageSink
from .fit_poses import FitPoses, choose_fit_poses, select_poses

FIT_STAGE = "fit"
MAX_SUM_ERROR = 1e-4
"""Largest difference from 1 of the sum of a vertex's own weights, so that they can replace fitted ones."""


def main() -> int:
    """Run the command line, and return the exit status."""
    parser = argparse.ArgumentParser("trainer.skin", description="Fit skin weights to a recording.")
    parser.add_argument("recording", type=Path)
    parser.add_argument("out", type=Path)
    parser.add_argument("--influences", type=int, required=True, help="largest number of joints per vertex")
    parser.add_argument("--hold-out", action="append", default=[], metavar="NAME", help="action to hold out")
    options, sink = parser.parse_args(), JsonMessageSink()
    stop_request = StopRequest(sink)

    def fit() -> None:
        with stop_request.exit_immediately():
            _fit(options, sink)
        sink.send(MessageType.FINISHED)

    return run_with_messages(fit, sink)


def _fit(options: argparse.Namespace, sink: JsonMessageSink) -> None:
    try:
        from .solver import fit_skin
    except ModuleNotFoundError as error:
        raise missing_package_error("A fit of skin weights", error) from error
    recording = read_recording(options.recording)
    fitted, actions, start = [], {name: [] for name in options.hold_out}, 0
    for source in recording.info.sampling.sources:
        poses = range(start, start + source.poses)
        start += source.poses
        if source.kind not in (ALONE, REFINED):
            actions.get(source.name, fitted).extend(poses)
    for name in (name for name, poses in actions.items() if not poses):
        raise RecordingError(f"The recording '{options.recording}' has no action '{name}'; record it, too.")
    chosen = np.array(fitted, int)[choose_fit_poses(len(fitted), recording.rig.vertex_count)]
    joints = np.array([i for i, name in enumerate(recording.rig.joint_names) if name != STATIC_JOINT])
    # A bone cannot express the static joint.
    fit_poses = select_poses(recording, chosen[::2]).with_joints(joints)
    fitted = fit_skin(
        fit_poses,
        "smooth",
        lambda done: sink.send(MessageType.PREPARING, stage=FIT_STAGE, done=done, total=recording.rig.vertex_count),
        options.influences,
        max_pruning_loss=0.0,
    )
    fitted_joints, weights = keep_better_weights(fit_poses, *fitted)
    held_out = {f"action_{name}": np.array(poses) for name, poses in actions.items()}
    np.savez(options.out, joints=joints[fitted_joints], weights=weights, held_out=chosen[1::2], **held_out)


def keep_better_weights(poses: FitPoses, joints: np.ndarray, weights: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Return (V, I) fitted joints and weights, with the rig's own of the vertices where these are better.

    The fit takes joints as equal that move a vertex nearly alike.
    """
    rig = poses.rig
    order = np.argsort(-rig.skin_weights, axis=1, kind="stable")[:, : weights.shape[1]]
    own = [np.take_along_axis(array, order, axis=1) for array in (rig.skin_joints, rig.skin_weights)]
    is_better = np.abs(own[1].sum(axis=1) - 1) < MAX_SUM_ERROR
    skinnings = [
        LinearSkinning(replace(rig, skin_joints=skin_joints, skin_weights=skin_weights))
        for skin_joints, skin_weights in (own, (joints, weights))
    ]
    squares = np.zeros((2, rig.vertex_count))
    for block in block_slices(len(poses.positions), 3 * rig.vertex_count):
        for row, skinning in zip(squares, skinnings, strict=True):
            row += (distances(skinning.positions(poses.pose_matrices[block]), poses.positions[block]) ** 2).sum(axis=0)
    is_better &= squares[0] < squares[1]
    columns = slice(0, own[0].shape[1])
    for array, own_array in ((joints, own[0]), (weights, own[1])):
        array[is_better] = 0
        array[is_better, columns] = own_array[is_better]
    return joints, weights


if __name__ == "__main__":
    sys.exit(main())
