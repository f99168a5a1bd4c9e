# SPDX-License-Identifier: GPL-3.0-or-later
"""Which network? Units, layers and activations compared: `python benchmarks/study.py OUT [--seeds 3] [--poses 1000]`.

Builds the arm, records it twice, and trains two of its partitions with every configuration. The learning rate of each
is chosen by the error of validation poses; the errors shown are of the second recording, which neither trains nor
chooses. Writes OUT/study.json, OUT/tables.md and the pictures; what is in OUT already is not made again.
"""

import argparse
import itertools
import os
import subprocess
import sys
from dataclasses import asdict, dataclass
from pathlib import Path

# One thread for everything that is timed. Read when numpy and torch load.
if __name__ == "__main__":
    os.environ.update(OMP_NUM_THREADS="1", OPENBLAS_NUM_THREADS="1", MKL_NUM_THREADS="1")
sys.path.insert(0, str(Path(__file__).resolve().parents[1]))

import numpy as np
import torch

from benchmarks.bench import ROOT, machine
from benchmarks.study_inference import inference_times
from benchmarks.study_pictures import draw_curves, draw_errors
from benchmarks.study_tables import tables
from benchmarks.study_trainings import Trainings, read_material, validation_score
from fdda_addon.core.errors import FDDAError, RecordingError
from fdda_addon.core.output import check_folder_writable, write_json, write_text
from trainer.config import TrainingConfig

PARTITIONS = ("shoulder", "index_0")
HELD_OUT_POSES = 300
TRAINING_SEED, HELD_OUT_SEED = 0, 1
"""Of the recordings. Those of the trainings are others."""
TOLERANCE_MM = 0.02
"""Of the basis, finer than the trainer's default: what it leaves would hide how the networks differ."""
VALIDATION_FRACTION = 0.1
"""Of the training recording; it holds nothing else back, as the other recording is there to measure on."""


@dataclass(frozen=True)
class Plan:
    """What is compared.

    Attributes:
        units, layers, activations: of the hidden layers; every combination is a configuration.
        beside: further configurations; the trainer's default, to compare with.
        learning_rates: from which each configuration takes the best, by the validation error with the first seed.
        seeds: of the split, the initial weights and the order of the poses.
        epochs: of every training. All other settings but the split and the tolerance are the trainer's defaults.
    """

    units: tuple[int, ...] = (128, 512)
    layers: tuple[int, ...] = (2, 3)
    activations: tuple[str, ...] = ("silu", "tanh", "relu")
    beside: tuple[tuple[int, int, str], ...] = (
        (TrainingConfig.hidden[0], len(TrainingConfig.hidden), TrainingConfig.activation),
    )
    learning_rates: tuple[float, ...] = (0.002, 0.005, 0.01)
    seeds: tuple[int, ...] = (0, 1, 2)
    epochs: int = TrainingConfig.epochs

    def configurations(self) -> list[tuple[int, int, str]]:
        """Units, layers and activation of each."""
        return [*self.beside, *itertools.product(self.units, self.layers, self.activations)]

    def config(self, units: int, layers: int, activation: str, rate: float, seed: int) -> TrainingConfig:
        return TrainingConfig(
            seed=seed,
            hidden=(units,) * layers,
            activation=activation,
            learning_rate=rate,
            epochs=self.epochs,
            tolerance_mm=TOLERANCE_MM,
            validation_fraction=VALIDATION_FRACTION,
        )


def compare(plan: Plan, trainings: Trainings) -> list[dict]:
    """Train every configuration of the plan, with the best of its learning rates.

    Returns:
        For each, its units, layers, activation, the score of every learning rate, the one chosen, and its trainings.
    """
    configurations = []
    for units, layers, activation in plan.configurations():
        tried = {
            rate: validation_score(trainings.get(plan.config(units, layers, activation, rate, plan.seeds[0])))
            for rate in plan.learning_rates
        }
        rate = min(tried, key=tried.__getitem__)
        configurations.append(
            {
                "units": units,
                "layers": layers,
                "activation": activation,
                "learning_rate": rate,
                "learning_rates": {f"{tried_rate:g}": score for tried_rate, score in tried.items()},
                "trainings": [trainings.get(plan.config(units, layers, activation, rate, seed)) for seed in plan.seeds],
            }
        )
    return configurations


