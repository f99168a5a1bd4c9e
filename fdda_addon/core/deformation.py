# SPDX-License-Identifier: GPL-3.0-or-later
"""JSON of everything that deforms a mesh apart from its skin weights, in recordings and models.

Playback compares the recorded deformation with the deformation of the rig. An empty key is left out:

| Key | Value |
|---|---|
| `modifiers` | list of `{"name", "type", "settings"}` in stack order |
| `shape_keys`, `b_bones` | settings of each shape key or B-Bone, by its name |
| `attributes` | digest of the values of each attribute or vertex group that settings or nodes name, by its name |
| `unread_bones` | settings of the bones whose effect the model learned from key joints, by their names |
| `drivers` | hash of each driver that is not muted, by OWNER/PATH[INDEX] |

A setting is a boolean, a number, a string or a list of these, and null where it is animated. An empty object means that
the deformation is unknown.
"""

import math
import re
from collections.abc import Iterable
from difflib import SequenceMatcher

from .controls import MESH_OBJECT, SHAPE_KEYS, Control

MAX_SHOWN_DIFFERENCES = 3
SETTING_TOLERANCE = 1e-4
"""Largest relative difference of two settings that count as equal; rounding to float32 is smaller."""
_GROUP_LABELS = {
    "shape_keys": "shape key",
    "b_bones": "bone",
    "attributes": "attribute or vertex group",
    "unread_bones": "bone",
}
DEFORMATION_KEYS = {
    "modifiers?": [{"name": str, "type": str, "settings": {}}],
    "drivers?": {str: str},
    **{f"{group}?": {str: {}} for group in _GROUP_LABELS},
}
"""Keys of a deformation and their values, as `check_json` describes them."""
_DIGESTS = {"shape", "values", "inheritance or IK", "drivers"}
"""Settings that are digests, so that a user is not told their values."""
_ARRAY_INDEX = re.compile(r"\[\d+\]$")
_NODE_INPUT_PATH = re.compile(r"\.properties\.inputs\.(\w+)\.value\b")


def versionless_path(path: str) -> str:
    """Return the RNA path of an input of Geometry Nodes as Blender 4.5 has it; other paths are the same in 5.2."""
    return _NODE_INPUT_PATH.sub(r'["\1"]', path)


def deformation_differences(recorded: dict, current: dict, controls: Iterable[Control] = ()) -> list[str]:
    """List the differences between the deformation of a rig and the recorded deformation.

    Args:
        recorded: deformation of a recording or model; an empty, unknown deformation has no differences.
        current: deformation of the rig.
        controls: controls of the model, whose values may differ.

    Returns:
        One clause per difference.
    """
    if not recorded or not current:
        return []
    control_paths = {(control.owner, control.path) for control in controls}
    clauses = _modifier_differences(recorded.get("modifiers", []), current.get("modifiers", []), control_paths)
    for group, label in _GROUP_LABELS.items():
        # Without the joints of a model, nobody knows which bones it does not read.
        if group != "unread_bones" or group in current:
            clauses += _group_differences(group, label, recorded.get(group, {}), current.get(group, {}), control_paths)
    clauses += _driver_differences(recorded.get("drivers", {}), current.get("drivers", {}), control_paths)
    return clauses[:MAX_SHOWN_DIFFERENCES] + (
        [f"{len(clauses) - MAX_SHOWN_DIFFERENCES} more"] if len(clauses) > MAX_SHOWN_DIFFERENCES else []
    )


def _driver_differences(recorded: dict, current: dict, control_paths: set[tuple[str, str]]) -> list[str]:
    """List other drivers, except those of controls, which the model reads."""
    clauses = []
    for name in sorted({*recorded, *current}):
        owner, _, path = name.rpartition("[")[0].partition("/")
        is_control = any(
            owner == control_owner and path == _ARRAY_INDEX.sub("", versionless_path(control_path))
            for control_owner, control_path in control_paths
        )
        if is_control or recorded.get(name) == current.get(name):
            continue
        if name not in recorded:
            clauses.append(f"it was recorded without the driver of '{path}'")
        elif name in current:
            clauses.append(f"the driver of '{path}' differs")
        else:
            clauses.append(f"the driver of '{path}' is muted or gone")
    return clauses


