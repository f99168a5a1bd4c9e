# SPDX-License-Identifier: GPL-3.0-or-later
"""Story for the pictures of the manual, which runs only by name: the first model, a training on too few poses, limits.

It writes screenshots, and `marks.json` with the positions of the numbered buttons, of areas and of arcs in them.
`docs/pictures/make_manual.py` draws the numbers and arcs.
"""

import json
import math
import os
from collections.abc import Iterator
from pathlib import Path

import bpy
import sidebar
from arm import (
    BLEND_FILE_NAME,
    arm_object,
    armature_object,
    extension_module,
    frame_object,
    make_empty_folder,
    show_preferences,
    wait_for_job,
)
from window import (
    main_screen,
    main_window,
    move_mouse,
    park_mouse,
    press_mouse_button,
    redraw_window,
    require,
    save_screenshot,
    view_area,
    view_region,
    wait_for_events,
    wait_until,
)

BADGE_INSET_PIXELS, LEFT_BADGE_PIXELS = 62, 16
"""Distance of a number from the right edge of the sidebar, and from the left edge in rows with texts at the right."""
PROBE_PIXELS = 3
"""Distance between mouse positions in the search for the edges of a button."""
FEW_POSES = 25
WIDER_PIXELS = 120
"""By how much the Properties editor is widened."""
ARC_STEPS, ELEVATION = 24, math.radians(50)
LIMITED_BONES = {"shoulder": 0.2, "elbow": 0.2, "wrist": 0.13}
"""Bones whose limits are drawn, with the radius of the arc in meters."""

_marks: dict[str, dict] = {}


def _shoot(folder: Path, name: str, **marks: object) -> Iterator[float]:
    """Write a screenshot, and store what is to be drawn on it."""
    yield from park_mouse()
    yield from save_screenshot(folder / f"{name}.png")
    side = view_region("UI")
    _marks[name] = {"sidebar": _box(side), **marks}
    (folder / "marks.json").write_text(json.dumps(_marks, indent=1), encoding="utf-8")


def _box(region: bpy.types.Region | bpy.types.Area) -> list[int]:
    """Return left, top, right and bottom of a region or an area in a screenshot, pixels."""
    height = main_window().height
    return [region.x, height - region.y - region.height, region.x + region.width, height - region.y]


def _number(number: int, identifier: str, across: float = 0.5, is_left: bool = False) -> Iterator[float]:
    """Return a number and the position in a screenshot where it is drawn, at the right or left end of a button."""
    x, y = yield from sidebar.find_button(identifier, across)
    edges = []
    for direction in (1, -1):
        edge = y
        while identifier in (yield from sidebar.description_at(x, edge + direction * PROBE_PIXELS)):
            edge += direction * PROBE_PIXELS
        edges.append(edge)
    side = view_region("UI")
    badge_x = side.x + (LEFT_BADGE_PIXELS if is_left else side.width - BADGE_INSET_PIXELS)
    return [number, badge_x, main_window().height - sum(edges) / 2]


def show_the_section_without_a_rig(folder: Path) -> Iterator[float]:
    bpy.ops.wm.read_homefile(app_template="", load_ui=False)
    yield 0.5
    bpy.context.view_layer.objects.active = None
    yield from sidebar.open_tab()
    number = yield from _number(1, "fdda.add_sample_arm")
    yield from _shoot(folder, "manual_empty", numbers=[number])


def measure_the_rig(folder: Path) -> Iterator[float]:
    bpy.ops.fdda.add_sample_arm()
    bpy.ops.ed.undo_push(message="arm")
    bpy.ops.wm.save_as_mainfile(filepath=str(make_empty_folder(folder / "manual") / BLEND_FILE_NAME))
    frame_object(arm_object())
    yield from redraw_window()
    yield from sidebar.open_section("rig")
    yield from sidebar.press_button("fdda.measure()")
    yield from wait_for_job("measure", 60)
    yield from redraw_window()
    number = yield from _number(3, "fdda.build_model")
    yield from _shoot(folder, "manual_rig", numbers=[number])


def show_the_poses(folder: Path) -> Iterator[float]:
    yield from sidebar.open_section("poses")
    number = yield from _number(4, "fdda.rest_pose", across=0.85, is_left=True)
    yield from _shoot(folder, "manual_poses", numbers=[number])


def record(folder: Path) -> Iterator[float]:
    yield from sidebar.open_section("recording")
    number = yield from _number(5, "fdda.record(")
    yield from _shoot(folder, "manual_recording", numbers=[number])
    yield from sidebar.press_button("fdda.record(")
    yield from wait_for_job("record", 240)


def train(folder: Path) -> Iterator[float]:
    yield from sidebar.open_section("training")
    yield from sidebar.press_button("fdda.train(")
    yield from wait_for_job("train", 240)
    yield from redraw_window()
    numbers = [(yield from _number(6, "fdda.train(")), (yield from _number(7, "fdda.bind("))]
    yield from _shoot(folder, "manual_training", numbers=numbers, rows=[y for _, _, y in numbers])


