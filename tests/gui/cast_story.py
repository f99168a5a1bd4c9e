# SPDX-License-Identifier: GPL-3.0-or-later
"""Several characters, other files and other folders: meshes that are recorded and trained together, appended
characters, all in one go and back, trusted folders. A function a step, with its checks."""

import shutil
from collections.abc import Iterator
from pathlib import Path

import bpy
import numpy as np
import sidebar
from arm import (
    BLEND,
    EXTENSION,
    arm,
    armature,
    check_it_plays,
    distance_mm,
    emptied,
    job_done,
    look_at,
    open_in,
    part,
    shape,
)
from window import (
    below_mouse,
    browsers,
    check,
    click,
    main_screen,
    main_window,
    move,
    over,
    picture,
    press,
    redraw,
    rest_mouse,
    settle,
    until,
)


def open_the_bound_file(folder: Path) -> Iterator[float]:
    """Open the file of the path."""
    yield from open_in(folder / "work" / "cast", folder)
    yield from sidebar.show()


def make_several_models_together(folder: Path) -> Iterator[float]:
    """Two meshes, the armature active, in pose mode: Record, Train and Bind work on both, no mesh is selected."""
    own = emptied(folder / "work" / "several")
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
    done = [read(own / f"{name}_recording")["complete"] for name in ("arm", "arm_sleeve")]
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


def cancel_all_in_one(folder: Path) -> Iterator[float]:
    """Record, Train & Bind on a new arm: a bar counts the poses; ESC ends it, and the rig is as before."""
    own = emptied(folder / "work" / "cancelled")
    bpy.ops.wm.read_homefile(app_template="", load_ui=False)
    yield 0.5
    bpy.ops.fdda.add_sample_arm(density="1")
    # ESC cancels while the job changes the scene, so it needs many poses to still run when the picture is taken.
    arm().fdda.settings.poses = 10_000
    bpy.ops.wm.save_as_mainfile(filepath=str(own / BLEND))
    before, job = shape(), part("jobs.job")
    yield from sidebar.show()
    yield from sidebar.open_section("rig")
    yield from sidebar.push("fdda.build_model")
    yield from until(
        lambda: job.state_of("build_model") and job.state_of("build_model").done > 5, 60, "nothing is done"
    )
    yield from picture(folder / "build_model.png")
    check(job.state_of("build_model").total, "there is no bar")
    yield from rest_mouse()
    yield from press("Escape")
    yield from until(lambda: not job.state_of("build_model").is_running, 20, "ESC does not end it")
    said = job.state_of("build_model").outcome
    check("Canceled" in said, f"it says '{said}'")
    check(not arm().fdda.is_bound and np.allclose(shape(), before, atol=1e-6), "the arm is not as before")


def trust_a_folder(folder: Path) -> Iterator[float]:
    """In the preferences: press Add Folder…, choose it, and a model in it is followed from a file elsewhere."""
    preferences = bpy.context.preferences.addons[EXTENSION].preferences
    trusted = emptied(folder / "work" / "trusted")
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
    check(part("scene.folder_trust").is_trusted(trusted / "arm.onnx"), "a model in it is not trusted")
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
    elsewhere = emptied(folder / "work" / "follows")
    bpy.ops.wm.save_as_mainfile(filepath=str(elsewhere / BLEND))
    bpy.ops.wm.open_mainfile(filepath=str(elsewhere / BLEND), load_ui=False)
    yield 1.0
    check_it_plays()


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
    make_several_models_together,
    append_the_characters,
    cancel_all_in_one,
    trust_a_folder,
)
