# SPDX-License-Identifier: GPL-3.0-or-later
"""Build characters on control rigs of Rigify, with a body of metaballs, automatic weights and two actions.

    python -m blend_fixtures.characters.rigify BASIC_HUMAN character.blend

builds one in a separate process. Tests need this, because bpy 4.5 hangs at exit after Rigify has generated a rig.

Both actions key only control bones. `rehearsal` moves every control bone through its range, to measure the ranges and
to record. `performance` moves all control bones at other rates, for evaluations.
"""

import contextlib
import io
import math
import os
import sys
from collections.abc import Callable
from dataclasses import dataclass, field

import bpy
from mathutils import Vector

REHEARSAL, PERFORMANCE = "rehearsal", "performance"
FRAMES = {REHEARSAL: 120, PERFORMANCE: 90}
KEY_STEP = 3
BALL_RADIUS_RATIO = 1.25
"""Radius of a metaball divided by the thickness of the body at that place."""


@dataclass(frozen=True)
class Body:
    """Settings that define a character.

    Attributes:
        metarig: operator of `bpy.ops.object` that adds the metarig.
        thickness: thickness of the body around bones of the metarig, meters, by prefix of the bones' names. The longest
            matching prefix counts; bones without a matching prefix get no body.
        resolution: size of the faces of the surface, meters.
        moves: largest motion of each control bone to both sides: meters along the axes of the armature, and degrees
            about the bone's axes.
    """

    metarig: str
    thickness: dict[str, float]
    resolution: float
    moves: dict[str, tuple[tuple[float, float, float], tuple[float, float, float]]] = field(default_factory=dict)


NO_MOTION = (0.0, 0.0, 0.0)
_TRUNK = {
    "torso": ((0.06, 0.08, 0.10), (12, 10, 10)),
    "hips": (NO_MOTION, (10, 10, 10)),
    "chest": (NO_MOTION, (18, 15, 12)),
    "neck": (NO_MOTION, (15, 15, 10)),
    "head": (NO_MOTION, (25, 35, 15)),
}
_LIMBS = {
    "shoulder": (NO_MOTION, (10, 5, 12)),
    "hand_ik": ((0.16, 0.22, 0.22), (35, 30, 35)),
    "foot_ik": ((0.08, 0.16, 0.09), (20, 12, 10)),
    "foot_heel_ik": (NO_MOTION, (20, 0, 10)),
}
_FINGERS = {f"f_{name}.01_master": (NO_MOTION, (30, 0, 6)) for name in ("index", "middle", "ring", "pinky")}

_HUMAN_THICKNESS = {
    "spine": 0.12, "spine.003": 0.135, "spine.004": 0.065, "spine.005": 0.065, "spine.006": 0.095, "pelvis": 0.075,
    "shoulder": 0.065, "upper_arm": 0.05, "forearm": 0.042, "hand": 0.036, "palm": 0.026, "thigh": 0.066,
    "shin": 0.05, "foot": 0.05, "toe": 0.042, "f_": 0.019, "thumb": 0.02,
}  # fmt: skip

HUMAN = Body("armature_human_metarig_add", _HUMAN_THICKNESS, 0.022, {**_TRUNK, **_LIMBS, **_FINGERS})
BASIC_HUMAN = Body("armature_basic_human_metarig_add", _HUMAN_THICKNESS, 0.03, {**_TRUNK, **_LIMBS})
HORSE = Body(
    "armature_horse_metarig_add",
    {
        "spine": 0.26, "abdomen": 0.24, "chest": 0.24, "neck": 0.16, "head": 0.11, "jaw": 0.07, "pelvis": 0.16,
        "hip": 0.16, "shoulder": 0.12, "upper_arm": 0.085, "forearm": 0.06, "forefoot": 0.05, "f_": 0.05, "thigh": 0.12,
        "lower_leg": 0.075, "hind_foot": 0.055, "r_": 0.05, "tail": 0.05,
    },
    0.05,
    {
        "torso": ((0.08, 0.12, 0.10), (8, 8, 8)),
        "hips": (NO_MOTION, (8, 8, 8)),
        "chest": (NO_MOTION, (8, 8, 8)),
        "neck": (NO_MOTION, (15, 12, 15)),
        "head": (NO_MOTION, (20, 20, 15)),
        "shoulder": (NO_MOTION, (10, 5, 8)),
        "forefoot_ik": ((0.06, 0.22, 0.12), (15, 8, 8)),
        "hind_foot_ik": ((0.06, 0.22, 0.12), (15, 8, 8)),
        "tail_master.001": (NO_MOTION, (15, 10, 15)),
    },
)  # fmt: skip


