# SPDX-License-Identifier: GPL-3.0-or-later
"""Story: rotation limits of a figure without limits are set, mirrored and copied. Each function is a step."""

from collections.abc import Iterator
from pathlib import Path

import bpy
import numpy as np
import sidebar
from arm import extension_module, frame_object
from window import redraw_window, region_override, require, save_screenshot, wait_until

BODY = {
    "hips": (None, (0, 0, 1.0), (0, 0, 1.2)),
    "spine": ("hips", (0, 0, 1.2), (0, 0, 1.5)),
    "upper_arm.L": ("spine", (0.2, 0, 1.5), (0.5, 0, 1.5)),
    "forearm.L": ("upper_arm.L", (0.5, 0, 1.5), (0.8, 0, 1.5)),
    "upper_arm.R": ("spine", (-0.2, 0, 1.5), (-0.5, 0, 1.5)),
    "forearm.R": ("upper_arm.R", (-0.5, 0, 1.5), (-0.8, 0, 1.5)),
    "tail": ("hips", (0, 0.1, 1.0), (0, 0.5, 1.0)),
}
"""Bones of the figure: parent, head and tail, meters."""


def set_human_limits_of_a_figure(folder: Path) -> Iterator[float]:
    """Press Human Limits on a figure without limits: all bones but the tail get limits."""
    bpy.ops.wm.read_homefile(app_template="", load_ui=False)
    yield 0.5
    bpy.data.objects.remove(bpy.data.objects["Cube"])
    _build_figure()
    frame_object(bpy.data.objects["figure"])
    yield from sidebar.open_tab()
    yield 1.0
    yield from sidebar.open_section("poses")
    yield from save_screenshot(folder / "no_limits.png")
    yield from sidebar.press_button("fdda.human_limits(")
    bones, ranges = bpy.data.objects["figure_rig"].pose.bones, extension_module("poses.motion_range")

    def has_limits(name: str) -> bool:
        return any(r.source != ranges.DEFAULT for r in ranges.rotation_ranges(bones[name]))

    yield from wait_until(lambda: has_limits("forearm.L"), 5, "the button sets no limits")
    missing = [name for name in BODY if name != "tail" and not has_limits(name)]
    require(
        not missing and not has_limits("tail"), f"{missing} have no limits; the tail has limits: {has_limits('tail')}"
    )


def _build_figure() -> None:
    data = bpy.data.armatures.new("figure_rig")
    rig = bpy.data.objects.new("figure_rig", data)
    bpy.context.scene.collection.objects.link(rig)
    bpy.context.view_layer.objects.active = rig
    with region_override("WINDOW"):
        bpy.ops.object.mode_set(mode="EDIT")
        for name, (parent, head, tail) in BODY.items():
            bone = data.edit_bones.new(name)
            bone.head, bone.tail = head, tail
            bone.parent = data.edit_bones[parent] if parent else None
        bpy.ops.object.mode_set(mode="OBJECT")
    vertices = [
        (x, y, z)
        for _, head, tail in BODY.values()
        for t in (0.1, 0.9)
        for x, y, z in _square_around_bone(head, tail, t)
    ]
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


def _square_around_bone(head: tuple, tail: tuple, position: float) -> Iterator[tuple]:
    start, end = np.array(head), np.array(tail)
    bone_vector = end - start
    first_normal = np.cross(bone_vector, (0, 1, 0) if abs(bone_vector[1]) < 0.3 else (1, 0, 0))
    first_normal *= 0.05 / np.linalg.norm(first_normal)
    second_normal = np.cross(bone_vector, first_normal)
    second_normal *= 0.05 / np.linalg.norm(second_normal)
    for first_sign, second_sign in ((1, 1), (-1, 1), (-1, -1), (1, -1)):
        yield tuple((start + position * bone_vector + first_sign * first_normal + second_sign * second_normal).tolist())


def mirror_and_copy_limits(folder: Path) -> Iterator[float]:
    """Press Mirror to Other Side and Copy to Selected: the other forearm and the upper arm get the forearm's limits."""
    compatibility = extension_module("scene.compatibility")
    bones, session = bpy.data.objects["figure_rig"].pose.bones, bpy.context.window_manager.fdda
    left, right, upper = bones["forearm.L"], bones["forearm.R"], bones["upper_arm.L"]
    ranges = extension_module("poses.motion_range")
    for axis in range(3):
        left.lock_rotation[axis] = right.lock_rotation[axis] = False
    ranges.set_rotation_range(left, 0, -0.25, 0.5)
    for bone in bones:
        compatibility.select_bone(bone, bone == left)
    session.bone_index = bones.find(left.name)
    yield from redraw_window()
    yield from sidebar.open_section("poses")
    yield from sidebar.open_subpanel("fdda.rest_pose", ".select", across=0.07, across_above=0.85)
    yield from sidebar.open_subpanel("lock_rotation", "fdda.mirror_limits(", across=0.8, across_above=0.15)
    yield from sidebar.press_button("fdda.mirror_limits(", across=0.8)
    yield from wait_until(
        lambda: abs(_x_range_width(right, ranges) - 0.75) < 0.01, 5, "the other forearm does not have the limits"
    )
    compatibility.select_bone(upper, True)
    yield from redraw_window()
    yield from save_screenshot(folder / "ranges.png")
    yield from sidebar.press_button("fdda.copy_limits(", across=0.25)
    yield from wait_until(
        lambda: abs(_x_range_width(upper, ranges) - 0.75) < 0.01, 5, "the upper arm does not have the limits"
    )


def _x_range_width(bone: bpy.types.PoseBone, ranges: object) -> float:
    x_range = ranges.rotation_ranges(bone)[0]
    return x_range.high - x_range.low


def shorten_names_with_a_common_prefix(folder: Path) -> Iterator[float]:
    """Give all bone names the prefix of Mixamo: the list shows the names without it."""
    armature_object = bpy.data.objects["figure_rig"]
    for bone in armature_object.data.bones:
        bone.name = f"mixamorig:{bone.name}"
    yield 1.0
    yield from redraw_window()
    yield from save_screenshot(folder / "names.png")
    short_name = extension_module("panels.bone_names").short_bone_name(armature_object, "mixamorig:upper_arm.L")
    require(short_name == "upper_arm.L", f"the bone is shown as '{short_name}'")


STEPS = (set_human_limits_of_a_figure, mirror_and_copy_limits, shorten_names_with_a_common_prefix)
