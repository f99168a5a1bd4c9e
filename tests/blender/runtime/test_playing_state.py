# SPDX-License-Identifier: GPL-3.0-or-later
"""Frames stay correct after users, scripts or other add-ons change a character, and when characters fail."""

import json
import os
import sys
from pathlib import Path

import bpy
import numpy as np
import onnx
import pytest
from onnx import TensorProto, helper

import fdda_addon
from fdda_addon.cli import interruption
from fdda_addon.cli.main import registered
from fdda_addon.core.errors import ModelError
from fdda_addon.core.formats.model import CONTROLS_INPUT, METADATA_KEY
from fdda_addon.registration import handler_table
from fdda_addon.runtime import modifier_switch, playback_modifier
from fdda_addon.runtime.binding import bind
from fdda_addon.runtime.player import Player
from fdda_addon.runtime.session import session
from fdda_addon.runtime.transitions import Event, State
from fdda_addon.scene.scene_rig import armature_modifier, find_rig

from ..conftest import (
    ADDED,
    ELBOW,
    ELBOW_RIG,
    assert_plays,
    evaluated_positions,
    pose,
    rig_positions,
    write_edited,
)
from ..playback import FRAME, animation, crowd_of, handler, set_camera
from ..rig_changes import change_in_edit_mode

RENDER_HANDLERS = ("render_pre", "render_post", "render_write")


def in_memory() -> tuple[int, int]:
    return len(bpy.data.objects), len(bpy.data.meshes)


@pytest.mark.parametrize("when", RENDER_HANDLERS)
@pytest.mark.parametrize("what", ["save", "strength", "mode"])
@pytest.mark.parametrize("use_in_render", [False, True])
def test_a_handler_of_a_render_that_touches_it(bound_elbow, elbow_files, tmp_path, when, what, use_in_render):
    bound_elbow.fdda.use_in_render = use_in_render
    set_camera()
    before = animation(tmp_path / "before")

    def touch(*_):
        if what == "save":
            bpy.ops.wm.save_as_mainfile(filepath=str(tmp_path / "backup.blend"), copy=True)
        elif what == "strength":
            bound_elbow.fdda.strength = 0.5
            bound_elbow.fdda.strength = 1.0
        else:
            bound_elbow.fdda.mode = "RIG"
            bound_elbow.fdda.mode = "FDDA"

    with handler(when, touch):
        touched = animation(tmp_path / "touched")
    for frame, pixels in before.items():
        assert np.array_equal(touched[frame], pixels), frame
    bpy.context.scene.frame_set(FRAME)
    assert_plays(bound_elbow, elbow_files.model)


@pytest.mark.parametrize("is_applied", [False, True], ids=["removed", "applied"])
def test_removing_the_playback_modifier_shows_the_rig_immediately(bound_elbow, is_applied, capsys):
    pose(angle=1.2)
    if is_applied:
        with bpy.context.temp_override(object=bound_elbow):
            bpy.ops.object.modifier_apply(modifier="FDDA")
    else:
        bound_elbow.modifiers.remove(playback_modifier.find_modifier(bound_elbow))
    bpy.context.view_layer.update()
    assert bound_elbow.fdda.mode == "RIG" and "was removed; bind the model again" in bound_elbow.fdda.status
    assert [m.show_viewport for m in bound_elbow.modifiers] == [True, True, False]
    first = evaluated_positions(bound_elbow)
    pose(angle=0.3)
    assert np.abs(evaluated_positions(bound_elbow) - first).max() > 1e-2
    assert capsys.readouterr().out.count("switched off") == 1
    bound_elbow.fdda.mode = "LINEAR"
    assert bound_elbow.fdda.mode == "RIG" and "was removed; bind the model again" in bound_elbow.fdda.status


def test_duplicates_and_deletions_leave_nothing(bound_elbow, tmp_path):
    pose(angle=0.5)
    objects, meshes = in_memory()
    for _ in range(30):
        copy = bound_elbow.copy()
        bpy.context.scene.collection.objects.link(copy)
        bpy.context.view_layer.update()
        assert in_memory() == (objects + 2, meshes + 1)
        bpy.data.objects.remove(copy)
        bpy.context.view_layer.update()
    assert in_memory() == (objects, meshes)
    bpy.ops.wm.save_as_mainfile(filepath=str(tmp_path / "saved.blend"))
    fdda_addon.unregister()
    bpy.ops.wm.open_mainfile(filepath=str(tmp_path / "saved.blend"))
    assert in_memory() == (objects - 1, meshes - 1)


