# SPDX-License-Identifier: GPL-3.0-or-later
"""Measure what each mechanism of the trainer brings: `python benchmarks/ablation.py OUT [--characters NAME …]`.

Records each character once. Trains it with all mechanisms, then without one of them at a time, and measures the models
on held-out poses. Writes OUT/tables.md. Models and recordings that are in OUT are used again.
"""

import argparse
import os
import re
import subprocess
import sys
from collections.abc import Sequence
from pathlib import Path

# Use one thread for everything that is timed. Numpy and torch read these variables when they load.
if __name__ == "__main__":
    os.environ.update(OMP_NUM_THREADS="1", OPENBLAS_NUM_THREADS="1", MKL_NUM_THREADS="1")
sys.path.insert(0, str(Path(__file__).resolve().parents[1]))

import numpy as np
import torch

from benchmarks.ablation_mechanisms import ALL, MECHANISMS
from benchmarks.ablation_trainings import ACTION, BEYOND, WITHIN, Character
from fdda_addon.core.errors import FDDAError, RecordingError
from fdda_addon.core.files.output import check_folder_writable, write_text

ROOT = Path(__file__).resolve().parents[1]
CHARACTERS = ("arm-1", "arm-2", "rigify")
POSES, EPOCHS = 600, 60


def record(name: str, folder: Path, poses: int) -> None:
    """Record a character in its own process, unless the folder has its recordings.

    Raises:
        RecordingError: the recording failed.
    """
    if (folder / "character.json").exists():
        return
    command = [sys.executable, str(ROOT / "benchmarks" / "ablation_recordings.py"), name, str(folder)]
    process = subprocess.run([*command, "--poses", str(poses)], capture_output=True, text=True)
    if process.returncode:
        lines = process.stderr.strip().splitlines() or ["it failed without a message"]
        raise RecordingError(f"The character '{name}' cannot be recorded: {lines[-1]}")


def format_table(name: str, results: dict[str, list[dict]]) -> str:
    """Format the results of a character as a Markdown table."""
    kinds = [kind for kind in (ACTION, WITHIN, BEYOND) if kind in results[ALL][0]["errors"]]
    headings = ["without", *kinds, "MB", "time of a pose", "training, s"]
    lines = ["| " + " | ".join(headings) + " |", "|---" * len(headings) + "|"]
    for without, of_seeds in results.items():
        errors = [np.median([result["errors"][kind] for result in of_seeds], axis=0) for kind in kinds]
        size, ratio, seconds = (np.median([r[key] for r in of_seeds]) for key in ("bytes", "frame_ratio", "seconds"))
        cells = [" / ".join(f"{100 * value:.2f}" for value in values) + " %" for values in errors]
        cells += [f"{size / 1e6:.2f}", f"{ratio:.2f}", f"{seconds:.0f}" if seconds else ""]
        lines.append(f"| {'nothing' if without == ALL else without} | " + " | ".join(cells) + " |")
    return f"{name}: mean / p99.9 / largest error relative to linear skinning\n\n" + "\n".join(lines)


def measure(
    out: Path, characters: Sequence[str], seeds: Sequence[int], without: Sequence[str], poses: int, epochs: int
) -> str:
    """Record, train and measure; return the tables of all characters."""
    tables = []
    for name in characters:
        folder = out / re.sub("[^A-Za-z0-9]+", "-", Path(name).name)
        record(name, folder, poses)
        character, results = Character(folder, epochs), {}
        for mechanism in (ALL, *without):
            results[mechanism] = [character.result(mechanism, seed) for seed in seeds]
            print(f"{name}: {mechanism}", file=sys.stderr, flush=True)
        tables.append(format_table(name, results))
        write_text(out / "tables.md", "\n\n".join(tables) + "\n")
    return "\n\n".join(tables)


def main(arguments: Sequence[str] | None = None) -> int:
    """Measure as the command line says; return the exit status."""
    names = list(MECHANISMS)[1:]
    parser = argparse.ArgumentParser("ablation", description=__doc__.partition("\n")[0])
    parser.add_argument("out", type=Path, help="folder for all output")
    parser.add_argument(
        "--characters",
        nargs="+",
        default=CHARACTERS,
        metavar="NAME",
        help="arm-1, arm-2, arm-3, rigify, or FILE.blend or FILE.glb[:ACTION] with the action to hold out",
    )
    parser.add_argument("--seeds", type=int, nargs="+", default=(0, 1, 2), help="seeds of the trainings")
    parser.add_argument("--without", nargs="+", choices=names, default=names, metavar="MECHANISM", help=str(names))
    parser.add_argument("--poses", type=int, default=POSES, help="random poses to train on")
    parser.add_argument("--passes", type=int, default=EPOCHS, help="epochs of each training")
    options = parser.parse_args(arguments)
    try:
        check_folder_writable(options.out)
        torch.set_num_threads(1)
        print(measure(options.out, *(vars(options)[k] for k in ("characters", "seeds", "without", "poses", "passes"))))
    except FDDAError as error:
        print(error, file=sys.stderr)
        return error.exit_status
    except KeyboardInterrupt:
        return 130
    return 0


if __name__ == "__main__":
    sys.exit(main())