def bind(folder: Path) -> Iterator[float]:
    """Press Bind in the section Training; show the modifiers before and after."""
    properties = next(area for area in main_screen().areas if area.type == "PROPERTIES")
    properties.spaces.active.context = "MODIFIER"
    # Names of modifiers are cut off in the narrow editor.
    yield from _drag_left_edge(properties, -WIDER_PIXELS)
    for modifier in arm_object().modifiers:
        modifier.show_expanded = False
    yield from _shoot(folder, "manual_modifiers_before", area=_box(properties))
    yield from sidebar.press_button("fdda.bind(")
    yield from wait_until(lambda: arm_object().fdda.is_bound, 20, "the button binds nothing")
    for modifier in arm_object().modifiers:
        modifier.show_expanded = False
    yield from _shoot(folder, "manual_modifiers_after", area=_box(properties))
    yield from _drag_left_edge(properties, WIDER_PIXELS)
    properties.spaces.active.context = "OBJECT"
    yield from sidebar.open_section("playback")
    yield from sidebar.press_button("fdda.measure()")
    yield from wait_for_job("measure", 90)
    yield from redraw_window()
    yield from _shoot(folder, "manual_model", numbers=[])


def _drag_left_edge(area: bpy.types.Area, pixels: int) -> Iterator[float]:
    """Drag the left edge of an area with the mouse."""
    x, y = area.x - 1, area.y + area.height // 2
    move_mouse(x, y)
    yield from wait_for_events()
    press_mouse_button("mousedown")
    yield from wait_for_events()
    for step in (0.5, 1.0):
        move_mouse(x + step * pixels, y)
        yield from wait_for_events()
    press_mouse_button("mouseup")
    yield 0.5
    require(abs(area.x - 1 - x - pixels) < 10, f"the edge was moved by {area.x - 1 - x} pixels")


def evaluate(folder: Path) -> Iterator[float]:
    yield from sidebar.open_section("evaluation")
    yield from sidebar.press_button("fdda.evaluate(")
    yield from wait_for_job("evaluate", 120)
    yield from redraw_window()
    number = yield from _number(8, "fdda.evaluate(")
    yield from _shoot(folder, "manual_evaluation", numbers=[number])
    yield from sidebar.open_section("models")
    yield from _shoot(folder, "manual_models", numbers=[])


def show_limits(folder: Path) -> Iterator[float]:
    """Compute arcs of the limits of some bones in the rest pose."""
    from mathutils import Euler

    armature_object().animation_data.action = None
    bpy.ops.fdda.rest_pose()
    view_area().spaces[0].show_region_ui = False
    view_area().spaces[0].region_3d.view_rotation = Euler((ELEVATION, 0, 0)).to_quaternion()
    yield 0.5
    frame_object(arm_object(), 1.2)
    yield 0.5
    arcs = [_arc(name, 0, radius) for name, radius in LIMITED_BONES.items()]
    yield from _shoot(folder, "manual_limits", arcs=[arc for arc in arcs if arc], area=_box(view_region("WINDOW")))
    yield from sidebar.open_tab()


def _arc(bone_name: str, axis: int, radius: float) -> dict | None:
    """Return the arc that the tip of a bone moves on between the limits about an axis; None if it is locked."""
    from bpy_extras.view3d_utils import location_3d_to_region_2d
    from mathutils import Matrix, Vector

    bone = armature_object().pose.bones[bone_name]
    limits = extension_module("poses.motion_range").rotation_ranges(bone)[axis]
    if not limits.moves:
        return None
    view, height = view_region("WINDOW"), main_window().height
    rest_matrix = armature_object().matrix_world @ bone.bone.matrix_local
    points = []
    for step in range(ARC_STEPS + 1):
        angle = limits.low + (limits.high - limits.low) * step / ARC_STEPS
        tip = Matrix.Rotation(angle, 4, "XYZ"[axis]) @ Vector((0, radius, 0))
        x, y = location_3d_to_region_2d(view, view_area().spaces[0].region_3d, rest_matrix @ tip)
        points.append([view.x + x, height - view.y - y])
    x, y = location_3d_to_region_2d(view, view_area().spaces[0].region_3d, rest_matrix.to_translation())
    return {"bone": bone_name, "axis": axis, "low": limits.low, "high": limits.high,
            "center": [view.x + x, height - view.y - y], "points": points}  # fmt: skip


def train_on_too_few_poses(folder: Path) -> Iterator[float]:
    bpy.ops.fdda.unbind(object="arm")
    settings = arm_object().fdda.settings
    settings.poses = FEW_POSES
    settings.recording, settings.model = "//few", "//few_model/few.onnx"
    bpy.ops.fdda.record(object="arm")
    yield from sidebar.open_section("training")
    yield from sidebar.press_button("fdda.train(")
    yield from wait_for_job("train", 240)
    yield from redraw_window()
    numbers = [(yield from _number(6, "fdda.train(")), (yield from _number(7, "fdda.bind("))]
    yield from _shoot(folder, "manual_few_poses", rows=[y for _, _, y in numbers])


def show_the_preferences(folder: Path) -> Iterator[float]:
    # As on a machine where nothing is installed yet.
    os.environ.pop("FDDA_TRAINER_PYTHON", None)
    bpy.context.preferences.system.use_online_access = True
    area = view_area()
    yield from show_preferences(area)
    yield from save_screenshot(folder / "manual_preferences.png")
    _marks["manual_preferences"] = {"area": _box(area)}
    (folder / "marks.json").write_text(json.dumps(_marks, indent=1), encoding="utf-8")
    area.type = "VIEW_3D"
    yield 0.5
    bpy.context.preferences.system.use_online_access = False
    require(view_area() is not None, "the view is gone")


STEPS = (
    show_the_section_without_a_rig,
    measure_the_rig,
    show_the_poses,
    record,
    train,
    bind,
    evaluate,
    train_on_too_few_poses,
    show_limits,
    show_the_preferences,
)
