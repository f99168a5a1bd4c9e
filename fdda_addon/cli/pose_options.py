# SPDX-License-Identifier: GPL-3.0-or-later
"""The options that choose poses, of the verbs `record` and `poses`."""

import argparse
from typing import Any

from ..core.settings import MIRROR, OVERSHOOT, POSES, SEED, SPREAD
from .files import add_repeatable_option


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
