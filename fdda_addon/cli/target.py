# SPDX-License-Identifier: GPL-3.0-or-later
"""Options of a target object, whose surface is recorded instead of that of the rig's mesh."""

import argparse
import math
from typing import TYPE_CHECKING

from ..core.defaults import REPEATABILITY_POSES, REST_THRESHOLD_MM
from ..core.errors import WrongUsageError

if TYPE_CHECKING:
    from ..rig.pose_setter import TargetSettings
    from ..scene.scene_rig import SceneRig


def add_repeatability_option(parser: argparse.ArgumentParser) -> None:
    """Add the option --repeatability-poses."""
    parser.add_argument(
        "--repeatability-poses",
        type=int,
        default=REPEATABILITY_POSES,
        metavar="N",
        help="show N settled poses or frames of actions again, coming from another pose, to measure how closely a "
        f"simulation repeats its shape (default {REPEATABILITY_POSES})",
    )


def add_target_options(parser: argparse.ArgumentParser) -> None:
    """Add the option --target and the options of its settings."""
    parser.add_argument(
        "--target",
        default="",
        metavar="OBJECT",
        help="record the surface of this object instead; it has the same vertices, and may be a copy with other "
        "modifiers, a point cache or a simulation",
    )
    parser.add_argument(
        "--pre-roll",
        type=int,
        default=0,
        metavar="N",
        help="N frames before an action in which a simulated target moves from the rest pose to the first frame",
    )
    parser.add_argument(
        "--max-settle-frames",
        type=int,
        default=0,
        metavar="N",
        help="hold each random pose for up to N frames, until a simulated target comes to rest",
    )
    parser.add_argument(
        "--rest-threshold-mm",
        type=float,
        default=REST_THRESHOLD_MM,
        metavar="X",
        help=f"a target is at rest if no vertex moves more than X mm per frame (default {REST_THRESHOLD_MM})",
    )


def target_settings(options: argparse.Namespace) -> "TargetSettings":
    """Return the settings of the target from the options.

    Raises:
        WrongUsageError: the options are invalid.
    """
    from ..rig.pose_setter import TargetSettings

    repeatability_poses = getattr(options, "repeatability_poses", 0)
    if (
        min(options.pre_roll, options.max_settle_frames, repeatability_poses) < 0
        or not 0 < options.rest_threshold_mm < math.inf
    ):
        raise WrongUsageError(
            "--pre-roll, --max-settle-frames and --repeatability-poses must be 0 or more, and --rest-threshold-mm "
            "more than 0."
        )
    if (options.pre_roll or options.max_settle_frames) and not options.target:
        raise WrongUsageError("--pre-roll and --max-settle-frames need a target; give --target OBJECT.")
    return TargetSettings(
        options.target, options.pre_roll, options.max_settle_frames, options.rest_threshold_mm, repeatability_poses
    )


def requested_poses(scene_rig: "SceneRig", options: argparse.Namespace) -> int | None:
    """Return the number of random poses; None for the default.

    A target that depends on the frame has no random poses by default if actions or strips are given.
    """
    from ..recording.plan import RecordingSettings, depends_on_time, read_sample_selection
    from ..rig.pose_setter import TargetSettings

    if (
        options.poses is not None
        or not options.target
        or options.max_settle_frames
        or not (options.action or options.strip)
    ):
        return options.poses
    settings = RecordingSettings(
        actions=tuple(options.action),
        sample=tuple(options.sample),
        controls=tuple(options.control),
        target=TargetSettings(options.target),
    )
    selection, _ = read_sample_selection(scene_rig, settings)
    return 0 if depends_on_time(scene_rig, settings, selection.controls) else None
