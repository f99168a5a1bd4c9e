# SPDX-License-Identifier: GPL-3.0-or-later
"""`record RIG.blend RECORDING`: random poses and their residuals, or more of them where a model is worst."""

import argparse
import time
from pathlib import Path
from typing import TYPE_CHECKING

if TYPE_CHECKING:
    from collections.abc import Iterator

    from ..core.progress import Progress
    from ..scene.rig import SceneRig


def add_options(parser: argparse.ArgumentParser) -> None:
    from ..core.partition import LEAST_VERTICES
    from .files import add_rig_options

    add_rig_options(parser)
    parser.add_argument("recording", metavar="RECORDING", type=Path, help="folder of the recording")
    parser.add_argument("--poses", type=int, help="number of random poses (default 1000, with --refine 250)")
    parser.add_argument("--seed", type=int, default=0, help="of the random poses (default 0)")
    parser.add_argument(
        "--spread", type=float, default=1.0, help="standard deviation as a part of half the range (default 1.0)"
    )
    parser.add_argument("--action", action="append", default=[], metavar="NAME", help="record its frames as well")
    parser.add_argument(
        "--strip", action="append", default=[], metavar="NAME", help="record the frames of a strip of the NLA as well"
    )
    parser.add_argument(
        "--mirror", action="store_true", help="record the frames of actions and strips a second time, mirrored"
    )
    parser.add_argument(
        "--sample",
        action="append",
        default=[],
        metavar="WHAT",
        help="what the random poses move, in place of the bones that have weights: collection:NAME, action:NAME (what "
        "it keys, in its range), bone:NAME or selected; may be given several times",
    )
    parser.add_argument(
        "--control",
        action="append",
        default=[],
        metavar="NAME[=LOW:HIGH]",
        help="a number that deforms the mesh beside the joints: the name of a shape key, shape_keys for all of them, "
        "or OWNER/PATH; those that drivers of the mesh read are found by themselves; may be given several times",
    )
    parser.add_argument(
        "--fit-linear",
        choices=("hard", "smooth"),
        default="",
        help="fit the skin weights of the linear layer to the poses: one joint a vertex, or at most four",
    )
    parser.add_argument(
        "--least-vertices",
        type=int,
        default=LEAST_VERTICES,
        metavar="N",
        help=f"merge partitions of fewer vertices into others, 0 for none (default {LEAST_VERTICES})",
    )
    parser.add_argument("--resume", action="store_true", help="continue a recording that was interrupted")
    parser.add_argument(
        "--refine", metavar="MODEL.onnx", type=Path, help="add poses to the recording where this model is worst"
    )


def run(options: argparse.Namespace) -> None:
    from ..core.errors import WrongUsageError
    from ..core.recording_check import merges_in_words
    from ..core.recording_index import read_index, read_info
    from ..runtime.binding import true_rig
    from .files import open_rig
    from .progress import ProgressPrinter

    if (options.poses or 0) < 0 or options.seed < 0 or options.least_vertices < 0:
        raise WrongUsageError("--poses, --seed and --least-vertices must be 0 or more.")
    # Wider is uniform already, and most draws would fall outside and be drawn again.
    if not 0 < options.spread <= 10:
        raise WrongUsageError("--spread must be more than 0 and at most 10.")
    of_new = (
        options.action,
        options.strip,
        options.mirror,
        options.resume,
        options.sample,
        options.control,
        options.fit_linear,
    )
    if options.refine and (any(of_new) or options.poses == 0):
        raise WrongUsageError(
            "--refine adds random poses to a complete recording; leave --action, --strip, --mirror, --sample, "
            "--control, --fit-linear and --resume out."
        )
    scene_rig = open_rig(options)
    start = time.monotonic()
    with ProgressPrinter() as progress, true_rig(scene_rig.mesh_object):
        for step in _steps(scene_rig, options):
            progress.show(step.stage, step.done, step.total)
    if not options.refine:
        index = read_index(options.recording)
        if options.fit_linear:
            print(read_info(index).fit.sentence())
        if line := merges_in_words(index, options.least_vertices):
            print(line)
    added = "added " if options.refine else ""
    print(f"{options.recording}: {step.total} poses {added}in {time.monotonic() - start:.1f} s")


def _steps(scene_rig: "SceneRig", options: argparse.Namespace) -> "Iterator[Progress]":
    from ..recording import RecordingSettings, record
    from ..refinement import RefinementSettings, refine

    given = {} if options.poses is None else {"poses": options.poses}
    if options.refine:
        settings = RefinementSettings(seed=options.seed, **given)
        return refine(scene_rig, options.recording, options.refine, settings)
    settings = RecordingSettings(
        seed=options.seed,
        spread=options.spread,
        actions=tuple(options.action),
        resume=options.resume,
        sample=tuple(options.sample),
        controls=tuple(options.control),
        fit_linear=options.fit_linear,
        least_vertices=options.least_vertices,
        strips=tuple(options.strip),
        mirror=options.mirror,
        **given,
    )
    return record(scene_rig, options.recording, settings)
