# SPDX-License-Identifier: GPL-3.0-or-later
"""A face: a head of 5,186 vertices with 22 bones, 22 shape keys that an animator sets, and 12 correctives.

Jaw, lips, brows, lids and cheeks are bones and shape keys both, as in production faces; correctives are shape keys that
are driven by the product of two others, or of one and the jaw. Delta mush comes last. With an action to compare on:
`python -m blend_fixtures.characters.face OUT.blend`.
"""

import math
import sys
from collections.abc import Callable
from pathlib import Path

import bpy
import numpy as np

from .base import link
from .bones import NewBone, add_bones, limit
from .controls import add_key

MESH, ARMATURE, SPEECH = "face", "face_rig", "speech"
FRAMES = 80
RADII = np.array((0.078, 0.096, 0.118))
"""Of the head, meters: it looks along -Y, its left is +X."""
RINGS, AROUND = 72, 72

# Where parts of the face lie: degrees to the left, and upwards.
PLACES = {
    "jaw": (0, -42), "chin": (0, -55), "nose": (0, 2), "lip_top": (0, -19), "lip_bottom": (0, -29),
    **{f"{name}.{side}": (sign * left, up)
       for side, sign in (("L", 1), ("R", -1))
       for name, left, up in (
           ("corner", 17, -24), ("lip_top", 9, -20), ("lip_bottom", 9, -28), ("lid_top", 21, 22),
           ("lid_bottom", 21, 12), ("brow_in", 9, 34), ("brow_out", 30, 35), ("cheek", 33, -6),
       )},
}  # fmt: skip
JAW_OPENS = math.radians(25)


def _direction(place: tuple[float, float]) -> np.ndarray:
    left, up = map(math.radians, place)
    return np.array((math.sin(left) * math.cos(up), -math.cos(left) * math.cos(up), math.sin(up)))


def _surface() -> tuple[np.ndarray, list[tuple[int, ...]]]:
    """Points (5186, 3) of the head, and its faces: rings around Z, and two poles."""
    up = (np.arange(RINGS) + 0.5) / RINGS * np.pi - np.pi / 2
    around = np.arange(AROUND) / AROUND * 2 * np.pi
    grid = np.array([(math.cos(u) * math.sin(a), -math.cos(u) * math.cos(a), math.sin(u)) for u in up for a in around])
    directions = np.concatenate([grid, [(0, 0, -1), (0, 0, 1)]])
    nose = np.exp(-(_apart(directions, "nose") ** 2) / 0.03)
    faces = [
        (r * AROUND + a, r * AROUND + (a + 1) % AROUND, (r + 1) * AROUND + (a + 1) % AROUND, (r + 1) * AROUND + a)
        for r in range(RINGS - 1)
        for a in range(AROUND)
    ]
    top = (RINGS - 1) * AROUND
    faces += [((a + 1) % AROUND, a, len(grid)) for a in range(AROUND)]
    faces += [(top + a, top + (a + 1) % AROUND, len(grid) + 1) for a in range(AROUND)]
    return directions * RADII * (1 + 0.14 * nose[:, None]), faces


def _apart(points: np.ndarray, name: str) -> np.ndarray:
    """(n,) angle between points, seen from the middle of the head, and a place; radians."""
    directions = points / RADII
    directions /= np.linalg.norm(directions, axis=1, keepdims=True)
    return np.arccos(np.clip(directions @ _direction(PLACES[name]), -1, 1))


def _bump(name: str, offset: tuple[float, float, float], size: float = 0.16) -> Callable[[np.ndarray], np.ndarray]:
    """Moves what is near a place, by millimeters."""

    def move(points: np.ndarray) -> np.ndarray:
        return points + np.exp(-((_apart(points, name) / size) ** 2))[:, None] * np.array(offset) / 1000

    return move


def _together(*moves: Callable[[np.ndarray], np.ndarray]) -> Callable[[np.ndarray], np.ndarray]:
    return lambda points: points + sum(move(points) - points for move in moves)