def study(training: Path, held_out: Path, out: Path, plan: Plan, names: tuple[str, ...] = PARTITIONS) -> dict:
    """The whole study of two recordings; writes everything but them.

    Args:
        training, held_out: folders of recordings of one rig.
        out: the folder to write into.
        plan: what is compared.
        names: of the partitions.

    Returns:
        What study.json holds.

    Raises:
        FDDAError: the recordings are no good, or a training fails.
    """
    material = read_material(training, held_out, names)
    trainings = Trainings(material, out / "trainings", lambda text: print(text, file=sys.stderr, flush=True))
    configurations = compare(plan, trainings)
    pose = np.array(material.held_out.pose_matrices[:1])
    times = inference_times(
        [[out / "trainings" / t["model"] for t in configuration["trainings"]] for configuration in configurations], pose
    )
    for configuration, microseconds in zip(configurations, times, strict=True):
        configuration["inference_us"] = microseconds
    result = {
        "machine": machine() | {"torch": str(torch.__version__)},
        "unit": "mm",
        "plan": asdict(plan),
        "poses": {"training": len(material.training.pose_matrices), "held_out": len(material.held_out.pose_matrices)},
        "partitions": list(names),
        "configurations": configurations,
    }
    write_json(out / "study.json", result)
    write_text(out / "tables.md", tables(result))
    draw_curves(result, out / "study_curves.png")
    draw_errors(result, out / "study_errors.png")
    return result


def record_arm(out: Path, poses: int) -> tuple[Path, Path]:
    """Build and record the arm, or go on where that was interrupted; the folders of both recordings."""
    rig, training, held_out = (out / name for name in ("arm.blend", "training", "held_out"))
    if not rig.exists():
        _command("build-arm", rig)
    for folder, count, seed in ((training, poses, TRAINING_SEED), (held_out, HELD_OUT_POSES, HELD_OUT_SEED)):
        _command("record", rig, folder, "--poses", count, "--seed", seed, "--resume")
    return training, held_out


def _command(*arguments: object) -> None:
    """Run a verb of the add-on; its last line is the error when it fails."""
    command = [sys.executable, "-m", "fdda_addon", *map(str, arguments)]
    environment = {**os.environ, "PYTHONPATH": str(ROOT)}
    done = subprocess.run(command, capture_output=True, text=True, env=environment)
    if done.returncode:
        raise RecordingError((done.stderr.strip().splitlines() or [f"{arguments[0]} failed without a word."])[-1])


def main(arguments: list[str] | None = None) -> int:
    """Do what the command line asks for; returns the exit status."""
    parser = argparse.ArgumentParser("study", description=__doc__.partition("\n")[0])
    parser.add_argument("out", type=Path, help="folder for all that is made")
    parser.add_argument("--seeds", type=int, default=3, help="trainings of each configuration (default 3)")
    parser.add_argument("--poses", type=int, default=1000, help="to train on (default 1000)")
    options = parser.parse_args(arguments)
    if options.seeds < 1 or options.poses < 1:
        parser.error("--seeds and --poses must be 1 or more")
    try:
        check_folder_writable(options.out)
        torch.set_num_threads(1)
        options.out.mkdir(parents=True, exist_ok=True)
        recordings = record_arm(options.out, options.poses)
        study(*recordings, options.out, Plan(seeds=tuple(range(options.seeds))))
    except FDDAError as error:
        print(error, file=sys.stderr)
        return error.exit_status
    except KeyboardInterrupt:
        return 130
    print((options.out / "tables.md").read_text(encoding="utf-8"))
    return 0


if __name__ == "__main__":
    sys.exit(main())
