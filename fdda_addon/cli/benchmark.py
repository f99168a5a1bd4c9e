# SPDX-License-Identifier: GPL-3.0-or-later
"""`benchmark RIG.blend MODEL.onnx --json OUT.json`: measures the time per frame of rig, linear skinning and model.

`benchmark RIG.blend --profile --json OUT.json` needs no model: it measures the parts of a frame of the rig.
"""

import argparse
from pathlib import Path

from ..core.errors import WrongUsageError
from ..core.file_kind import BENCHMARK
from ..core.output import check_outputs, write_json
from ..core.progress import Progress
from ..runtime.binding import model_disabled
from ..timing.benchmark import benchmark
from ..timing.frame_profile import profile_frame
from .files import add_rig_options, open_rig
from .folders import open_rigs, to_json_by_object, with_heading
from .outputs import add_overwrite_option
from .progress import ProgressPrinter


def add_options(parser: argparse.ArgumentParser) -> None:
    add_rig_options(parser)
    parser.add_argument(
        "model",
        metavar="MODEL.onnx",
        type=Path,
        nargs="?",
        help="the model, or a folder of models; none with --profile",
    )
    parser.add_argument(
        "--profile",
        action="store_true",
        help="measure the parts of a frame of the rig: bones, each modifier, the rest; and the most expensive bones",
    )
    parser.add_argument("--json", metavar="OUT.json", type=Path, required=True, help="file to write the times to")
    parser.add_argument(
        "--frames", type=int, default=100, help="number of frames to measure with each deformation (default 100)"
    )
    add_overwrite_option(parser)


def run(options: argparse.Namespace) -> None:
    if options.frames < 1:
        raise WrongUsageError("--frames must be 1 or more.")
    if (options.model is None) != options.profile:
        raise WrongUsageError("Give a model to measure, or --profile without a model.")
    inputs = [options.rig] if options.profile else [options.rig, options.model]
    check_outputs({options.json: BENCHMARK}, inputs, options.overwrite)
    if options.profile:
        _profile(options)
        return
    benchmarks = {}
    for name, (scene_rig, model) in open_rigs(options).items():
        with ProgressPrinter() as progress, model_disabled(scene_rig.mesh_object):
            for step in benchmark(scene_rig, model, options.frames):
                if isinstance(step, Progress):
                    progress.show(step.stage, step.done, step.total)
        benchmarks[name] = step
    write_json(options.json, to_json_by_object({name: result.to_json() for name, result in benchmarks.items()}))
    for name, result in benchmarks.items():
        print(with_heading(name, result.table()))


def _profile(options: argparse.Namespace) -> None:
    scene_rig = open_rig(options)
    with ProgressPrinter() as progress:
        for step in profile_frame(scene_rig):
            if isinstance(step, Progress):
                progress.show(step.stage, step.done, step.total)
            else:
                write_json(options.json, step.to_json())
                progress.end_line()
                print(step.table())
