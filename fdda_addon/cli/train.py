# SPDX-License-Identifier: GPL-3.0-or-later
"""`train RECORDING MODEL.onnx …`: the trainer with its own options, started in the Python that has torch."""

import subprocess

from ..core.messages import MessageType
from ..training import Training, trainer_command
from .progress import ProgressPrinter

INTERRUPTED = 130


def run(arguments: list[str]) -> int:
    """Train; `arguments` are those of `python -m trainer`. Returns the exit status."""
    if not arguments or {"-h", "--help"} & set(arguments):
        command, environment = trainer_command(arguments)
        return subprocess.run(command, env=environment, check=False).returncode
    with Training(arguments) as training, ProgressPrinter() as progress:
        for message in training.messages():
            values = message.values
            if message.type is MessageType.PROGRESS:
                note = f"validation {values['validation_mm']:.4f} mm"
                progress.show("training", values["epoch"], values["epochs"], note)
            elif message.type is MessageType.LOG:
                progress.say(values["text"])
            elif message.type is MessageType.CANCELLED:
                return INTERRUPTED
    print(f"{values['model']}: trained in {values['seconds']:.1f} s, validation error {values['validation_mm']:.4f} mm")
    return 0
