# SPDX-License-Identifier: GPL-3.0-or-later
"""`record RIG.blend RECORDING`: records how a rig deforms its mesh, or adds poses at the worst errors of a model.

With `--all`, or with several `--object`, all meshes are recorded in the same poses, each into a subfolder of RECORDING.
"""

import argparse
import time
from contextlib import ExitStack
from pathlib import Path
from typing import TYPE_CHECKING

from ..core.counts import format_count
from ..core.defaults import MARGIN, MIN_PARTITION_VERTICES, POSES, REFINEMENT_POSES, SPREAD
from ..core.joint_option import ALL, parse_joints

if TYPE_CHECKING:
    from collections.abc import Iterator

    from ..core.progress import Progress
    from ..scene.scene_rig import SceneRig


def add_options(parser: argparse.ArgumentParser) -> None:
    from .files import add_rig_argument
    from .target import add_repeatability_option, add_target_options

    add_rig_argument(parser)
    parser.add_argument(
        "--object",
        action="append",
        default=[],
        metavar="NAME",
        help="mesh object to record, if several have a rig; repeatable, each with a subfolder of RECORDING",
    )
    parser.add_argument(
        "--all",
        action="store_true",
        help="record all meshes that an armature deforms, each into a subfolder of RECORDING",
    )
    parser.add_argument("recording", metavar="RECORDING", type=Path, help="folder of the recording")
    parser.add_argument(
        "--poses", type=int, help=f"number of random poses (default {POSES}, with --refine {REFINEMENT_POSES})"
    )
    parser.add_argument("--seed", type=int, default=0, help="random seed of the poses (default 0)")
    parser.add_argument(
        "--spread",
        type=float,
        default=SPREAD,
        help=f"how far random poses spread over the limits, from their middle (default {SPREAD})",
    )
    parser.add_argument(
        "--margin",
        type=float,
        default=MARGIN,
        metavar="F",
        help="take a quarter of the random poses from limits wider by this factor, and rotate locked axes too, "
        f"so that the model stays accurate beyond the limits; 1 to stay within the limits (default {MARGIN:g})",
    )
    parser.add_argument(
        "--action",
        action="append",
        default=[],
        metavar="NAME",
        help="also record all frames of this action; repeatable",
    )
    parser.add_argument(
        "--strip",
        action="append",
        default=[],
        metavar="NAME",
        help="also record all frames of this NLA strip; repeatable",
    )
    parser.add_argument(
        "--mirror",
        action="store_true",
        help="record the frames of actions and strips a second time, with left and right swapped",
    )
    parser.add_argument(
        "--sample",
        action="append",
        default=[],
        metavar="WHAT",
        help="bones that random poses move, instead of the deforming bones: collection:NAME, action:NAME (the bones "
        "that the action keys, in the ranges that it uses), bone:NAME, selected, or remix (every second pose takes "
        "each limb from a random frame of the actions of --action, with noise); repeatable",
    )
    parser.add_argument(
        "--control",
        action="append",
        default=[],
        metavar="NAME[=LOW:HIGH]",
        help="extra input of the model besides bones: the name of a shape key, shape_keys for all shape keys, "
        "OWNER/PATH, or control bones, collection:NAME or bone:NAME: their unlocked channels and custom properties; "
        "inputs that drivers of the mesh read are detected automatically; repeatable",
    )
    parser.add_argument(
        "--fit-linear",
        choices=("hard", "smooth"),
        default="",
        help="fit the skin weights of linear skinning to the poses: one bone per vertex, or at most four (smooth)",
    )
    parser.add_argument(
        "--joints",
        type=_parse_joints,
        default=ALL,
        metavar="auto|N|all",
        help="bones that the model reads: the fewest from which the other bones follow (auto), their number, or all "
        f"(default {ALL}); skin weights are fitted to these bones, and the model learns the rest",
    )
    parser.add_argument(
        "--min-partition-vertices",
        type=int,
        default=MIN_PARTITION_VERTICES,
        metavar="N",
        help=f"merge body parts with fewer vertices into a neighbor; 0: none (default {MIN_PARTITION_VERTICES})",
    )
    parser.add_argument("--resume", action="store_true", help="continue an interrupted recording")
    parser.add_argument("--overwrite", action="store_true", help="replace an existing recording, even if it is damaged")
    parser.add_argument(
        "--shard",
        type=_parse_shard,
        metavar="K/N",
        help="record only part K of N of the poses; merge-recordings joins all parts to one recording",
    )
    parser.add_argument(
        "--detect-influences",
        action="store_true",
        help="only detect which joints influence which partitions, once for all shards",
    )
    parser.add_argument(
        "--influences",
        metavar="FOLDER",
        type=Path,
        help="use the influences in this folder, which --detect-influences has written for the same rig",
    )
    add_target_options(parser)
    add_repeatability_option(parser)
    parser.add_argument(
        "--refine", metavar="MODEL.onnx", type=Path, help="add poses at the worst errors of this model to the recording"
    )


def _parse_shard(text: str) -> tuple[int, int]:
    """Parse index and count of a shard, such as "2/8".

    Raises:
        argparse.ArgumentTypeError: the text is invalid.
    """
    from ..core.recording.shard import MAX_SHARDS

    number, _, count = text.partition("/")
    if not (number.isdecimal() and count.isdecimal() and 1 <= int(number) <= int(count) <= MAX_SHARDS):
        raise argparse.ArgumentTypeError(f"a shard is K/N, part K of N, with K from 1 to N and not {text!r}")
    return int(number), int(count)


