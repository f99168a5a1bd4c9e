# SPDX-License-Identifier: GPL-3.0-or-later
"""Numbers that deform a mesh are inputs, or are named: numbers without a range, and ranges wider than their effect."""

from pathlib import Path

import bpy
import pytest

from blend_fixtures.characters.base import tube
from blend_fixtures.characters.controls import add_cast, drive_by_property
from fdda_addon.recording.plan import RecordingSettings
from fdda_addon.recording.run import record
from fdda_addon.scene.scene_rig import find_rig


def notes_of_recording(folder: Path, *controls: str) -> str:
    settings = RecordingSettings(poses=4, influence_poses=1, extra_inputs=controls)
    return " ".join(step.note for step in record(find_rig("elbow"), folder / "recording", settings))


def drive_strength(owner: bpy.types.ID, path: str, expression: str = "value") -> None:
    """Let the strength of a modifier of the tube follow an expression of the number `value` at a path, from 0 to 1."""
    drive_by_property(add_cast(bpy.data.objects["elbow"]), "factor", owner, path)
    bpy.data.objects["elbow"].animation_data.drivers[0].driver.expression = f"min(max({expression}, 0), 1)"
    bpy.context.view_layer.update()


@pytest.mark.parametrize(
    ("value", "limits", "expression", "note"),
    [
        (0.0, (-10_000.0, 10_000.0), "value", "number 'armature_object/[\"fat\"]' without a range"),
        (0.0, None, "value", "number 'armature_object/[\"fat\"]' without a range"),
        (0, None, "value", "number 'armature_object/[\"fat\"]' without a range"),
        (0.0, (-1000.0, 1000.0), "value", "changes only between 0 and 1.46 in the range -1000 to 1000"),
        (0.0, (0.0, 360.0), "min(max((value - 90) / 10, 0), 1)", "changes only between 90 and 101 in the range 0 to"),
        (0.0, (-180.0, 180.0), "(value + 180) / 360", ""),
        (0.0, (0.0, 1.0), "value > 0.5", ""),
    ],
)
def test_a_custom_property_is_an_input_or_is_named(
    value: float, limits: tuple[float, float] | None, expression: str, note: str, tmp_path: Path
):
    _, armature_object = tube()
    armature_object["fat"] = value
    if limits:
        armature_object.id_properties_ui("fat").update(min=limits[0], max=limits[1])
    armature_object.update_tag()
    drive_strength(armature_object, '["fat"]', expression)
    notes = notes_of_recording(tmp_path)
    assert note in notes and bool(note) == ("'elbow'" in notes)
    assert armature_object["fat"] == value
    if note:
        assert "surface" not in notes_of_recording(tmp_path / "named", 'armature_object/["fat"]=0:5')


def test_other_numbers_are_named(tmp_path: Path):
    _, armature_object = tube()
    dial = bpy.data.objects.new("dial", None)
    bpy.context.scene.collection.objects.link(dial)
    drive_strength(dial, "location[0]")
    assert "number 'object:dial/location[0]' without a range" in notes_of_recording(tmp_path)
    # A driven number is no input; the number that its driver reads is.
    armature_object["strength"] = 0.0
    variable = dial.driver_add("location", 0).driver.variables.new()
    variable.targets[0].id, variable.targets[0].data_path = armature_object, '["strength"]'
    notes = notes_of_recording(tmp_path / "driven")
    assert "dial" not in notes and "number 'armature_object/[\"strength\"]' without a range" in notes
    target = bpy.data.objects["elbow"].animation_data.drivers[0].driver.variables[0].targets[0]
    target.id_type, bpy.context.scene["fat"] = "SCENE", 0.0
    target.id, target.data_path = bpy.context.scene, '["fat"]'
    assert "number '[\"fat\"] of Scene', which cannot be an input" in notes_of_recording(tmp_path / "scene")
