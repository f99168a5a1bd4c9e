# SPDX-License-Identifier: GPL-3.0-or-later
"""The options that choose poses and a target object, whose surface is recorded instead of that of the rig's mesh."""

import argparse
from typing import Any

from ..core.errors import WrongUsageError
from ..core.settings import (
    LEARN_FROM,
    MIRROR,
    OVERSHOOT,
    POSES,
    PRE_ROLL,
    REST_THRESHOLD_MM,
    SEED,
    SETTLE_FRAMES,
    SPREAD,
    settings_of,
    values_from,
)
from ..poses.remix import choose_bones
from ..recording.plan import RecordingSettings, find_actions
from ..rig.pose_setter import TargetSettings
from ..scene.scene_rig import SceneRig
from .files import add_repeatable_option

DEFORMING = "deforming"
"""Value of --bones-to-pose for the deforming bones, within their limits."""


def add_pose_options(parser: argparse.ArgumentParser, **arguments: Any) -> None:
    """Add the options to a parser; `arguments` are those of the option `--poses` that differ (`Setting.add_option`)."""
    POSES.add_option(parser, **arguments)
    for setting in (SEED, SPREAD, OVERSHOOT, MIRROR):
        setting.add_option(parser)
    add_repeatable_option(parser, "--action", "NAME", "also record all frames of this action")
    add_repeatable_option(parser, "--strip", "NAME", "also record all frames of this NLA strip")
    add_repeatable_option(
        parser,
        "--bones-to-pose",
        "WHAT",
        "bones that random poses move: collection:NAME, action:NAME (the bones that the action keys, in the ranges "
        "that it uses), bone:NAME, selected, deforming, or remix (every second pose takes each limb from a random "
        "frame of the actions of --action, else of all actions of the rig, with noise); default: remix if --action "
        "moves bones, or if no bone has limits, else deforming",
    )
    add_repeatable_option(
        parser,
        "--extra-input",
        "NAME[=LOW:HIGH]",
        "extra input of the model besides bones: the name of a shape key, OWNER/PATH, or control bones, "
        "collection:NAME or bone:NAME: their unlocked channels and custom properties; shape keys, and inputs that "
        "drivers of the mesh read, are detected automatically",
    )


def add_target_options(parser: argparse.ArgumentParser) -> None:
    """Add the option --learn-from and the options of its settings."""
    for setting in (LEARN_FROM, PRE_ROLL, SETTLE_FRAMES, REST_THRESHOLD_MM):
        setting.add_option(parser)


def target_settings(options: argparse.Namespace) -> TargetSettings:
    """Return the settings of the target from the options.

    Raises:
        WrongUsageError: there are options of a target, and no target.
    """
    if (options.pre_roll or options.settle_frames) and not options.learn_from:
        raise WrongUsageError("--pre-roll and --settle-frames need a target; give --learn-from OBJECT.")
    settings = [setting for setting in settings_of(TargetSettings) if hasattr(options, setting.name)]
    return TargetSettings(options.learn_from, **values_from(options, settings))


def pose_settings(options: argparse.Namespace, scene_rig: SceneRig | None = None) -> dict[str, object]:
    """Return the arguments of `RecordingSettings` that choose poses, from the options of `add_pose_options`.

    Args:
        scene_rig: the rig, whose actions choose the bones if no option does; None to leave them out.
    """
    settings = [setting for setting in settings_of(RecordingSettings) if hasattr(options, setting.name)]
    values = values_from(options, settings)
    lists = {
        "actions": options.action,
        "strips": options.strip,
        "bones_to_pose": options.bones_to_pose,
        "extra_inputs": options.extra_input,
    }
    values = {name: value for name, value in values.items() if value is not None}
    values |= {name: tuple(value) for name, value in lists.items()}
    if scene_rig and not options.bones_to_pose and options.poses != 0:
        values["bones_to_pose"] = choose_bones(scene_rig, find_actions(RecordingSettings(**values)))
    elif DEFORMING in options.bones_to_pose:
        if set(options.bones_to_pose) != {DEFORMING}:
            raise WrongUsageError(f"--bones-to-pose {DEFORMING} stands alone; leave the others out.")
        values["bones_to_pose"] = ()
    return values
