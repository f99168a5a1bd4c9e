# SPDX-License-Identifier: GPL-3.0-or-later
"""`fast-rig RIG.blend MODEL.onnx OUT.blend`: saves a fast rig, without what the model and the controls do not need."""

import argparse
from pathlib import Path

from ..core.errors import OutputError, WrongUsageError
from ..core.files.file_kind import BLEND
from ..core.files.output import check_outputs
from ..core.wording import format_count, format_list
from ..fast_rig.controls import check_choices
from ..fast_rig.frame_times import measure_frames
from ..fast_rig.run import FastRig, make_fast_rig
from .files import add_model_argument, add_overwrite_option, add_rig_options, open_rigs
from .progress import ProgressPrinter

MAX_LISTED = 10
DEFAULT_CONTROLS = ("visible", "keyed")


def add_options(parser: argparse.ArgumentParser) -> None:
    add_rig_options(parser)
    add_model_argument(parser)
    parser.add_argument("out", metavar="OUT.blend", type=Path, help="file to save, with the fast rig")
    parser.add_argument(
        "--controls",
        nargs="+",
        default=DEFAULT_CONTROLS,
        metavar="CHOICE",
        help="control bones to keep: visible, keyed (in an action of the file), collection:NAME of a bone collection "
        "(default: visible keyed)",
    )
    parser.add_argument(
        "--frames",
        type=int,
        default=60,
        help="number of frames to time with each rig (default 60); 0 for none",
    )
    add_overwrite_option(parser)


def run(options: argparse.Namespace) -> None:
    if options.frames < 0:
        raise WrongUsageError("--frames must be 0 or more.")
    check_choices(options.controls)
    # The source is the full rig that renders need, so it is never overwritten.
    check_outputs({options.out: BLEND}, (options.rig, options.model), options.overwrite)
    out = options.out
    if out.exists() and options.rig.exists() and out.samefile(options.rig):
        raise OutputError(f"'{out}' is the full rig, which renders need; give the fast rig another name.")
    rigs_and_models = list(open_rigs(options).values())
    object_name = rigs_and_models[0][0].mesh_object.name
    with ProgressPrinter() as progress:
        fast_rig = progress.run(make_fast_rig(rigs_and_models, options.out, tuple(options.controls)))
        print(f"{options.out}: {_summary(fast_rig)}")
        if options.frames:
            controls, size = fast_rig.controls, fast_rig.size
            times = progress.run(measure_frames(options.rig, options.out, object_name, controls, options.frames, size))
    if options.frames:
        print(f"{options.out}: {times.sentence}")


def _summary(fast_rig: FastRig) -> str:
    """Return what was removed and compared, a line each."""
    lines = [
        f"'{fast_rig.armature_name}' has {fast_rig.bones_after:,} of {fast_rig.bones_before:,} bones; the model reads "
        f"{fast_rig.joints:,}, animators pose {len(fast_rig.controls):,}",
        f"  removed {_count(fast_rig.removed.objects, 'object')}, {_count(fast_rig.removed.modifiers, 'modifier')} "
        f"and {format_count(fast_rig.removed.drivers, 'driver')}",
    ]
    if fast_rig.moving_joints:
        lines.append(
            f"  the joints, the controls and {format_count(fast_rig.object_count, 'rendered object')} are as in the "
            f"full rig in {format_count(fast_rig.pose_count, 'pose')} (largest difference "
            f"{fast_rig.largest_difference:.1e} of the size)"
        )
    else:
        lines.append(
            f"  no joint moves in {format_count(fast_rig.pose_count, 'pose')} of these controls, so nothing shows that "
            "the joints move as in the full rig; choose the controls that move them with --controls"
        )
    if counts := fast_rig.infinite_bones:
        lines.append(
            f"  in up to {max(counts.values())} of these, both rigs give no finite transform to "
            f"{format_list(list(counts), MAX_LISTED)}; there they were not compared"
        )
    if fast_rig.unrepeated:
        lines.append(f"  not compared, because the full rig does not repeat it: {', '.join(fast_rig.unrepeated)}")
    for action, counts in fast_rig.lost_channels.items():
        count, names = sum(counts.values()), format_list(list(counts), MAX_LISTED)
        lines.append(f"  '{action}': {count:,} keyed channels have no bone any more: {names}")
    return "\n".join(lines)


def _count(names: tuple[str, ...], noun: str) -> str:
    return format_count(len(names), noun) + (f" ({format_list(names, MAX_LISTED)})" if names else "")
