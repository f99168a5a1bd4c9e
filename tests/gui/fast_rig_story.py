# SPDX-License-Identifier: GPL-3.0-or-later
"""Story: a fast rig is made, animated in a shot, and replaced by the full rig for rendering. Each function is a step.

The mouse presses all buttons. Blender's own operators link the collection and make the override, the key I inserts the
keyframes, and the context menu of the Outliner relocates the library.
"""

from collections.abc import Iterator
from pathlib import Path

import bpy
import numpy as np
import sidebar
from arm import (
    evaluated_positions,
    expected_positions,
    extension_module,
    frame_object,
    make_empty_folder,
    wait_for_job,
)
from window import (
    RIGHT_BUTTON,
    click,
    close_browser,
    file_browser_count,
    main_screen,
    park_mouse,
    press_keys,
    read_pixels,
    redraw_window,
    region_override,
    require,
    save_screenshot,
    wait_until,
)

from blend_fixtures.characters.dependencies import UNUSED, studio_arm

MESH, ARMATURE, CONTROL, CHARACTER = "elbow", "elbow_rig", "control", "Character"
POSES, EPOCHS = 30, 3
KEYS = {1: 0.0, 20: 0.5}
"""Rotation of the control about X in radians, by frame."""
FRAME = 15
USED = ("target", "ik", "action", "driven_influence")
"""Ways in which the joints depend on hidden bones. In a new library override, Blender disables drivers that find their
object by its name in the scene, so those are not among them."""
ROW_PIXELS = 20
"""Height of a row of the Outliner."""
MAX_DISTANCE = 1e-5
"""Largest distance between the mesh and the output of the model, meters."""

_expected_render: np.ndarray | None = None


def _select_control(armature_object: bpy.types.Object) -> Iterator[float]:
    """Select the control in Pose Mode, and no other bone."""
    with region_override("WINDOW"):
        bpy.ops.object.select_all(action="DESELECT")
        bpy.context.view_layer.objects.active = armature_object
        armature_object.select_set(True)
        bpy.ops.object.mode_set(mode="POSE")
    for bone in armature_object.pose.bones:
        extension_module("scene.compatibility").select_bone(bone, bone.name == CONTROL)
    yield from redraw_window()


def _leave_pose_mode() -> None:
    with region_override("WINDOW"):
        bpy.ops.object.mode_set(mode="OBJECT")


def save_the_full_rig(folder: Path) -> Iterator[float]:
    """Save the file of a rig whose joints depend on hidden bones."""
    bpy.ops.wm.read_homefile(app_template="", load_ui=False, use_empty=True)
    yield 0.5
    mesh_object, armature_object = studio_arm(*USED)
    armature_object.pose.bones[CONTROL].rotation_mode = "XYZ"
    character = bpy.data.collections.new(CHARACTER)
    for scene_object in list(bpy.context.scene.collection.objects):
        bpy.context.scene.collection.objects.unlink(scene_object)
        character.objects.link(scene_object)
    bpy.context.scene.collection.children.link(character)
    mesh_object.fdda.settings.poses, mesh_object.fdda.settings.epochs = POSES, EPOCHS
    bpy.ops.wm.save_as_mainfile(filepath=str(make_empty_folder(folder / "fast_rig") / "full.blend"))
    frame_object(mesh_object)
    yield from sidebar.open_tab()


def profile_a_frame(folder: Path) -> Iterator[float]:
    """Press Profile Frame: the section Rig says what a model and a fast rig would save."""
    yield from sidebar.open_section("rig")
    yield from sidebar.open_subpanel("fdda.measure(", "fdda.profile_frame")
    yield from save_screenshot(folder / "profile_opened.png")
    yield from sidebar.press_button("fdda.profile_frame")
    yield from wait_for_job("profile_frame", 90)
    yield from redraw_window()
    profile = extension_module("timing.measurements").last("profile_frame", bpy.data.objects[MESH].parent)
    saving = profile.fast_rig
    require(saving is not None, f"nothing says what a fast rig saves: {profile.fast_rig_problem}")
    require(saving.bones - saving.kept_bones == 2, f"it keeps {saving.kept_bones} bones")


