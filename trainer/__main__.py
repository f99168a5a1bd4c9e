# SPDX-License-Identifier: GPL-3.0-or-later
"""The command line of the trainer: `python -m trainer RECORDING MODEL.onnx`.

Exit status:
    0: the model is written.
    1: the training failed; stderr has one sentence.
    2: the arguments are wrong.
    75: the training failed because disk space or memory ran out.
    130: the training was interrupted.
"""

import argparse
import sys
from pathlib import Path

from fdda_addon.core.files.stop_signals import exit_on_stop_signal
from fdda_addon.core.files.temporary import check_temporary_folder
from fdda_addon.core.files.terminal import escape_unencodable_output

if __name__ == "__main__":
    # Before the other imports: a signal during an import would otherwise end in a traceback.
    exit_on_stop_signal()

from .config import add_options, config_from_arguments
from .outputs import check_training_outputs
from .process import StopRequest, missing_package_error, run_with_messages
from .progress import MessageSink


def main(arguments: list[str] | None = None) -> int:
    """Run the command line, and return the exit status."""
    escape_unencodable_output()
    options = _parser().parse_args(arguments)
    sink = MessageSink()
    stop_request = StopRequest(sink)
    return run_with_messages(lambda: _train(options, sink, stop_request), sink)


def _train(options: argparse.Namespace, sink: MessageSink, stop_request: StopRequest) -> None:
    config = config_from_arguments(options)
    check_temporary_folder()  # torch fails without a temporary folder.
    # Files are checked first, because loading torch takes seconds.
    check_training_outputs(options.model, options.overwrite)
    try:
        with stop_request.exit_immediately():
            from .train import train_model
    except ModuleNotFoundError as error:
        raise missing_package_error("Training", error) from error
    train_model(
        options.recording,
        options.model,
        config,
        sink,
        stop_request.exit_immediately,
        options.warm_start,
        options.strict,
    )


def _parser() -> argparse.ArgumentParser:
    parser = argparse.ArgumentParser("trainer", description="Train a model from a recording.")
    parser.add_argument("recording", type=Path, help="folder that record wrote")
    parser.add_argument("model", type=Path, help="the .onnx file to write, with its report beside it")
    parser.add_argument(
        "--warm-start", action="store_true", help="start from the checkpoint of the model, on a recording that grew"
    )
    parser.add_argument("--strict", action="store_true", help="treat warnings about the recording as errors")
    parser.add_argument("--overwrite", action="store_true", help="overwrite files of another kind")
    add_options(parser)
    return parser


if __name__ == "__main__":
    sys.exit(main())
