# SPDX-License-Identifier: GPL-3.0-or-later
"""Story: several meshes, other files and other folders. Each function is a step.

Two meshes are recorded and trained together, characters are appended to another file, Record, Train & Bind is canceled,
and a folder is added to the trusted ones.
"""

import shutil
from collections.abc import Iterator
from pathlib import Path

import bpy
import numpy as np
import sidebar
from arm import (
    BLEND_FILE_NAME,
    EXTENSION,
    arm_object,
    arm_positions,
    armature_object,
    check_model_plays,
    extension_module,
    frame_object,
    make_empty_folder,
    mean_distance_mm,
    open_copy_in,
    show_preferences,
    wait_for_job,
)
from window import (
    click,
    describe_button_below_mouse,
    file_browser_count,
    main_screen,
    main_window,
    move_mouse,
    park_mouse,
    press_keys,
    redraw_window,
    region_override,
    require,
    save_screenshot,
    wait_for_events,
    wait_until,
)


def open_the_bound_file(folder: Path) -> Iterator[float]:
    """Open a copy of the file with the bound model."""
    yield from open_copy_in(folder / "work" / "cast", folder)
    yield from sidebar.open_tab()


def make_models_of_two_meshes_together(folder: Path) -> Iterator[float]:
    """In Pose Mode, with no mesh selected, press Record, Train and Bind: each works on both meshes of the armature."""
    folder_of_file = make_empty_folder(folder / "work" / "several")
    bpy.ops.fdda.unbind(object="arm")
    arm_object().fdda.models.clear()
    sleeve = arm_object().copy()
    sleeve.name, sleeve.data = "sleeve", arm_object().data.copy()
    bpy.context.scene.collection.objects.link(sleeve)
    for mesh_object in (arm_object(), sleeve):
        mesh_object.fdda.settings.poses, mesh_object.fdda.settings.epochs = 40, 15
        mesh_object.fdda.settings.recording = mesh_object.fdda.settings.model = ""
    bpy.ops.wm.save_as_mainfile(filepath=str(folder_of_file / BLEND_FILE_NAME))
    with region_override("WINDOW"):
        bpy.ops.object.select_all(action="DESELECT")
        bpy.context.view_layer.objects.active = armature_object()
        armature_object().select_set(True)
        bpy.ops.object.mode_set(mode="POSE")
    yield 1.0
    yield from sidebar.open_section("recording")
    yield from sidebar.press_button("fdda.record(")
    yield from wait_for_job("record", 120)
    read_index = extension_module("core.recording.index").read_index
    indices = [read_index(folder_of_file / f"{name}_recording") for name in ("arm", "arm_sleeve")]
    pose_counts = [index["sampling"]["sources"][0]["poses"] for index in indices]
    require(pose_counts == [40, 40], f"{pose_counts} random poses are recorded")
    yield from sidebar.open_section("training")
    yield from sidebar.press_button("fdda.train(")
    yield from wait_for_job("train", 180)
    yield from sidebar.open_section("playback")
    yield from save_screenshot(folder / "several_to_bind.png")
    yield from sidebar.press_button("fdda.bind(")
    bindings = (arm_object().fdda, bpy.data.objects["sleeve"].fdda)
    yield from wait_until(
        lambda: all(b.is_bound and b.mode == "FDDA" for b in bindings), 20, "the meshes are not both bound"
    )
    yield from save_screenshot(folder / "several.png")
    with region_override("WINDOW"):
        bpy.ops.object.mode_set(mode="OBJECT")
    bpy.ops.wm.save_mainfile()


def append_the_characters(folder: Path) -> Iterator[float]:
    """Append the characters to a new file: their models are appended and play, without helper objects."""
    source = folder / "work" / "several" / BLEND_FILE_NAME
    bpy.ops.wm.read_homefile(app_template="", load_ui=False)
    yield 0.5
    with region_override("WINDOW"):
        bpy.ops.wm.append(
            directory=f"{source}/Object/", filename="arm", files=[{"name": name} for name in ("arm", "sleeve")]
        )
    yield 1.5
    names = sorted(o.name for o in bpy.context.scene.objects)
    require(names == ["Camera", "Cube", "Light", "arm", "arm_rig", "sleeve"], f"the scene has {names}")
    for name in ("arm", "sleeve"):
        binding = bpy.data.objects[name].fdda
        require(binding.mode == "FDDA" and not binding.status, f"'{name}' plays {binding.mode}: {binding.status}")
        require(binding.packed is not None, f"the model of '{name}' was not appended")
    bpy.data.objects["Cube"].hide_set(True)
    frame_object(arm_object())
    armature_object().pose.bones[2].rotation_mode = "XYZ"
    rest_positions = arm_positions(1)
    armature_object().pose.bones[2].rotation_euler[0] += 0.4
    bpy.context.view_layer.update()
    mesh = arm_object().evaluated_get(bpy.context.evaluated_depsgraph_get()).data
    posed_positions = np.empty_like(rest_positions)
    mesh.attributes["position"].data.foreach_get("vector", posed_positions.reshape(-1))
    require(mean_distance_mm(posed_positions, rest_positions) > 1, "the appended arm does not follow its armature")
    yield from sidebar.open_tab()
    yield from save_screenshot(folder / "appended.png")


