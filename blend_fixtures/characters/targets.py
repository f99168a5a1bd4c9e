# SPDX-License-Identifier: GPL-3.0-or-later
"""Build characters with a target object `flesh`; each function builds one in the current scene.

The mesh `elbow` has only its Armature modifier. Cache files are in a folder that is removed when Python exits.
"""

import functools
import struct
import tempfile
from collections.abc import Callable, Iterator
from pathlib import Path

import bpy
import numpy as np

from blend_fixtures.elbow import ACTION, FRAMES
from fdda_addon.scene.mesh import evaluated_positions

from .base import add_key, bulge, tube
from .stacks import build_node_chain

TARGET = "flesh"


def target_copy() -> bpy.types.Object:
    """Build a tube, and a copy of it with delta mush after its Armature modifier; return the copy."""
    mesh_object, _ = tube()
    flesh = add_target_copy(mesh_object)
    modifier = flesh.modifiers.new("Mush", "CORRECTIVE_SMOOTH")
    modifier.rest_source, modifier.factor, modifier.iterations = "ORCO", 0.6, 8
    return flesh


def target_alembic() -> None:
    """Build the target as an object that plays an Alembic file of the copy's action."""
    _export_and_import(
        "abc", lambda path: bpy.ops.wm.alembic_export(filepath=path, selected=True, start=1, end=FRAMES, flatten=False)
    )


def target_usd() -> None:
    """Build the target as an object that plays a USD file of the copy's action."""
    _export_and_import(
        "usdc",
        lambda path: bpy.ops.wm.usd_export(
            filepath=path, selected_objects_only=True, export_animation=True, export_armatures=False
        ),
    )


def target_pc2() -> None:
    """Build the target as a copy whose Mesh Cache modifier plays a .pc2 file of its action."""
    flesh = target_copy()
    path = _cache_folder() / "flesh.pc2"
    header = struct.pack("<12siiffi", b"POINTCACHE2\0", 1, len(flesh.data.vertices), 1.0, 1.0, FRAMES)
    path.write_bytes(header + b"".join(positions.astype("<f4").tobytes() for positions in _positions_by_frame(flesh)))
    _play_file(flesh, path, "PC2")


def target_mdd() -> None:
    """Build the target as a copy whose Mesh Cache modifier plays an .mdd file of its action."""
    flesh = target_copy()
    path = _cache_folder() / "flesh.mdd"
    seconds = np.arange(FRAMES, dtype=">f4") / bpy.context.scene.render.fps
    header = struct.pack(">ii", FRAMES, len(flesh.data.vertices)) + seconds.tobytes()
    path.write_bytes(header + b"".join(positions.astype(">f4").tobytes() for positions in _positions_by_frame(flesh)))
    _play_file(flesh, path, "MDD")


def target_shape_keys() -> None:
    """Build the target as a copy with a shape key whose value is keyed in every frame of the action."""
    mesh_object, armature_object = tube()
    flesh = add_target_copy(mesh_object)
    key = add_key(flesh, "flexed", bulge)
    scene, bone = bpy.context.scene, armature_object.pose.bones["lower"]
    for frame in range(1, FRAMES + 1):
        scene.frame_set(frame)
        key.value = bone.rotation_euler[0] / 2
        key.keyframe_insert("value", frame=frame)
    scene.frame_set(1)


def target_soft_body() -> bpy.types.Object:
    """Build the target as a copy with a soft body whose goal is the skinned surface; return the copy."""
    flesh = add_target_copy(tube()[0])
    flesh.modifiers.new("Softbody", "SOFT_BODY")
    soft_body = flesh.soft_body
    soft_body.use_goal, soft_body.goal_default, soft_body.goal_spring, soft_body.goal_friction = True, 0.7, 0.5, 20.0
    soft_body.use_edges, soft_body.pull, soft_body.push, soft_body.damping, soft_body.bend = True, 0.3, 0.3, 20.0, 0.5
    soft_body.step_max, soft_body.error_threshold = 40, 0.1
    return flesh


def target_cloth() -> bpy.types.Object:
    """Build the target as a copy with cloth that has a pin weight of one half; return the copy."""
    flesh = add_target_copy(tube()[0])
    add_cloth(flesh)
    return flesh


def add_cloth(flesh: bpy.types.Object, quality: int = 4) -> None:
    """Add cloth with a pin weight of one half, so that gravity and stretching edges move the mesh."""
    pin_group = flesh.vertex_groups.new(name="pin")
    pin_group.add(range(len(flesh.data.vertices)), 0.5, "REPLACE")
    settings = flesh.modifiers.new("Cloth", "CLOTH").settings
    settings.vertex_group_mass, settings.quality, settings.air_damping = "pin", quality, 10.0


