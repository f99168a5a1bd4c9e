# SPDX-License-Identifier: GPL-3.0-or-later
"""Makes an action of the poses of a recording, for training and exports in other programs."""

from contextlib import closing
from dataclasses import replace

import bpy
import numpy as np

from ..core.errors import RigError
from ..core.mathematics.poses import CONTROL, ROTATION_VECTOR, bones_with_changed_range
from ..core.progress import Job, Progress
from ..core.recording.index import ACTION, MIRRORED, RANDOM, STRIP, RecordingInfo
from ..poses.clip import find_clips
from ..poses.clip_player import ClipPlayer
from ..poses.remix import REMIX
from ..rig.pose_setter import temporary_rig_state
from ..scene.animated_values import read_value
from ..scene.armature import FOUR_COMPONENT_ROTATIONS, clear_pose, pose_values
from ..scene.arrays import KEY_INTERPOLATION_ELEMENT, KEY_POSITION_ELEMENT, POSE_CHANNELS, write
from ..scene.controls import bone_transform, can_be_set, is_driven, owner_of
from ..scene.scene_rig import SceneRig
from ..scene.temporary_state import assign_action
from .plan import RecordingSettings, make_pose_sampler, make_sampling, read_sampled_rig
from .pose_plan import PosePlan

ACTION_NAME = "Poses"
CONSTANT = 0
"""Blender's number of the interpolation that keeps the value until the next key."""

CurveValues = dict[tuple[bpy.types.ID, str], np.ndarray]
"""Values (F, n) in F frames, by datablock and RNA path of a property with n numbers."""


def recorded_settings(info: RecordingInfo) -> RecordingSettings:
    """Return settings that give the poses of a recording, without refined poses."""
    sampling = info.sampling
    names = {kind: tuple(s.name for s in sampling.sources if s.kind == kind) for kind in (RANDOM, ACTION, STRIP)}
    return RecordingSettings(
        poses=sum(source.poses for source in sampling.sources if source.kind == RANDOM),
        seed=sampling.seed,
        spread=sampling.spread,
        overshoot=sampling.overshoot.factor if sampling.overshoot else 1.0,
        actions=names[ACTION],
        strips=names[STRIP],
        mirror=any(source.kind == MIRRORED for source in sampling.sources),
        bones_to_pose=(REMIX,) if REMIX in names[RANDOM] else (),
    )


