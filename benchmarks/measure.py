# SPDX-License-Identifier: GPL-3.0-or-later
"""One measurement of one rig, in a process of its own: `measure.py frames|recording|crowd|cold-start FILES…`.

Prints one line of JSON. `bench.py` starts it for every figure that it shows; what is compared is timed in one process,
in turn.
"""

import json
import statistics
import sys
import tempfile
import time
from collections.abc import Callable
from pathlib import Path

import bpy

sys.path.insert(0, str(Path(__file__).resolve().parent.parent))

import fdda_addon
from fdda_addon.core.poses import sample_pose
from fdda_addon.poses.sampling import sampled_channels
from fdda_addon.recording.plan import RecordingSettings
from fdda_addon.recording.run import record
from fdda_addon.rig.reading import PoseReader, read_rig
from fdda_addon.runtime import model_files
from fdda_addon.runtime.network import Network
from fdda_addon.scene.armature import Poser, clear_pose
from fdda_addon.scene.mesh import evaluated_positions
from fdda_addon.scene.scene_rig import SceneRig, armature_modifier, find_rig
from fdda_addon.scene.temporary_state import temporary_pose
from fdda_addon.timing.benchmark import benchmark, key_random_poses

ROUNDS = 5
CROWD = 20


def frames(rig: str, model: str, count: str = "100") -> dict:
    """A whole frame of rig, linear skinning, model and floor, as the verb `benchmark` times it."""
    bpy.ops.wm.open_mainfile(filepath=rig)
    *_, measured = benchmark(find_rig(), Path(model), int(count))
    return measured.to_json()


def recording(rig: str, poses: str = "60") -> dict:
    """Poses a second of a recording, and of a loop that only poses and evaluates."""
    bpy.ops.wm.open_mainfile(filepath=rig)
    scene_rig = find_rig()
    count = int(poses)
    pairs = [(_bare_loop(scene_rig, count), _recording(scene_rig, count)) for _ in range(ROUNDS)]
    bare, recorded = (statistics.median(pair[i] for pair in pairs) for i in (0, 1))
    ratio = statistics.median(bare_s / recorded_s for bare_s, recorded_s in pairs)
    return {"bare_poses_a_second": count / bare, "poses_a_second": count / recorded, "ratio": ratio}


def _bare_loop(scene_rig: SceneRig, count: int) -> float:
    channels = sampled_channels(scene_rig, read_rig(scene_rig))
    poser = Poser(scene_rig, channels)
    with temporary_pose(scene_rig.armature_object):
        clear_pose(scene_rig.armature_object)
        values = [sample_pose(channels, 0, index) for index in range(count)]
        return _seconds(lambda: [(poser.set(pose), bpy.context.view_layer.update()) for pose in values])


def _recording(scene_rig: SceneRig, count: int) -> float:
    """Seconds of the stage "poses"; the influences are found once, whatever the number of poses."""
    with tempfile.TemporaryDirectory() as folder:
        started = 0.0
        for step in record(scene_rig, Path(folder) / "recording", RecordingSettings(poses=count, influence_poses=1)):
            if step.stage == "poses" and not started:
                started = time.perf_counter()
        return time.perf_counter() - started


def crowd(bound: str) -> dict:
    """A frame of one bound character and of a crowd, each in a pose of its own; and without the characters."""
    bpy.ops.wm.open_mainfile(filepath=bound)
    first = next(o for o in bpy.data.objects if o.fdda.is_bound)
    armature_object = armature_modifier(first).object
    if armature_object.animation_data is None or armature_object.animation_data.action is None:
        key_random_poses(SceneRig(first, armature_object))
    one = _frame_times(60)
    empty = _without_play(first)
    for number in range(1, CROWD):
        mesh_copy, armature_copy = first.copy(), armature_object.copy()
        for copy in (mesh_copy, armature_copy):
            bpy.context.scene.collection.objects.link(copy)
        mesh_copy.data = first.data.copy()
        _redirect_drivers(mesh_copy.data.shape_keys, armature_object, armature_copy)
        mesh_copy.parent = armature_copy if first.parent else None
        armature_modifier(mesh_copy).object = armature_copy
        _shift_action(armature_copy, number * 7)
    many = _frame_times(60)
    return {
        "one_ms": one,
        "switched_off_ms": empty,
        "characters": CROWD,
        "crowd_ms": many,
        "ms_a_character": many / CROWD,
        "ratio": many / CROWD / one,
    }


