# SPDX-License-Identifier: GPL-3.0-or-later
"""`train RECORDING MODEL.onnx …`: the trainer with its own options, started in the Python that has torch.

RECORDING may be a folder of recordings, and MODEL.onnx is then the folder of their models. With `--refine RIG.blend` it
goes on by itself: while the goal is missed and more poses help, it adds poses to the recording where the model is
worst, and trains on.
"""

import argparse
import subprocess
from pathlib import Path
from typing import TYPE_CHECKING

from ..core.defaults import REFINEMENT_POSES
from ..core.errors import WrongUsageError
from ..core.messages import WARNING_LINE, MessageType
from ..core.recording.folder import recordings_in
from ..core.report import Verdict
from ..core.stop_signals import INTERRUPTED
from ..training.process import Training, trainer_command
from .progress import ProgressPrinter

if TYPE_CHECKING:
    from ..scene.scene_rig import SceneRig

WARM_START, GOAL = "--warm-start", "--goal-mm"
MAX_ROUNDS = 20


def run(arguments: list[str]) -> int:
    """Train; `arguments` are those of `python -m trainer` and of `_refinement_parser`. Returns the exit status."""
    parser = _refinement_parser()
    if not arguments or {"-h", "--help"} & set(arguments):
        command, environment = trainer_command(arguments)
        status = subprocess.run(command, env=environment, check=False).returncode
        if arguments:
            print(f"\n{parser.format_help()}", end="")
        return status
    options, own = parser.parse_known_args(arguments)
    if options.refine is None:
        if options.object or options.poses is not None:
            raise WrongUsageError("--object and --poses say how to refine; give --refine RIG.blend with them.")
        return _train(own)[0]
    return _train_to_goal(own, options)


def _refinement_parser() -> argparse.ArgumentParser:
    parser = argparse.ArgumentParser("train", usage=argparse.SUPPRESS, add_help=False, allow_abbrev=False)
    group = parser.add_argument_group("until the accuracy goal is met, with --goal-mm")
    group.add_argument(
        "--refine", metavar="RIG.blend", type=Path, help="add poses of this rig where the model is worst, and train on"
    )
    group.add_argument("--object", default="", metavar="NAME", help="the mesh object, when several have a rig")
    group.add_argument("--poses", type=int, metavar="N", help=f"poses to add each time (default {REFINEMENT_POSES})")
    return parser


def _train(arguments: list[str]) -> tuple[int, dict]:
    """One training; its exit status, and what it said last."""
    values: dict = {}
    with Training(arguments) as training, ProgressPrinter() as progress:
        for message in training.messages():
            values = message.values
            if message.type is MessageType.PREPARING:
                progress.show("preparation", values["done"], values["total"])
            elif message.type is MessageType.PROGRESS:
                note = f"validation {values['validation_mm']:.4f} mm"
                progress.show("training", values["epoch"], values["epochs"], note)
            elif message.type is MessageType.LOG:
                progress.say(values["text"])
            elif message.type is MessageType.WARNING:
                progress.say(WARNING_LINE.format(**values))
            elif message.type is MessageType.MODEL_FINISHED:
                progress.end_line()
                print(_line(values), flush=True)
            elif message.type is MessageType.CANCELLED:
                return INTERRUPTED, values
    if models := values.get("models"):
        print(f"{values['model']}: {models} models in {values['seconds']:.1f} s")
    else:
        print(_line(values))
    return 0, values


def _line(values: dict) -> str:
    """About a model that is trained."""
    return f"{values['model']}: trained in {values['seconds']:.1f} s, held-out error {values['held_out_mm']:.4f} mm"


def _train_to_goal(arguments: list[str], options: argparse.Namespace) -> int:
    """Train, and refine the recording, in turn."""
    if len(arguments) < 2 or any(argument.startswith("-") for argument in arguments[:2]):
        raise WrongUsageError("With --refine, give RECORDING and MODEL.onnx before the training settings.")
    if not any(argument.partition("=")[0] == GOAL for argument in arguments):
        raise WrongUsageError(f"--refine trains until an accuracy goal is met; say which with {GOAL}.")
    recording, model = map(Path, arguments[:2])
    if recordings_in(recording):
        raise WrongUsageError(
            f"--refine takes one mesh, and '{recording}' holds recordings of several; give one of them, its model and "
            "--object NAME."
        )
    # A training that refines nothing needs no Blender.
    from .registered import registered

    with registered():
        # Before the first training: a wrong path or object shows at once.
        _open_rig(options)
        for number in range(MAX_ROUNDS):
            if number:
                _refine(recording, model, options, number)
            warm = [WARM_START] if number and WARM_START not in arguments else []
            status, values = _train([*arguments, *warm])
            if status or values.get("verdict") != Verdict.MISSED.value:
                return status
    print(f"The goal is not met after {MAX_ROUNDS} rounds; run the command again with {WARM_START} to go on.")
    return 0


def _open_rig(options: argparse.Namespace) -> "SceneRig":
    from ..scene.scene_rig import find_rig
    from .files import open_file

    open_file(options.refine)
    return find_rig(options.object)


def _refine(recording: Path, model: Path, options: argparse.Namespace, number: int) -> None:
    from ..recording.refinement import RefinementSettings, refine
    from ..runtime.binding import model_disabled

    scene_rig = _open_rig(options)
    given = {} if options.poses is None else {"poses": options.poses}
    with ProgressPrinter() as progress, model_disabled(scene_rig.mesh_object):
        for step in refine(scene_rig, recording, model, RefinementSettings(seed=number, **given)):
            progress.show(step.stage, step.done, step.total)
    print(f"{recording}: {step.total} poses added where the model is worst")