def test_a_deleted_character_leaves_nothing(bound_elbow):
    bpy.ops.object.select_all(action="DESELECT")
    bound_elbow.select_set(True)
    bpy.context.view_layer.objects.active = bound_elbow
    bpy.ops.object.delete()
    bpy.context.view_layer.update()
    assert [o.name for o in bpy.data.objects] == [ELBOW_RIG]
    pose(angle=1.3)
    bpy.context.scene.frame_set(7)


def test_playback_continues_after_a_purge_of_unused_data(bound_elbow, elbow_files):
    crowd = crowd_of(bound_elbow, 5)
    for frame in (1, 2, 3, 4):
        bpy.context.scene.frame_set(frame)
    bpy.data.orphans_purge(do_recursive=True)
    for frame in (5, 6):
        bpy.context.scene.frame_set(frame)
        for mesh_object in crowd:
            assert_plays(mesh_object, elbow_files.model)


def test_disabled_and_enabled(bound_elbow, elbow_files, capfd):
    pose(angle=1.0)
    expected, count = rig_positions(bound_elbow), in_memory()
    for _ in range(3):
        fdda_addon.unregister()
        assert not hasattr(bpy.types.Object, "fdda_playback")
        assert in_memory() == (count[0] - 1, count[1] - 1)
        visibilities = {m.name: (m.show_viewport, m.show_render) for m in bound_elbow.modifiers}
        assert visibilities == {"Armature": (True, True), "CorrectiveSmooth": (True, True), **ADDED}
        bpy.context.view_layer.update()
        assert np.abs(evaluated_positions(bound_elbow) - expected).max() < 1e-6
        fdda_addon.register()
        bpy.context.view_layer.update()
        assert_plays(bound_elbow, elbow_files.model)
        assert in_memory() == count
    assert "rror" not in "".join(capfd.readouterr())


def test_an_auto_saved_file_shows_the_mesh_without_the_addon(bound_elbow, elbow_files, tmp_path):
    """An auto-save calls no handler. Without the add-on, its file must show the mesh in rest pose, not a point."""
    handlers = [bpy.app.handlers.save_pre[:], bpy.app.handlers.save_post[:]]
    bpy.app.handlers.save_pre.clear()
    bpy.app.handlers.save_post.clear()
    path = elbow_files.bound.with_name("itself.blend")
    bpy.ops.wm.save_as_mainfile(filepath=str(path), copy=True)
    bpy.app.handlers.save_pre[:], bpy.app.handlers.save_post[:] = handlers
    bpy.ops.wm.open_mainfile(filepath=str(path))
    pose(angle=0.8)
    assert_plays(bpy.data.objects[ELBOW], elbow_files.model)
    fdda_addon.unregister()
    bpy.ops.wm.open_mainfile(filepath=str(path))
    mesh_object = bpy.data.objects[ELBOW]
    rest = np.array([vertex.co[:] for vertex in mesh_object.data.vertices], np.float32)
    assert np.abs(evaluated_positions(mesh_object) - rest).max() < 1e-6


def test_a_joint_that_is_not_a_number(bound_elbow, elbow_files):
    """Vertices of this joint follow its parent, and the rest of the character does not change."""
    armature_object = bpy.data.objects[ELBOW_RIG]
    armature_object.animation_data_clear()
    pose(angle=0.0)
    straight = assert_plays(bound_elbow, elbow_files.model)
    armature_object.pose.bones["lower"].rotation_euler[0] = float("nan")
    pose(bone="upper", angle=0.5)
    shown = evaluated_positions(bound_elbow)
    assert np.isfinite(shown).all() and "joint 'lower' of 'elbow_rig' is not a number" in bound_elbow.fdda.status
    assert bound_elbow.fdda.mode == "FDDA"
    pose(angle=0.0)
    assert np.abs(shown - assert_plays(bound_elbow, elbow_files.model)).max() < 1e-5
    assert np.abs(shown - straight).max() > 1e-2