def target_geometry_nodes() -> bpy.types.Object:
    """Build the target as a copy with delta mush whose vertices lag behind the skinned surface; return the copy.

    A simulation zone of Geometry Nodes computes the lag.
    """
    flesh = add_target_copy(tube()[0])
    flesh.modifiers.new("Lag", "NODES").node_group = lagging_group()
    delta_mush = flesh.modifiers.new("Mush", "CORRECTIVE_SMOOTH")
    delta_mush.rest_source, delta_mush.factor, delta_mush.iterations = "ORCO", 0.6, 8
    return flesh


def lagging_group() -> bpy.types.NodeTree:
    """Build a node group that moves the vertices of the previous frame halfway to their input positions."""
    group = build_node_chain(
        "Lag", "GeometryNodeSimulationInput", "GeometryNodeSetPosition", "GeometryNodeSimulationOutput"
    )
    nodes = {node.bl_idname: node for node in group.nodes}
    simulation_input, simulation_output = nodes["GeometryNodeSimulationInput"], nodes["GeometryNodeSimulationOutput"]
    simulation_input.pair_with_output(simulation_output)
    group.links.clear()
    group_input, group_output, set_position = (
        nodes[kind] for kind in ("NodeGroupInput", "NodeGroupOutput", "GeometryNodeSetPosition")
    )
    position, index = (group.nodes.new(f"GeometryNodeInput{input_name}") for input_name in ("Position", "Index"))
    sample, mix = group.nodes.new("GeometryNodeSampleIndex"), group.nodes.new("ShaderNodeMix")
    sample.data_type, mix.data_type = "FLOAT_VECTOR", "VECTOR"
    mix.inputs["Factor"].default_value = 0.5

    def find_vector_socket(sockets: object, name: str) -> bpy.types.NodeSocket:
        return next(socket for socket in sockets if socket.name == name and socket.type == "VECTOR")

    for output_socket, input_socket in (
        (group_input.outputs[0], simulation_input.inputs[0]),
        (simulation_input.outputs["Geometry"], set_position.inputs["Geometry"]),
        (group_input.outputs[0], sample.inputs["Geometry"]),
        (position.outputs[0], find_vector_socket(sample.inputs, "Value")),
        (index.outputs[0], sample.inputs["Index"]),
        (position.outputs[0], find_vector_socket(mix.inputs, "A")),
        (find_vector_socket(sample.outputs, "Value"), find_vector_socket(mix.inputs, "B")),
        (find_vector_socket(mix.outputs, "Result"), set_position.inputs["Position"]),
        (set_position.outputs["Geometry"], simulation_output.inputs["Geometry"]),
        (simulation_output.outputs["Geometry"], group_output.inputs[0]),
    ):
        group.links.new(output_socket, input_socket)
    return group


def _cache_folder() -> Path:
    """Return the folder for cache files. Blender's temporary folder is not used: opening another file empties it."""
    return Path(_temporary_directory().name)


@functools.cache
def _temporary_directory() -> tempfile.TemporaryDirectory:
    return tempfile.TemporaryDirectory(prefix="fdda_targets_")


def add_target_copy(mesh_object: bpy.types.Object) -> bpy.types.Object:
    """Copy an object and its mesh; return the copy."""
    flesh = mesh_object.copy()
    flesh.data, flesh.name = mesh_object.data.copy(), TARGET
    bpy.context.scene.collection.objects.link(flesh)
    bpy.context.scene.frame_start, bpy.context.scene.frame_end = 1, 250
    bpy.context.view_layer.update()
    return flesh


def _positions_by_frame(flesh: bpy.types.Object) -> Iterator[np.ndarray]:
    """Yield the evaluated positions of an object, (V, 3), in each frame of the action."""
    for frame in range(1, FRAMES + 1):
        bpy.context.scene.frame_set(frame)
        yield evaluated_positions(flesh, bpy.context.evaluated_depsgraph_get())
    bpy.context.scene.frame_set(1)


def _play_file(flesh: bpy.types.Object, path: Path, kind: str) -> None:
    """Replace the modifiers of an object with a Mesh Cache modifier that plays a file."""
    flesh.modifiers.clear()
    modifier = flesh.modifiers.new("Cache", "MESH_CACHE")
    modifier.cache_format, modifier.filepath, modifier.frame_start = kind, str(path), 1


def _export_and_import(suffix: str, export: Callable[[str], object]) -> None:
    """Export the copy to a file, remove it, and import the file as the target."""
    flesh = target_copy()
    scene = bpy.context.scene
    scene.frame_start, scene.frame_end = 1, FRAMES
    for scene_object in scene.objects:
        scene_object.select_set(scene_object == flesh)
    path = str(_cache_folder() / f"flesh.{suffix}")
    export(path)
    bpy.data.objects.remove(flesh)
    objects_before = set(bpy.data.objects)
    if suffix == "abc":
        bpy.ops.wm.alembic_import(filepath=path)
    else:
        bpy.ops.wm.usd_import(filepath=path)
    imported = next(o for o in bpy.data.objects if o not in objects_before and o.type == "MESH")
    imported.name = TARGET
    assert bpy.data.actions[ACTION]
