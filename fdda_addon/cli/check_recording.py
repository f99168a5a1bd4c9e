# SPDX-License-Identifier: GPL-3.0-or-later
"""`check-recording RECORDING`: checks a recording for problems before training."""

import argparse
from pathlib import Path

from ..core.checks.recording import check_recording
from ..core.checks.warning import raise_first_warning
from ..core.errors import RecordingError
from ..core.files.file_kind import WARNINGS
from ..core.files.output import check_outputs, write_json
from ..core.recording.index import repeatability_sentence
from ..core.recording.reader import read_recording
from ..core.recording.skinned import skin_recording
from .files import add_overwrite_option


def add_options(parser: argparse.ArgumentParser) -> None:
    parser.add_argument("recording", metavar="RECORDING", type=Path, help="folder of the recording")
    parser.add_argument("--strict", action="store_true", help="treat warnings as errors")
    parser.add_argument("--json", metavar="OUT.json", type=Path, help="file to write the warnings to")
    add_overwrite_option(parser)


def run(options: argparse.Namespace) -> None:
    """Print the warnings, one per line.

    Raises:
        RecordingError: the recording cannot be read, or --strict is given and there are warnings.
        OutputError: the file cannot be written.
    """
    if options.json:
        check_outputs({options.json: WARNINGS}, overwrite=options.overwrite)
    recording = read_recording(options.recording)
    if not recording.rig.has_weights:
        raise RecordingError(
            f"The rig of '{options.recording}' has no skin weights, and its residuals follow from fitted ones; train "
            "with --base-skinning smooth, which checks the recording."
        )
    if sentence := repeatability_sentence(recording.info.repeatability_mm):
        print(sentence)
    warnings = check_recording(skin_recording(recording))
    for warning in warnings:
        print(warning)
    if options.json:
        write_json(options.json, {"warnings": [warning.to_json() for warning in warnings]})
    if options.strict:
        raise_first_warning(warnings)
    if not warnings:
        print(f"{options.recording}: no problems were found")
