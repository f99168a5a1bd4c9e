# SPDX-License-Identifier: GPL-3.0-or-later
"""Characters that learn the surface of another object, `flesh`: a function each, which builds it in the current scene.

The mesh `elbow` keeps nothing but its Armature modifier. Files go to a folder that is removed when Python ends.
"""

import functools
import struct
import tempfile
from collections.abc import Callable, Iterator
from pathlib import Path

import bpy
import numpy as np

from blend_fixtures.elbow import ACTION, FRAMES
from fdda_addon.core.point_cache import PointCacheWriter
from fdda_addon.scene.mesh import evaluated_positions

from .base import bulge, tube
from .stacks import chain

TARGET = "flesh"


def target_copy() -> bpy.types.Object:
    """A tube, and a copy of it that smooths itself after its own Armature modifier; returns the copy."""
    mesh_object, _ = tube()
    flesh = _copy(mesh_object)
    modifier = flesh.modifiers.new("Mush", "CORRECTIVE_SMOOTH")
    modifier.rest_source, modifier.factor, modifier.iterations = "ORCO", 0.6, 8
    return flesh


def target_alembic() -> None:
    """An Alembic file of the copy's action; its stack is thrown away."""
    _through_a_file(
        "abc", lambda path: bpy.ops.wm.alembic_export(filepath=path, selected=True, start=1, end=FRAMES, flatten=False)
    )


def target_usd() -> None:
    """A USD file of the copy's action; its stack is thrown away."""
    _through_a_file(
        "usdc",
        lambda path: bpy.ops.wm.usd_export(
            filepath=path, selected_objects_only=True, export_animation=True, export_armatures=False
        ),
    )


def target_pc2() -> None:
    """A .pc2 file of the copy's action, played by Mesh Cache."""
    flesh = target_copy()
    path = _folder() / "flesh.pc2"
    with open(path, "wb") as file:
        writer = PointCacheWriter(file, len(flesh.data.vertices), 1, FRAMES)
        for positions in _shown(flesh):
            writer.append(positions[None])
        writer.finish()
    _play(flesh, path, "PC2")


def target_mdd() -> None:
    """An .mdd file of the copy's action, played by Mesh Cache."""
    flesh = target_copy()
    path = _folder() / "flesh.mdd"
    seconds = np.arange(FRAMES, dtype=">f4") / bpy.context.scene.render.fps
    head = struct.pack(">ii", FRAMES, len(flesh.data.vertices)) + seconds.tobytes()
    path.write_bytes(head + b"".join(positions.astype(">f4").tobytes() for positions in _shown(flesh)))
    _play(flesh, path, "MDD")


def target_shape_keys() -> None:
    """A copy with a sculpted shape that is keyed as the elbow bends."""
    mesh_object, armature_object = tube()
    flesh = _copy(mesh_object)
    flesh.shape_key_add(name="Basis", from_mix=False)
    key = flesh.shape_key_add(name="flexed", from_mix=False)
    points = np.array([point.co for point in key.data])
    key.data.foreach_set("co", bulge(points).astype(np.float32).ravel())
    scene, bone = bpy.context.scene, armature_object.pose.bones["lower"]
    for frame in range(1, FRAMES + 1):
        scene.frame_set(frame)
        key.value = bone.rotation_euler[0] / 2
        key.keyframe_insert("value", frame=frame)
    scene.frame_set(1)


def target_soft_body() -> bpy.types.Object:
    """A copy with flesh that sags and bulges, held to its Armature modifier by goals; returns the copy."""
    flesh = _copy(tube()[0])
    flesh.modifiers.new("Softbody", "SOFT_BODY")
    soft = flesh.soft_body
    soft.use_goal, soft.goal_default, soft.goal_spring, soft.goal_friction = True, 0.7, 0.5, 20.0
    soft.use_edges, soft.pull, soft.push, soft.damping, soft.bend = True, 0.3, 0.3, 20.0, 0.5
    soft.step_max, soft.error_threshold = 40, 0.1
    return flesh


def target_cloth() -> bpy.types.Object:
    """A copy that is cloth, pinned by half everywhere; returns the copy."""
    flesh = _copy(tube()[0])
    pin = flesh.vertex_groups.new(name="pin")
    pin.add(range(len(flesh.data.vertices)), 0.5, "REPLACE")
    settings = flesh.modifiers.new("Cloth", "CLOTH").settings
    settings.vertex_group_mass, settings.quality, settings.air_damping = "pin", 4, 10.0
    return flesh