def build(body: Body) -> tuple[bpy.types.Object, bpy.types.Object]:
    """Build a character in the current scene: its mesh object `body` and its armature object `rig`."""
    with contextlib.redirect_stdout(io.StringIO()):
        bpy.ops.preferences.addon_enable(module="rigify")
        getattr(bpy.ops.object, body.metarig)()
        metarig = bpy.context.object
        objects_before = set(bpy.data.objects)
        bpy.ops.pose.rigify_generate()
    (armature_object,) = (o for o in set(bpy.data.objects) - objects_before if o.type == "ARMATURE")
    armature_object.name = "rig"
    mesh_object = _build_body_mesh(metarig, body)
    bpy.data.objects.remove(metarig)
    bpy.ops.object.select_all(action="DESELECT")
    for selected in (mesh_object, armature_object):
        selected.select_set(True)
    bpy.context.view_layer.objects.active = armature_object
    with contextlib.redirect_stdout(io.StringIO()):
        bpy.ops.object.parent_set(type="ARMATURE_AUTO")
    smooth = mesh_object.modifiers.new("Corrective Smooth", "CORRECTIVE_SMOOTH")
    smooth.iterations, smooth.use_only_smooth = 10, False
    for name, value_at_time in ((REHEARSAL, _rehearsal_value), (PERFORMANCE, _performance_value)):
        _add_action(armature_object, body, name, value_at_time)
    return mesh_object, armature_object


def _build_body_mesh(metarig: bpy.types.Object, body: Body) -> bpy.types.Object:
    """Build a closed mesh from metaballs around the bones of a metarig; keep only the largest piece."""
    balls = bpy.data.metaballs.new("body")
    balls.resolution, balls.threshold = body.resolution, 0.1
    for bone in metarig.data.bones:
        prefixes = [name for name in body.thickness if bone.name.startswith(name)]
        if prefixes:
            radius = body.thickness[max(prefixes, key=len)]
            count = max(2, math.ceil(bone.length / (radius * 0.5)) + 1)
            for index in range(count):
                ball = balls.elements.new(type="BALL")
                ball.co = metarig.matrix_world @ bone.head_local.lerp(bone.tail_local, index / (count - 1))
                ball.radius = radius * BALL_RADIUS_RATIO
    metaball_object = bpy.data.objects.new("body", balls)
    bpy.context.scene.collection.objects.link(metaball_object)
    bpy.context.view_layer.update()
    mesh = bpy.data.meshes.new_from_object(metaball_object.evaluated_get(bpy.context.evaluated_depsgraph_get()))
    bpy.data.objects.remove(metaball_object)
    bpy.data.metaballs.remove(balls)
    mesh_object = bpy.data.objects.new("body", mesh)
    bpy.context.scene.collection.objects.link(mesh_object)
    _remesh(mesh_object, body.resolution)
    _keep_largest_piece(mesh_object)
    return mesh_object