def _keys() -> dict[str, Callable[[np.ndarray], np.ndarray]]:
    """The 22 shapes that an animator sets."""
    found = {
        "pucker": _together(
            _bump("corner.L", (-7, -4, 0)), _bump("corner.R", (7, -4, 0)), _bump("lip_top", (0, -5, 0))
        ),
        "funnel": _together(_bump("lip_top", (0, -5, 3)), _bump("lip_bottom", (0, -5, -3))),
        "press": _together(_bump("lip_top", (0, 1, -3)), _bump("lip_bottom", (0, 1, 3))),
        "chin_up": _bump("chin", (0, -2, 5)),
    }
    for side, sign in (("L", 1), ("R", -1)):
        found |= {
            f"smile.{side}": _together(_bump(f"corner.{side}", (6 * sign, 3, 7)), _bump(f"cheek.{side}", (0, -3, 4))),
            f"frown.{side}": _bump(f"corner.{side}", (2 * sign, 0, -7)),
            f"wide.{side}": _bump(f"corner.{side}", (7 * sign, 3, 0)),
            f"blink.{side}": _together(
                _bump(f"lid_top.{side}", (0, -2, -8), 0.12), _bump(f"lid_bottom.{side}", (0, 0, 2), 0.1)
            ),
            f"squint.{side}": _bump(f"lid_bottom.{side}", (0, -2, 4), 0.12),
            f"brow_up.{side}": _together(_bump(f"brow_in.{side}", (0, 0, 6)), _bump(f"brow_out.{side}", (0, 0, 7))),
            f"angry.{side}": _bump(f"brow_in.{side}", (-4 * sign, -2, -6)),
            f"sneer.{side}": _together(_bump(f"lip_top.{side}", (0, -2, 5)), _bump("nose", (0, 0, 3), 0.1)),
            f"puff.{side}": _bump(f"cheek.{side}", (6 * sign, -5, 0), 0.2),
        }
    return found


def _correctives() -> dict[tuple[str, str], Callable[[np.ndarray], np.ndarray]]:
    """What is wrong where two of the shapes come together, or one and the open jaw."""
    found = {("pucker", "jaw"): _bump("lip_bottom", (0, -4, 3)), ("funnel", "press"): _bump("lip_top", (0, 3, -2))}
    for side, sign in (("L", 1), ("R", -1)):
        found |= {
            (f"smile.{side}", "jaw"): _bump(f"corner.{side}", (-5 * sign, 0, -4)),
            (f"smile.{side}", "pucker"): _bump(f"corner.{side}", (3 * sign, -4, 3)),
            (f"blink.{side}", f"squint.{side}"): _bump(f"lid_bottom.{side}", (0, 2, -4), 0.1),
            (f"brow_up.{side}", f"angry.{side}"): _bump(f"brow_in.{side}", (2 * sign, -4, 2)),
            (f"sneer.{side}", f"smile.{side}"): _bump(f"lip_top.{side}", (2 * sign, -3, -3)),
        }
    return found


def face() -> None:
    """Build it in the current scene: `face`, `face_rig`."""
    points, faces = _surface()
    mesh = bpy.data.meshes.new(MESH)
    mesh.from_pydata(points.tolist(), [], faces)
    mesh_object = link(bpy.data.objects.new(MESH, mesh))
    armature_object = link(bpy.data.objects.new(ARMATURE, bpy.data.armatures.new(ARMATURE)))
    mesh_object.parent = armature_object
    _rig(armature_object)
    _weigh(mesh_object, points)
    mesh_object.modifiers.new("Armature", "ARMATURE").object = armature_object
    for name, move in _keys().items():
        add_key(mesh_object, name, move)
    for (first, second), move in _correctives().items():
        _drive(add_key(mesh_object, f"{first}_{second}", move), mesh_object, armature_object, (first, second))
    smooth = mesh_object.modifiers.new("CorrectiveSmooth", "CORRECTIVE_SMOOTH")
    smooth.rest_source, smooth.factor, smooth.iterations = "ORCO", 0.5, 6
    bpy.context.view_layer.update()


