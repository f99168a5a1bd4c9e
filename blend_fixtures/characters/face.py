# SPDX-License-Identifier: GPL-3.0-or-later
"""Build a face: a head of 5,186 vertices with 22 bones, 22 shape keys that an animator sets, and 12 correctives.

Both bones and shape keys move the jaw, lips, brows, lids and cheeks, as in production faces. A corrective is a shape
key that is driven by the product of two other shape keys, or of a shape key and the opening of the jaw. Delta mush is
the last modifier. `python -m blend_fixtures.characters.face OUT.blend` saves the face with an action for evaluations.
"""

import math
import sys
from collections.abc import Callable
from pathlib import Path

import bpy
import numpy as np

from .base import add_key, add_variable, link
from .bones import NewBone, add_bones, limit

MESH, ARMATURE, SPEECH = "face", "face_rig", "speech"
FRAMES = 80
RADII = np.array((0.078, 0.096, 0.118))
"""Radii of the head along X, Y and Z, meters: it faces -Y, and its left side is at +X."""
RINGS, RING_VERTICES = 72, 72

# Directions of the parts of the face from the center of the head: degrees to the left and upward.
PART_ANGLES = {
    "jaw": (0, -42), "chin": (0, -55), "nose": (0, 2), "lip_top": (0, -19), "lip_bottom": (0, -29),
    **{f"{name}.{side}": (sign * left, up)
       for side, sign in (("L", 1), ("R", -1))
       for name, left, up in (
           ("corner", 17, -24), ("lip_top", 9, -20), ("lip_bottom", 9, -28), ("lid_top", 21, 22),
           ("lid_bottom", 21, 12), ("brow_in", 9, 34), ("brow_out", 30, 35), ("cheek", 33, -6),
       )},
}  # fmt: skip
JAW_OPENING = math.radians(25)


def _direction(part_angles: tuple[float, float]) -> np.ndarray:
    left, up = map(math.radians, part_angles)
    return np.array((math.sin(left) * math.cos(up), -math.cos(left) * math.cos(up), math.sin(up)))


def head_surface() -> tuple[np.ndarray, list[tuple[int, ...]]]:
    """Return the points (5186, 3) and the faces of the head: rings around Z and two poles."""
    elevations = (np.arange(RINGS) + 0.5) / RINGS * np.pi - np.pi / 2
    azimuths = np.arange(RING_VERTICES) / RING_VERTICES * 2 * np.pi
    grid = np.array(
        [(math.cos(u) * math.sin(a), -math.cos(u) * math.cos(a), math.sin(u)) for u in elevations for a in azimuths]
    )
    directions = np.concatenate([grid, [(0, 0, -1), (0, 0, 1)]])
    nose = np.exp(-(_angle_from_part(directions, "nose") ** 2) / 0.03)
    faces = [
        (
            r * RING_VERTICES + a,
            r * RING_VERTICES + (a + 1) % RING_VERTICES,
            (r + 1) * RING_VERTICES + (a + 1) % RING_VERTICES,
            (r + 1) * RING_VERTICES + a,
        )
        for r in range(RINGS - 1)
        for a in range(RING_VERTICES)
    ]
    last_ring = (RINGS - 1) * RING_VERTICES
    faces += [((a + 1) % RING_VERTICES, a, len(grid)) for a in range(RING_VERTICES)]
    faces += [(last_ring + a, last_ring + (a + 1) % RING_VERTICES, len(grid) + 1) for a in range(RING_VERTICES)]
    return directions * RADII * (1 + 0.14 * nose[:, None]), faces


def _angle_from_part(points: np.ndarray, name: str) -> np.ndarray:
    """Return the (N,) angles at the center of the head between points and a part of the face, radians."""
    directions = points / RADII
    directions /= np.linalg.norm(directions, axis=1, keepdims=True)
    return np.arccos(np.clip(directions @ _direction(PART_ANGLES[name]), -1, 1))


def move_near(name: str, offset: tuple[float, float, float], size: float = 0.16) -> Callable[[np.ndarray], np.ndarray]:
    """Return a function that moves the points near a part of the face; `offset` in millimeters, `size` in radians."""

    def move(points: np.ndarray) -> np.ndarray:
        return points + np.exp(-((_angle_from_part(points, name) / size) ** 2))[:, None] * np.array(offset) / 1000

    return move


def _combine(*moves: Callable[[np.ndarray], np.ndarray]) -> Callable[[np.ndarray], np.ndarray]:
    return lambda points: points + sum(move(points) - points for move in moves)


