# SPDX-License-Identifier: GPL-3.0-or-later
"""Characters whose surface depends on time or on a second armature, at random: refused, or the model is told.

A model is a function of the pose and the controls of its recording. So a recorded character falls short where two
surfaces differ and what a model is told of them does not.
"""

import shutil
from collections.abc import Callable
from pathlib import Path

import bpy
import numpy as np

import fdda_addon
from blend_fixtures.characters import in_time, second_armature, stacks
from fdda_addon.core.recording.reader import read_recording
from fdda_addon.recording.plan import RecordingSettings
from fdda_addon.recording.run import record
from fdda_addon.rig.reading import PoseEvaluator
from fdda_addon.scene.scene_rig import SceneRig, find_rig

from .cases import ShortfallError, attempt, say

SETTINGS = RecordingSettings(poses=4, influence_poses=1)
SAME_INPUT, SAME_SURFACE = 1e-4, 1e-4
"""Inputs, no unit or mesh units, and metres, that differ by less are the same."""
FRAMES = (1, 9, 23, 30)
STACKS = [build for build in stacks.STACKS if build is not stacks.subdivided]
WAYS = ("keys", "frame", "scene", "property")


def run_time(folder: Path, seed: int, first: int, end: int) -> None:
    """A random number of a random stack depends on time; every fifth case is a character of `in_time` as it is."""
    _run("time", folder, seed, first, end, _build_in_time, _all_frames)


def run_armatures(folder: Path, seed: int, first: int, end: int) -> None:
    """Second armatures with random locks, modes, limits and actions, moved at random."""
    _run("second armature", folder, seed, first, end, _build_second_armature, _all_moves)


def _run(
    part: str, folder: Path, seed: int, first: int, end: int, build: Callable[..., str], poses: Callable[..., object]
) -> None:
    fdda_addon.register()
    for number in range(first, end):
        random = np.random.default_rng((seed, number))
        bpy.ops.wm.read_factory_settings(use_empty=True)
        fdda_addon.register()
        name = build(random)

        def action(random: np.random.Generator = random) -> float:
            return _record_and_compare(folder / f"{part} recording", lambda rig: poses(rig, random))

        say(attempt(part, f"{part} {seed}/{number} ({name})", action))


def _record_and_compare(path: Path, poses: Callable[[SceneRig], object]) -> float:
    shutil.rmtree(path, ignore_errors=True)
    rig = find_rig("elbow")
    for _ in record(rig, path, SETTINGS):
        pass
    recording = read_recording(path)
    animation = rig.armature_object.animation_data
    if animation:
        animation.action = None
    rig.armature_object.pose.bones["lower"].rotation_euler[0] = 1.0
    evaluator, told = PoseEvaluator(rig, recording.rig), []
    for _ in poses(rig):
        pose, shown, controls = evaluator.evaluate()
        told.append((np.append(pose, controls), shown))
    apart = 0.0
    for number, (inputs, shown) in enumerate(told):
        for other_inputs, other in told[:number]:
            if np.abs(inputs - other_inputs).max() < SAME_INPUT:
                apart = max(apart, float(np.linalg.norm(shown - other, axis=1).max()))
    if apart > SAME_SURFACE:
        raise ShortfallError(f"recorded, and two surfaces of one input are {apart * 1000:.1f} mm apart")
    return apart


def _all_frames(_rig: SceneRig, _random: np.random.Generator) -> object:
    for frame in FRAMES:
        bpy.context.scene.frame_set(frame)
        yield