def _rig(armature_object: bpy.types.Object) -> None:
    bones = [NewBone("head", (0.0, 0.02, -0.12), (0.0, 0.02, 0.1))]
    for name, place in PLACES.items():
        tip = _direction(place) * RADII
        # They turn about points inside the head, the jaw about the ears.
        start = np.array((0.0, 0.03, 0.0)) if name == "jaw" else tip * (0.35, 0.35, 0.35)
        parent = "jaw" if name.startswith(("chin", "lip_bottom")) else "head"
        bones.append(NewBone(name, tuple(start.tolist()), tuple(tip.tolist()), parent))
    add_bones(armature_object, *bones)
    pose = armature_object.pose.bones
    for bone in pose:
        limit(bone, "LIMIT_ROTATION", {0: (-6.0, 6.0), 2: (-6.0, 6.0)})
    for name, ranges in (("head", {0: (-20.0, 20.0), 1: (-30.0, 30.0)}), ("jaw", {0: (-25.0, 0.0), 2: (-6.0, 6.0)})):
        for constraint in list(pose[name].constraints):
            pose[name].constraints.remove(constraint)
        limit(pose[name], "LIMIT_ROTATION", ranges)


def _weigh(mesh_object: bpy.types.Object, points: np.ndarray) -> None:
    """Weights that fall off around each place; the jaw has the lower part of the face, the head the rest."""
    weights = {name: np.exp(-((_apart(points, name) / 0.2) ** 2)) for name in PLACES if name != "jaw"}
    up = points[:, 2] / RADII[2]
    weights["jaw"] = 0.7 / (1 + np.exp((up + 0.42) * 18)) / (1 + np.exp(points[:, 1] / RADII[1] * 12))
    total = sum(weights.values())
    weights = {name: own * np.minimum(1, 0.97 / np.maximum(total, 1e-9)) for name, own in weights.items()}
    weights["head"] = 1 - sum(weights.values())
    for name, own in weights.items():
        group = mesh_object.vertex_groups.new(name=name)
        for index in np.flatnonzero(own > 1e-3):
            group.add([int(index)], float(own[index]), "REPLACE")


def _drive(
    key: bpy.types.ShapeKey, mesh_object: bpy.types.Object, armature_object: bpy.types.Object, by: tuple[str, str]
) -> None:
    """The product of two shape keys, or of one and how far the jaw is open."""
    driver = key.driver_add("value").driver
    for letter, name in zip("ab", by, strict=True):
        variable = driver.variables.new()
        variable.name = letter
        if name == "jaw":
            variable.type = "TRANSFORMS"
            target = variable.targets[0]
            target.id, target.bone_target = armature_object, "jaw"
            target.transform_type, target.transform_space = "ROT_X", "LOCAL_SPACE"
        else:
            target = variable.targets[0]
            target.id_type, target.id = "KEY", mesh_object.data.shape_keys
            target.data_path = f'key_blocks["{name}"].value'
    driver.expression = f"a * b / {-JAW_OPENS:.6f}" if "jaw" in by else "a * b"


def add_speech() -> bpy.types.Action:
    """The action `speech`, of bones and shape keys: each goes its own way, many at a time, none far at first."""
    armature_object, keys = bpy.data.objects[ARMATURE], bpy.data.objects[MESH].data.shape_keys
    animation = armature_object.animation_data_create()
    animation.action = action = bpy.data.actions.new(SPEECH)
    free = [block for block in keys.key_blocks[1:] if block.name in _keys()]
    for frame in range(1, FRAMES + 1, 4):
        for number, bone in enumerate(armature_object.pose.bones):
            (held,) = bone.constraints
            for axis, letter in enumerate("xyz"):
                if not bone.lock_rotation[axis]:
                    low, high = getattr(held, f"min_{letter}"), getattr(held, f"max_{letter}")
                    part = 0.5 + 0.45 * math.sin(frame * (0.11 + 0.017 * number) + 2.1 * number + axis)
                    bone.rotation_euler[axis] = low + (high - low) * part
            bone.keyframe_insert("rotation_euler", frame=frame)
    moved = keys.animation_data_create()
    action.slots.new(id_type="KEY", name=keys.name)
    moved.action = action
    for frame in range(1, FRAMES + 1, 4):
        for number, block in enumerate(free):
            block.value = max(0.0, math.sin(frame * (0.09 + 0.013 * number) + 1.7 * number))
            keys.keyframe_insert(f'key_blocks["{block.name}"].value', frame=frame)
    for block in free:
        block.value = 0.0
    moved.action = None
    return action


def main(target: Path) -> None:
    """Build the face with its action, and save it."""
    bpy.ops.wm.read_factory_settings(use_empty=True)
    face()
    add_speech()
    bpy.ops.wm.save_as_mainfile(filepath=str(target.absolute()), copy=True)


if __name__ == "__main__":
    main(Path(sys.argv[1]))
