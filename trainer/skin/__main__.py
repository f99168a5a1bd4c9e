# SPDX-License-Identifier: GPL-3.0-or-later
"""The command line of a skin fit: `python -m trainer.skin RECORDING OUT.npz`. Exit statuses are those of the trainer.

OUT.npz has the joints (V, I) int32 and weights (V, I) float32 of the vertices, the indices `held_out` (n,) of the poses
that were held out, and those of held-out actions, `action_NAME`.
"""

import argparse
import sys
from pathlib import Path

from fdda_addon.core.files.stop_signals import exit_on_stop_signal

if __name__ == "__main__":
    exit_on_stop_signal()

import numpy as np

from fdda_addon.core.errors import RecordingError
from fdda_addon.core.formats.messages import FIT_STAGE, MessageType
from fdda_addon.core.recording.index import ALONE, REFINED
from fdda_addon.core.recording.reader import read_recording
from fdda_addon.core.rig import STATIC_JOINT

from ..process import StopRequest, missing_package_error, run_with_messages
from ..progress import MessageSink
from .fit_poses import choose_fit_poses, select_poses


def main() -> int:
    """Run the command line, and return the exit status."""
    parser = argparse.ArgumentParser("trainer.skin", description="Fit skin weights to a recording.")
    parser.add_argument("recording", type=Path)
    parser.add_argument("out", type=Path)
    parser.add_argument("--influences", type=int, required=True, help="largest number of joints per vertex")
    parser.add_argument("--hold-out", action="append", default=[], metavar="NAME", help="action to hold out")
    options, sink = parser.parse_args(), MessageSink()
    stop_request = StopRequest(sink)

    def fit() -> None:
        with stop_request.exit_immediately():
            _fit(options, sink)
        sink.send(MessageType.FINISHED)

    return run_with_messages(fit, sink)


def _fit(options: argparse.Namespace, sink: MessageSink) -> None:
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
    fitted_joints, weights = fit_skin(
        # A bone cannot express the static joint.
        select_poses(recording, chosen[::2]).with_joints(joints),
        "smooth",
        lambda done: sink.send(MessageType.PREPARING, stage=FIT_STAGE, done=done, total=recording.rig.vertex_count),
        options.influences,
        max_pruning_loss=0.0,
    )
    held_out = {f"action_{name}": np.array(poses) for name, poses in actions.items()}
    np.savez(options.out, joints=joints[fitted_joints], weights=weights, held_out=chosen[1::2], **held_out)


if __name__ == "__main__":
    sys.exit(main())
