# SPDX-License-Identifier: GPL-3.0-or-later
"""Run one measurement of one rig: `measure.py frames|recording|crowd|cold-start|inference FILES…`.

Prints one line of JSON. `bench.py` starts this script for every figure of its table. Times that are compared with each
other are measured alternately in the same process.
"""

import json
import statistics
import sys
import tempfile
import time
from collections.abc import Callable
from pathlib import Path

import bpy
import numpy as np

sys.path.insert(0, str(Path(__file__).resolve().parent.parent))

import fdda_addon
from fdda_addon.core.mathematics.poses import sample_pose
from fdda_addon.core.progress import run_job
from fdda_addon.poses.sampling import sampled_channels
from fdda_addon.recording.plan import RecordingSettings
from fdda_addon.recording.run import record
from fdda_addon.rig.reading import PoseEvaluator, read_model_rig, read_rig
from fdda_addon.runtime import model_files
from fdda_addon.runtime.network import Network
from fdda_addon.scene.armature import Poser, clear_pose
from fdda_addon.scene.scene_rig import SceneRig, armature_modifier, armature_of, find_rig
from fdda_addon.scene.temporary_state import temporary_pose
from fdda_addon.timing.animation import key_random_poses
from fdda_addon.timing.benchmark import benchmark

ROUNDS = 5
TIMED_FRAMES = 60
CROWD_SIZE = 20


def frames(rig: str, model: str, count: str = "100") -> dict:
    """Time a frame with the rig, linear skinning, the model and constant positions, as the verb `benchmark` does."""
    bpy.ops.wm.open_mainfile(filepath=rig)
    scene_rig = find_rig()
    models = {scene_rig.mesh_object: Path(model)}
    return run_job(benchmark(scene_rig.armature_object, int(count), models)).to_json()


def recording(rig: str, poses: str = "60") -> dict:
    """Return the poses per second of a recording, and of a loop that only sets poses and evaluates them."""
    bpy.ops.wm.open_mainfile(filepath=rig)
    scene_rig = find_rig()
    count = int(poses)
    pairs = [(_time_bare_loop(scene_rig, count), _time_recording(scene_rig, count)) for _ in range(ROUNDS)]
    bare_loop_s, recording_s = (statistics.median(pair[i] for pair in pairs) for i in (0, 1))
    ratio = statistics.median(pair[0] / pair[1] for pair in pairs)
    return {"bare_poses_a_second": count / bare_loop_s, "poses_a_second": count / recording_s, "ratio": ratio}


def _time_bare_loop(scene_rig: SceneRig, count: int) -> float:
    channels = sampled_channels(scene_rig, read_rig(scene_rig))
    poser = Poser(scene_rig, channels)
    with temporary_pose(scene_rig.armature_object):
        clear_pose(scene_rig.armature_object)
        values = [sample_pose(channels, 0, index) for index in range(count)]
        return _time_call(lambda: [(poser.set(pose), bpy.context.view_layer.update()) for pose in values])


def _time_recording(scene_rig: SceneRig, count: int) -> float:
    """Time the stage "poses" alone: the checks before it take the same time for any number of poses."""
    with tempfile.TemporaryDirectory() as folder:
        start_time = 0.0
        for step in record(scene_rig, Path(folder) / "recording", RecordingSettings(poses=count, influence_poses=1)):
            if step.stage == "poses" and not start_time:
                start_time = time.perf_counter()
        return time.perf_counter() - start_time


