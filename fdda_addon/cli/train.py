# SPDX-License-Identifier: GPL-3.0-or-later
"""`train RECORDING MODEL.onnx …`: starts the trainer, which parses the options, in the Python that has torch.

With `--refine RIG.blend` the verb adds poses at the worst errors and continues the training, until the goal is met or
more poses no longer help.
"""

import argparse
import subprocess
from pathlib import Path
from typing import TYPE_CHECKING

from ..core.errors import WrongUsageError
from ..core.files.stop_signals import INTERRUPTED
from ..core.formats.messages import WARNING_LINE, MessageType
from ..core.formats.report import Verdict
from ..core.settings import REFINEMENT_POSES
from ..core.wording import format_count
from ..training.process import Training, trainer_command
from .progress import ProgressPrinter

if TYPE_CHECKING:
    from ..scene.scene_rig import SceneRig

WARM_START, GOAL = "--warm-start", "--goal-mm"
MAX_ROUNDS = 20


def run(arguments: list[str]) -> int:
    """Train with the arguments of `python -m trainer` and of `_refinement_parser`; return the exit status."""
    parser = _refinement_parser()
    if not arguments or {"-h", "--help"} & set(arguments):
        command, environment = trainer_command(arguments)
        status = subprocess.run(command, env=environment, check=False).returncode
        if arguments:
            print(f"\n{parser.format_help()}", end="")
        return status
    options, trainer_arguments = parser.parse_known_args(arguments)
    if options.refine is None:
        if options.object or options.poses is not None:
            raise WrongUsageError("--object and --poses are options of --refine; give --refine RIG.blend too.")
        return _train(trainer_arguments)[0]
    return _train_to_goal(trainer_arguments, options)


def _refinement_parser() -> argparse.ArgumentParser:
    parser = argparse.ArgumentParser("train", usage=argparse.SUPPRESS, add_help=False, allow_abbrev=False)
    group = parser.add_argument_group("options to train until the accuracy goal (--goal-mm) is met")
    group.add_argument(
        "--refine",
        metavar="RIG.blend",
        type=Path,
        help="add poses of this rig at the worst errors, and continue the training",
    )
    group.add_argument(
        "--object", default="", metavar="NAME", help="mesh object of the recording, if it has another name now"
    )
    group.add_argument(
        "--poses", type=int, metavar="N", help=f"number of poses to add in each round (default {REFINEMENT_POSES})"
    )
    return parser


def _train(arguments: list[str]) -> tuple[int, dict]:
    """Run one training; return its exit status and its last message."""
    values: dict = {}
    with Training(arguments) as training, ProgressPrinter() as progress:
        for message in training.messages():
            values = message.values
            if message.type is MessageType.PREPARING:
                stage = values["stage"] if values["stage"] != "partitions" else "preparation"
                progress.show(stage, values["done"], values["total"])
            elif message.type is MessageType.PROGRESS:
                note = f"validation {values['validation_mm']:.4f} mm"
                progress.show("training", values["epoch"], values["epochs"], note)
            elif message.type is MessageType.LOG:
                progress.say(values["text"])
            elif message.type is MessageType.WARNING:
                progress.say(WARNING_LINE.format(**values))
            elif message.type is MessageType.CANCELLED:
                return INTERRUPTED, values
    print(f"{values['model']}: trained in {values['seconds']:.1f} s, held-out error {values['held_out_mm']:.4f} mm")
    return 0, values


def _train_to_goal(arguments: list[str], options: argparse.Namespace) -> int:
    """Alternate training and refinement until the goal is met."""
    if len(arguments) < 2 or any(argument.startswith("-") for argument in arguments[:2]):
        raise WrongUsageError("With --refine, give RECORDING and MODEL.onnx before the training settings.")
    if not any(argument.partition("=")[0] == GOAL for argument in arguments):
        raise WrongUsageError(f"--refine trains until an accuracy goal is met; give the goal with {GOAL}.")
    recording, model = map(Path, arguments[:2])
    # Imported here, because a training without refinement needs no Blender.
    from .main import registered

    with registered():
        # Open the rig now, so that a wrong path or object raises an error before the training.
        _open_rig(recording, options)
        for round_index in range(MAX_ROUNDS):
            if round_index:
                _refine(recording, model, options, round_index)
            warm_start_option = [WARM_START] if round_index and WARM_START not in arguments else []
            status, values = _train([*arguments, *warm_start_option])
            if status or values.get("verdict") != Verdict.MISSED.value:
                return status
    print(f"The goal is not met after {MAX_ROUNDS} rounds; run the command again with {WARM_START} to continue.")
    return 0


def _open_rig(recording: Path, options: argparse.Namespace) -> "SceneRig":
    from ..recording.plan import find_recorded_character
    from .files import open_file

    open_file(options.refine)
    return find_recorded_character(recording, options.object)


def _refine(recording: Path, model: Path, options: argparse.Namespace, round_index: int) -> None:
    from ..recording.refinement import RefinementSettings, refine
    from ..runtime.binding import model_disabled

    scene_rig = _open_rig(recording, options)
    pose_options = {} if options.poses is None else {"poses": options.poses}
    with ProgressPrinter() as progress, model_disabled(*scene_rig.mesh_objects):
        for step in refine(scene_rig, recording, model, RefinementSettings(seed=round_index, **pose_options)):
            progress.show(step.stage, step.done, step.total)
    print(f"{recording}: added {format_count(step.total, 'pose')} at the worst errors of the model")