def _build_in_time(random: np.random.Generator) -> str:
    if random.random() < 0.2:
        builders = (*in_time.REFUSED, *in_time.TOLD, *in_time.HARMLESS)
        build = builders[random.integers(len(builders))]
        build()
        return build.__name__
    owners = []
    while not owners:
        bpy.ops.wm.read_factory_settings(use_empty=True)
        fdda_addon.register()
        build = STACKS[random.integers(len(STACKS))]
        build()
        owners = _owners()
    owner, path = owners[random.integers(len(owners))]
    way = str(random.choice(WAYS))
    old = getattr(owner, path)
    high = old + float(random.uniform(0.05, 1.0))
    if way == "keys":
        in_time.key(owner, path, old, high)
    else:
        _drive(owner, path, way, old, high - old)
    bpy.context.scene.frame_set(1)
    return f"{way} of {path} in {build.__name__}"


def _owners() -> list[tuple[bpy.types.bpy_struct, str]]:
    """Numbers that may move the surface, or may not."""
    found = []
    for scene_object in bpy.context.scene.objects:
        structs = [*scene_object.modifiers]
        keys = getattr(scene_object.data, "shape_keys", None)
        structs += list(keys.key_blocks)[1:] if keys else []
        for struct in structs:
            for prop in struct.bl_rna.properties:
                if prop.type == "FLOAT" and not prop.is_readonly and not prop.is_array and prop.is_animatable:
                    path = f"{struct.path_from_id()}.{prop.identifier}"
                    animation = struct.id_data.animation_data
                    if path not in {curve.data_path for curve in (animation.drivers if animation else ())}:
                        found.append((struct, prop.identifier))
    return found


def _drive(owner: bpy.types.bpy_struct, path: str, way: str, start: float, change: float) -> None:
    driver = owner.driver_add(path).driver
    part = "min(1, frame / 30)"
    if way == "scene":
        variable = driver.variables.new()
        variable.name, variable.targets[0].id_type = "now", "SCENE"
        variable.targets[0].id, variable.targets[0].data_path = bpy.context.scene, "frame_current"
        part = "min(1, now / 30)"
    elif way == "property":
        holder = bpy.data.objects.new("holder", None)
        bpy.context.scene.collection.objects.link(holder)
        holder["part"] = 0.0
        in_time.key(holder, '["part"]', 0.0, 1.0)
        variable = driver.variables.new()
        variable.name, variable.targets[0].id, variable.targets[0].data_path = "part", holder, '["part"]'
        part = "part"
    driver.expression = f"{start} + {change} * {part}"


def _build_second_armature(random: np.random.Generator) -> str:
    builders = (*second_armature.REFUSED, *second_armature.TOLD)
    build = builders[random.integers(len(builders))]
    build()
    bone = second_armature.bone()
    bone.rotation_mode = str(random.choice(["QUATERNION", "AXIS_ANGLE", "XYZ", "ZYX"]))
    for locks in (bone.lock_location, bone.lock_rotation, bone.lock_scale):
        for axis in range(3):
            # Mostly locked: else nearly all are refused.
            locks[axis] = random.random() < 0.85
    if random.random() < 0.3:
        in_time.key(bone, "location", (0.0, 0.0, 0.0), (0.0, 0.02, 0.02))
    return f"{bone.rotation_mode} in {build.__name__}"


def _all_moves(_rig: SceneRig, random: np.random.Generator) -> object:
    """Move the bones of the second armature in all that is not locked."""
    for _ in range(6):
        for bone in bpy.data.objects[second_armature.MUSCLES].pose.bones:
            for axis in range(3):
                if not bone.lock_location[axis]:
                    bone.location[axis] = random.uniform(-0.05, 0.05)
                if not bone.lock_rotation[axis]:
                    bone.rotation_euler[axis] = random.uniform(-0.5, 0.5)
                if not bone.lock_scale[axis]:
                    bone.scale[axis] = random.uniform(0.5, 1.5)
            if not all(bone.lock_rotation):
                bone.rotation_quaternion = bone.rotation_euler.to_quaternion()
                axis, angle = bone.rotation_quaternion.to_axis_angle()
                bone.rotation_axis_angle = (angle, *axis)
        bpy.context.view_layer.update()
        yield
        bpy.context.scene.frame_set(int(random.integers(1, 31)))
        yield