def cancel_record_train_and_bind(folder: Path) -> Iterator[float]:
    """Press Record, Train & Bind on a new arm, then ESC: the job shows a progress bar, and the rig is restored."""
    folder_of_file = make_empty_folder(folder / "work" / "cancelled")
    bpy.ops.wm.read_homefile(app_template="", load_ui=False)
    yield 0.5
    bpy.ops.fdda.add_sample_arm(density="1")
    # ESC cancels while the job changes the scene, so it needs many poses to still run when the picture is taken.
    arm_object().fdda.settings.poses = 10_000
    bpy.ops.wm.save_as_mainfile(filepath=str(folder_of_file / BLEND_FILE_NAME))
    initial_positions, job = arm_positions(), extension_module("jobs.job")
    yield from sidebar.open_tab()
    yield from sidebar.open_section("rig")
    yield from sidebar.press_button("fdda.build_model")
    yield from wait_until(
        lambda: job.state_of("build_model") and job.state_of("build_model").done > 5, 60, "there is no progress"
    )
    yield from save_screenshot(folder / "build_model.png")
    require(job.state_of("build_model").total, "there is no progress bar")
    yield from park_mouse()
    yield from press_keys("Escape")
    yield from wait_until(lambda: not job.state_of("build_model").is_running, 20, "ESC does not end the job")
    outcome = job.state_of("build_model").outcome
    require("Canceled" in outcome, f"the outcome is '{outcome}'")
    require(
        not arm_object().fdda.is_bound and np.allclose(arm_positions(), initial_positions, atol=1e-6),
        "the arm is not as before",
    )


def trust_a_folder(folder: Path) -> Iterator[float]:
    """Add a trusted folder in the preferences: a file in another folder then loads a model from it."""
    preferences = bpy.context.preferences.addons[EXTENSION].preferences
    trusted_folder = make_empty_folder(folder / "work" / "trusted")
    area = next(a for a in main_screen().areas if a.type == "VIEW_3D")
    yield from show_preferences(area)
    yield 0.5
    yield from save_screenshot(folder / "preferences.png")
    preferences_region = next(r for r in area.regions if r.type == "WINDOW")
    button_position = yield from _find_button_in_region(area, preferences_region, "fdda.add_trusted_folder")
    yield from click(*button_position)
    yield from wait_until(file_browser_count, 5, "the button opens no file browser")
    browser = next(a for a in main_screen().areas if a.type == "FILE_BROWSER")
    browser.spaces.active.params.directory = str(trusted_folder).encode()
    yield 0.5
    yield from save_screenshot(folder / "choose_folder.png")
    move_mouse(main_window().width / 2, main_window().height / 2)
    yield from wait_for_events()
    with bpy.context.temp_override(
        window=main_window(), area=browser, region=next(r for r in browser.regions if r.type == "WINDOW")
    ):
        bpy.ops.file.execute()
    yield from wait_until(lambda: len(preferences.folders) == 1, 5, "no folder is trusted")
    require(
        extension_module("scene.folder_trust").is_trusted(trusted_folder / "arm.onnx"), "a model in it is not trusted"
    )
    area = next(a for a in main_screen().areas if a.type == "PREFERENCES")
    yield from redraw_window()
    yield from save_screenshot(folder / "trusted.png")
    area.type = "VIEW_3D"
    yield 0.5
    shutil.copy(folder / "work" / "arm_model" / "arm.away", trusted_folder / "arm.onnx")
    bpy.ops.wm.open_mainfile(filepath=str(folder / "work" / BLEND_FILE_NAME), load_ui=False)
    yield 1.0
    preferences.pack_models = False
    bpy.ops.fdda.unbind(object="arm")
    arm_object().fdda.models.clear()
    bpy.ops.fdda.bind(object="arm", filepath=str(trusted_folder / "arm.onnx"))
    require(arm_object().fdda.packed is None, "the model was packed")
    other_folder = make_empty_folder(folder / "work" / "follows")
    bpy.ops.wm.save_as_mainfile(filepath=str(other_folder / BLEND_FILE_NAME))
    bpy.ops.wm.open_mainfile(filepath=str(other_folder / BLEND_FILE_NAME), load_ui=False)
    yield 1.0
    check_model_plays()


def _find_button_in_region(area: bpy.types.Area, region: bpy.types.Region, operator_name: str) -> Iterator[float]:
    """Move the mouse down a region until it is over a button; return the position of the button in the window."""
    for relative_x in (0.5, 0.3):
        for step in range(region.height // 12):
            x, y = region.x + relative_x * region.width, region.y + region.height - 12 * step
            move_mouse(x, y)
            yield from wait_for_events()
            with bpy.context.temp_override(window=main_window(), area=area, region=region):
                description = describe_button_below_mouse()
            if operator_name in description:
                return x, y
    require(False, f"there is no button {operator_name}")


STEPS = (
    open_the_bound_file,
    make_models_of_two_meshes_together,
    append_the_characters,
    cancel_record_train_and_bind,
    trust_a_folder,
)
