# SPDX-License-Identifier: GPL-3.0-or-later
"""What a shot takes besides: masks, the rig beside the model, ranges of people, a character that is appended, several
meshes that are recorded and trained together, trusted folders. A function a step, with its checks."""

import shutil
from collections.abc import Iterator
from pathlib import Path

import bpy
import numpy as np
import sidebar
from path_story import BLEND, EXTENSION, FRAME, arm, distance_mm, job_done, main_screen, part, shape
from window import (
    below_mouse,
    button,
    check,
    click,
    main_window,
    move,
    over,
    picture,
    pixels,
    press,
    redraw,
    region,
    rest_mouse,
    settle,
    until,
    view_area,
)
from work_story import armature, browsers

GROUP = "learned"
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


def open_the_bound_file(folder: Path) -> Iterator[float]:
    """Open the file of the path, look at the arm, and at its hand on."""
    own = folder / "work" / "shot"
    own.mkdir(exist_ok=True)
    shutil.copy(folder / "work" / BLEND, own / BLEND)
    bpy.ops.wm.open_mainfile(filepath=str(own / BLEND), load_ui=False)
    yield 1.0
    check(arm().fdda.mode == "FDDA" and not arm().fdda.status, f"it plays {arm().fdda.mode}: {arm().fdda.status}")
    look_at(arm())
    yield from sidebar.show()


def look_at(mesh_object: bpy.types.Object, times: float = 1.0) -> None:
    """Make an object the active one, and have it fill the view, or a part of it."""
    with over("WINDOW"):
        bpy.ops.object.select_all(action="DESELECT")
        mesh_object.select_set(True)
        bpy.context.view_layer.objects.active = mesh_object
        bpy.ops.view3d.view_selected()
    view_area().spaces[0].region_3d.view_distance *= times


def choose_a_mask(folder: Path) -> Iterator[float]:
    """Click the field Mask, type the name of a vertex group: below the elbow there is the linear layer."""
    binding = arm().fdda
    model = shape()
    binding.mode = "LINEAR"
    linear = shape()
    binding.mode = "FDDA"
    along = np.array([vertex.co.x for vertex in arm().data.vertices])
    weights = along < np.median(along)
    arm().vertex_groups.new(name=GROUP).add(np.flatnonzero(weights).tolist(), 1.0, "REPLACE")
    yield from sidebar.open_section("playback")
    x, y = yield from sidebar.find("fdda.mask", across=0.7)
    yield from click(x, y)
    yield 0.5
    yield from press(*GROUP)
    yield 0.3
    yield from picture(folder / "mask_search.png")
    yield from press("Return")
    yield from until(lambda: binding.mask == GROUP, 5, f"the field has '{binding.mask}'")
    expected = np.where(weights[:, None], model, linear)
    check(distance_mm(model, linear) > 0.5, "model and linear layer are the same here")
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
    unified.size, unified.weight = 200, 0.5
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
    yield from sidebar.push("fdda.compare(way='BESIDE')", across=0.5)
    yield from until(lambda: side.find(arm()) is not None, 5, "the button shows no rig")
    look_at(arm(), 1.8)
    yield 0.5
    yield from picture(folder / "beside.png")
    before = _place_of_rig()
    yield from rest_mouse()
    bpy.context.scene.frame_set(1)
    yield from press("space")
    yield from until(lambda: main_screen().is_animation_playing, 5, "the space bar does not play the action")
    yield from until(lambda: bpy.context.scene.frame_current > 40, 30, "the action does not go on")
    yield from press("space")
    yield from until(lambda: not main_screen().is_animation_playing, 5, "the space bar does not stop the action")
    check(distance_mm(_place_of_rig(), before) > 1, "the rig beside does not move")
    check(not arm().fdda.status, f"the model was switched off: {arm().fdda.status}")


