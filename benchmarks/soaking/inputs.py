# SPDX-License-Identifier: GPL-3.0-or-later
"""Soak test of characters whose surface depends on time or on a second armature.

A model is a function of the pose and the controls of its recording. The recording must therefore be refused, or the
model's inputs must differ wherever two surfaces differ.
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

from .cases import CaseFailedError, print_case, run_case

SETTINGS = RecordingSettings(poses=4, influence_poses=1)
SAME_INPUT_TOLERANCE, SAME_SURFACE_TOLERANCE = 1e-4, 1e-4
"""Inputs (mesh units or no unit) and surfaces (meters) that differ by less count as equal."""
FRAMES = (1, 9, 23, 30)
STACK_BUILDERS = [build for build in stacks.STACKS if build is not stacks.subdivided]
TIME_DEPENDENCIES = ("keys", "frame", "scene", "property")


def run_time(folder: Path, seed: int, first_case: int, end_case: int) -> None:
    """Let a random property of a random modifier stack depend on time; every fifth case is a character of `in_time`."""
    _run("time", folder, seed, first_case, end_case, _build_time_dependent, _visit_frames)


def run_armatures(folder: Path, seed: int, first_case: int, end_case: int) -> None:
    """Move second armatures that have random locks, rotation modes, limits and actions."""
    _run("second armature", folder, seed, first_case, end_case, _build_second_armature, _move_second_armature)


def _run(
    part: str,
    folder: Path,
    seed: int,
    first_case: int,
    end_case: int,
    build_character: Callable[..., str],
    visit_poses: Callable[..., object],
) -> None:
    fdda_addon.register()
    for case_index in range(first_case, end_case):
        random = np.random.default_rng((seed, case_index))
        bpy.ops.wm.read_factory_settings(use_empty=True)
        fdda_addon.register()
        name = build_character(random)

        def action(random: np.random.Generator = random) -> float:
            return _record_and_compare(folder / f"{part} recording", lambda rig: visit_poses(rig, random))

        print_case(run_case(part, f"{part} {seed}/{case_index} ({name})", action))


def _record_and_compare(path: Path, visit_poses: Callable[[SceneRig], object]) -> float:
    """Record a character, then compare the surfaces of poses with equal inputs; return the largest distance, meters."""
    shutil.rmtree(path, ignore_errors=True)
    rig = find_rig("elbow")
    for _ in record(rig, path, SETTINGS):
        pass
    recording = read_recording(path)
    animation = rig.armature_object.animation_data
    if animation:
        animation.action = None
    rig.armature_object.pose.bones["lower"].rotation_euler[0] = 1.0
    evaluator, samples = PoseEvaluator(rig, recording.rig), []
    for _ in visit_poses(rig):
        pose, positions, controls = evaluator.evaluate()
        samples.append((np.append(pose, controls), positions))
    distance_m = 0.0
    for index, (inputs, positions) in enumerate(samples):
        for other_inputs, other_positions in samples[:index]:
            if np.abs(inputs - other_inputs).max() < SAME_INPUT_TOLERANCE:
                distance_m = max(distance_m, float(np.linalg.norm(positions - other_positions, axis=1).max()))
    if distance_m > SAME_SURFACE_TOLERANCE:
        raise CaseFailedError(f"recorded, but two surfaces with equal inputs are {distance_m * 1000:.1f} mm apart")
    return distance_m


def _visit_frames(_rig: SceneRig, _random: np.random.Generator) -> object:
    for frame in FRAMES:
        bpy.context.scene.frame_set(frame)
        yield


def _build_time_dependent(random: np.random.Generator) -> str:
    if random.random() < 0.2:
        builders = (*in_time.REFUSED, *in_time.TOLD, *in_time.HARMLESS)
        build = builders[random.integers(len(builders))]
        build()
        return build.__name__
    properties = []
    while not properties:
        bpy.ops.wm.read_factory_settings(use_empty=True)
        fdda_addon.register()
        build = STACK_BUILDERS[random.integers(len(STACK_BUILDERS))]
        build()
        properties = _animatable_properties()
    owner, path = properties[random.integers(len(properties))]
    dependency = str(random.choice(TIME_DEPENDENCIES))
    start_value = getattr(owner, path)
    end_value = start_value + float(random.uniform(0.05, 1.0))
    if dependency == "keys":
        in_time.insert_keys(owner, path, start_value, end_value)
    else:
        _add_driver(owner, path, dependency, start_value, end_value - start_value)
    bpy.context.scene.frame_set(1)
    return f"{dependency} of {path} in {build.__name__}"


def _animatable_properties() -> list[tuple[bpy.types.bpy_struct, str]]:
    """List the animatable numbers of all modifiers and shape keys, each as its owner and name."""
    properties = []
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
                        properties.append((struct, prop.identifier))
    return properties


def _add_driver(owner: bpy.types.bpy_struct, path: str, dependency: str, start: float, change: float) -> None:
    """Drive a property from a start value by a change over 30 frames."""
    driver = owner.driver_add(path).driver
    progress = "min(1, frame / 30)"
    if dependency == "scene":
        variable = driver.variables.new()
        variable.name, variable.targets[0].id_type = "now", "SCENE"
        variable.targets[0].id, variable.targets[0].data_path = bpy.context.scene, "frame_current"
        progress = "min(1, now / 30)"
    elif dependency == "property":
        holder = bpy.data.objects.new("holder", None)
        bpy.context.scene.collection.objects.link(holder)
        holder["progress"] = 0.0
        in_time.insert_keys(holder, '["progress"]', 0.0, 1.0)
        variable = driver.variables.new()
        variable.name, variable.targets[0].id, variable.targets[0].data_path = "progress", holder, '["progress"]'
        progress = "progress"
    driver.expression = f"{start} + {change} * {progress}"


def _build_second_armature(random: np.random.Generator) -> str:
    builders = (*second_armature.REFUSED, *second_armature.TOLD)
    build = builders[random.integers(len(builders))]
    build()
    bone = second_armature.muscle_bone()
    bone.rotation_mode = str(random.choice(["QUATERNION", "AXIS_ANGLE", "XYZ", "ZYX"]))
    for locks in (bone.lock_location, bone.lock_rotation, bone.lock_scale):
        for axis in range(3):
            # With few locks, nearly all recordings would be refused.
            locks[axis] = random.random() < 0.85
    if random.random() < 0.3:
        in_time.insert_keys(bone, "location", (0.0, 0.0, 0.0), (0.0, 0.02, 0.02))
    return f"{bone.rotation_mode} in {build.__name__}"


def _move_second_armature(_rig: SceneRig, random: np.random.Generator) -> object:
    """Move the bones of the second armature along all unlocked axes, yielding after each pose."""
    for _ in range(6):
        for bone in bpy.data.objects[second_armature.ARMATURE].pose.bones:
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