def _remesh(mesh_object: bpy.types.Object, size: float) -> None:
    """Replace the mesh with even faces of the given size. Metaballs have slivers, which Corrective Smooth inverts."""
    remesh_modifier = mesh_object.modifiers.new("cells", "REMESH")
    remesh_modifier.mode, remesh_modifier.scale = "SMOOTH", 0.99
    remesh_modifier.octree_depth = math.ceil(math.log2(max(mesh_object.dimensions) / size))
    smooth_modifier = mesh_object.modifiers.new("relaxed", "SMOOTH")
    smooth_modifier.iterations = 6
    evaluated = mesh_object.evaluated_get(bpy.context.evaluated_depsgraph_get())
    metaball_mesh, mesh_object.data = mesh_object.data, bpy.data.meshes.new_from_object(evaluated)
    mesh_object.modifiers.clear()
    bpy.data.meshes.remove(metaball_mesh)


def _keep_largest_piece(mesh_object: bpy.types.Object) -> None:
    import bmesh

    surface = bmesh.new()
    surface.from_mesh(mesh_object.data)
    bmesh.ops.remove_doubles(surface, verts=surface.verts, dist=1e-6)
    pieces, visited = [], set()
    for start in surface.verts:
        if start not in visited:
            piece, pending = set(), [start]
            while pending:
                vertex = pending.pop()
                if vertex not in piece:
                    piece.add(vertex)
                    pending += [edge.other_vert(vertex) for edge in vertex.link_edges]
            visited |= piece
            pieces.append(piece)
    largest = max(pieces, key=len)
    bmesh.ops.delete(surface, geom=[v for v in surface.verts if v not in largest], context="VERTS")
    surface.to_mesh(mesh_object.data)
    surface.free()


def _rehearsal_value(index: int, axis: int, time: float) -> float:
    """Return the value of an axis in the action `rehearsal`, -1 to 1: each axis moves at a different rate."""
    return math.sin(2 * math.pi * (time * (3 + (index * 3 + axis) % 7) + 0.37 * index + 0.11 * axis))


def _performance_value(index: int, axis: int, time: float) -> float:
    """Return the value of an axis in the action `performance`, which is slower and covers 85 % of the range."""
    return 0.85 * math.sin(2 * math.pi * (time * (1 + (index * 5 + axis * 2) % 4) + 0.23 * index + 0.41 * axis))


def _add_action(
    armature_object: bpy.types.Object, body: Body, name: str, value_at_time: Callable[[int, int, float], float]
) -> None:
    """Add an action that keys the control bones; bones of both sides are keyed."""
    action = bpy.data.actions.new(name)
    action.use_fake_user = True
    animation = armature_object.animation_data or armature_object.animation_data_create()
    animation.action = action
    bones = armature_object.pose.bones
    names = [n for base in body.moves for n in (base, f"{base}.L", f"{base}.R") if n in bones]
    for index, bone_name in enumerate(names):
        bone = bones[bone_name]
        bone.rotation_mode = "XYZ"
        distances, degrees = body.moves[bone_name.removesuffix(".L").removesuffix(".R")]
        to_bone_axes = bone.bone.matrix_local.to_3x3().inverted()
        for frame in range(1, FRAMES[name] + 1, KEY_STEP):
            time = frame / FRAMES[name]
            if any(distances):
                offset = Vector([amount * value_at_time(index, axis, time) for axis, amount in enumerate(distances)])
                bone.location = to_bone_axes @ offset
                bone.keyframe_insert("location", frame=frame)
            if any(degrees):
                angles = [
                    math.radians(amount) * value_at_time(index, axis + 3, time) for axis, amount in enumerate(degrees)
                ]
                bone.rotation_euler = angles
                bone.keyframe_insert("rotation_euler", frame=frame)
    animation.action = None
    for bone_name in names:
        bones[bone_name].location, bones[bone_name].rotation_euler = NO_MOTION, NO_MOTION


def main(name: str, path: str) -> None:
    """Build the character of a constant of this module, save it to a new file, and exit the process."""
    bpy.ops.wm.read_factory_settings(use_empty=True)
    build(globals()[name])
    bpy.ops.wm.save_as_mainfile(filepath=os.path.abspath(path))
    sys.stdout.flush()
    os._exit(0)


if __name__ == "__main__":
    main(*sys.argv[1:])
