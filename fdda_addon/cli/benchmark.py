# SPDX-License-Identifier: GPL-3.0-or-later
"""`benchmark RIG.blend [MODEL.onnx] --json OUT.json`: measures the time per frame of a character, before and after.

A character is all meshes of one armature. Without a model, those that are bound in the file are measured, or untrained
models of the same size. `--profile` measures the parts of a frame of the rig, and what models and a fast rig would
save. `--fast-rig` measures the latter alone.
"""

import argparse
from dataclasses import asdict, replace
from pathlib import Path

import bpy

from ..core.errors import TRY_AGAIN, FDDAError, RigError, WrongUsageError, exit_status
from ..core.files.file_kind import BENCHMARK
from ..core.files.output import check_outputs, write_json
from ..core.files.temporary import check_temporary_folder
from ..fast_rig.frame_times import measure_saving
from ..scene.scene_rig import find_rig, find_rigs
from ..timing.benchmark import benchmark
from ..timing.frame_profile import profile_frame
from .files import add_overwrite_option, add_rig_options, open_file, open_rigs, to_json_by_object, with_heading
from .progress import ProgressPrinter


def add_options(parser: argparse.ArgumentParser) -> None:
    add_rig_options(parser)
    parser.add_argument(
        "model",
        metavar="MODEL.onnx",
        type=Path,
        nargs="?",
        help="the model, or a folder of models; other meshes play the models that are bound to them. Without any model "
        "untrained models of the same size give an estimate",
    )
    group = parser.add_mutually_exclusive_group()
    group.add_argument(
        "--profile",
        action="store_true",
        help="measure the parts of a frame of the rig: bones, each modifier, the rest; and what a fast rig would save",
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
    if options.model is not None and (options.profile or options.fast_rig):
        raise WrongUsageError(
            "--profile and --fast-rig take no model; they measure the bound models, or untrained ones."
        )
    check_outputs({options.json: BENCHMARK}, list(filter(None, (options.rig, options.model))), options.overwrite)
    if options.model is None:
        check_temporary_folder()  # before the measurements, which take a minute
    if options.profile:
        armature_object, failure = _open_armature(options), None
        with ProgressPrinter() as progress:
            profile = progress.run(profile_frame(armature_object))
            try:
                profile = replace(profile, fast_rig=progress.run(measure_saving(armature_object, options.rig)))
            except FDDAError as error:
                profile, failure = replace(profile, fast_rig_problem=str(error)), error
        write_json(options.json, profile.to_json())
        print(profile.table())
        if failure is not None and exit_status(failure) == TRY_AGAIN:
            raise failure
        return
    if options.fast_rig:
        with ProgressPrinter() as progress:
            saving = progress.run(measure_saving(_open_armature(options), options.rig))
        write_json(options.json, asdict(saving) | {"unit": "ms"})
        print(saving.describe(saving.full))
        return
    models: dict[bpy.types.Object, dict[bpy.types.Object, Path]] = {}
    if options.model is None:
        models[_open_armature(options)] = {}
    else:
        for scene_rig, model in open_rigs(options).values():
            models.setdefault(scene_rig.armature_object, {})[scene_rig.mesh_object] = model
    benchmarks, errors = {}, []
    for armature_object, models_of_meshes in models.items():
        name = armature_object.name if len(models) > 1 else ""
        try:
            with ProgressPrinter() as progress:
                result = benchmarks[name] = progress.run(benchmark(armature_object, options.frames, models_of_meshes))
            measured = {mesh_object.name for mesh_object in models_of_meshes}
            errors += [FDDAError(mesh.reason) for mesh in result.meshes if mesh.reason and mesh.name in measured]
        except FDDAError as error:
            # The times of the others took minutes.
            errors.append(error)
    if benchmarks:
        write_json(options.json, to_json_by_object({name: result.to_json() for name, result in benchmarks.items()}))
    for name, result in benchmarks.items():
        print(with_heading(name, result.table()))
    if errors:
        raise errors[0]


def _open_armature(options: argparse.Namespace) -> bpy.types.Object:
    """Open the file, and return the armature of its character, or of the mesh object of the options."""
    open_file(options.rig)
    rigs = [find_rig(options.object)] if options.object else find_rigs()
    names = sorted({rig.armature_object.name for rig in rigs})
    if len(names) > 1:
        raise RigError(
            f"'{options.rig}' has {len(names)} characters (armatures {', '.join(names)}); choose one with --object "
            "and the name of a mesh of it."
        )
    return rigs[0].armature_object
