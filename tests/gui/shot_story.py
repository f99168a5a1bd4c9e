# SPDX-License-Identifier: GPL-3.0-or-later
"""What an animator sees of a model in a shot: masks, the rig beside it and over it, its error in the timeline and by
bone. A function a step, with its checks."""

from collections.abc import Iterator
from pathlib import Path

import bpy
import numpy as np
import sidebar
from arm import FRAME, arm, armature, distance_mm, job_done, look_at, open_in, part, positions, shape
from window import (
    button,
    check,
    click,
    main_screen,
    move,
    over,
    picture,
    pixels,
    play,
    press,
    redraw,
    region,
    rest_mouse,
    settle,
    stop,
    until,
    view_area,
)

GROUP = "learned"


def open_the_bound_file(folder: Path) -> Iterator[float]:
    """Open the file of the path, and look at the arm."""
    yield from open_in(folder / "work" / "shot", folder)
    yield from sidebar.show()


def choose_a_mask(folder: Path) -> Iterator[float]:
    """Click the field Mask, type the name of a vertex group: below the elbow there is linear skinning."""
    binding = arm().fdda
    model = shape()
    binding.mode = "LINEAR"
    linear = shape()
    binding.mode = "FDDA"
    along = np.array([vertex.co.x for vertex in arm().data.vertices])
    weights = along < np.median(along)
    arm().vertex_groups.new(name=GROUP).add(np.flatnonzero(weights).tolist(), 1.0, "REPLACE")
    yield from sidebar.open_section("playback")
    yield from sidebar.type_into("fdda.mask", GROUP)
    yield from picture(folder / "mask_search.png")
    yield from press("Return")
    yield from until(lambda: binding.mask == GROUP, 5, f"the field has '{binding.mask}'")
    expected = np.where(weights[:, None], model, linear)
    check(distance_mm(model, linear) > 0.5, "model and linear skinning are the same here")
    check(np.allclose(shape(), expected, atol=1e-6), "the mask is not what its weights say")
    yield from sidebar.push("fdda.invert_mask", across=0.99)
    yield from until(lambda: binding.invert_mask, 5, "the arrows do not invert the mask")
    check(
        np.allclose(shape(), np.where(weights[:, None], linear, model), atol=1e-6), "inverted it is not the other way"
    )
    yield from picture(folder / "mask.png")


def paint_the_mask(folder: Path) -> Iterator[float]:
    """Weight Paint: a stroke with the mouse over the arm, and what plays follows."""
    arm().vertex_groups.active = arm().vertex_groups[GROUP]
    before = shape()
    with over("WINDOW"):
        bpy.ops.object.mode_set(mode="WEIGHT_PAINT")
    yield 0.5
    paint = bpy.context.tool_settings.weight_paint
    # Of the whole scene before Blender 5.
    unified = getattr(paint, "unified_paint_settings", None) or bpy.context.tool_settings.unified_paint_settings
    unified.size = 200
    unified.weight = paint.brush.weight = 0.5
    view, shown = region("WINDOW"), part("scene.mask")
    before_stroke = shown.read_mask(arm()).weights
    for height in (0.4, 0.5, 0.6):
        for step in range(10):
            move(view.x + view.width * (0.2 + 0.05 * step), view.y + view.height * height)
            yield from settle()
            if step == 0:
                button("mousedown")
            yield 0.05
        button("mouseup")
        yield 0.3
    yield 0.5
    yield from picture(folder / "mask_painted.png")
    with over("WINDOW"):
        bpy.ops.object.mode_set(mode="OBJECT")
    yield 0.3
    check(arm().fdda.mode == "FDDA" and not arm().fdda.status, f"painting has switched it off: {arm().fdda.status}")
    weights = part("scene.mask").read_mask(arm()).weights
    check(np.abs(weights - before_stroke).max() > 0.1, "the strokes have painted nothing")
    check(distance_mm(shape(), before) > 1e-3, "what is painted does not show")
    arm().fdda.mask = ""
    yield 0.2