def target_geometry_nodes() -> bpy.types.Object:
    """A copy whose vertices lag behind the skin, and stay a little behind, in a simulation of Geometry Nodes."""
    flesh = _copy(tube()[0])
    flesh.modifiers.new("Lag", "NODES").node_group = lagging_group()
    mush = flesh.modifiers.new("Mush", "CORRECTIVE_SMOOTH")
    mush.rest_source, mush.factor, mush.iterations = "ORCO", 0.6, 8
    return flesh


TARGETS: tuple[Callable[[], object], ...] = (
    target_copy, target_alembic, target_usd, target_pc2, target_mdd, target_shape_keys, target_soft_body, target_cloth,
    target_geometry_nodes,
)  # fmt: skip


def lagging_group() -> bpy.types.NodeTree:
    """Each frame takes the vertices of the frame before halfway to where the modifiers before have them."""
    group = chain("Lag", "GeometryNodeSimulationInput", "GeometryNodeSetPosition", "GeometryNodeSimulationOutput")
    nodes = {node.bl_idname: node for node in group.nodes}
    begin, end = nodes["GeometryNodeSimulationInput"], nodes["GeometryNodeSimulationOutput"]
    begin.pair_with_output(end)
    group.links.clear()
    source, out, move = (nodes[kind] for kind in ("NodeGroupInput", "NodeGroupOutput", "GeometryNodeSetPosition"))
    position, index = (group.nodes.new(f"GeometryNodeInput{what}") for what in ("Position", "Index"))
    sample, mix = group.nodes.new("GeometryNodeSampleIndex"), group.nodes.new("ShaderNodeMix")
    sample.data_type, mix.data_type = "FLOAT_VECTOR", "VECTOR"
    mix.inputs["Factor"].default_value = 0.5

    def vector(sockets: object, name: str) -> bpy.types.NodeSocket:
        return next(socket for socket in sockets if socket.name == name and socket.type == "VECTOR")

    for start, goal in (
        (source.outputs[0], begin.inputs[0]),
        (begin.outputs["Geometry"], move.inputs["Geometry"]),
        (source.outputs[0], sample.inputs["Geometry"]),
        (position.outputs[0], vector(sample.inputs, "Value")),
        (index.outputs[0], sample.inputs["Index"]),
        (position.outputs[0], vector(mix.inputs, "A")),
        (vector(sample.outputs, "Value"), vector(mix.inputs, "B")),
        (vector(mix.outputs, "Result"), move.inputs["Position"]),
        (move.outputs["Geometry"], end.inputs["Geometry"]),
        (end.outputs["Geometry"], out.inputs[0]),
    ):
        group.links.new(start, goal)
    return group


def _folder() -> Path:
    """Where cache files lie. Blender's own folder for temporary files is emptied when another file is opened."""
    return Path(_temporary().name)


@functools.cache
def _temporary() -> tempfile.TemporaryDirectory:
    return tempfile.TemporaryDirectory(prefix="fdda_targets_")


def _copy(mesh_object: bpy.types.Object) -> bpy.types.Object:
    """A copy of an object with a mesh of its own."""
    flesh = mesh_object.copy()
    flesh.data, flesh.name = mesh_object.data.copy(), TARGET
    bpy.context.scene.collection.objects.link(flesh)
    bpy.context.scene.frame_start, bpy.context.scene.frame_end = 1, 250
    bpy.context.view_layer.update()
    return flesh


def _shown(flesh: bpy.types.Object) -> Iterator[np.ndarray]:
    """What an object shows in the frames of the action, (V, 3) each."""
    for frame in range(1, FRAMES + 1):
        bpy.context.scene.frame_set(frame)
        yield evaluated_positions(flesh, bpy.context.evaluated_depsgraph_get())
    bpy.context.scene.frame_set(1)


def _play(flesh: bpy.types.Object, path: Path, kind: str) -> None:
    """Let a file alone deform an object."""
    flesh.modifiers.clear()
    modifier = flesh.modifiers.new("Cache", "MESH_CACHE")
    modifier.cache_format, modifier.filepath, modifier.frame_start = kind, str(path), 1


def _through_a_file(suffix: str, export: Callable[[str], object]) -> None:
    """Export the copy, remove it, and import it again."""
    flesh = target_copy()
    scene = bpy.context.scene
    scene.frame_start, scene.frame_end = 1, FRAMES
    for scene_object in scene.objects:
        scene_object.select_set(scene_object == flesh)
    path = str(_folder() / f"flesh.{suffix}")
    export(path)
    bpy.data.objects.remove(flesh)
    before = set(bpy.data.objects)
    if suffix == "abc":
        bpy.ops.wm.alembic_import(filepath=path)
    else:
        bpy.ops.wm.usd_import(filepath=path)
    imported = next(o for o in bpy.data.objects if o not in before and o.type == "MESH")
    imported.name = TARGET
    assert bpy.data.actions[ACTION]