def add_the_control_as_an_input(folder: Path) -> Iterator[float]:
    """Select the control, and press Add Bones as Controls in the section Training Poses."""
    yield from _select_control(bpy.data.objects[ARMATURE])
    settings = bpy.data.objects[MESH].fdda.settings
    yield from sidebar.open_section("poses")
    yield from sidebar.open_subpanel("fdda.rest_pose", "fdda.add_control_bones", across_above=0.85)
    yield from sidebar.press_button("fdda.add_control_bones")
    yield from wait_until(lambda: settings.controls, 5, "the button adds nothing")
    require(settings.controls.keys() == [f"bone:{CONTROL}"], f"the list has {settings.controls.keys()}")
    yield from redraw_window()
    yield from save_screenshot(folder / "control_added.png")
    _leave_pose_mode()
    frame_object(bpy.data.objects[MESH])


def record_train_and_bind(_folder: Path) -> Iterator[float]:
    yield from sidebar.open_section("rig")
    yield from sidebar.press_button("fdda.build_model")
    yield from wait_for_job("build_model", 120)
    binding = bpy.data.objects[MESH].fdda
    require(binding.mode == "FDDA" and not binding.status, f"it plays {binding.mode}: {binding.status}")
    bpy.ops.wm.save_mainfile()


def make_the_fast_rig(folder: Path) -> Iterator[float]:
    """Press Fast Rig…, and Return in the file browser: the file is written beside the open one, which stays."""
    yield from sidebar.open_section("playback")
    yield from sidebar.press_button("fdda.fast_rig")
    yield from wait_until(file_browser_count, 5, "the button opens no file browser")
    yield 0.5
    yield from save_screenshot(folder / "fast_rig_browser.png")
    yield from close_browser("Return")
    yield from wait_until(lambda: extension_module("jobs.job").current() is not None, 5, "Return starts no job")
    yield 1.0
    yield from save_screenshot(folder / "fast_rig_running.png")
    yield from wait_for_job("fast_rig", 120)
    outcome = extension_module("jobs.job").state_of("fast_rig").outcome
    require(outcome.startswith(f"full_fast.blend: '{ARMATURE}' has"), f"it reports '{outcome}'")
    require(Path(bpy.data.filepath).name == "full.blend", f"the open file is {bpy.data.filepath}")
    require((folder / "fast_rig" / "full_fast.blend").is_file(), "there is no full_fast.blend")


def _open_shot(library: Path) -> Iterator[float]:
    """Link the character of a file into a new shot, make an override, and key its control with the key I."""
    bpy.ops.wm.read_homefile(app_template="", load_ui=False)
    yield 0.5
    bpy.data.objects.remove(bpy.data.objects["Cube"])
    with region_override("WINDOW"):
        bpy.ops.wm.link(directory=f"{library}/Collection/", filename=CHARACTER)
        bpy.ops.object.make_override_library()
    yield 0.5
    scene, camera = bpy.context.scene, bpy.context.scene.camera
    scene.render.engine = "BLENDER_WORKBENCH"
    scene.render.resolution_x, scene.render.resolution_y = 320, 240
    camera.data.type, camera.data.ortho_scale = "ORTHO", 0.9
    camera.location, camera.rotation_euler = (0.25, -2, 0), (np.pi / 2, 0, 0)
    yield from _select_control(_override("ARMATURE"))
    for frame, angle in KEYS.items():
        scene.frame_set(frame)
        _override("ARMATURE").pose.bones[CONTROL].rotation_euler[0] = angle
        yield from park_mouse()
        yield from press_keys("i")
        yield 0.3
    _leave_pose_mode()
    action = _override("ARMATURE").animation_data.action
    require(action is not None, "the key I inserts no keyframes")
    scene.frame_set(FRAME)
    angle = _override("ARMATURE").pose.bones[CONTROL].rotation_euler[0]
    require(0.2 < angle < 0.5, f"at frame {FRAME} the control is turned by {angle}")
    frame_object(_override("MESH"))
    yield from redraw_window()


def _override(kind: str) -> bpy.types.Object:
    """Return the override of the mesh or armature object of the character."""
    return next(o for o in bpy.context.scene.objects if o.type == kind and o.override_library and MESH in o.name)


