# SPDX-License-Identifier: GPL-3.0-or-later
"""`benchmark RIG.blend MODEL.onnx --json OUT.json`: what a frame costs."""

import argparse
from pathlib import Path

from ..benchmark import benchmark
from ..core.errors import WrongUsageError
from ..core.output import check_writable, write_json
from ..recording import Progress
from ..runtime.binding import true_rig
from .files import add_rig_options
from .folders import by_object, headed, open_rigs
from .progress import ProgressPrinter


def add_options(parser: argparse.ArgumentParser) -> None:
    add_rig_options(parser)
    parser.add_argument("model", metavar="MODEL.onnx", type=Path, help="the model, or a folder of models")
    parser.add_argument("--json", metavar="OUT.json", type=Path, required=True, help="where to write the times")
    parser.add_argument("--frames", type=int, default=100, help="frames to time, each way (default 100)")


def run(options: argparse.Namespace) -> None:
    if options.frames < 1:
        raise WrongUsageError("--frames must be 1 or more.")
    check_writable(options.json)
    benchmarks = {}
    for name, (scene_rig, model) in open_rigs(options).items():
        with ProgressPrinter() as progress, true_rig(scene_rig.mesh_object):
            for step in benchmark(scene_rig, model, options.frames):
                if isinstance(step, Progress):
                    progress.show(step.stage, step.done, step.total)
        benchmarks[name] = step
    write_json(options.json, by_object({name: measured.to_json() for name, measured in benchmarks.items()}))
    for name, measured in benchmarks.items():
        print(headed(name, measured.table()))
