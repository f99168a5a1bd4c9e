# SPDX-License-Identifier: GPL-3.0-or-later
"""Trains several models in one process: starting PyTorch takes longer than training what the tests need."""

import json
import os
import subprocess
import sys
from collections.abc import Iterable
from pathlib import Path

ROOT = Path(__file__).resolve().parents[2]
CODE = """
import json, sys
from trainer.__main__ import main
for arguments in json.loads(sys.argv[1]):
    if status := main(arguments):
        sys.exit(status)
"""


def train_all(recordings: Iterable[tuple[Path, Path]], *options: object) -> None:
    """Train a model from each recording, all with the same options.

    Args:
        recordings: folder of the recording and the .onnx file to write.
        options: of the trainer's command line.
    """
    lines = [[str(recording), str(model), *map(str, options)] for recording, model in recordings]
    python = os.environ.get("FDDA_TRAINER_PYTHON", sys.executable)
    command = [python, "-c", CODE, json.dumps(lines)]
    done = subprocess.run(command, cwd=ROOT, capture_output=True, text=True, check=False)
    assert done.returncode == 0, done.stderr
