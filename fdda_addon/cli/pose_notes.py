# SPDX-License-Identifier: GPL-3.0-or-later
"""Prints what the user should know about the poses of a recording before it begins."""

import argparse

import bpy

from ..poses.action_range import measured_ranges
from ..poses.control_bones import describe_control_bones, split_control_bones
from ..recording.plan import RecordingSettings, listed_controls
from ..scene.scene_rig import SceneRig
from .target import pose_settings, requested_poses

REMIX_HINT = (
    "Hint: random poses move each bone by itself; with --bones-to-pose remix they combine limbs of the actions, and "
    "the model follows unseen actions more closely."
)


def print_control_bones(scene_rig: SceneRig, options: argparse.Namespace) -> None:
    """Print how many inputs the control bones are, and which locations and custom properties have no range."""
    names, _ = split_control_bones(scene_rig, options.extra_input)
    if names:
        settings = RecordingSettings(**pose_settings(options))
        print(describe_control_bones(scene_rig.armature_object, names, listed_controls(scene_rig, settings)))


def print_remix_hint(scene_rig: SceneRig, options: argparse.Namespace) -> None:
    """Print a hint to remix the actions if they move bones, unless the poses are chosen already."""
    actions = [bpy.data.actions[name] for name in options.action if name in bpy.data.actions]
    if options.bones_to_pose or options.resume or not actions or requested_poses(scene_rig, options) == 0:
        return
    if measured_ranges(scene_rig.armature_object, actions):
        print(REMIX_HINT)