def _modifier_differences(recorded: list[dict], current: list[dict], control_paths: set[tuple[str, str]]) -> list[str]:
    types, current_types = ([modifier["type"] for modifier in modifiers] for modifiers in (recorded, current))
    if types != current_types and sorted(types) == sorted(current_types):
        return ["the modifiers are in another order"]
    clauses = []
    for operation, start, end, current_start, current_end in SequenceMatcher(
        None, types, current_types, False
    ).get_opcodes():
        if operation == "equal":
            for recorded_modifier, current_modifier in zip(
                recorded[start:end], current[current_start:current_end], strict=True
            ):
                clauses += _setting_differences(
                    "modifier",
                    current_modifier["name"],
                    recorded_modifier["settings"],
                    current_modifier["settings"],
                    control_paths,
                )
            continue
        clauses += [
            f"it was recorded without the modifier '{modifier['name']}'"
            for modifier in current[current_start:current_end]
        ]
        clauses += [
            f"the modifier '{modifier['name']}' is gone, switched off or behind the modifier FDDA"
            for modifier in recorded[start:end]
        ]
    return clauses


def _group_differences(
    group: str, label: str, recorded: dict, current: dict, control_paths: set[tuple[str, str]]
) -> list[str]:
    lost = "is no B-Bone any more" if group == "b_bones" else "is gone"
    clauses = [f"the {label} '{name}' {lost}" for name in recorded if name not in current]
    for name, settings in current.items():
        if name in recorded:
            clauses += _setting_differences(label, name, recorded[name], settings, control_paths)
        elif group == "b_bones":
            clauses.append(f"the bone '{name}' was no B-Bone when it was recorded")
        elif group == "attributes" or (settings.get("value", 0.0) != 0 and not settings.get("mute")):
            clauses.append(f"it was recorded without the {label} '{name}'")
    return clauses


def _setting_differences(
    group_label: str, name: str, recorded: dict, current: dict, control_paths: set[tuple[str, str]]
) -> list[str]:
    clauses = []
    for setting, recorded_value in recorded.items():
        tolerance = SETTING_TOLERANCE if setting == "rest pose" else SETTING_TOLERANCE * SETTING_TOLERANCE
        # A setting may exist in one version of Blender only.
        if setting not in current or _are_equal(recorded_value, current[setting], tolerance):
            continue
        escaped = name.replace("\\", "\\\\").replace('"', '\\"')
        owner, struct = {
            "modifier": (MESH_OBJECT, f'modifiers["{escaped}"]'),
            "shape key": (SHAPE_KEYS, f'key_blocks["{escaped}"]'),
        }.get(group_label, ("", ""))
        paths = (f"{struct}.{setting}", f'{struct}["{setting}"]')
        if any(
            control_owner == owner and _ARRAY_INDEX.sub("", versionless_path(control_path)) in paths
            for control_owner, control_path in control_paths
        ):
            continue
        setting_label = f"'{setting}' of the {group_label} '{name}'"
        if current[setting] is None:
            clauses.append(f"{setting_label} is animated and is no control of the model")
        elif isinstance(recorded_value, bool | int | float | str) and setting not in _DIGESTS:
            values = [value if value != "" else "empty" for value in (recorded_value, current[setting])]
            clauses.append(f"{setting_label} was {values[0]} and is {values[1]}")
        else:
            clauses.append(f"{setting_label} differs")
    return clauses


def _are_equal(value: object, current: object, abs_tolerance: float) -> bool:
    """Return whether two settings are equal; an animated one, None, equals any."""
    if isinstance(value, list) and isinstance(current, list):
        pairs = zip(value, current, strict=False)
        return len(value) == len(current) and all(_are_equal(*pair, abs_tolerance) for pair in pairs)
    if isinstance(value, int | float) and isinstance(current, int | float):
        return math.isclose(value, current, rel_tol=SETTING_TOLERANCE, abs_tol=abs_tolerance)
    return value is None or value == current