def test_the_others_play_on_when_one_character_raises_any_error(bound_elbow, elbow_files, monkeypatch, capsys):
    from fdda_addon.runtime.player import Player

    crowd = crowd_of(bound_elbow, 3)
    bpy.context.view_layer.update()
    real = Player.write_positions

    def write(self, buffer, mesh_object):
        if mesh_object.name == crowd[1].name:
            raise SystemExit("out")
        real(self, buffer, mesh_object)

    monkeypatch.setattr(Player, "write_positions", write)
    for mesh_object in crowd:
        armature_modifier(mesh_object).object.pose.bones["lower"].rotation_euler[0] += 0.1
    bpy.context.view_layer.update()
    assert [o.fdda.mode for o in crowd] == ["FDDA", "RIG", "FDDA"]
    assert "cannot be played (SystemExit('out'))" in crowd[1].fdda.status
    assert [m.show_viewport for m in crowd[1].modifiers] == [True, True, False, False]
    for mesh_object in (crowd[0], crowd[2]):
        assert_plays(mesh_object, elbow_files.model)
    assert capsys.readouterr().out.count("switched off") == 1


def test_a_failure_is_reported_even_if_switching_the_modifiers_fails_too(bound_elbow, monkeypatch, capsys):
    def refuse(*_: object) -> None:
        raise RuntimeError("read-only")

    character = session.character_of(bound_elbow)
    monkeypatch.setattr(modifier_switch, "switch_modifiers", refuse)
    session.dispatch(Event.FAIL, character, ModelError("the reason"))
    assert character.state == State.FAILED and bound_elbow.fdda.mode == "RIG"
    assert bound_elbow.fdda.status == "the reason" and "the reason" in capsys.readouterr().out


def test_the_rig_is_shown_even_if_the_terminal_is_closed(bound_elbow, monkeypatch):
    with open(os.devnull) as unwritable:
        monkeypatch.setattr(sys, "stdout", unwritable)
        session.dispatch(Event.FAIL, session.character_of(bound_elbow), ModelError("the reason"))
        monkeypatch.undo()
    assert bound_elbow.fdda.status == "the reason"
    assert not any(character.player for character in session.characters.values())
    assert armature_modifier(bound_elbow).show_viewport


def test_a_topology_that_changes_shows_the_rig_in_the_same_frame(bound_elbow):
    bound_elbow.data.vertices.add(3)
    bound_elbow.data.update()
    bpy.context.scene.frame_set(9)
    bpy.context.view_layer.update()
    assert "has 303 vertices and its model was trained for 300" in bound_elbow.fdda.status
    assert len(evaluated_positions(bound_elbow)) == 303 and bound_elbow.modifiers["Armature"].show_viewport


def test_enabled_while_the_mesh_is_in_edit_mode(bound_elbow, elbow_files):
    """In Edit Mode Blender has no mesh attributes. The add-on must register, and the model plays afterwards."""
    bpy.context.view_layer.objects.active = bound_elbow
    fdda_addon.unregister()
    bpy.ops.object.mode_set(mode="EDIT")
    fdda_addon.register()
    bpy.ops.object.mode_set(mode="OBJECT")
    bpy.data.objects[ELBOW].fdda.mode = "FDDA"
    pose(angle=0.8)
    assert_plays(bpy.data.objects[ELBOW], elbow_files.model)


def add_on_handlers() -> list[tuple[str, object]]:
    """Return the registered handlers of the add-on, with the names of their lists."""
    lists = {name: getattr(bpy.app.handlers, name) for name in dir(bpy.app.handlers) if not name.startswith("_")}
    handlers = [(name, handler) for name, listed in lists.items() if isinstance(listed, list) for handler in listed]
    return [entry for entry in handlers if getattr(entry[1], "__module__", "").startswith("fdda_addon.")]


