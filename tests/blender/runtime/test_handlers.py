# SPDX-License-Identifier: GPL-3.0-or-later
"""The add-on's table of handlers lists every handler once; unregistering removes these handlers and no others."""

import sys

import bpy

import fdda_addon
from fdda_addon.cli import interruption
from fdda_addon.cli.main import registered
from fdda_addon.registration import handler_table


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