def _place_of_rig() -> np.ndarray:
    other = part("evaluation.side_by_side").find(arm())
    mesh = other.evaluated_get(bpy.context.evaluated_depsgraph_get()).data
    positions = np.empty((len(mesh.vertices), 3), np.float32)
    mesh.attributes["position"].data.foreach_get("vector", positions.reshape(-1))
    return positions


def show_the_rig_over_it(folder: Path) -> Iterator[float]:
    """Press Overlay, and Off."""
    side = part("evaluation.side_by_side")
    bpy.context.scene.frame_set(FRAME)
    yield from sidebar.push("fdda.compare(way='OVERLAY')", across=0.85)
    yield from until(lambda: side.way_of(arm()) == "OVERLAY", 5, "the button shows no overlay")
    look_at(arm())
    yield 0.5
    yield from picture(folder / "overlay.png")
    yield from sidebar.push("fdda.compare(way='NONE')", across=0.15)
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
    rig = part("scene.active_rig").shown_rig(bpy.context)
    shown = part("panels.evaluation").active_bone_name(bpy.context, rig)
    check(shown == "elbow", f"the table has '{shown}' on top")
    with over("WINDOW"):
        bpy.ops.object.mode_set(mode="OBJECT")
    look_at(arm())


def make_several_models_together(folder: Path) -> Iterator[float]:
    """Two meshes, the armature active, in pose mode: Record, Train and Bind work on both, no mesh is selected."""
    own = folder / "work" / "several"
    own.mkdir(exist_ok=True)
    bpy.ops.fdda.unbind(object="arm")
    arm().fdda.models.clear()
    sleeve = arm().copy()
    sleeve.name, sleeve.data = "sleeve", arm().data.copy()
    bpy.context.scene.collection.objects.link(sleeve)
    for each in (arm(), sleeve):
        each.fdda.settings.poses, each.fdda.settings.epochs = 40, 15
        each.fdda.settings.recording = each.fdda.settings.model = ""
    bpy.ops.wm.save_as_mainfile(filepath=str(own / BLEND))
    with over("WINDOW"):
        bpy.ops.object.select_all(action="DESELECT")
        bpy.context.view_layer.objects.active = armature()
        armature().select_set(True)
        bpy.ops.object.mode_set(mode="POSE")
    yield 1.0
    yield from sidebar.open_section("recording")
    yield from sidebar.push("fdda.record(")
    yield from job_done("record", 120)
    read = part("core.recording.index").read_index
    done = [read(own / f"{name}_recording")["complete"] for name in ("arm", "sleeve")]
    check(done == [40, 40], f"{done} poses are recorded")
    yield from sidebar.open_section("training")
    yield from sidebar.push("fdda.train(")
    yield from job_done("train", 180)
    yield from sidebar.open_section("playback")
    yield from picture(folder / "several_to_bind.png")
    yield from sidebar.push("fdda.bind(")
    both = (arm().fdda, bpy.data.objects["sleeve"].fdda)
    yield from until(lambda: all(b.is_bound and b.mode == "FDDA" for b in both), 20, "not both are bound")
    yield from picture(folder / "several.png")
    with over("WINDOW"):
        bpy.ops.object.mode_set(mode="OBJECT")
    bpy.ops.wm.save_mainfile()


def append_the_characters(folder: Path) -> Iterator[float]:
    """A new file, Append: the models come along and play, and nothing of ours shows."""
    source = folder / "work" / "several" / BLEND
    bpy.ops.wm.read_homefile(app_template="", load_ui=False)
    yield 0.5
    with over("WINDOW"):
        bpy.ops.wm.append(
            directory=f"{source}/Object/", filename="arm", files=[{"name": name} for name in ("arm", "sleeve")]
        )
    yield 1.5
    names = sorted(o.name for o in bpy.context.scene.objects)
    check(names == ["Camera", "Cube", "Light", "arm", "arm_rig", "sleeve"], f"the scene has {names}")
    for name in ("arm", "sleeve"):
        binding = bpy.data.objects[name].fdda
        check(binding.mode == "FDDA" and not binding.status, f"'{name}' plays {binding.mode}: {binding.status}")
        check(binding.packed is not None, f"the model of '{name}' has not come along")
    bpy.data.objects["Cube"].hide_set(True)
    look_at(arm())
    armature().pose.bones[2].rotation_mode = "XYZ"
    before = shape(1)
    armature().pose.bones[2].rotation_euler[0] += 0.4
    bpy.context.view_layer.update()
    mesh = arm().evaluated_get(bpy.context.evaluated_depsgraph_get()).data
    moved = np.empty_like(before)
    mesh.attributes["position"].data.foreach_get("vector", moved.reshape(-1))
    check(distance_mm(moved, before) > 1, "the appended arm does not follow its armature")
    yield from sidebar.show()
    yield from picture(folder / "appended.png")


