# SPDX-License-Identifier: GPL-3.0-or-later
"""Options of a target object, whose surface is recorded instead of that of the rig's mesh."""

import argparse
from typing import TYPE_CHECKING

from ..core.errors import WrongUsageError
from ..core.settings import MAX_SETTLE_FRAMES, PRE_ROLL, REST_THRESHOLD_MM, TARGET, settings_of, values_from

if TYPE_CHECKING:
    from ..rig.pose_setter import TargetSettings
    from ..scene.scene_rig import SceneRig


def add_target_options(parser: argparse.ArgumentParser) -> None:
    """Add the option --target and the options of its settings."""
    for setting in (TARGET, PRE_ROLL, MAX_SETTLE_FRAMES, REST_THRESHOLD_MM):
        setting.add_option(parser)


def target_settings(options: argparse.Namespace) -> "TargetSettings":
    """Return the settings of the target from the options.

    Raises:
        WrongUsageError: there are options of a target, and no target.
    """
    from ..rig.pose_setter import TargetSettings

    if (options.pre_roll or options.max_settle_frames) and not options.target:
        raise WrongUsageError("--pre-roll and --max-settle-frames need a target; give --target OBJECT.")
    settings = [setting for setting in settings_of(TargetSettings) if hasattr(options, setting.name)]
    return TargetSettings(options.target, **values_from(options, settings))


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
