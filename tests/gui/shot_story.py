# SPDX-License-Identifier: GPL-3.0-or-later
"""Story: masks, the rig next to and over the model, and its errors in the timeline. Each function is a step."""

from collections.abc import Iterator
from pathlib import Path

import bpy
import numpy as np
import sidebar
from arm import (
    BENT_FRAME,
    arm_object,
    arm_positions,
    armature_object,
    check_model_plays,
    evaluated_positions,
    extension_module,
    frame_object,
    mean_distance_mm,
    open_copy_in,
    wait_for_job,
)
from window import (
    click,
    main_screen,
    move_mouse,
    park_mouse,
    press_keys,
    press_mouse_button,
    read_pixels,
    redraw_window,
    region_override,
    require,
    save_screenshot,
    start_playback,
    stop_playback,
    view_area,
    view_region,
    wait_for_events,
    wait_until,
)

GROUP_NAME = "learned"


def open_the_bound_file(folder: Path) -> Iterator[float]:
    """Open a copy of the file with the bound model."""
    yield from open_copy_in(folder / "work" / "shot", folder)
    yield from sidebar.open_tab()


def bind_again_after_the_modifier_was_removed(folder: Path) -> Iterator[float]:
    """Remove the modifier FDDA, as its X in the Properties editor does: Bind Again brings it back."""
    with region_override("WINDOW"):
        bpy.ops.object.modifier_remove(modifier="FDDA")
    yield from wait_until(lambda: arm_object().fdda.status, 5, "nothing says that the modifier is gone")
    yield from sidebar.open_section("playback")
    yield from save_screenshot(folder / "modifier_removed.png")
    yield from sidebar.press_button("fdda.bind(", across=0.75)
    yield from wait_until(lambda: arm_object().fdda.mode == "FDDA", 10, "Bind Again does not bind")
    check_model_plays()


def choose_a_mask(folder: Path) -> Iterator[float]:
    """Type the name of a vertex group into the field Mask: vertices outside the group have linear skinning."""
    binding = arm_object().fdda
    model_positions = arm_positions()
    binding.mode = "LINEAR"
    linear_positions = arm_positions()
    binding.mode = "FDDA"
    x_coordinates = np.array([vertex.co.x for vertex in arm_object().data.vertices])
    is_in_group = x_coordinates < np.median(x_coordinates)
    arm_object().vertex_groups.new(name=GROUP_NAME).add(np.flatnonzero(is_in_group).tolist(), 1.0, "REPLACE")
    yield from sidebar.open_section("playback")
    yield from sidebar.open_subpanel("fdda.unbind", "fdda.mask", across=0.7)
    yield from sidebar.type_into_search_field("fdda.mask", GROUP_NAME)
    yield from save_screenshot(folder / "mask_search.png")
    yield from press_keys("Return")
    yield from wait_until(lambda: binding.mask == GROUP_NAME, 5, f"the field has '{binding.mask}'")
    masked_positions = np.where(is_in_group[:, None], model_positions, linear_positions)
    require(mean_distance_mm(model_positions, linear_positions) > 0.5, "model and linear skinning give the same shape")
    require(
        np.allclose(arm_positions(), masked_positions, atol=1e-6), "the shape does not follow the weights of the mask"
    )
    yield from sidebar.press_button("fdda.invert_mask", across=0.99)
    yield from wait_until(lambda: binding.invert_mask, 5, "the arrows do not invert the mask")
    require(
        np.allclose(arm_positions(), np.where(is_in_group[:, None], linear_positions, model_positions), atol=1e-6),
        "the shape does not follow the inverted mask",
    )
    yield from save_screenshot(folder / "mask.png")


def paint_the_mask(folder: Path) -> Iterator[float]:
    """Paint weights of the mask with the mouse: the shape changes."""
    arm_object().vertex_groups.active = arm_object().vertex_groups[GROUP_NAME]
    initial_positions = arm_positions()
    with region_override("WINDOW"):
        bpy.ops.object.mode_set(mode="WEIGHT_PAINT")
    yield 0.5
    paint = bpy.context.tool_settings.weight_paint
    # Before Blender 5 these settings belong to the scene.
    brush_settings = getattr(paint, "unified_paint_settings", None) or bpy.context.tool_settings.unified_paint_settings
    brush_settings.size = 200
    brush_settings.weight = paint.brush.weight = 0.5
    view, mask_module = view_region("WINDOW"), extension_module("scene.mask")
    initial_weights = mask_module.read_mask(arm_object()).weights
    for height in (0.4, 0.5, 0.6):
        for step in range(10):
            move_mouse(view.x + view.width * (0.2 + 0.05 * step), view.y + view.height * height)
            yield from wait_for_events()
            if step == 0:
                press_mouse_button("mousedown")
            yield 0.05
        press_mouse_button("mouseup")
        yield 0.3
    yield 0.5
    yield from save_screenshot(folder / "mask_painted.png")
    with region_override("WINDOW"):
        bpy.ops.object.mode_set(mode="OBJECT")
    yield 0.3
    require(
        arm_object().fdda.mode == "FDDA" and not arm_object().fdda.status,
        f"painting has switched it off: {arm_object().fdda.status}",
    )
    weights = extension_module("scene.mask").read_mask(arm_object()).weights
    require(np.abs(weights - initial_weights).max() > 0.1, "the strokes have painted nothing")
    require(mean_distance_mm(arm_positions(), initial_positions) > 1e-3, "the painted weights do not change the shape")
    arm_object().fdda.mask = ""
    yield 0.2


