# SPDX-License-Identifier: GPL-3.0-or-later
"""The errors that users read.

Each carries one sentence: what is wrong, with names and numbers, and what to do about it. The command line prints
it and exits with status 1; an operator reports it and is cancelled. Any other exception is a bug and propagates.
"""


class FDDAError(Exception):
    """Base of every error whose text is meant for the user; `exit_status` is that of the command line."""

    exit_status = 1


class WrongUsageError(FDDAError):
    """Options that make no sense."""

    exit_status = 2


class RigError(FDDAError):
    """The scene holds no rig that can be recorded, bound or evaluated."""


class RecordingError(FDDAError):
    """A recording cannot be read, resumed or written."""


class ModelError(FDDAError):
    """A model cannot be read, or was trained for another rig."""


class TrainingError(FDDAError):
    """The training could not start, died, or reported a failure."""


class TrainerEnvironmentError(FDDAError):
    """The Python environment of the trainer cannot be made, removed or used."""


class OutputError(FDDAError):
    """An output path cannot be written."""


class PointCacheError(FDDAError):
    """A point cache cannot be read."""