def _shape_key_moves() -> dict[str, Callable[[np.ndarray], np.ndarray]]:
    """Return the 22 shape keys that an animator sets: functions that move points, by name."""
    found = {
        "pucker": _combine(
            move_near("corner.L", (-7, -4, 0)), move_near("corner.R", (7, -4, 0)), move_near("lip_top", (0, -5, 0))
        ),
        "funnel": _combine(move_near("lip_top", (0, -5, 3)), move_near("lip_bottom", (0, -5, -3))),
        "press": _combine(move_near("lip_top", (0, 1, -3)), move_near("lip_bottom", (0, 1, 3))),
        "chin_up": move_near("chin", (0, -2, 5)),
    }
    for side, sign in (("L", 1), ("R", -1)):
        found |= {
            f"smile.{side}": _combine(
                move_near(f"corner.{side}", (6 * sign, 3, 7)), move_near(f"cheek.{side}", (0, -3, 4))
            ),
            f"frown.{side}": move_near(f"corner.{side}", (2 * sign, 0, -7)),
            f"wide.{side}": move_near(f"corner.{side}", (7 * sign, 3, 0)),
            f"blink.{side}": _combine(
                move_near(f"lid_top.{side}", (0, -2, -8), 0.12), move_near(f"lid_bottom.{side}", (0, 0, 2), 0.1)
            ),
            f"squint.{side}": move_near(f"lid_bottom.{side}", (0, -2, 4), 0.12),
            f"brow_up.{side}": _combine(
                move_near(f"brow_in.{side}", (0, 0, 6)), move_near(f"brow_out.{side}", (0, 0, 7))
            ),
            f"angry.{side}": move_near(f"brow_in.{side}", (-4 * sign, -2, -6)),
            f"sneer.{side}": _combine(move_near(f"lip_top.{side}", (0, -2, 5)), move_near("nose", (0, 0, 3), 0.1)),
            f"puff.{side}": move_near(f"cheek.{side}", (6 * sign, -5, 0), 0.2),
        }
    return found


def _corrective_moves() -> dict[tuple[str, str], Callable[[np.ndarray], np.ndarray]]:
    """Return the correctives for two shape keys, or for a shape key and the open jaw: functions that move points."""
    found = {
        ("pucker", "jaw"): move_near("lip_bottom", (0, -4, 3)),
        ("funnel", "press"): move_near("lip_top", (0, 3, -2)),
    }
    for side, sign in (("L", 1), ("R", -1)):
        found |= {
            (f"smile.{side}", "jaw"): move_near(f"corner.{side}", (-5 * sign, 0, -4)),
            (f"smile.{side}", "pucker"): move_near(f"corner.{side}", (3 * sign, -4, 3)),
            (f"blink.{side}", f"squint.{side}"): move_near(f"lid_bottom.{side}", (0, 2, -4), 0.1),
            (f"brow_up.{side}", f"angry.{side}"): move_near(f"brow_in.{side}", (2 * sign, -4, 2)),
            (f"sneer.{side}", f"smile.{side}"): move_near(f"lip_top.{side}", (2 * sign, -3, -3)),
        }
    return found


def face() -> None:
    """Build the mesh object `face` and the armature object `face_rig` in the current scene."""
    mesh_object, armature_object, points = add_head()
    _add_face_bones(armature_object)
    add_groups(mesh_object, _face_weights(points))
    for name, move in _shape_key_moves().items():
        add_key(mesh_object, name, move)
    for (first, second), move in _corrective_moves().items():
        _drive_by_product(
            add_key(mesh_object, f"{first}_{second}", move), mesh_object, armature_object, (first, second)
        )
    bpy.context.view_layer.update()


def add_head() -> tuple[bpy.types.Object, bpy.types.Object, np.ndarray]:
    """Add the head with its modifiers; return mesh object, armature object without bones, and points (5186, 3)."""
    points, faces = head_surface()
    mesh = bpy.data.meshes.new(MESH)
    mesh.from_pydata(points.tolist(), [], faces)
    mesh_object = link(bpy.data.objects.new(MESH, mesh))
    armature_object = link(bpy.data.objects.new(ARMATURE, bpy.data.armatures.new(ARMATURE)))
    mesh_object.parent = armature_object
    mesh_object.modifiers.new("Armature", "ARMATURE").object = armature_object
    smooth = mesh_object.modifiers.new("CorrectiveSmooth", "CORRECTIVE_SMOOTH")
    smooth.rest_source, smooth.factor, smooth.iterations = "ORCO", 0.5, 6
    return mesh_object, armature_object, points


def add_groups(mesh_object: bpy.types.Object, weights: dict[str, np.ndarray]) -> None:
    """Add vertex groups with the (V,) weights of bones."""
    for name, bone_weights in weights.items():
        group = mesh_object.vertex_groups.new(name=name)
        for index in np.flatnonzero(bone_weights > 1e-3):
            group.add([int(index)], float(bone_weights[index]), "REPLACE")


