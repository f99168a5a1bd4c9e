# SPDX-License-Identifier: GPL-3.0-or-later
"""`record RIG.blend RECORDING`: records how a rig deforms its mesh, or adds poses at the worst errors of a model.

With `--all`, or with several `--object`, all meshes are recorded in the same poses, each into a subfolder of RECORDING.
"""

import argparse
import time
from contextlib import ExitStack
from pathlib import Path
from typing import TYPE_CHECKING

from ..core.sentences.counts import format_count

if TYPE_CHECKING:
    from collections.abc import Iterator

    from ..core.progress import Progress
    from ..scene.scene_rig import SceneRig


def add_options(parser: argparse.ArgumentParser) -> None:
    from .record_options import add_record_options

    add_record_options(parser)


def run(options: argparse.Namespace) -> None:
    from ..core.checks.target import unsettled_sentence
    from ..core.recording.index import read_index, read_info
    from ..runtime.binding import model_disabled
    from .files import open_file
    from .pose_notes import print_control_bones, print_remix_hint
    from .progress import ProgressPrinter
    from .record_options import check_options

    check_options(options)
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
    if options.refine:
        print(f"{options.recording}: {format_count(step.total, 'pose')} added in {seconds:.1f} s")
        return
    for _, recording in rigs:
        index = read_index(recording)
        repeatability = read_info(index).repeatability
        for sentence in filter(None, (unsettled_sentence(index), repeatability and repeatability.sentence())):
            print(sentence)
        print(f"{recording}: {format_count(index['poses'], 'pose')} in {seconds:.1f} s")


def _find_rigs(options: argparse.Namespace) -> "list[tuple[SceneRig, Path]]":
    """Return the rigs to record, each with the folder of its recording."""
    from ..scene.scene_rig import describe_left_out_meshes, find_rig, find_rigs
    from .folders import mesh_folders

    names = list(dict.fromkeys(options.object))
    if options.all:
        rigs = find_rigs()
        if note := describe_left_out_meshes(rigs):
            print(note)
        return mesh_folders(rigs, options.recording)
    if len(names) > 1:
        return mesh_folders([find_rig(name) for name in names], options.recording)
    return [(find_rig(*names), options.recording)]


def _make_job(rigs: "list[tuple[SceneRig, Path]]", options: argparse.Namespace) -> "Iterator[Progress]":
    from ..core.settings import POSES, settings_of, values_from
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
        actions=tuple(options.action),
        resume=options.resume,
        overwrite=options.overwrite,
        sample=tuple(options.sample),
        controls=tuple(options.control),
        strips=tuple(options.strip),
        target=target_settings(options),
        **(values_from(options, settings_of(RecordingSettings)) | {"poses": POSES.default} | pose_options),
    )
    return record_meshes(rigs, settings)
