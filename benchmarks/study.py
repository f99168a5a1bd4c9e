# SPDX-License-Identifier: GPL-3.0-or-later
"""Compare units, layers and activations of networks: `python benchmarks/study.py OUT [--seeds 3] [--poses 1000]`.

Builds the arm, records it twice, and trains two of its partitions with every configuration. Chooses the learning rate
of each configuration by the error on validation poses. The tables show errors on the second recording, which is used
neither to train nor to choose. Writes OUT/study.json, OUT/tables.md and the pictures. Skips files that exist in OUT.
"""

import argparse
import itertools
import os
import subprocess
import sys
from dataclasses import asdict, dataclass
from pathlib import Path

# Use one thread for everything that is timed. Numpy and torch read these variables when they load.
if __name__ == "__main__":
    os.environ.update(OMP_NUM_THREADS="1", OPENBLAS_NUM_THREADS="1", MKL_NUM_THREADS="1")
sys.path.insert(0, str(Path(__file__).resolve().parents[1]))

import numpy as np
import torch

from benchmarks.bench import ROOT, describe_machine
from benchmarks.study_inference import inference_times
from benchmarks.study_pictures import draw_curves, draw_errors
from benchmarks.study_tables import format_tables
from benchmarks.study_trainings import Trainings, read_study_data, validation_score
from fdda_addon.core.errors import FDDAError, RecordingError
from fdda_addon.core.output import check_folder_writable, write_json, write_text
from trainer.config import TrainingConfig

PARTITIONS = ("shoulder", "index_0")
HELD_OUT_POSES = 300
TRAINING_SEED, HELD_OUT_SEED = 0, 1
"""Seeds of the two recordings; the trainings use other seeds."""
TOLERANCE_MM = 0.02
"""Tolerance of the basis. A basis with the trainer's larger default would hide the differences between the networks."""
VALIDATION_FRACTION = 0.1
"""Fraction of the training recording that validates. The other recording measures the held-out errors."""


@dataclass(frozen=True)
class Plan:
    """The configurations, learning rates and seeds to compare.

    Attributes:
        units, layers, activations: properties of the hidden layers; every combination is a configuration.
        extra_configurations: further configurations: the trainer's default, for comparison.
        learning_rates: each configuration uses the rate with the lowest validation error for the first seed.
        seeds: seeds of the split, the initial weights and the order of the poses.
        epochs: epochs of every training. All other settings but the split and the tolerance are the trainer's defaults.
    """

    units: tuple[int, ...] = (128, 512)
    layers: tuple[int, ...] = (2, 3)
    activations: tuple[str, ...] = ("silu", "tanh", "relu")
    extra_configurations: tuple[tuple[int, int, str], ...] = (
        (TrainingConfig.hidden[0], len(TrainingConfig.hidden), TrainingConfig.activation),
    )
    learning_rates: tuple[float, ...] = (0.002, 0.005, 0.01)
    seeds: tuple[int, ...] = (0, 1, 2)
    epochs: int = TrainingConfig.epochs

    def configurations(self) -> list[tuple[int, int, str]]:
        """Return the units, layers and activation of each configuration."""
        return [*self.extra_configurations, *itertools.product(self.units, self.layers, self.activations)]

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
    """Train every configuration of the plan with its best learning rate.

    Returns:
        For each configuration: its units, layers, activation, the score of every learning rate, the chosen learning
        rate, and its trainings.
    """
    configurations = []
    for units, layers, activation in plan.configurations():
        score_by_rate = {
            rate: validation_score(trainings.get(plan.config(units, layers, activation, rate, plan.seeds[0])))
            for rate in plan.learning_rates
        }
        rate = min(score_by_rate, key=score_by_rate.__getitem__)
        configurations.append(
            {
                "units": units,
                "layers": layers,
                "activation": activation,
                "learning_rate": rate,
                "learning_rates": {f"{rate_key:g}": score for rate_key, score in score_by_rate.items()},
                "trainings": [trainings.get(plan.config(units, layers, activation, rate, seed)) for seed in plan.seeds],
            }
        )
    return configurations


def study(training: Path, held_out: Path, out: Path, plan: Plan, names: tuple[str, ...] = PARTITIONS) -> dict:
    """Run the study on two recordings and write its results and pictures.

    Args:
        training, held_out: folders of recordings of one rig.
        out: folder to write to.
        plan: configurations to compare.
        names: names of the partitions.

    Returns:
        The content of study.json.

    Raises:
        FDDAError: the recordings are not usable, or a training fails.
    """
    study_data = read_study_data(training, held_out, names)
    trainings = Trainings(study_data, out / "trainings", lambda text: print(text, file=sys.stderr, flush=True))
    configurations = compare(plan, trainings)
    pose = np.array(study_data.held_out.pose_matrices[:1])
    times = inference_times(
        [[out / "trainings" / t["model"] for t in configuration["trainings"]] for configuration in configurations], pose
    )
    for configuration, microseconds in zip(configurations, times, strict=True):
        configuration["inference_us"] = microseconds
    result = {
        "machine": describe_machine() | {"torch": str(torch.__version__)},
        "unit": "mm",
        "plan": asdict(plan),
        "poses": {
            "training": len(study_data.training.pose_matrices),
            "held_out": len(study_data.held_out.pose_matrices),
        },
        "partitions": list(names),
        "configurations": configurations,
    }
    write_json(out / "study.json", result)
    write_text(out / "tables.md", format_tables(result))
    draw_curves(result, out / "study_curves.png")
    draw_errors(result, out / "study_errors.png")
    return result


def record_arm(out: Path, poses: int) -> tuple[Path, Path]:
    """Build and record the arm, or resume interrupted recordings; return the folders of both recordings."""
    rig, training, held_out = (out / name for name in ("arm.blend", "training", "held_out"))
    if not rig.exists():
        run_verb("build-arm", rig)
    for folder, count, seed in ((training, poses, TRAINING_SEED), (held_out, HELD_OUT_POSES, HELD_OUT_SEED)):
        run_verb("record", rig, folder, "--poses", count, "--seed", seed, "--resume")
    return training, held_out


def run_verb(*arguments: object) -> None:
    """Run a verb of the add-on; if it fails, raise its last line of output as an error."""
    command = [sys.executable, "-m", "fdda_addon", *map(str, arguments)]
    environment = {**os.environ, "PYTHONPATH": str(ROOT)}
    process = subprocess.run(command, capture_output=True, text=True, env=environment)
    if process.returncode:
        raise RecordingError((process.stderr.strip().splitlines() or [f"{arguments[0]} failed without a message."])[-1])


def main(arguments: list[str] | None = None) -> int:
    """Run the study with the settings of the command line; return the exit status."""
    parser = argparse.ArgumentParser("study", description=__doc__.partition("\n")[0])
    parser.add_argument("out", type=Path, help="folder for all output")
    parser.add_argument("--seeds", type=int, default=3, help="trainings of each configuration (default 3)")
    parser.add_argument("--poses", type=int, default=1000, help="poses to train on (default 1000)")
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
