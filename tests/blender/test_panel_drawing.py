# SPDX-License-Identifier: GPL-3.0-or-later
"""Every section draws without a window: its properties, operators and lists exist, and few fields are open at first."""

from types import MethodType, SimpleNamespace

import bpy
import pytest

from fdda_addon.evaluation import last_evaluation
from fdda_addon.operators.meshes import MENU_OPERATORS
from fdda_addon.panels import MODULES, checks, models, playback
from fdda_addon.scene.scene_rig import SceneRig

MAX_OPEN_FIELDS = 5


class Layout:
    """Stands for a `UILayout`: records what is drawn, and fails where Blender would."""

    def __init__(self, drawn: list[tuple[str, str, bool]], is_open: bool = True):
        self.__dict__.update(drawn=drawn, is_open=is_open)

    def __setattr__(self, name: str, value: object) -> None:
        assert name in bpy.types.UILayout.bl_rna.properties, f"a layout has no {name}"
        self.__dict__[name] = value

    def sub(self, *_: object, **__: object) -> "Layout":
        return Layout(self.drawn, self.is_open)

    row = column = box = split = grid_flow = sub

    def add(self, kind: str, text: str) -> None:
        self.drawn.append((kind, text, self.is_open))

    def label(self, text: str = "", **_: object) -> None:
        self.add("label", text)

    def progress(self, factor: float = 0.0, text: str = "", **_: object) -> None:
        assert 0 <= factor <= 1
        self.add("label", text)

    def separator(self, **_: object) -> None:
        pass

    def template_icon(self, **_: object) -> None:
        pass

    def prop(self, owner: bpy.types.bpy_struct, name: str, text: str | None = None, **_: object) -> None:
        self.add("field", owner.bl_rna.properties[name].name if text is None else text)

    def prop_search(self, owner, name, data, collection, text=None, **_: object) -> None:
        assert collection in data.bl_rna.properties
        self.prop(owner, name, text)

    def template_list(self, list_class, _identifier, data, name, active, active_name, **_: object) -> None:
        assert hasattr(bpy.types, list_class)
        assert name in data.bl_rna.properties and active_name in active.bl_rna.properties
        self.add("list", list_class)

    def operator(self, name: str, text: str | None = None, **_: object) -> SimpleNamespace:
        package, _, function = name.partition(".")
        rna = getattr(getattr(bpy.ops, package), function).get_rna_type()
        self.add("button", rna.name if text is None else text)
        return OperatorProperties(rna)

    def panel(self, _identifier: str, default_closed: bool = False) -> "tuple[Layout, Layout]":
        return self.sub(), Layout(self.drawn, self.is_open and not default_closed)


class OperatorProperties:
    """Stands for the properties of a button: takes those that the operator has."""

    def __init__(self, rna: bpy.types.Struct):
        self.__dict__["bl_rna"] = rna

    def __setattr__(self, name: str, value: object) -> None:
        assert name in self.bl_rna.properties, f"{self.bl_rna.identifier} has no {name}"


class Context:
    """The context with a region for the sidebar."""

    region = SimpleNamespace(width=330)

    def __getattr__(self, name: str) -> object:
        return getattr(bpy.context, name)


def draw(name: str) -> list[tuple[str, str, bool]]:
    """Return what a section draws: kind, text, and whether it is in an open sub-panel."""
    section, drawn = getattr(bpy.types, f"FDDA_PT_{name}"), []
    panel = SimpleNamespace(layout=Layout(drawn), verbs=section.verbs, is_done=section.is_done)
    for method in ("enabled_layout", *(own for own in vars(section) if own.startswith("_draw"))):
        setattr(panel, method, MethodType(getattr(section, method), panel))
    section.draw(panel, Context())
    return drawn


@pytest.mark.parametrize("name", MODULES)
def test_a_section_of_a_rig(rig: SceneRig, name: str):
    bpy.context.view_layer.objects.active = rig.mesh_object
    checks.check_now(rig)
    drawn = draw(name)
    assert drawn
    # Without the buttons X, Y and Z of the active bone.
    fields = [text for kind, text, is_open in drawn if kind == "field" and is_open and len(text) > 1]
    assert len(fields) <= MAX_OPEN_FIELDS, fields


@pytest.mark.parametrize("name", MODULES)
def test_a_section_of_a_bound_model(bound: bpy.types.Object, name: str):
    bpy.context.view_layer.objects.active = bound
    bpy.ops.fdda.evaluate()
    bpy.ops.fdda.measure_model(frames=5)
    bpy.ops.fdda.color_mesh(colors="ERRORS")
    playback._confidence_value.compute_now(bound)
    models._problem_values.compute_now(bound)
    texts = [text for _, text, _ in draw(name)]
    expected = {"playback": "Confidence in This Pose", "evaluation": "Max Color (mm)", "models": "Matches this rig"}
    assert expected.get(name, texts[0]) in texts


def test_worst_random_poses_are_numbered_from_1_as_in_the_preview(bound: bpy.types.Object, capfd):
    bpy.context.view_layer.objects.active = bound
    bpy.ops.fdda.evaluate(source="RANDOM", poses=3)
    index, error_mm = last_evaluation.get(bound).worst(1)[0]
    assert f"Pose {index + 1}: {error_mm:.2f} mm" in [text for _, text, _ in draw("evaluation")]
    bpy.ops.fdda.jump_to_worst()
    assert f"Random pose {index + 1}: max error {error_mm:.2f} mm." in capfd.readouterr().out


def test_the_menu_has_all_operators_but_those_that_need_a_button_of_a_panel():
    in_menu = {name.removeprefix("fdda.") for group in MENU_OPERATORS for name in group}
    assert set(dir(bpy.ops.fdda)) - in_menu == {
        *("add_trusted_folder", "remove_trusted_folder"),
        *("cancel", "cancel_trainer_environment", "open_trainer_log", "remove_trainer_environment"),
        *("set_limit", "clear_limit", "show_bone", "show_mesh", "copy_objects"),
    }


@pytest.mark.parametrize("name", MODULES)
def test_a_section_without_a_rig(name: str):
    bpy.ops.wm.read_factory_settings(use_empty=True)
    if name == "rig":
        assert "Add Sample Arm" in [text for _, text, _ in draw(name)]
    else:
        draw(name)