def _redirect_drivers(
    keys: bpy.types.Key | None, armature_object: bpy.types.Object, armature_copy: bpy.types.Object
) -> None:
    """Let the drivers of shape keys read the armature of their own character."""
    for curve in keys.animation_data.drivers if keys is not None and keys.animation_data else ():
        for target in (target for variable in curve.driver.variables for target in variable.targets):
            if target.id == armature_object:
                target.id = armature_copy


def _without_play(mesh_object: bpy.types.Object) -> float:
    mesh_object.hide_viewport = True
    try:
        return _frame_times(60)
    finally:
        mesh_object.hide_viewport = False


def _shift_action(armature_object: bpy.types.Object, frames_later: int) -> None:
    """Play the action later, through the NLA: every character of the crowd is in another pose."""
    animation = armature_object.animation_data
    action = animation.action
    animation.action = None
    strip = animation.nla_tracks.new().strips.new("shifted", 1, action)
    strip.frame_start_ui = 1 - frames_later
    strip.repeat = 3


def _frame_times(count: int) -> float:
    scene = bpy.context.scene
    times = [_seconds(lambda frame=frame: scene.frame_set(frame)) for frame in range(1, count + 1)]
    return statistics.median(times[5:]) * 1000


def cold_start(bound: str) -> dict:
    """Seconds from opening a bound file to its next frame, ONNX Runtime's import and the model's load included.

    Whether that frame shows what the model says is looked at afterwards.
    """

    def start() -> None:
        bpy.ops.wm.open_mainfile(filepath=bound)
        bpy.context.scene.frame_set(bpy.context.scene.frame_current + 1)

    imported_before = "onnxruntime" in sys.modules
    seconds = _seconds(start)
    return {"seconds": seconds, "onnxruntime_at_start_up": imported_before, "is_right": _is_model_shown()}


def _is_model_shown() -> bool:
    mesh_object = next(o for o in bpy.data.objects if o.fdda.is_bound)
    armature_object = armature_modifier(mesh_object).object
    network = Network(model_files.model_path(mesh_object))
    depsgraph = bpy.context.evaluated_depsgraph_get()
    reader = PoseReader(
        SceneRig(mesh_object, armature_object),
        tuple(joint.name for joint in network.info.joints),
        network.info.rest_matrices,
    )
    pose = reader.read(mesh_object.evaluated_get(depsgraph), armature_object.evaluated_get(depsgraph))
    shown = evaluated_positions(mesh_object, depsgraph)
    return bool(abs(shown - network.positions(pose[None])[0]).max() < 1e-5)


def inference(model: str) -> dict:
    """Milliseconds of the model alone, at one pose and at a crowd's, a character."""
    network = Network(Path(model))
    result = {}
    for characters in (1, CROWD):
        poses = network.info.rest_matrices[None].repeat(characters, axis=0)
        times = [_seconds(lambda poses=poses: network.positions(poses)) for _ in range(200)]
        result[f"ms_at_{characters}"] = statistics.median(times[20:]) * 1000 / characters
    return result


def _seconds(call: Callable[[], object]) -> float:
    start = time.perf_counter()
    call()
    return time.perf_counter() - start


MEASUREMENTS = {
    "frames": frames,
    "recording": recording,
    "crowd": crowd,
    "cold-start": cold_start,
    "inference": inference,
}

if __name__ == "__main__":
    fdda_addon.register()
    try:
        print(json.dumps(MEASUREMENTS[sys.argv[1]](*sys.argv[2:])))
    finally:
        fdda_addon.unregister()