def give_a_figure_human_ranges(folder: Path) -> Iterator[float]:
    """A figure with limbs that states no limits, as it says; press Human Ranges."""
    bpy.ops.wm.read_homefile(app_template="", load_ui=False)
    yield 0.5
    bpy.data.objects.remove(bpy.data.objects["Cube"])
    _build_figure()
    look_at(bpy.data.objects["figure"])
    yield from sidebar.show()
    yield 1.0
    yield from sidebar.open_section("poses")
    yield from picture(folder / "no_limits.png")
    yield from sidebar.push("fdda.limits_preset(")
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
    """Another range for one forearm: press Mirror, and the other has it; press Copy, and the upper arm has it too."""
    compatibility = part("scene.compatibility")
    bones, session = bpy.data.objects["figure_rig"].pose.bones, bpy.context.window_manager.fdda
    left, right, upper = bones["forearm.L"], bones["forearm.R"], bones["upper_arm.L"]
    ranges = part("poses.motion_range")
    for axis in range(3):
        left.lock_rotation[axis] = right.lock_rotation[axis] = False
    ranges.state_rotation_range(left, 0, -0.25, 0.5)
    for bone in bones:
        compatibility.select_bone(bone, bone == left)
    session.joint_index = bones.find(left.name)
    yield from redraw()
    yield from sidebar.open_section("poses")
    yield from sidebar.push("fdda.mirror_ranges(", across=0.8)
    yield from until(lambda: abs(_width(right, ranges) - 0.75) < 0.01, 5, "the other forearm has not the range")
    compatibility.select_bone(upper, True)
    yield from redraw()
    yield from picture(folder / "ranges.png")
    yield from sidebar.push("fdda.copy_ranges(", across=0.25)
    yield from until(lambda: abs(_width(upper, ranges) - 0.75) < 0.01, 5, "the upper arm has not the range")


def _width(bone: bpy.types.PoseBone, ranges: object) -> float:
    found = ranges.rotation_ranges(bone)[0]
    return found.high - found.low


def cancel_all_in_one(folder: Path) -> Iterator[float]:
    """Prepare, Train, Bind on a new arm: a bar counts the poses; ESC ends it, and the rig is as before."""
    own = folder / "work" / "cancelled"
    own.mkdir(exist_ok=True)
    bpy.ops.wm.read_homefile(app_template="", load_ui=False)
    yield 0.5
    bpy.ops.fdda.add_arm(density="1")
    bpy.ops.wm.save_as_mainfile(filepath=str(own / BLEND))
    before, job = shape(), part("jobs.job")
    yield from sidebar.show()
    yield from sidebar.open_section("rig")
    yield from sidebar.push("fdda.make_model")
    yield from until(lambda: job.state_of("make_model") and job.state_of("make_model").done > 5, 60, "nothing is done")
    yield from picture(folder / "one_go.png")
    check(job.state_of("make_model").total, "there is no bar")
    yield from rest_mouse()
    yield from press("Escape")
    yield from until(lambda: not job.state_of("make_model").is_running, 20, "ESC does not end it")
    said = job.state_of("make_model").outcome
    check("Cancelled" in said, f"it says '{said}'")
    check(not arm().fdda.is_bound and np.allclose(shape(), before, atol=1e-6), "the arm is not as before")


