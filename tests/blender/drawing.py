# SPDX-License-Identifier: GPL-3.0-or-later
"""A layout that records what panels draw without a window, and fails where Blender's would."""

from collections.abc import Callable
from types import SimpleNamespace
from typing import NamedTuple

import bpy

LIST_FLAG = 1 << 30
"""Value of `UIList.bitflag_filter_item`."""


class DrawnElement(NamedTuple):
    """An element of the interface."""

    kind: str
    text: str
    is_open: bool
    """Whether no closed sub-panel hides the element."""


def check_options(function_name: str, options: dict[str, object]) -> None:
    """Assert that a function of `UILayout` has these keyword arguments, and the values of those that are enums."""
    parameters = bpy.types.UILayout.bl_rna.functions[function_name].parameters
    for name, value in options.items():
        assert name in parameters, f"UILayout.{function_name} has no argument {name}"
        if parameters[name].type == "ENUM":
            assert value in parameters[name].enum_items, f"{name} of UILayout.{function_name} cannot be {value}"


def sub_layout_function(function_name: str) -> Callable:
    """Return a method of `Layout` that creates a layout inside the layout, such as a row."""

    def create(self: "Layout", **options: object) -> "Layout":
        check_options(function_name, options)
        return Layout(self.drawn, self.is_open)

    return create


class Layout:
    """Records what is drawn, and fails where a `UILayout` would."""

    def __init__(self, drawn: list[DrawnElement], is_open: bool = True):
        self.__dict__.update(drawn=drawn, is_open=is_open)

    def __setattr__(self, name: str, value: object) -> None:
        assert name in bpy.types.UILayout.bl_rna.properties, f"a layout has no {name}"
        self.__dict__[name] = value

    row, column, box, split, grid_flow = map(sub_layout_function, ("row", "column", "box", "split", "grid_flow"))

    def add(self, kind: str, text: str) -> None:
        self.drawn.append(DrawnElement(kind, text, self.is_open))

    def label(self, **options: object) -> None:
        check_options("label", options)
        self.add("label", options.get("text", ""))

    def progress(self, **options: object) -> None:
        check_options("progress", options)
        assert 0 <= options["factor"] <= 1
        self.add("label", options["text"])

    def separator(self, **options: object) -> None:
        check_options("separator", options)

    def template_icon(self, **options: object) -> None:
        check_options("template_icon", options)

    def prop(self, owner: bpy.types.bpy_struct, name: str, **options: object) -> None:
        check_options("prop", options)
        self.add("field", options.get("text") or owner.bl_rna.properties[name].name)

    def prop_enum(self, owner: bpy.types.bpy_struct, name: str, value: str, **options: object) -> None:
        check_options("prop_enum", options)
        assert value in owner.bl_rna.properties[name].enum_items
        self.add("field", options.get("text") or owner.bl_rna.properties[name].enum_items[value].name)

    def prop_search(
        self,
        owner: bpy.types.bpy_struct,
        name: str,
        data: bpy.types.bpy_struct,
        collection_name: str,
        **options: object,
    ) -> None:
        check_options("prop_search", options)
        assert collection_name in data.bl_rna.properties
        self.add("field", options.get("text") or owner.bl_rna.properties[name].name)

    def template_list(
        self,
        class_name: str,
        _identifier: str,
        data: bpy.types.bpy_struct,
        name: str,
        active_data: bpy.types.bpy_struct,
        active_name: str,
        **options: object,
    ) -> None:
        """Draw the items that the filter of the list shows."""
        check_options("template_list", options)
        assert active_name in active_data.bl_rna.properties
        list_class = getattr(bpy.types, class_name)
        ui_list = SimpleNamespace(filter_name="", bitflag_filter_item=LIST_FLAG)
        items = getattr(data, name)
        flags = [LIST_FLAG] * len(items)
        if "filter_items" in vars(list_class):
            flags, _order = list_class.filter_items(ui_list, Context(), data, name)
            assert len(flags) == len(items)
        argument_count = list_class.draw_item.__code__.co_argcount
        for index, item in enumerate(items):
            if flags[index] & LIST_FLAG:
                row = Layout([])
                arguments = (ui_list, Context(), row, data, item, 0, active_data, active_name, index)
                list_class.draw_item(*arguments[:argument_count])
                self.add("list item", " ".join(element.text for element in row.drawn))

    def operator(self, name: str, **options: object) -> "OperatorProperties":
        check_options("operator", options)
        package, _, function = name.partition(".")
        rna = getattr(getattr(bpy.ops, package), function).get_rna_type()
        self.add("button", options.get("text") or rna.name)
        return OperatorProperties(rna)

    def panel(self, _identifier: str, **options: object) -> "tuple[Layout, Layout]":
        check_options("panel", options)
        is_open = self.is_open and not options.get("default_closed", False)
        return Layout(self.drawn, self.is_open), Layout(self.drawn, is_open)


class OperatorProperties:
    """The properties of a button. Only properties of its operator can be set."""

    def __init__(self, rna: bpy.types.Struct):
        self.__dict__["bl_rna"] = rna

    def __setattr__(self, name: str, value: object) -> None:
        assert name in self.bl_rna.properties, f"{self.bl_rna.identifier} has no {name}"


class Context:
    """Blender's context, with a region for the sidebar."""

    region = SimpleNamespace(width=330)

    def __getattr__(self, name: str) -> object:
        return getattr(bpy.context, name)


def texts_of(drawn: list[DrawnElement]) -> list[str]:
    return [element.text for element in drawn]
