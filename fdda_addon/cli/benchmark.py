# SPDX-License-Identifier: GPL-3.0-or-later
"""`benchmark RIG.blend MODEL.onnx --json OUT.json`: measures the time per frame of rig, linear skinning and model.

`benchmark RIG.blend --profile --json OUT.json` needs no model: it measures the parts of a frame of the rig, and what a
fast rig would save. `--fast-rig` measures the latter alone.
"""

import argparse
from dataclasses import replace
from pathlib import Path

from ..core.errors import TRY_AGAIN, FDDAError, WrongUsageError, exit_status
from ..core.files.file_kind import BENCHMARK
from ..core.files.output import check_outputs, write_json
from ..core.files.temporary import check_temporary_folder
from ..fast_rig.saving import measure_saving
from ..runtime.binding import model_disabled
from ..timing.benchmark import benchmark
from ..timing.profiling import profile_frame
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
        help="the model, or a folder of models; none with --profile and --fast-rig",
    )
    group = parser.add_mutually_exclusive_group()
    group.add_argument(
        "--profile",
        action="store_true",
        help="measure the parts of a frame of the rig: bones, each modifier, the rest; the most expensive bones; and "
        "what a fast rig would save",
    )
    group.add_argument("--fast-rig", action="store_true", help="measure only what a fast rig would save")
    parser.add_argument("--json", metavar="OUT.json", type=Path, required=True, help="file to write the times to")
    parser.add_argument(
        "--frames", type=int, default=100, help="number of frames to measure with each deformation (default 100)"
    )
    add_overwrite_option(parser)


def run(options: argparse.Namespace) -> None:
    if options.frames < 1:
        raise WrongUsageError("--frames must be 1 or more.")
    needs_model = not (options.profile or options.fast_rig)
    if (options.model is not None) != needs_model:
        raise WrongUsageError("Give a model to measure, or --profile or --fast-rig without a model.")
    check_outputs({options.json: BENCHMARK}, list(filter(None, (options.rig, options.model))), options.overwrite)
    if not needs_model:
        check_temporary_folder()  # before the measurements, which take a minute
    if options.profile:
        scene_rig, failure = open_rig(options), None
        with ProgressPrinter() as progress:
            profile = progress.run(profile_frame(scene_rig))
            try:
                profile = replace(profile, fast_rig=progress.run(measure_saving(scene_rig, options.rig)))
            except FDDAError as error:
                profile, failure = replace(profile, fast_rig_problem=str(error)), error
        write_json(options.json, profile.to_json())
        print(profile.table())
        if failure is not None and exit_status(failure) == TRY_AGAIN:
            raise failure
        return
    if options.fast_rig:
        with ProgressPrinter() as progress:
            saving = progress.run(measure_saving(open_rig(options), options.rig))
        write_json(options.json, saving.to_json() | {"unit": "ms"})
        print(saving.sentence)
        return
    benchmarks, errors = {}, []
    for name, (scene_rig, model) in open_rigs(options).items():
        try:
            with ProgressPrinter() as progress, model_disabled(scene_rig.mesh_object):
                benchmarks[name] = progress.run(benchmark(scene_rig, model, options.frames))
        except FDDAError as error:
            # The times of the other meshes took minutes.
            errors.append(error)
    if benchmarks:
        write_json(options.json, to_json_by_object({name: result.to_json() for name, result in benchmarks.items()}))
    for name, result in benchmarks.items():
        print(with_heading(name, result.table()))
    if errors:
        raise errors[0]