def _render(path: Path) -> np.ndarray:
    """Render the current frame to a file, and return its pixels (H, W, 3)."""
    bpy.context.scene.render.filepath = str(path)
    bpy.ops.render.render(write_still=True)
    return read_pixels(path)


def render_a_shot_with_the_full_rig(folder: Path) -> Iterator[float]:
    global _expected_render
    yield from _open_shot(folder / "fast_rig" / "full.blend")
    _expected_render = _render(folder / "fast_rig_expected.png")


def animate_the_fast_rig(folder: Path) -> Iterator[float]:
    """Link the fast rig into a shot and key its control: the mesh plays the model."""
    yield from _open_shot(folder / "fast_rig" / "full_fast.blend")
    mesh_object, armature_object = _override("MESH"), _override("ARMATURE")
    require(UNUSED not in armature_object.data.bones, "the shot has the full rig")
    require(mesh_object.fdda.mode == "FDDA" and not mesh_object.fdda.status, f"its status is {mesh_object.fdda.status}")
    for frame in (*KEYS, FRAME):
        bpy.context.scene.frame_set(frame)
        positions = evaluated_positions(mesh_object)
        distance = np.abs(positions - expected_positions(mesh_object, armature_object)).max()
        require(distance < MAX_DISTANCE, f"at frame {frame} the mesh is {distance:.2g} m from the model")
    yield from sidebar.open_tab()
    yield from sidebar.open_section("playback")
    preview = _render(folder / "fast_rig_preview.png")
    require(not np.array_equal(preview, _expected_render), "the renders of both rigs are equal before relocating")
    bpy.ops.wm.save_as_mainfile(filepath=str(folder / "fast_rig" / "shot.blend"))


def relocate_in_the_outliner(folder: Path) -> Iterator[float]:
    """Choose Relocate in the context menu of the library: the full rig has the keys of the shot."""
    area = next(a for a in main_screen().areas if a.type == "PROPERTIES")
    area.type = "OUTLINER"
    area.spaces.active.display_mode = "LIBRARIES"
    yield from redraw_window()
    region = next(r for r in area.regions if r.type == "WINDOW")
    top, row_height = region.y + region.height, ROW_PIXELS * bpy.context.preferences.system.ui_scale
    # Close the row "Current File"; the next one is the library.
    yield from click(region.x + row_height / 2, top - row_height / 2)
    yield from redraw_window()
    yield from click(region.x + 4 * row_height, top - 1.5 * row_height, button=RIGHT_BUTTON)
    yield 0.5
    yield from save_screenshot(folder / "library_menu.png")
    yield from press_keys("r")
    yield from wait_until(file_browser_count, 5, "Relocate opens no file browser")
    browser = next(a for a in main_screen().areas if a.type == "FILE_BROWSER")
    browser.spaces.active.params.filename = "full.blend"
    yield 0.5
    yield from save_screenshot(folder / "relocate_browser.png")
    yield from close_browser("Return")
    yield from wait_until(lambda: UNUSED in _override("ARMATURE").data.bones, 10, "the shot has no full rig")
    yield from redraw_window()
    mesh_object = _override("MESH")
    require(
        not mesh_object.fdda.status and not mesh_object.fdda.is_fast_rig, f"its status is {mesh_object.fdda.status}"
    )


def render_the_full_rig(folder: Path) -> Iterator[float]:
    """Render the relocated shot, and once more after saving and opening it: each pixel is that of the full rig."""
    shot = folder / "fast_rig" / "shot.blend"
    for name in ("relocated", "opened"):
        difference = np.abs(_render(folder / f"fast_rig_{name}.png") - _expected_render).max()
        require(difference == 0.0, f"the {name} shot differs from the shot with the full rig by {difference:.3f}")
        bpy.ops.wm.save_as_mainfile(filepath=str(shot))
        bpy.ops.wm.open_mainfile(filepath=str(shot), load_ui=False)
        yield 1.0


STEPS = (
    save_the_full_rig,
    profile_a_frame,
    add_the_control_as_an_input,
    record_train_and_bind,
    make_the_fast_rig,
    render_a_shot_with_the_full_rig,
    animate_the_fast_rig,
    relocate_in_the_outliner,
    render_the_full_rig,
)