def persistent_functions() -> set[object]:
    """Return the functions of the add-on's loaded modules that are marked as persistent."""
    modules = [module for name, module in sys.modules.items() if name.startswith("fdda_addon.")]
    functions = {value for module in modules for value in vars(module).values() if callable(value)}
    return {f for f in functions if "_bpy_persistent" in getattr(f, "__dict__", {}) or hasattr(f, "_bpy_persistent")}


def test_registering_twice_adds_each_handler_once():
    expected = sorted(handler_table(), key=str)
    assert expected and sorted(add_on_handlers(), key=str) == expected
    fdda_addon.register()
    assert sorted(add_on_handlers(), key=str) == expected


def test_unregistering_removes_only_handlers_of_the_add_on():
    def other_handler(*_: object) -> None:
        """Do nothing, as a handler of another add-on."""

    bpy.app.handlers.load_post.append(other_handler)
    try:
        fdda_addon.unregister()
        assert add_on_handlers() == [] and other_handler in bpy.app.handlers.load_post
    finally:
        bpy.app.handlers.load_post.remove(other_handler)
        fdda_addon.register()


def test_all_handlers_are_persistent_and_in_the_table():
    before = add_on_handlers()
    bpy.ops.wm.read_factory_settings(use_empty=True)
    assert add_on_handlers() == before
    assert persistent_functions() == {handler for _, handler in handler_table()}


def test_ctrl_c_is_delayed_in_all_modules_with_handlers():
    """Blender prints exceptions of handlers and continues, so a KeyboardInterrupt in a handler would be lost."""
    with registered():
        modules = [sys.modules[handler.__module__] for _, handler in handler_table()]
        assert all(interruption._has_callbacks(vars(module)) for module in modules)
        assert all(name in sys.modules for name in interruption._CALLBACK_MODULES)
        assert not interruption._has_callbacks(vars(interruption))


@pytest.mark.parametrize("count", [3, 5], ids=["single", "batched"])
def test_a_character_without_vertices_shows_an_error(bound_elbow, elbow_files, count):
    crowd = crowd_of(bound_elbow, count)
    for frame in (1, 2, 3):
        bpy.context.scene.frame_set(frame)
    crowd[1].data = crowd[1].data.copy()
    change_in_edit_mode(crowd[1], lambda: (bpy.ops.mesh.select_all(action="SELECT"), bpy.ops.mesh.delete(type="VERT")))
    for frame in (4, 9):
        bpy.context.scene.frame_set(frame)
        for mesh_object in [o for o in crowd if o != crowd[1]]:
            assert_plays(mesh_object, elbow_files.model)
    pose(angle=0.4)
    assert_plays(crowd[0], elbow_files.model)
    assert crowd[1].fdda.mode == "RIG" and "has 0 vertices and its model was trained for" in crowd[1].fdda.status


FAILING_METHODS = {
    "created": (Player, "__init__"),
    "object changed": (Player, "fits_object"),
    "rig checked": (Player, "check_rig"),
    "mask read": (Player, "update_mask"),
}


@pytest.mark.parametrize("event", FAILING_METHODS)
def test_an_unexpected_error_stops_one_character_only(bound_elbow, elbow_files, monkeypatch, event):
    crowd = crowd_of(bound_elbow, 3)
    bpy.context.view_layer.update()
    owner, name = FAILING_METHODS[event]
    method, failing_uid = getattr(owner, name), crowd[1].session_uid

    def fail(player: Player, *arguments: object, **keywords: object) -> object:
        if failing_uid in (getattr(player, "object_uid", 0), getattr(arguments[0], "session_uid", 0)):
            raise KeyError("position")
        return method(player, *arguments, **keywords)

    monkeypatch.setattr(owner, name, fail)
    if event == "created":
        session.reset()
    for mesh_object in crowd:
        mesh_object.data.update()
        mesh_object.update_tag()
    bpy.context.view_layer.update()
    bpy.context.scene.frame_set(8)
    for mesh_object in (crowd[0], crowd[2]):
        assert_plays(mesh_object, elbow_files.model)
    assert crowd[1].fdda.mode == "RIG" and "cannot be played (KeyError('position'))" in crowd[1].fdda.status


