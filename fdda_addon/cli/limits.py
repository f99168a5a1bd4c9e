# SPDX-License-Identifier: GPL-3.0-or-later
"""`limits RIG.blend OUT.blend --action NAME`: sets the rotation limits of a rig to the motion in actions."""

import argparse
import math
from pathlib import Path

from ..core.errors import WrongUsageError
from ..core.files.file_kind import BLEND
from ..core.files.output import check_outputs
from ..core.wording import format_count
from ..poses.action_range import measured_ranges
from ..poses.clip import find_action
from ..poses.measured_limits import DEFAULT_MARGIN, describe_limits, set_limits_from_actions
from ..scene.blend_file import save_copy
from .files import add_overwrite_option, add_repeatable_option, add_rig_options, open_rig


def add_options(parser: argparse.ArgumentParser) -> None:
    add_rig_options(parser)
    parser.add_argument("out", metavar="OUT.blend", type=Path, help="file to save the rig with the limits to")
    add_repeatable_option(parser, "--action", "NAME", "action whose motion sets the limits", required=True)
    parser.add_argument(
        "--margin",
        type=float,
        default=DEFAULT_MARGIN,
        help=f"ratio of the width of each range to add at both ends (default {DEFAULT_MARGIN})",
    )
    add_overwrite_option(parser)


def run(options: argparse.Namespace) -> None:
    if not 0 <= options.margin <= 10 or math.isnan(options.margin):
        raise WrongUsageError("--margin must be 0 to 10.")
    check_outputs({options.out: BLEND}, (options.rig,), options.overwrite)
    scene_rig = open_rig(options)
    actions = [find_action(name) for name in options.action]
    limits = set_limits_from_actions(scene_rig, actions, options.margin)
    save_copy(options.out)
    for line in describe_limits(scene_rig.armature_object, limits):
        print(line)
    for action in actions:
        if not measured_ranges(scene_rig.armature_object, [action]):
            print(f"The action '{action.name}' moves no bone of '{scene_rig.armature_object.name}'.")
    bone_count = len({limit.bone for limit in limits if not limit.reason_unset})
    print(f"{options.out}: set the limits of {format_count(bone_count, 'bone')} of '{scene_rig.armature_object.name}'")
