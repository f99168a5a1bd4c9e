# SPDX-License-Identifier: GPL-3.0-or-later
"""The options of the verb `record`, and which of them contradict each other."""

import argparse
from pathlib import Path

from ..core.errors import WrongUsageError
from ..core.settings import (
    MAX_AUTO_POSES,
    MIRROR,
    OVERSHOOT,
    POSES,
    REFINEMENT_POSES,
    REPEATABILITY_POSES,
    SEED,
    SPREAD,
)
from .files import add_rig_argument
from .target import add_target_options, target_settings


def add_record_options(parser: argparse.ArgumentParser) -> None:
    """Add the options to a parser."""
    add_rig_argument(parser)
    _add_mesh_options(parser)
    add_pose_options(parser)
    parser.add_argument("--resume", action="store_true", help="continue an interrupted recording")
    parser.add_argument("--overwrite", action="store_true", help="replace an existing recording, even if it is damaged")
    add_target_options(parser)
    REPEATABILITY_POSES.add_option(parser)
    parser.add_argument(
        "--refine", metavar="MODEL.onnx", type=Path, help="add poses at the worst errors of this model to the recording"
    )


def _add_mesh_options(parser: argparse.ArgumentParser) -> None:
    parser.add_argument(
        "--object",
        action="append",
        default=[],
        metavar="NAME",
        help="mesh object to record, if several have a rig; repeatable, for one recording of several meshes",
    )
    parser.add_argument(
        "--all",
        action="store_true",
        help="record all meshes that follow the armature by their modifiers",
    )
    parser.add_argument("recording", metavar="RECORDING", type=Path, help="folder of the recording")


def add_pose_options(parser: argparse.ArgumentParser) -> None:
    """Add the options that choose poses."""
    default_text = (
        f"(default: as many as are evaluated in about a minute, {POSES.default} to {MAX_AUTO_POSES}; with --refine "
        f"{REFINEMENT_POSES})"
    )
    POSES.add_option(parser, default=None, help=f"number of random poses {default_text}")
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
        help="extra input of the model besides bones: the name of a shape key, shape_keys for all shape keys, "
        "OWNER/PATH, or control bones, collection:NAME or bone:NAME: their unlocked channels and custom properties; "
        "inputs that drivers of the mesh read are detected automatically; repeatable",
    )


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
    if options.overwrite and (options.resume or options.refine):
        raise WrongUsageError("--overwrite makes a new recording; leave --resume and --refine out.")
