# SPDX-License-Identifier: GPL-3.0-or-later
"""Characters on control rigs of Rigify, which comes with Blender: a body of metaballs, automatic weights, two actions.

    python -m blend_fixtures.characters.rigify BASIC_HUMAN character.blend

builds one in a process of its own. Tests have to: where Rigify has generated a rig, the 4.5 module hangs at exit.

Both actions key control bones alone. `rehearsal` goes through the range of every one, to measure it and to record;
`performance` moves them all at once in other rhythms, to evaluate on.
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
BALL_RADIUS = 1.25
"""Radius of a metaball in units of the thickness that is wanted."""


@dataclass(frozen=True)
class Body:
    """What a character is made of.

    Attributes:
        metarig: operator of `bpy.ops.object` that adds the metarig.
        thickness: of the body around the bones of the metarig, meters, by the beginning of their names; the longest
            that fits counts, bones of no entry get no flesh.
        resolution: of the surface, meters.
        moves: what an animator does with a control bone: how far it goes to both sides, in meters along the axes of the
            armature, and how far it turns, in degrees about its own axes.
    """

    metarig: str
    thickness: dict[str, float]
    resolution: float
    moves: dict[str, tuple[tuple[float, float, float], tuple[float, float, float]]] = field(default_factory=dict)


STAND, TURN = (0.0, 0.0, 0.0), (0.0, 0.0, 0.0)
_TRUNK = {
    "torso": ((0.06, 0.08, 0.10), (12, 10, 10)),
    "hips": (STAND, (10, 10, 10)),
    "chest": (STAND, (18, 15, 12)),
    "neck": (STAND, (15, 15, 10)),
    "head": (STAND, (25, 35, 15)),
}
_LIMBS = {
    "shoulder": (STAND, (10, 5, 12)),
    "hand_ik": ((0.16, 0.22, 0.22), (35, 30, 35)),
    "foot_ik": ((0.08, 0.16, 0.09), (20, 12, 10)),
    "foot_heel_ik": (STAND, (20, 0, 10)),
}
_FINGERS = {f"f_{name}.01_master": (STAND, (30, 0, 6)) for name in ("index", "middle", "ring", "pinky")}

_FLESH = {
    "spine": 0.12, "spine.003": 0.135, "spine.004": 0.065, "spine.005": 0.065, "spine.006": 0.095, "pelvis": 0.075,
    "shoulder": 0.065, "upper_arm": 0.05, "forearm": 0.042, "hand": 0.036, "palm": 0.026, "thigh": 0.066,
    "shin": 0.05, "foot": 0.05, "toe": 0.042, "f_": 0.019, "thumb": 0.02,
}  # fmt: skip

HUMAN = Body("armature_human_metarig_add", _FLESH, 0.022, {**_TRUNK, **_LIMBS, **_FINGERS})
BASIC_HUMAN = Body("armature_basic_human_metarig_add", _FLESH, 0.03, {**_TRUNK, **_LIMBS})
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
        "hips": (STAND, (8, 8, 8)),
        "chest": (STAND, (8, 8, 8)),
        "neck": (STAND, (15, 12, 15)),
        "head": (STAND, (20, 20, 15)),
        "shoulder": (STAND, (10, 5, 8)),
        "forefoot_ik": ((0.06, 0.22, 0.12), (15, 8, 8)),
        "hind_foot_ik": ((0.06, 0.22, 0.12), (15, 8, 8)),
        "tail_master.001": (STAND, (15, 10, 15)),
    },
)  # fmt: skip


def build(body: Body) -> tuple[bpy.types.Object, bpy.types.Object]:
    """Build a character in the current scene: its mesh object `body` and its armature object `rig`."""
    with contextlib.redirect_stdout(io.StringIO()):
        bpy.ops.preferences.addon_enable(module="rigify")
        getattr(bpy.ops.object, body.metarig)()
        metarig = bpy.context.object
        before = set(bpy.data.objects)
        bpy.ops.pose.rigify_generate()
    (armature_object,) = (o for o in set(bpy.data.objects) - before if o.type == "ARMATURE")
    armature_object.name = "rig"
    mesh_object = _flesh(metarig, body)
    bpy.data.objects.remove(metarig)
    bpy.ops.object.select_all(action="DESELECT")
    for selected in (mesh_object, armature_object):
        selected.select_set(True)
    bpy.context.view_layer.objects.active = armature_object
    with contextlib.redirect_stdout(io.StringIO()):
        bpy.ops.object.parent_set(type="ARMATURE_AUTO")
    smooth = mesh_object.modifiers.new("Corrective Smooth", "CORRECTIVE_SMOOTH")
    smooth.iterations, smooth.use_only_smooth = 10, False
    for name, rhythm in ((REHEARSAL, _rehearsed), (PERFORMANCE, _performed)):
        _key(armature_object, body, name, rhythm)
    return mesh_object, armature_object


def _flesh(metarig: bpy.types.Object, body: Body) -> bpy.types.Object:
    """A closed mesh of metaballs around the bones of a metarig; the largest piece of them."""
    balls = bpy.data.metaballs.new("body")
    balls.resolution, balls.threshold = body.resolution, 0.1
    for bone in metarig.data.bones:
        fitting = [name for name in body.thickness if bone.name.startswith(name)]
        if fitting:
            radius = body.thickness[max(fitting, key=len)]
            count = max(2, math.ceil(bone.length / (radius * 0.5)) + 1)
            for number in range(count):
                ball = balls.elements.new(type="BALL")
                ball.co = metarig.matrix_world @ bone.head_local.lerp(bone.tail_local, number / (count - 1))
                ball.radius = radius * BALL_RADIUS
    source = bpy.data.objects.new("body", balls)
    bpy.context.scene.collection.objects.link(source)
    bpy.context.view_layer.update()
    mesh = bpy.data.meshes.new_from_object(source.evaluated_get(bpy.context.evaluated_depsgraph_get()))
    bpy.data.objects.remove(source)
    bpy.data.metaballs.remove(balls)
    mesh_object = bpy.data.objects.new("body", mesh)
    bpy.context.scene.collection.objects.link(mesh_object)
    _remesh(mesh_object, body.resolution)
    _keep_largest_piece(mesh_object)
    return mesh_object


def _remesh(mesh_object: bpy.types.Object, size: float) -> None:
    """Make even faces of this size: metaballs leave slivers, which smoothing turns inside out."""
    cells = mesh_object.modifiers.new("cells", "REMESH")
    cells.mode, cells.scale = "SMOOTH", 0.99
    cells.octree_depth = math.ceil(math.log2(max(mesh_object.dimensions) / size))
    relaxed = mesh_object.modifiers.new("relaxed", "SMOOTH")
    relaxed.iterations = 6
    evaluated = mesh_object.evaluated_get(bpy.context.evaluated_depsgraph_get())
    coarse, mesh_object.data = mesh_object.data, bpy.data.meshes.new_from_object(evaluated)
    mesh_object.modifiers.clear()
    bpy.data.meshes.remove(coarse)


def _keep_largest_piece(mesh_object: bpy.types.Object) -> None:
    import bmesh

    surface = bmesh.new()
    surface.from_mesh(mesh_object.data)
    bmesh.ops.remove_doubles(surface, verts=surface.verts, dist=1e-6)
    pieces, seen = [], set()
    for start in surface.verts:
        if start not in seen:
            piece, waiting = set(), [start]
            while waiting:
                vertex = waiting.pop()
                if vertex not in piece:
                    piece.add(vertex)
                    waiting += [edge.other_vert(vertex) for edge in vertex.link_edges]
            seen |= piece
            pieces.append(piece)
    largest = max(pieces, key=len)
    bmesh.ops.delete(surface, geom=[v for v in surface.verts if v not in largest], context="VERTS")
    surface.to_mesh(mesh_object.data)
    surface.free()


def _rehearsed(number: int, axis: int, time: float) -> float:
    """One axis after the other through its whole range, to and fro, -1 to 1."""
    return math.sin(2 * math.pi * (time * (3 + (number * 3 + axis) % 7) + 0.37 * number + 0.11 * axis))


def _performed(number: int, axis: int, time: float) -> float:
    """Slower, in another order, not quite as far."""
    return 0.85 * math.sin(2 * math.pi * (time * (1 + (number * 5 + axis * 2) % 4) + 0.23 * number + 0.41 * axis))


def _key(armature_object: bpy.types.Object, body: Body, name: str, rhythm: Callable[[int, int, float], float]) -> None:
    """Key an action on the control bones; left and right ones where a bone has sides."""
    action = bpy.data.actions.new(name)
    action.use_fake_user = True
    animation = armature_object.animation_data or armature_object.animation_data_create()
    animation.action = action
    bones = armature_object.pose.bones
    names = [n for base in body.moves for n in (base, f"{base}.L", f"{base}.R") if n in bones]
    for number, bone_name in enumerate(names):
        bone = bones[bone_name]
        bone.rotation_mode = "XYZ"
        far, turn = body.moves[bone_name.removesuffix(".L").removesuffix(".R")]
        own_axes = bone.bone.matrix_local.to_3x3().inverted()
        for frame in range(1, FRAMES[name] + 1, KEY_STEP):
            time = frame / FRAMES[name]
            if any(far):
                offset = Vector([amount * rhythm(number, axis, time) for axis, amount in enumerate(far)])
                bone.location = own_axes @ offset
                bone.keyframe_insert("location", frame=frame)
            if any(turn):
                angles = [math.radians(amount) * rhythm(number, axis + 3, time) for axis, amount in enumerate(turn)]
                bone.rotation_euler = angles
                bone.keyframe_insert("rotation_euler", frame=frame)
    animation.action = None
    for bone_name in names:
        bones[bone_name].location, bones[bone_name].rotation_euler = STAND, TURN


def main(name: str, path: str) -> None:
    """Build a character by its name here and save it to a new file; ends the process."""
    bpy.ops.wm.read_factory_settings(use_empty=True)
    build(globals()[name])
    bpy.ops.wm.save_as_mainfile(filepath=os.path.abspath(path))
    sys.stdout.flush()
    os._exit(0)


if __name__ == "__main__":
    main(*sys.argv[1:])
