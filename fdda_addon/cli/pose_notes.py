# SPDX-License-Identifier: GPL-3.0-or-later
"""Prints what the user should know about the poses of a recording before it begins."""

import argparse

from ..poses.control_bones import describe_control_bones, split_control_bones
from ..poses.remix import describe_bones
from ..recording.plan import RecordingSettings, find_actions, listed_controls
from ..scene.scene_rig import SceneRig
from .target import pose_settings


def print_control_bones(scene_rig: SceneRig, options: argparse.Namespace) -> None:
    """Print how many inputs the control bones are, and which locations and custom properties have no range."""
    names, _ = split_control_bones(scene_rig, options.extra_input)
    if names:
        settings = RecordingSettings(**pose_settings(options, scene_rig))
        print(describe_control_bones(scene_rig.armature_object, names, listed_controls(scene_rig, settings)))


def print_bones_to_pose(scene_rig: SceneRig, options: argparse.Namespace) -> None:
    """Print what random poses move if no option chooses it."""
    if not options.bones_to_pose and options.poses != 0:
        print(describe_bones(scene_rig, find_actions(RecordingSettings(actions=tuple(options.action)))))