def _parse_joints(text: str) -> str:
    """Check the option `--joints`; raise argparse.ArgumentTypeError if it is invalid."""
    try:
        return parse_joints(text)
    except ValueError as error:
        raise argparse.ArgumentTypeError(str(error)) from error


def run(options: argparse.Namespace) -> None:
    from ..core.checks.recording import merges_sentence
    from ..core.checks.target import unsettled_sentence
    from ..core.errors import WrongUsageError
    from ..core.poses import MAX_MARGIN
    from ..core.recording.index import read_index, read_info
    from ..runtime.binding import model_disabled
    from .files import open_file
    from .pose_notes import print_control_bones, print_remix_hint
    from .progress import ProgressPrinter
    from .target import target_settings

    if (options.poses or 0) < 0 or options.seed < 0 or options.min_partition_vertices < 0:
        raise WrongUsageError("--poses, --seed and --min-partition-vertices must be 0 or more.")
    # At 10 the distribution is uniform. Above, most values would lie outside of the range and be drawn again.
    if not 0 < options.spread <= 10:
        raise WrongUsageError("--spread must be more than 0 and at most 10.")
    if not 1 <= options.margin <= MAX_MARGIN:
        raise WrongUsageError(f"--margin must be 1, for none, to {MAX_MARGIN:g} times the range of motion.")
    target_settings(options)
    new_recording_options = (
        options.action,
        options.strip,
        options.mirror,
        options.sample,
        options.control,
        options.fit_linear,
        options.joints != ALL,
        options.shard,
        options.detect_influences,
        options.influences,
        options.target,
    )
    if options.refine and (any(new_recording_options) or options.poses == 0):
        raise WrongUsageError(
            "--refine adds random poses to a complete recording; leave --action, --strip, --mirror, --sample, "
            "--control, --fit-linear, --joints, --shard, --influences and --target out."
        )
    if options.detect_influences and (options.shard or options.influences):
        raise WrongUsageError(
            "--detect-influences finds influences for all shards; leave --shard and --influences out."
        )
    if options.refine and (options.all or len(options.object) > 1):
        raise WrongUsageError("--refine takes one mesh; give --object NAME once, and the recording and model of it.")
    if options.all and options.object:
        raise WrongUsageError("--all records all meshes, and --object those that it names; give one of them.")
    if options.overwrite and (options.resume or options.refine):
        raise WrongUsageError("--overwrite makes a new recording; leave --resume and --refine out.")
    open_file(options.rig)
    rigs = _find_rigs(options)
    if not options.refine:
        print_control_bones(rigs[0][0], options)
        print_remix_hint(rigs[0][0], options)
    start = time.monotonic()
    with ProgressPrinter() as progress, ExitStack() as stack:
        for scene_rig, _ in rigs:
            stack.enter_context(model_disabled(scene_rig.mesh_object))
        for step in _make_job(rigs, options):
            if step.note:
                progress.end_line()
                print(step.note, flush=True)
            progress.show(step.stage, step.done, step.total, step.detail)
    seconds = time.monotonic() - start
    for _, recording in rigs:
        if not options.refine:
            index = read_index(recording)
            if fit := read_info(index).fit:
                print(fit.sentence())
            for line in (merges_sentence(index, options.min_partition_vertices), unsettled_sentence(index)):
                if line:
                    print(line)
            if repeatability := read_info(index).repeatability:
                print(repeatability.sentence())
        poses_text = f"{format_count(step.total, 'pose')}{' added' if options.refine else ''}"
        print(f"{recording}: {'influences' if options.detect_influences else poses_text} in {seconds:.1f} s")


def _find_rigs(options: argparse.Namespace) -> "list[tuple[SceneRig, Path]]":
    """Return the rigs to record, each with the folder of its recording."""
    from ..scene.scene_rig import find_rig, find_rigs
    from .folders import mesh_folders

    names = list(dict.fromkeys(options.object))
    if options.all:
        return mesh_folders(find_rigs(), options.recording)
    if len(names) > 1:
        return mesh_folders([find_rig(name) for name in names], options.recording)
    return [(find_rig(*names), options.recording)]


def _make_job(rigs: "list[tuple[SceneRig, Path]]", options: argparse.Namespace) -> "Iterator[Progress]":
    from ..recording.plan import RecordingSettings
    from ..recording.refinement import RefinementSettings, refine
    from ..recording.run import record_meshes
    from .target import requested_poses, target_settings

    poses = requested_poses(rigs[0][0], options)
    pose_options = {} if poses is None else {"poses": poses}
    if options.refine:
        settings = RefinementSettings(seed=options.seed, resume=options.resume, **pose_options)
        return refine(rigs[0][0], options.recording, options.refine, settings)
    settings = RecordingSettings(
        seed=options.seed,
        spread=options.spread,
        margin=options.margin,
        actions=tuple(options.action),
        resume=options.resume,
        overwrite=options.overwrite,
        sample=tuple(options.sample),
        controls=tuple(options.control),
        fit_linear=options.fit_linear,
        joints=options.joints,
        min_partition_vertices=options.min_partition_vertices,
        strips=tuple(options.strip),
        mirror=options.mirror,
        shard=options.shard,
        detect_influences=options.detect_influences,
        influences=options.influences,
        target=target_settings(options),
        **pose_options,
    )
    return record_meshes(rigs, settings)
