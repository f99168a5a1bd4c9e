# SPDX-License-Identifier: GPL-3.0-or-later
"""Fits skin weights to poses that `record` has evaluated: `python -m trainer.skin FOLDER hard|smooth [--joints auto]`.

`core.recording.fit_folder` writes FOLDER, and this command writes the fitted weights into it. It has the same messages
and exit statuses as `python -m trainer`.
"""

import argparse
import sys
from pathlib import Path

from fdda_addon.core.files.terminal import escape_unencodable_output
from fdda_addon.core.joint_option import ALL, parse_joints
from fdda_addon.core.mathematics.skin_fit import FIT_KINDS

from ..process import StopRequest, missing_package_error, run_with_messages
from ..progress import JsonMessageSink, MessageSink


def main(arguments: list[str] | None = None) -> int:
    """Run the command line; returns the exit status."""
    escape_unencodable_output()
    parser = argparse.ArgumentParser("trainer.skin", description="Fit skin weights to the poses in a folder.")
    parser.add_argument("folder", type=Path, help="folder that record made")
    parser.add_argument("kind", choices=FIT_KINDS, help="one joint per vertex, or at most four")
    parser.add_argument("--metres-per-unit", type=float, default=1.0, help="length of a mesh unit in meters")
    parser.add_argument("--joints", type=parse_joints, default=ALL, help="key joints: auto, all, or their number")
    parser.add_argument("--random-poses", type=int, default=0, help="number of random poses, which come first")
    parser.add_argument("--static-joint", type=int, default=-1, help="index of the joint that never moves; -1: none")
    options = parser.parse_args(arguments)
    sink = JsonMessageSink()
    stop_request = StopRequest(sink)
    return run_with_messages(lambda: _fit(options, sink, stop_request), sink)


def _fit(options: argparse.Namespace, sink: MessageSink, stop_request: StopRequest) -> None:
    with stop_request.exit_immediately():
        try:
            from .job import fit_folder
        except ModuleNotFoundError as error:
            raise missing_package_error("Fitting skin weights", error) from error
        fit_folder(sink=sink, **vars(options))


if __name__ == "__main__":
    sys.exit(main())
