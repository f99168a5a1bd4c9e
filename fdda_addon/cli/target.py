# SPDX-License-Identifier: GPL-3.0-or-later
"""Options of a target object, whose surface is recorded instead of that of the rig's mesh."""

import argparse
from typing import TYPE_CHECKING

from ..core.errors import WrongUsageError
from ..core.settings import LEARN_FROM, PRE_ROLL, REST_THRESHOLD_MM, SETTLE_FRAMES, settings_of, values_from

if TYPE_CHECKING:
    from ..rig.pose_setter import TargetSettings
    from ..scene.scene_rig import SceneRig


def add_target_options(parser: argparse.ArgumentParser) -> None:
    """Add the option --learn-from and the options of its settings."""
    for setting in (LEARN_FROM, PRE_ROLL, SETTLE_FRAMES, REST_THRESHOLD_MM):
        setting.add_option(parser)


def target_settings(options: argparse.Namespace) -> "TargetSettings":
    """Return the settings of the target from the options.

    Raises:
        WrongUsageError: there are options of a target, and no target.
    """
    from ..rig.pose_setter import TargetSettings

    if (options.pre_roll or options.settle_frames) and not options.learn_from:
        raise WrongUsageError("--pre-roll and --settle-frames need a target; give --learn-from OBJECT.")
    settings = [setting for setting in settings_of(TargetSettings) if hasattr(options, setting.name)]
    return TargetSettings(options.learn_from, **values_from(options, settings))


def pose_settings(options: argparse.Namespace) -> dict[str, object]:
    """Return the arguments of `RecordingSettings` that choose poses, from the options of `add_pose_options`."""
    from ..recording.plan import RecordingSettings

    values = values_from(options, settings_of(RecordingSettings))
    lists = {
        "actions": options.action,
        "strips": options.strip,
        "bones_to_pose": options.bones_to_pose,
        "extra_inputs": options.extra_input,
    }
    return {name: value for name, value in values.items() if value is not None} | {
        n: tuple(v) for n, v in lists.items()
    }


def requested_poses(scene_rig: "SceneRig", options: argparse.Namespace) -> int | None:
    """Return the number of random poses; None for the default.

    A target that depends on the frame has no random poses by default if actions or strips are given.
    """
    from ..recording.plan import RecordingSettings, depends_on_time, read_sample_selection
    from ..rig.pose_setter import TargetSettings

    if (
        options.poses is not None
        or not options.learn_from
        or options.settle_frames
        or not (options.action or options.strip)
    ):
        return options.poses
    settings = RecordingSettings(**pose_settings(options), target=TargetSettings(options.learn_from))
    selection, _ = read_sample_selection(scene_rig, settings)
    return 0 if depends_on_time(scene_rig, settings, selection.controls) else None