def make_posed_action(
    scene_rig: SceneRig, settings: RecordingSettings, info: RecordingInfo | None = None
) -> Job[tuple[bpy.types.Action, list[str]]]:
    """Make an action of poses while the generator is iterated, and assign it to all that it poses.

    Frame 0 is the rest pose, and each further frame a pose. The action keys the bones in their rotation mode and the
    controls; all else keeps its value in the file. The scene gets the frames of the action, without time stretching.

    Args:
        settings: settings of the poses.
        info: the recording whose poses the settings give (`recorded_settings`); None for new poses.

    Returns:
        The action, and the names of controls whose drivers are muted for it.

    Raises:
        RigError: the rig cannot be posed, or gives other poses than the recording has.
    """
    rig, channels = read_sampled_rig(scene_rig, settings)
    if info:
        channels = info.sampling.channels
        kinds = {RANDOM, ACTION, STRIP, MIRRORED}
        recorded = replace(info.sampling, sources=tuple(s for s in info.sampling.sources if s.kind in kinds))
        remix = make_pose_sampler(scene_rig, settings).remix
        recorded_limbs, limbs = (
            tuple(channel for channel in each if channel.kind == ROTATION_VECTOR)
            for each in (channels, remix.channels if remix else channels)
        )
        is_same = make_sampling(scene_rig, settings, channels) == recorded
        if not is_same or bones_with_changed_range(recorded_limbs, limbs):
            raise RigError(
                f"'{scene_rig.mesh_object.name}' does not give the recorded poses any more: its actions or locked "
                "axes have changed; record again, or leave --recording out."
            )
    clips = find_clips([scene_rig], settings.actions, settings.strips, settings.mirror)
    plan = PosePlan(scene_rig, channels, settings, clips)
    if plan.total < 1:
        raise RigError("There is no pose: 0 random poses and no action; give --poses or --action.")
    names = [channel.name for channel in channels if channel.kind == CONTROL and can_be_set(channel.name)]
    properties = {name: (owner_of(scene_rig, name.partition("/")[0]), name.partition("/")[2]) for name in names}
    properties = {name: key for name, key in properties.items() if not bone_transform(key[1])}
    driven = [name for name, key in properties.items() if is_driven(*key)]
    values: dict[tuple[bpy.types.ID, str], list[np.ndarray]] = {}

    def append_pose(player: ClipPlayer) -> None:
        numbers = player.current_clip_frame.numbers | {key: read_value(*key) for key in properties.values()}
        for armature_object in player.armature_objects:
            values.setdefault((armature_object, ""), []).append(pose_values(armature_object))
        for key, value in numbers.items():
            values.setdefault(key, []).append(np.atleast_1d(np.array(value, np.float64)))

    with temporary_rig_state(scene_rig, rig, channels, clips) as player:
        append_pose(player)
        with closing(plan.show_poses(player, range(plan.total))) as poses:
            for index in poses:
                append_pose(player)
                yield Progress("poses", index + 1, plan.total)
        armature_objects = player.armature_objects
    for armature_object in armature_objects:
        clear_pose(armature_object)
    action = _write_action(_curve_values({key: np.array(rows) for key, rows in values.items()}))
    for datablock, path in (properties[name] for name in driven):
        for curve in datablock.animation_data.drivers:
            curve.mute |= curve.data_path == path
    scene = bpy.context.scene
    scene.render.frame_map_old = scene.render.frame_map_new = 100
    scene.frame_start, scene.frame_end, scene.use_preview_range = 0, plan.total, False
    scene.frame_set(0)
    return action, driven


def _curve_values(values: CurveValues) -> CurveValues:
    """Split the values of pose bones (path "") by property; leave out what is equal in all frames."""
    curves = {}
    for (datablock, path), rows in values.items():
        if path:
            curves[datablock, path] = rows
            continue
        ends = np.cumsum([element.shape[0] for element in POSE_CHANNELS])
        rows_by_property = dict(zip((e.name for e in POSE_CHANNELS), np.split(rows, ends[:-1], axis=2), strict=True))
        for index, bone in enumerate(datablock.pose.bones):
            rotation = FOUR_COMPONENT_ROTATIONS.get(bone.rotation_mode, "rotation_euler")
            for name in ("location", rotation, "scale"):
                curves[datablock, f"{bone.path_from_id()}.{name}"] = rows_by_property[name][:, index]
    return {key: rows for key, rows in curves.items() if (rows != rows[0]).any()}


def _write_action(curves: CurveValues) -> bpy.types.Action:
    """Write values to a new action, one key per frame from frame 0 on, and assign it to their datablocks."""
    action = bpy.data.actions.new(ACTION_NAME)
    strip = action.layers.new("Layer").strips.new(type="KEYFRAME")
    slots = {}
    for (datablock, path), rows in curves.items():
        if datablock not in slots:
            slots[datablock] = action.slots.new(id_type=datablock.id_type, name=datablock.name)
        bag = strip.channelbag(slots[datablock], ensure=True)
        for index in range(rows.shape[1]):
            curve = bag.fcurves.new(path, index=index)
            curve.keyframe_points.add(len(rows))
            points = np.stack([np.arange(len(rows)), rows[:, index]], axis=1).astype(np.float32)
            write(curve.keyframe_points, KEY_POSITION_ELEMENT, points)
            # No frame blends two poses.
            write(curve.keyframe_points, KEY_INTERPOLATION_ELEMENT, np.full(len(rows), CONSTANT, np.int32))
            curve.update()
    for datablock, slot in slots.items():
        assign_action(datablock, action, slot)
        datablock.animation_data.use_nla = False
    return action
