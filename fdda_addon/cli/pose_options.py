# SPDX-License-Identifier: GPL-3.0-or-later
"""The options that choose poses, of the verbs `record` and `poses`."""

import argparse
from typing import Any

from ..core.settings import MIRROR, OVERSHOOT, POSES, SEED, SPREAD


def add_pose_options(parser: argparse.ArgumentParser, **arguments: Any) -> None:
    """Add the options to a parser; `arguments` are those of the option `--poses` that differ (`Setting.add_option`)."""
    POSES.add_option(parser, **arguments)
    for setting in (SEED, SPREAD, OVERSHOOT, MIRROR):
        setting.add_option(parser)
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
        "--bones-to-pose",
        action="append",
        default=[],
        metavar="WHAT",
        help="bones that random poses move: collection:NAME, action:NAME (the bones that the action keys, in the "
        "ranges that it uses), bone:NAME, selected, deforming, or remix (every second pose takes each limb from a "
        "random frame of the actions of --action, else of all actions of the rig, with noise); repeatable (default: "
        "remix if --action moves bones, or if no bone has limits; else deforming)",
    )
    parser.add_argument(
        "--extra-input",
        action="append",
        default=[],
        metavar="NAME[=LOW:HIGH]",
        help="extra input of the model besides bones: the name of a shape key, OWNER/PATH, or control bones, "
        "collection:NAME or bone:NAME: their unlocked channels and custom properties; shape keys, and inputs that "
        "drivers of the mesh read, are detected automatically; repeatable",
    )
