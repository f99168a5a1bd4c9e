# SPDX-License-Identifier: GPL-3.0-or-later
"""The command line of the trainer: `python -m trainer RECORDING MODEL.onnx`.

Exit status: 0 done, 1 failed with one sentence on stderr, 2 wrong usage, 130 interrupted.
"""

import argparse
import os
import signal
import sys
import traceback
from pathlib import Path

from fdda_addon.core.errors import FDDAError, TrainingError
from fdda_addon.core.messages import MessageType

from .announcements import Announcer, MessageLines, Text
from .config import add_options, config_from_arguments

INTERRUPTED = 130
# Threads of OpenMP that wait by spinning make training ten times slower on a machine that is busy with something else,
# and no faster on one that is not. Read when torch loads.
os.environ.setdefault("OMP_WAIT_POLICY", "PASSIVE")
# Half the processors: the networks are small, and a second thread on two busy processors costs far more than it brings.
os.environ.setdefault("OMP_NUM_THREADS", str(max(1, (os.cpu_count() or 2) // 2)))


def main(arguments: list[str] | None = None) -> int:
    """Train as the arguments say; returns the exit status."""
    options = _parser().parse_args(arguments)
    announcer: Announcer = MessageLines() if options.messages else Text()
    stop = _StopRequest()
    try:
        status = _train(options, announcer, stop)
    except BrokenPipeError:
        # Whoever started the training is gone. Python would complain once more when it closes stdout.
        os.dup2(os.open(os.devnull, os.O_WRONLY), sys.stdout.fileno())
        return 1
    return status


def _train(options: argparse.Namespace, announcer: Announcer, stop: "_StopRequest") -> int:
    """Run the training; every way out but a broken pipe announces one last message."""
    try:
        config = config_from_arguments(options)
        training, cancelled = _import_training()
        try:
            training(options.recording, options.model, config, announcer, stop, options.warm_start)
        except cancelled:
            announcer.say(MessageType.CANCELLED)
            return INTERRUPTED
    except FDDAError as error:
        return _failed(str(error), announcer)
    except BrokenPipeError:
        raise
    except Exception as error:  # The boundary: the add-on waits for a last message, whatever happened.
        traceback.print_exc()
        return _failed(f"The trainer stopped on an error of its own ({error!r}); please report it.", announcer)
    return 0


def _failed(text: str, announcer: Announcer) -> int:
    announcer.say(MessageType.FAILED, text=text)
    print(text, file=sys.stderr)
    return 1


def _import_training():
    """The function that trains, and the exception that says it was cancelled.

    Raises:
        TrainingError: a package that training needs is missing.
    """
    try:
        from .loop import Cancelled
        from .training import train_model
    except ModuleNotFoundError as error:
        raise TrainingError(
            f"Training needs the Python package '{error.name}', which {sys.executable} does not have; install torch, "
            "onnx, onnxruntime, numpy and matplotlib there, create the trainer environment in the preferences of the "
            "add-on, or set FDDA_TRAINER_PYTHON to a Python that has them."
        ) from error
    return train_model, Cancelled


class _StopRequest:
    """True once the process was asked to end: Ctrl-C, or SIGTERM from the add-on."""

    def __init__(self):
        self.requested = False
        for number in (signal.SIGINT, signal.SIGTERM):
            signal.signal(number, self._request)

    def _request(self, *_) -> None:
        self.requested = True

    def __call__(self) -> bool:
        return self.requested


def _parser() -> argparse.ArgumentParser:
    parser = argparse.ArgumentParser("trainer", description="Train a model from a recording.")
    parser.add_argument("recording", type=Path, help="folder that record made")
    parser.add_argument("model", type=Path, help="the .onnx file to write; the report is written beside it")
    parser.add_argument(
        "--messages", action="store_true", help="JSON messages on stdout, for a program, in place of text"
    )
    parser.add_argument(
        "--warm-start", action="store_true", help="start from the last weights of the model, on a recording that grew"
    )
    add_options(parser)
    return parser


if __name__ == "__main__":
    sys.exit(main())