def show_the_rig_beside(folder: Path) -> Iterator[float]:
    """Press Beside: the rig stands to the side, and moves as the action plays."""
    side = part("evaluation.side_by_side")
    yield from sidebar.open_section("evaluation")
    yield from sidebar.push("fdda.show_rig(placement='BESIDE')", across=0.5)
    yield from until(lambda: side.find(arm()) is not None, 5, "the button shows no rig")
    look_at(arm(), 1.8)
    yield 0.5
    yield from picture(folder / "beside.png")
    before = positions(part("evaluation.side_by_side").find(arm()))
    yield from rest_mouse()
    bpy.context.scene.frame_set(1)
    yield from play()
    yield from until(lambda: bpy.context.scene.frame_current > 40, 30, "the action does not go on")
    yield from stop()
    check(
        distance_mm(positions(part("evaluation.side_by_side").find(arm())), before) > 1, "the rig beside does not move"
    )
    check(not arm().fdda.status, f"the model was switched off: {arm().fdda.status}")


def show_the_rig_over_it(folder: Path) -> Iterator[float]:
    """Press Overlay, and Off."""
    side = part("evaluation.side_by_side")
    bpy.context.scene.frame_set(FRAME)
    yield from sidebar.push("fdda.show_rig(placement='OVERLAY')", across=0.85)
    yield from until(lambda: side.display_mode(arm()) == "OVERLAY", 5, "the button shows no overlay")
    look_at(arm())
    yield 0.5
    yield from picture(folder / "overlay.png")
    yield from sidebar.push("fdda.show_rig(placement='NONE')", across=0.15)
    yield from until(lambda: side.find(arm()) is None, 5, "the button leaves the rig there")


def see_the_error_in_the_timeline(folder: Path) -> Iterator[float]:
    """Press Evaluate: the timeline has a graph of the error; the box switches it off."""
    bpy.context.scene.frame_set(FRAME)
    yield from sidebar.push("fdda.evaluate(")
    yield from job_done("evaluate", 90)
    yield from rest_mouse()
    with_graph = folder / "timeline.png"
    yield from picture(with_graph)
    drawn = _red_in_timeline(with_graph)
    yield from sidebar.push("fdda_view.graph", across=0.4)
    view = bpy.context.window_manager.fdda_view
    yield from until(lambda: not view.graph, 5, "the box does not switch the graph off")
    yield from rest_mouse()
    without = folder / "timeline_plain.png"
    yield from picture(without)
    left = _red_in_timeline(without)
    check(drawn > 200 and left < drawn / 10, f"with the graph {drawn} pixels of the timeline are red, without {left}")
    view.graph = True


def _red_in_timeline(path: Path) -> int:
    area = next(a for a in main_screen().areas if a.type == "DOPESHEET_EDITOR")
    inside = pixels(path)[area.y : area.y + area.height, area.x : area.x + area.width]
    return int(((inside[..., 0] > inside[..., 2] + 0.15) & (inside[..., 0] > inside[..., 1] + 0.1)).sum())


def click_a_bone_for_its_partition(folder: Path) -> Iterator[float]:
    """Pose mode, a click on the elbow in the view: its partition is on top of the table."""
    from bpy_extras.view3d_utils import location_3d_to_region_2d

    look_at(arm())
    with over("WINDOW"):
        bpy.context.view_layer.objects.active = armature()
        armature().select_set(True)
        bpy.ops.object.mode_set(mode="POSE")
    yield 0.5
    view, bone = region("WINDOW"), armature().pose.bones["elbow"]
    middle = armature().matrix_world @ ((bone.head + bone.tail) / 2)
    x, y = location_3d_to_region_2d(view, view_area().spaces[0].region_3d, middle)
    yield from click(view.x + x, view.y + y)
    yield from until(
        lambda: armature().data.bones.active is not None and armature().data.bones.active.name == "elbow",
        5,
        f"the click chooses {armature().data.bones.active}",
    )
    yield from redraw()
    yield from picture(folder / "partition_of_bone.png")
    rig = part("scene.active_rig").cached_active_rig(bpy.context)
    shown = part("panels.evaluation").active_bone_name(bpy.context, rig)
    check(shown == "elbow", f"the table has '{shown}' on top")
    with over("WINDOW"):
        bpy.ops.object.mode_set(mode="OBJECT")
    look_at(arm())


STEPS = (
    open_the_bound_file,
    choose_a_mask,
    paint_the_mask,
    show_the_rig_beside,
    show_the_rig_over_it,
    see_the_error_in_the_timeline,
    click_a_bone_for_its_partition,
)
