# SPDX-License-Identifier: GPL-3.0-or-later
"""`record RIG.blend RECORDING`: records how a rig deforms its mesh, or adds poses at the worst errors of a model.

With `--all`, or with several `--object`, one recording has several meshes of an armature.
"""

import argparse
import time
from collections.abc import Iterator
from pathlib import Path

from ..core.checks.target import unsettled_sentence
from ..core.errors import WrongUsageError
from ..core.progress import Progress
from ..core.recording.estimate import format_poses
from ..core.recording.index import read_index, read_info, repeatability_sentence
from ..core.settings import MAX_AUTO_POSES, POSES, REFINEMENT_POSES
from ..core.wording import format_count
from ..poses.remix import choose_bones, describe_bones
from ..poses.sample_selection import describe_control_bones, split_control_bones
from ..recording.plan import RecordingSettings, find_actions, find_recorded_character, listed_controls
from ..recording.refinement import RefinementSettings, refine
from ..recording.run import record
from ..runtime.binding import model_disabled
from ..scene.scene_rig import SceneRig, find_character, find_whole_character
from .files import add_repeatable_option, add_rig_argument, open_file
from .pose_options import add_pose_options, add_target_options, pose_settings, target_settings
from .progress import ProgressPrinter


def add_options(parser: argparse.ArgumentParser) -> None:
    add_recording_options(parser, "if several have a rig")
    parser.add_argument("recording", metavar="RECORDING", type=Path, help="folder of the recording")
    parser.add_argument(
        "--all", action="store_true", help="record all meshes that follow the armature by their modifiers"
    )
    parser.add_argument("--resume", action="store_true", help="continue an interrupted recording")
    parser.add_argument("--overwrite", action="store_true", help="replace an existing recording, even if it is damaged")
    parser.add_argument(
        "--refine",
        metavar="MODEL.onnx",
        type=Path,
        help=f"add poses at the worst errors of this model to the recording ({REFINEMENT_POSES} without --poses)",
    )


def add_recording_options(parser: argparse.ArgumentParser, object_help: str) -> None:
    """Add the argument RIG.blend, and the options that choose meshes and poses; --object with when to give it."""
    add_rig_argument(parser)
    text = f"mesh object to record, {object_help}, or one of several of one recording"
    add_repeatable_option(parser, "--object", "NAME", text)
    add_pose_options(
        parser,
        default=None,
        help=f"number of random poses (default: {POSES.default:,} to {MAX_AUTO_POSES:,}, by the speed of the rig, so "
        "that they take about a minute)",
    )
    add_target_options(parser)


def run(options: argparse.Namespace) -> None:
    check_options(options)
    open_file(options.rig)
    scene_rig = _find_rig(options)
    if not options.refine:
        if names := split_control_bones(scene_rig, options.extra_input)[0]:
            controls = listed_controls(scene_rig, RecordingSettings(**pose_settings(options, scene_rig)))
            print(describe_control_bones(scene_rig.armature_object, names, controls))
        if not options.bones_to_pose and options.poses != 0 and not options.learn_from:
            actions = find_actions(RecordingSettings(actions=tuple(options.action)))
            print(describe_bones(scene_rig, choose_bones(scene_rig, actions), actions))
    start = time.monotonic()
    with ProgressPrinter() as progress, model_disabled(*scene_rig.mesh_objects):
        for step in _make_job(scene_rig, options):
            if step.note:
                progress.end_line()
                print(step.note, flush=True)
            progress.show(step.stage, step.done, step.total, step.detail)
    seconds = time.monotonic() - start
    if options.refine:
        print(f"{options.recording}: {format_count(step.total, 'pose')} added in {seconds:.1f} s")
        return
    index = read_index(options.recording)
    info = read_info(index)
    for sentence in filter(None, (unsettled_sentence(index), repeatability_sentence(info.repeatability_mm))):
        print(sentence)
    meshes = f", of {len(index['meshes'])} meshes" if len(index["meshes"]) > 1 else ""
    poses = format_poses(info.poses, len(info.alone_poses))
    print(f"{options.recording}: {poses}{meshes}, in {seconds:.1f} s")


def check_options(options: argparse.Namespace) -> None:
    """Check the options, as far as they need no rig.

    Raises:
        WrongUsageError: two options contradict each other.
    """
    target_settings(options)
    new_recording_options = (
        options.action,
        options.strip,
        options.mirror,
        options.bones_to_pose,
        options.extra_input,
        options.learn_from,
    )
    if options.refine and (any(new_recording_options) or options.poses == 0):
        raise WrongUsageError(
            "--refine adds random poses to a complete recording; leave --action, --strip, --mirror, --bones-to-pose, "
            "--extra-input and --learn-from out."
        )
    if options.all and options.object:
        raise WrongUsageError("--all records all meshes, and --object those that it names; give one of them.")
    if options.overwrite + options.resume + (options.refine is not None) > 1:
        raise WrongUsageError("--overwrite, --resume and --refine exclude each other; give one of them.")


def _find_rig(options: argparse.Namespace) -> SceneRig:
    """Return the rig of the meshes to record, or of those of the recording that `--refine` extends."""
    if options.refine:
        return find_recorded_character(options.recording, *options.object[:1])
    if not options.all:
        return find_character(options.object or [""])
    scene_rig, note = find_whole_character()
    if note:
        print(note)
    return scene_rig


def _make_job(scene_rig: SceneRig, options: argparse.Namespace) -> Iterator[Progress]:
    if options.refine:
        pose_options = {} if options.poses is None else {"poses": options.poses}
        settings = RefinementSettings(seed=options.seed, **pose_options)
        return refine(scene_rig, options.recording, options.refine, settings)
    settings = RecordingSettings(
        resume=options.resume,
        overwrite=options.overwrite,
        target=target_settings(options),
        auto_poses=options.poses is None,
        **pose_settings(options, scene_rig),
    )
    return record(scene_rig, options.recording, settings)