def _add_face_bones(armature_object: bpy.types.Object) -> None:
    bones = [NewBone("head", (0.0, 0.02, -0.12), (0.0, 0.02, 0.1))]
    for name, part_angles in PART_ANGLES.items():
        tip = _direction(part_angles) * RADII
        # The pivots are inside the head; the pivot of the jaw is between the ears.
        pivot = np.array((0.0, 0.03, 0.0)) if name == "jaw" else tip * (0.35, 0.35, 0.35)
        parent = "jaw" if name.startswith(("chin", "lip_bottom")) else "head"
        bones.append(NewBone(name, tuple(pivot.tolist()), tuple(tip.tolist()), parent))
    add_bones(armature_object, *bones)
    pose = armature_object.pose.bones
    for bone in pose:
        limit(bone, "LIMIT_ROTATION", {0: (-6.0, 6.0), 2: (-6.0, 6.0)})
    for name, ranges in (("head", {0: (-20.0, 20.0), 1: (-30.0, 30.0)}), ("jaw", {0: (-25.0, 0.0), 2: (-6.0, 6.0)})):
        for constraint in list(pose[name].constraints):
            pose[name].constraints.remove(constraint)
        limit(pose[name], "LIMIT_ROTATION", ranges)


def _face_weights(points: np.ndarray) -> dict[str, np.ndarray]:
    """Return weights that fall off around each part; the jaw gets the lower face, the head what remains."""
    weights = {name: np.exp(-((_angle_from_part(points, name) / 0.2) ** 2)) for name in PART_ANGLES if name != "jaw"}
    weights["jaw"] = 0.7 * lower_face(points)
    weight_sums = sum(weights.values())
    weights = {
        name: part_weights * np.minimum(1, 0.97 / np.maximum(weight_sums, 1e-9))
        for name, part_weights in weights.items()
    }
    return weights | {"head": 1 - sum(weights.values())}


def lower_face(points: np.ndarray) -> np.ndarray:
    """Return the (V,) weights of the lower face, 0 to 1."""
    heights = points[:, 2] / RADII[2]
    return 1 / (1 + np.exp((heights + 0.42) * 18)) / (1 + np.exp(points[:, 1] / RADII[1] * 12))


def _drive_by_product(
    key: bpy.types.ShapeKey,
    mesh_object: bpy.types.Object,
    armature_object: bpy.types.Object,
    driving_names: tuple[str, str],
) -> None:
    """Drive a shape key by the product of two shape keys, or of a shape key and the opening of the jaw."""
    driver = key.driver_add("value").driver
    for letter, name in zip("ab", driving_names, strict=True):
        if name == "jaw":
            add_variable(driver, letter, armature_object, ("jaw", "ROT_X"))
        else:
            add_variable(driver, letter, mesh_object.data.shape_keys, f'key_blocks["{name}"].value')
    driver.expression = f"a * b / {-JAW_OPENING:.6f}" if "jaw" in driving_names else "a * b"


def add_performance(mesh_object: bpy.types.Object, name: str) -> bpy.types.Action:
    """Add an action in which all bones and the shape keys without drivers move at the same time, at different rates."""
    armature_object, keys = mesh_object.find_armature(), mesh_object.data.shape_keys
    action = bpy.data.actions.new(name)
    armature_object.animation_data_create().action = action
    for frame in range(1, FRAMES + 1, 4):
        for index, bone in enumerate(armature_object.pose.bones):
            (limit_constraint,) = bone.constraints
            for axis, letter in enumerate("xyz"):
                if not bone.lock_rotation[axis]:
                    low, high = getattr(limit_constraint, f"min_{letter}"), getattr(limit_constraint, f"max_{letter}")
                    fraction = 0.5 + 0.45 * math.sin(frame * (0.11 + 0.017 * index) + 2.1 * index + axis)
                    bone.rotation_euler[axis] = low + (high - low) * fraction
            bone.keyframe_insert("rotation_euler", frame=frame)
    key_animation = keys.animation_data_create()
    driven_paths = {curve.data_path for curve in key_animation.drivers}
    blocks = [b for b in keys.key_blocks[1:] if f'key_blocks["{b.name}"].value' not in driven_paths]
    action.slots.new(id_type="KEY", name=keys.name)
    key_animation.action = action
    for frame in range(1, FRAMES + 1, 4):
        for index, block in enumerate(blocks):
            block.value = max(0.0, math.sin(frame * (0.09 + 0.013 * (index % 30)) + 1.7 * index))
            keys.keyframe_insert(f'key_blocks["{block.name}"].value', frame=frame)
    for block in blocks:
        block.value = 0.0
    key_animation.action = None
    return action


def main(output_path: Path) -> None:
    """Build the face with its action, and save it."""
    bpy.ops.wm.read_factory_settings(use_empty=True)
    face()
    add_performance(bpy.data.objects[MESH], SPEECH)
    bpy.ops.wm.save_as_mainfile(filepath=str(output_path.absolute()), copy=True)


if __name__ == "__main__":
    main(Path(sys.argv[1]))