def show_the_rig_beside(folder: Path) -> Iterator[float]:
    """Press Beside: the rig is shown next to the model, and moves as the action plays."""
    side_by_side = extension_module("evaluation.side_by_side")
    yield from sidebar.open_section("evaluation")
    yield from sidebar.press_button("placement='BESIDE'", across=0.5)
    yield from wait_until(lambda: side_by_side.find(arm_object()) is not None, 5, "the button shows no rig")
    frame_object(arm_object(), 1.8)
    yield 0.5
    yield from save_screenshot(folder / "beside.png")
    initial_positions = evaluated_positions(extension_module("evaluation.side_by_side").find(arm_object()))
    yield from park_mouse()
    bpy.context.scene.frame_set(1)
    yield from start_playback()
    yield from wait_until(lambda: bpy.context.scene.frame_current > 10, 120, "the action does not go on")
    yield from stop_playback()
    require(
        mean_distance_mm(
            evaluated_positions(extension_module("evaluation.side_by_side").find(arm_object())), initial_positions
        )
        > 1,
        "the rig beside does not move",
    )
    require(not arm_object().fdda.status, f"the model was switched off: {arm_object().fdda.status}")


def show_the_rig_as_overlay(folder: Path) -> Iterator[float]:
    """Press Overlay, then Off."""
    side_by_side = extension_module("evaluation.side_by_side")
    bpy.context.scene.frame_set(BENT_FRAME)
    yield from sidebar.press_button("placement='OVERLAY'", across=0.85)
    yield from wait_until(
        lambda: side_by_side.display_mode(arm_object()) == "OVERLAY", 5, "the button shows no overlay"
    )
    frame_object(arm_object())
    yield 0.5
    yield from save_screenshot(folder / "overlay.png")
    yield from sidebar.press_button("placement='NONE'", across=0.15)
    yield from wait_until(lambda: side_by_side.find(arm_object()) is None, 5, "the button does not hide the rig")


def show_the_error_in_the_timeline(folder: Path) -> Iterator[float]:
    """Press Evaluate: the timeline shows a graph of the error; its checkbox hides the graph."""
    bpy.context.scene.frame_set(BENT_FRAME)
    yield from sidebar.press_button("fdda.evaluate(")
    yield from wait_for_job("evaluate", 90)
    yield from park_mouse()
    with_graph = folder / "timeline.png"
    yield from save_screenshot(with_graph)
    red_pixels_with_graph = _count_red_pixels_in_timeline(with_graph)
    yield from sidebar.press_button("fdda_view.graph", across=0.4)
    view = bpy.context.window_manager.fdda_view
    yield from wait_until(lambda: not view.graph, 5, "the checkbox does not hide the graph")
    yield from park_mouse()
    without_graph = folder / "timeline_plain.png"
    yield from save_screenshot(without_graph)
    red_pixels_without_graph = _count_red_pixels_in_timeline(without_graph)
    require(
        red_pixels_with_graph > 200 and red_pixels_without_graph < red_pixels_with_graph / 10,
        f"with the graph {red_pixels_with_graph} pixels of the timeline are red, without {red_pixels_without_graph}",
    )
    view.graph = True


def _count_red_pixels_in_timeline(path: Path) -> int:
    area = next(a for a in main_screen().areas if a.type == "DOPESHEET_EDITOR")
    timeline_pixels = read_pixels(path)[area.y : area.y + area.height, area.x : area.x + area.width]
    return int(
        (
            (timeline_pixels[..., 0] > timeline_pixels[..., 2] + 0.15)
            & (timeline_pixels[..., 0] > timeline_pixels[..., 1] + 0.1)
        ).sum()
    )


def click_a_bone_to_show_its_body_part(folder: Path) -> Iterator[float]:
    """Click the elbow in Pose Mode: its body part is the first of the table."""
    from bpy_extras.view3d_utils import location_3d_to_region_2d

    frame_object(arm_object())
    with region_override("WINDOW"):
        bpy.context.view_layer.objects.active = armature_object()
        armature_object().select_set(True)
        bpy.ops.object.mode_set(mode="POSE")
    yield 0.5
    view, bone = view_region("WINDOW"), armature_object().pose.bones["elbow"]
    bone_center = armature_object().matrix_world @ ((bone.head + bone.tail) / 2)
    x, y = location_3d_to_region_2d(view, view_area().spaces[0].region_3d, bone_center)
    yield from click(view.x + x, view.y + y)
    yield from wait_until(
        lambda: armature_object().data.bones.active is not None and armature_object().data.bones.active.name == "elbow",
        5,
        f"the click chooses {armature_object().data.bones.active}",
    )
    yield from redraw_window()
    yield from save_screenshot(folder / "partition_of_bone.png")
    rig = extension_module("scene.active_rig").cached_active_rig(bpy.context)
    bone_name = extension_module("panels.evaluation").active_bone_name(bpy.context, rig)
    require(bone_name == "elbow", f"the table has '{bone_name}' on top")
    with region_override("WINDOW"):
        bpy.ops.object.mode_set(mode="OBJECT")
    frame_object(arm_object())


STEPS = (
    open_the_bound_file,
    bind_again_after_the_modifier_was_removed,
    choose_a_mask,
    paint_the_mask,
    show_the_rig_beside,
    show_the_rig_as_overlay,
    show_the_error_in_the_timeline,
    click_a_bone_to_show_its_body_part,
)
