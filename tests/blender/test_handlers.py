# SPDX-License-Identifier: GPL-3.0-or-later
"""The one table of handlers: all of the add-on's are in it, once each, and it is all that is removed."""

import sys

import bpy

import fdda_addon
from fdda_addon.cli import interruption
from fdda_addon.cli.registered import registered
from fdda_addon.registration import handler_table


def ours() -> list[tuple[str, object]]:
    """Handlers of the add-on that Blender calls now."""
    lists = {name: getattr(bpy.app.handlers, name) for name in dir(bpy.app.handlers) if not name.startswith("_")}
    found = [(name, handler) for name, listed in lists.items() if isinstance(listed, list) for handler in listed]
    return [entry for entry in found if getattr(entry[1], "__module__", "").startswith("fdda_addon.")]


def declared() -> set[object]:
    """Functions of the loaded modules of the add-on that are marked to outlive a file."""
    modules = [module for name, module in sys.modules.items() if name.startswith("fdda_addon.")]
    functions = {value for module in modules for value in vars(module).values() if callable(value)}
    return {f for f in functions if "_bpy_persistent" in getattr(f, "__dict__", {}) or hasattr(f, "_bpy_persistent")}


def test_all_are_registered_once_however_often_it_is_done():
    expected = sorted(handler_table(), key=str)
    assert expected and sorted(ours(), key=str) == expected
    fdda_addon.register()
    assert sorted(ours(), key=str) == expected


def test_exactly_the_table_is_removed():
    def of_another(*_: object) -> None:
        """Another add-on's."""

    bpy.app.handlers.load_post.append(of_another)
    try:
        fdda_addon.unregister()
        assert ours() == [] and of_another in bpy.app.handlers.load_post
    finally:
        bpy.app.handlers.load_post.remove(of_another)
        fdda_addon.register()


def test_all_outlive_a_file_and_are_in_the_table():
    before = ours()
    bpy.ops.wm.read_factory_settings(use_empty=True)
    assert ours() == before
    assert declared() == {handler for _, handler in handler_table()}


def test_ctrl_c_waits_in_all_of_them():
    """Blender prints what leaves a handler and goes on: a Ctrl-C that is raised there is lost."""
    with registered():
        assert {handler.__module__ for _, handler in handler_table()} <= interruption._callback_modules
        assert all(name in sys.modules for name in interruption._callback_modules)