def trust_a_folder(folder: Path) -> Iterator[float]:
    """In the preferences: press Trust a Folder…, choose it, and a model in it is followed from a file elsewhere."""
    preferences = bpy.context.preferences.addons[EXTENSION].preferences
    trusted = folder / "work" / "trusted"
    trusted.mkdir(exist_ok=True)
    area = next(a for a in main_screen().areas if a.type == "VIEW_3D")
    area.type = "PREFERENCES"
    bpy.context.preferences.active_section = "ADDONS"
    bpy.context.window_manager.addon_search = "FDDA"
    import addon_utils

    module = next(m for m in addon_utils.modules() if m.__name__ == EXTENSION)
    addon_utils.module_bl_info(module)["show_expanded"] = True
    yield from redraw()
    yield 0.5
    yield from picture(folder / "preferences.png")
    inside = next(r for r in area.regions if r.type == "WINDOW")
    place = yield from _find_in(area, inside, "fdda.add_trusted_folder")
    yield from click(*place)
    yield from until(browsers, 5, "the button opens no file browser")
    browser = next(a for a in main_screen().areas if a.type == "FILE_BROWSER")
    browser.spaces.active.params.directory = str(trusted).encode()
    yield 0.5
    yield from picture(folder / "choose_folder.png")
    move(main_window().width / 2, main_window().height / 2)
    yield from settle()
    with bpy.context.temp_override(
        window=main_window(), area=browser, region=next(r for r in browser.regions if r.type == "WINDOW")
    ):
        bpy.ops.file.execute()
    yield from until(lambda: len(preferences.folders) == 1, 5, "no folder is trusted")
    check(part("scene.model_trust").is_trusted(trusted / "arm.onnx"), "a model in it is not trusted")
    area = next(a for a in main_screen().areas if a.type == "PREFERENCES")
    yield from redraw()
    yield from picture(folder / "trusted.png")
    area.type = "VIEW_3D"
    yield 0.5
    shutil.copy(folder / "work" / "arm_model" / "arm.away", trusted / "arm.onnx")
    bpy.ops.wm.open_mainfile(filepath=str(folder / "work" / BLEND), load_ui=False)
    yield 1.0
    preferences.pack_models = False
    bpy.ops.fdda.unbind(object="arm")
    arm().fdda.models.clear()
    bpy.ops.fdda.bind(object="arm", filepath=str(trusted / "arm.onnx"))
    check(arm().fdda.packed is None, "the model was packed")
    elsewhere = folder / "work" / "follows"
    elsewhere.mkdir(exist_ok=True)
    bpy.ops.wm.save_as_mainfile(filepath=str(elsewhere / BLEND))
    bpy.ops.wm.open_mainfile(filepath=str(elsewhere / BLEND), load_ui=False)
    yield 1.0
    check(arm().fdda.mode == "FDDA" and not arm().fdda.status, f"it plays {arm().fdda.mode}: {arm().fdda.status}")


def _find_in(area: bpy.types.Area, inside: bpy.types.Region, what: str) -> Iterator[float]:
    """Move the mouse down a region onto a button; returns its place in the window."""
    for across in (0.5, 0.3):
        for step in range(inside.height // 12):
            x, y = inside.x + across * inside.width, inside.y + inside.height - 12 * step
            move(x, y)
            yield from settle()
            with bpy.context.temp_override(window=main_window(), area=area, region=inside):
                found = below_mouse()
            if what in found:
                return x, y
    check(False, f"there is no button {what}")


STEPS = (
    open_the_bound_file,
    choose_a_mask,
    paint_the_mask,
    show_the_rig_beside,
    show_the_rig_over_it,
    see_the_error_in_the_timeline,
    click_a_bone_for_its_partition,
    make_several_models_together,
    append_the_characters,
    give_a_figure_human_ranges,
    mirror_and_copy_ranges,
    cancel_all_in_one,
    trust_a_folder,
)
