# SPDX-License-Identifier: GPL-3.0-or-later
"""Ranges of motion of a figure that states none: those of people, mirrored and copied. A function a step."""

from collections.abc import Iterator
from pathlib import Path

import bpy
import numpy as np
import sidebar
from arm import look_at, part
from window import check, over, picture, redraw, until

BODY = {
    "hips": (None, (0, 0, 1.0), (0, 0, 1.2)),
    "spine": ("hips", (0, 0, 1.2), (0, 0, 1.5)),
    "upper_arm.L": ("spine", (0.2, 0, 1.5), (0.5, 0, 1.5)),
    "forearm.L": ("upper_arm.L", (0.5, 0, 1.5), (0.8, 0, 1.5)),
    "upper_arm.R": ("spine", (-0.2, 0, 1.5), (-0.5, 0, 1.5)),
    "forearm.R": ("upper_arm.R", (-0.5, 0, 1.5), (-0.8, 0, 1.5)),
    "tail": ("hips", (0, 0.1, 1.0), (0, 0.5, 1.0)),
}
"""Bones of a figure: parent, head and tail."""


def give_a_figure_human_ranges(folder: Path) -> Iterator[float]:
    """A figure with limbs that states no limits, as it says; press Human Limits."""
    bpy.ops.wm.read_homefile(app_template="", load_ui=False)
    yield 0.5
    bpy.data.objects.remove(bpy.data.objects["Cube"])
    _build_figure()
    look_at(bpy.data.objects["figure"])
    yield from sidebar.show()
    yield 1.0
    yield from sidebar.open_section("poses")
    yield from picture(folder / "no_limits.png")
    yield from sidebar.push("fdda.human_limits(")
    bones, ranges = bpy.data.objects["figure_rig"].pose.bones, part("poses.motion_range")

    def stated(name: str) -> bool:
        return any(r.source != ranges.DEFAULT for r in ranges.rotation_ranges(bones[name]))

    yield from until(lambda: stated("forearm.L"), 5, "the button gives no ranges")
    missing = [name for name in BODY if name != "tail" and not stated(name)]
    check(not missing and not stated("tail"), f"{missing} have no ranges, the tail has {stated('tail')}")


def _build_figure() -> None:
    data = bpy.data.armatures.new("figure_rig")
    rig = bpy.data.objects.new("figure_rig", data)
    bpy.context.scene.collection.objects.link(rig)
    bpy.context.view_layer.objects.active = rig
    with over("WINDOW"):
        bpy.ops.object.mode_set(mode="EDIT")
        for name, (parent, head, tail) in BODY.items():
            bone = data.edit_bones.new(name)
            bone.head, bone.tail = head, tail
            bone.parent = data.edit_bones[parent] if parent else None
        bpy.ops.object.mode_set(mode="OBJECT")
    vertices = [(x, y, z) for _, head, tail in BODY.values() for t in (0.1, 0.9) for x, y, z in _ring(head, tail, t)]
    faces = [
        (8 * b + k, 8 * b + (k + 1) % 4, 8 * b + 4 + (k + 1) % 4, 8 * b + 4 + k)
        for b in range(len(BODY))
        for k in range(4)
    ]
    mesh = bpy.data.meshes.new("figure")
    mesh.from_pydata(vertices, [], faces)
    figure = bpy.data.objects.new("figure", mesh)
    bpy.context.scene.collection.objects.link(figure)
    for number, name in enumerate(BODY):
        figure.vertex_groups.new(name=name).add(list(range(8 * number, 8 * number + 8)), 1.0, "REPLACE")
    figure.modifiers.new("Armature", "ARMATURE").object = rig
    figure.select_set(True)
    bpy.context.view_layer.objects.active = figure


def _ring(head: tuple, tail: tuple, t: float) -> Iterator[tuple]:
    start, end = np.array(head), np.array(tail)
    along = end - start
    side = np.cross(along, (0, 1, 0) if abs(along[1]) < 0.3 else (1, 0, 0))
    side *= 0.05 / np.linalg.norm(side)
    other = np.cross(along, side)
    other *= 0.05 / np.linalg.norm(other)
    for a, b in ((1, 1), (-1, 1), (-1, -1), (1, -1)):
        yield tuple((start + t * along + a * side + b * other).tolist())


def mirror_and_copy_ranges(folder: Path) -> Iterator[float]:
    """Limit one forearm: press Mirror to Other Side, and the other forearm has its limits; press Copy to Selected, and
    the upper arm has them too."""
    compatibility = part("scene.compatibility")
    bones, session = bpy.data.objects["figure_rig"].pose.bones, bpy.context.window_manager.fdda
    left, right, upper = bones["forearm.L"], bones["forearm.R"], bones["upper_arm.L"]
    ranges = part("poses.motion_range")
    for axis in range(3):
        left.lock_rotation[axis] = right.lock_rotation[axis] = False
    ranges.set_rotation_range(left, 0, -0.25, 0.5)
    for bone in bones:
        compatibility.select_bone(bone, bone == left)
    session.bone_index = bones.find(left.name)
    yield from redraw()
    yield from sidebar.open_section("poses")
    yield from sidebar.push("fdda.mirror_limits(", across=0.8)
    yield from until(lambda: abs(_width(right, ranges) - 0.75) < 0.01, 5, "the other forearm has not the range")
    compatibility.select_bone(upper, True)
    yield from redraw()
    yield from picture(folder / "ranges.png")
    yield from sidebar.push("fdda.copy_limits(", across=0.25)
    yield from until(lambda: abs(_width(upper, ranges) - 0.75) < 0.01, 5, "the upper arm has not the range")


def _width(bone: bpy.types.PoseBone, ranges: object) -> float:
    found = ranges.rotation_ranges(bone)[0]
    return found.high - found.low


def read_names_with_a_prefix(folder: Path) -> Iterator[float]:
    """All bones begin alike, as with Mixamo's: the list shows what tells them apart."""
    armature = bpy.data.objects["figure_rig"]
    for bone in armature.data.bones:
        bone.name = f"mixamorig:{bone.name}"
    yield 1.0
    yield from redraw()
    yield from picture(folder / "names.png")
    shown = part("panels.bone_names").short_bone_name(armature, "mixamorig:upper_arm.L")
    check(shown == "upper_arm.L", f"the bone is shown as '{shown}'")


STEPS = (give_a_figure_human_ranges, mirror_and_copy_ranges, read_names_with_a_prefix)