def add_control_to_model(model: Path, owner: str, path: str) -> Path:
    """Write a copy of a model with a control that has no effect, in the same folder."""

    def add_control(proto: onnx.ModelProto) -> None:
        proto.graph.input.append(helper.make_tensor_value_info(CONTROLS_INPUT, TensorProto.FLOAT, ["N", 1]))
        (metadata,) = (prop for prop in proto.metadata_props if prop.key == METADATA_KEY)
        info = json.loads(metadata.value)
        info["controls"] = [{"owner": owner, "path": path, "low": 0.0, "high": 1.0}]
        metadata.value = json.dumps(info)

    return write_edited(model, model.with_name(f"controlled_{os.getpid()}.onnx"), add_control)


def armature_object() -> bpy.types.Object:
    return bpy.data.objects[ELBOW_RIG]


def shape_keys() -> bpy.types.Key:
    return bpy.data.objects[ELBOW].data.shape_keys


def remove_shape_key() -> None:
    bpy.data.objects[ELBOW].shape_key_remove(shape_keys().key_blocks["smile"])


def delete_property() -> None:
    del armature_object()["dial"]
    # Like the user interface; without the tag, Blender keeps using the old value.
    armature_object().update_tag()


def rename_property() -> None:
    armature_object()["stretch"] = armature_object()["dial"]
    delete_property()


def rename_object() -> None:
    bpy.data.objects["dials"].name = "others"
    session.reset()


SHAPE_KEY_CONTROL = ("shape_keys", 'key_blocks["smile"].value')

BONE_CONTROL = ("armature_object", 'pose.bones["dial"]["fist"]')

OBJECT_CONTROL = ("object:dials", "location[2]")

CONTROL_REMOVALS = {
    "a property is deleted": (("armature_object", '["dial"]'), delete_property),
    "a property is renamed": (("armature_object", '["dial"]'), rename_property),
    "a shape key is removed": (SHAPE_KEY_CONTROL, remove_shape_key),
    "all shape keys are removed": (SHAPE_KEY_CONTROL, lambda: bpy.data.objects[ELBOW].shape_key_clear()),
    "a shape key is renamed": (SHAPE_KEY_CONTROL, lambda: setattr(shape_keys().key_blocks["smile"], "name", "grin")),
    "a bone is renamed": (BONE_CONTROL, lambda: setattr(armature_object().data.bones["dial"], "name", "knob")),
    "an object is removed": (OBJECT_CONTROL, lambda: bpy.data.objects.remove(bpy.data.objects["dials"])),
    "an object is renamed": (OBJECT_CONTROL, rename_object),
}  # fmt: skip


@pytest.mark.parametrize("update", ["pose", "frame"])
@pytest.mark.parametrize("removal", CONTROL_REMOVALS)
def test_a_character_that_lacks_a_control_shows_its_rig(rig, elbow_files, removal, update):
    mesh_object = rig.mesh_object
    armature_object()["dial"] = 0.5
    mesh_object.shape_key_add(name="Basis")
    mesh_object.shape_key_add(name="smile").value = 0.5
    dials = bpy.data.objects.new("dials", None)
    bpy.context.scene.collection.objects.link(dials)
    bpy.context.view_layer.objects.active = armature_object()
    bpy.ops.object.mode_set(mode="EDIT")
    bone = armature_object().data.edit_bones.new("dial")
    bone.head, bone.tail, bone.use_deform = (1, 0, 0), (1, 0, 0.2), False
    bpy.ops.object.mode_set(mode="OBJECT")
    armature_object().pose.bones["dial"]["fist"] = 0.5
    (owner, path), change = CONTROL_REMOVALS[removal]
    bind(find_rig(), add_control_to_model(elbow_files.model, owner, path))
    pose(angle=1.0)
    assert mesh_object.fdda.mode == "FDDA" and not mesh_object.fdda.status
    change()
    if update == "pose":
        pose(angle=0.6)
    else:
        bpy.context.scene.frame_set(11)
    assert mesh_object.fdda.mode == "RIG"
    assert f"'elbow' lacks the control '{owner}/{path}'" in mesh_object.fdda.status
    shown = evaluated_positions(mesh_object)
    mesh_object.modifiers.remove(mesh_object.modifiers["FDDA"])
    assert np.array_equal(evaluated_positions(mesh_object), shown)