def crowd(bound: str) -> dict:
    """Time a frame with one bound character, with a crowd of differently posed copies, and with no character."""
    bpy.ops.wm.open_mainfile(filepath=bound)
    first = next(o for o in bpy.data.objects if o.fdda.is_bound)
    armature_object = armature_modifier(first).object
    if armature_object.animation_data is None or armature_object.animation_data.action is None:
        key_random_poses(SceneRig(first, armature_object))
    single_ms = _median_frame_ms()
    hidden_ms = _median_hidden_frame_ms(first)
    for number in range(1, CROWD_SIZE):
        mesh_copy, armature_copy = first.copy(), armature_object.copy()
        for copy in (mesh_copy, armature_copy):
            bpy.context.scene.collection.objects.link(copy)
        mesh_copy.data = first.data.copy()
        _redirect_drivers(mesh_copy.data.shape_keys, armature_object, armature_copy)
        mesh_copy.parent = armature_copy if first.parent else None
        armature_modifier(mesh_copy).object = armature_copy
        _shift_action(armature_copy, number * 7)
    crowd_ms = _median_frame_ms()
    return {
        "one_ms": single_ms,
        "switched_off_ms": hidden_ms,
        "characters": CROWD_SIZE,
        "crowd_ms": crowd_ms,
        "ms_a_character": crowd_ms / CROWD_SIZE,
        "ratio": crowd_ms / CROWD_SIZE / single_ms,
    }


def _redirect_drivers(
    keys: bpy.types.Key | None, armature_object: bpy.types.Object, armature_copy: bpy.types.Object
) -> None:
    """Point the drivers of shape keys at the copied armature."""
    for curve in keys.animation_data.drivers if keys is not None and keys.animation_data else ():
        for target in (target for variable in curve.driver.variables for target in variable.targets):
            if target.id == armature_object:
                target.id = armature_copy


def _median_hidden_frame_ms(mesh_object: bpy.types.Object) -> float:
    mesh_object.hide_viewport = True
    try:
        return _median_frame_ms()
    finally:
        mesh_object.hide_viewport = False


def _shift_action(armature_object: bpy.types.Object, delay_frames: int) -> None:
    """Delay the action with an NLA strip, so that every character of the crowd is in a different pose."""
    animation = armature_object.animation_data
    action = animation.action
    animation.action = None
    strip = animation.nla_tracks.new().strips.new("shifted", 1, action)
    strip.frame_start_ui = 1 - delay_frames
    strip.repeat = 3


def _median_frame_ms() -> float:
    scene = bpy.context.scene
    times = [_time_call(lambda frame=frame: scene.frame_set(frame)) for frame in range(1, TIMED_FRAMES + 1)]
    return statistics.median(times[5:]) * 1000


def cold_start(bound: str) -> dict:
    """Time opening a bound file and evaluating its next frame, with importing ONNX Runtime and loading the model.

    Checks afterwards, untimed, that the frame shows the output of the model.

    Returns:
        Among others the processor time of all threads, which depends little on what else the machine does.
    """

    def open_and_evaluate() -> None:
        bpy.ops.wm.open_mainfile(filepath=bound)
        bpy.context.scene.frame_set(bpy.context.scene.frame_current + 1)

    was_imported = "onnxruntime" in sys.modules
    processor_start = time.process_time()
    seconds = _time_call(open_and_evaluate)
    return {
        "seconds": seconds,
        "processor_seconds": time.process_time() - processor_start,
        "onnxruntime_at_start_up": was_imported,
        "is_right": _is_model_shown(),
    }


def _is_model_shown() -> bool:
    mesh_object = next(o for o in bpy.data.objects if o.fdda.is_bound)
    scene_rig = SceneRig(mesh_object, armature_of(mesh_object))
    network = model_files.network_of(mesh_object)
    pose, shown_positions, controls = PoseEvaluator(scene_rig, read_model_rig(scene_rig, network.info)).evaluate()
    return bool(abs(shown_positions - network.positions(pose[None], controls[None])[0]).max() < 1e-5)


def inference(model: str) -> dict:
    """Time the model alone on one pose and on the poses of a crowd; return milliseconds per character."""
    network = Network(Path(model))
    result = {}
    for pose_count in (1, CROWD_SIZE):
        poses = network.info.rest_matrices[None].repeat(pose_count, axis=0)
        controls = np.zeros((pose_count, len(network.info.controls)), np.float32)
        times = [
            _time_call(lambda poses=poses, controls=controls: network.positions(poses, controls)) for _ in range(200)
        ]
        result[f"ms_at_{pose_count}"] = statistics.median(times[20:]) * 1000 / pose_count
    return result


def _time_call(function: Callable[[], object]) -> float:
    start = time.perf_counter()
    function()
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
