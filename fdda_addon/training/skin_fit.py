# SPDX-License-Identifier: GPL-3.0-or-later
"""Fits skin weights to a recording in the trainer's process."""

from pathlib import Path

from ..core.formats.messages import MessageType
from ..core.progress import Job, Progress
from .process import TrainerProcess


class _SkinFitProcess(TrainerProcess):
    module = "trainer.skin"
    failure_message = "The fit of skin weights failed."
    loss_advice = "no weights were fitted, try again"


def fit_skin(recording: Path, out: Path, influences: int, held_out_actions: tuple[str, ...]) -> Job[None]:
    """Fit skin weights to a recording and write them to `out`, whose content `trainer/skin/__main__.py` describes.

    Args:
        influences: largest number of bones per vertex.
        held_out_actions: names of recorded actions to which nothing is fitted.
    """
    options = [f"--influences={influences}", *(f"--hold-out={name}" for name in held_out_actions)]
    with _SkinFitProcess([str(recording), str(out), *options]) as process:
        for message in process.messages(wait=False):
            if message is not None and message.type is MessageType.PREPARING:
                yield Progress(message.values["stage"], message.values["done"], message.values["total"])
            else:
                yield None
