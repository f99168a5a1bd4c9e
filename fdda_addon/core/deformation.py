# SPDX-License-Identifier: GPL-3.0-or-later
"""What deforms a mesh beside its skin weights, as JSON in recordings and models; playback compares it with the rig.

Keys, each left out where it is empty: `modifiers`, a list of `{"name", "type", "settings"}` in stack order;
`shape_keys` and `b_bones`, objects of settings by name; `drivers`, a hash. A setting is a boolean, a number, a string
or a list of these, and null where it is animated. An empty object means that the deformation is unknown.
"""

import math
from collections.abc import Iterable
from difflib import SequenceMatcher

from .controls import MESH_OBJECT, SHAPE_KEYS, Control

MAX_ENTRIES = 10_000
MAX_SHOWN_DIFFERENCES = 3
SETTING_TOLERANCE = 1e-4
"""Largest relative difference of two equal settings; rounding to float32 is smaller."""
_GROUPS = {"shape_keys": "shape key", "b_bones": "bone"}


def check_deformation(value: object) -> dict:
    """Return a deformation from a file; raise TypeError, KeyError or ValueError where it is damaged."""
    if not isinstance(value, dict) or not value.keys() <= {"modifiers", "drivers", *_GROUPS}:
        raise TypeError("its deformation is invalid")
    named = [(m["name"], m["settings"]) for m in value.get("modifiers", [])]
    named += [entry for group in _GROUPS for entry in value.get(group, {}).items()]
    texts = [value.get("drivers", ""), *(m["type"] for m in value.get("modifiers", []))]
    if len(named) > MAX_ENTRIES or sum(len(settings) for _, settings in named) > MAX_ENTRIES:
        raise ValueError("its deformation has too many settings")
    if not all(isinstance(text, str) for text in texts) or not all(
        isinstance(name, str) and isinstance(settings, dict) for name, settings in named
    ):
        raise TypeError("its deformation is damaged")
    return value


def deformation_differences(recorded: dict, now: dict, controls: Iterable[Control] = ()) -> list[str]:
    """List in what the deformation of a rig differs from the recorded one.

    Args:
        recorded: of a recording or model; an empty one is unknown and differs in nothing.
        now: of the rig to compare.
        controls: inputs of the model, whose values may differ.

    Returns:
        One clause per difference.
    """
    if not recorded or not now:
        return []
    inputs = {(control.owner, control.path) for control in controls}
    clauses = _modifier_differences(recorded.get("modifiers", []), now.get("modifiers", []), inputs)
    for group, kind in _GROUPS.items():
        clauses += _group_differences(kind, recorded.get(group, {}), now.get(group, {}), inputs)
    if recorded.get("drivers", "") != now.get("drivers", ""):
        clauses.append("the drivers that deform the mesh differ")
    return clauses[:MAX_SHOWN_DIFFERENCES] + (
        [f"{len(clauses) - MAX_SHOWN_DIFFERENCES} more"] if len(clauses) > MAX_SHOWN_DIFFERENCES else []
    )


def _modifier_differences(recorded: list[dict], now: list[dict], inputs: set[tuple[str, str]]) -> list[str]:
    types, types_now = ([modifier["type"] for modifier in modifiers] for modifiers in (recorded, now))
    if types != types_now and sorted(types) == sorted(types_now):
        return ["the modifiers are in another order"]
    clauses = []
    for operation, first, end, first_now, end_now in SequenceMatcher(None, types, types_now, False).get_opcodes():
        if operation == "equal":
            for before, after in zip(recorded[first:end], now[first_now:end_now], strict=True):
                clauses += _setting_differences(
                    "modifier", after["name"], before["settings"], after["settings"], inputs
                )
            continue
        clauses += [f"it was recorded without the modifier '{m['name']}'" for m in now[first_now:end_now]]
        clauses += [
            f"the modifier '{m['name']}' is gone, switched off or behind the modifier FDDA" for m in recorded[first:end]
        ]
    return clauses


def _group_differences(kind: str, recorded: dict, now: dict, inputs: set[tuple[str, str]]) -> list[str]:
    clauses = [f"the {kind} '{name}' is gone" for name in recorded if name not in now and kind != "bone"]
    clauses += [f"the bone '{name}' is no B-Bone any more" for name in recorded if name not in now and kind == "bone"]
    for name, settings in now.items():
        if name in recorded:
            clauses += _setting_differences(kind, name, recorded[name], settings, inputs)
        elif kind == "bone":
            clauses.append(f"the bone '{name}' was no B-Bone when it was recorded")
        elif settings.get("value", 0.0) != 0 and not settings.get("mute"):
            clauses.append(f"it was recorded without the shape key '{name}'")
    return clauses


def _setting_differences(kind: str, name: str, recorded: dict, now: dict, inputs: set[tuple[str, str]]) -> list[str]:
    clauses = []
    for setting, value in recorded.items():
        # Versions of Blender have different settings.
        if value is None or setting not in now or _is_same(value, now[setting]):
            continue
        if _is_input(kind, name, setting, inputs):
            continue
        label = f"'{setting}' of the {kind} '{name}'"
        if now[setting] is None:
            clauses.append(f"{label} is animated and is no control of the model")
        elif isinstance(value, bool | int | float | str) and setting != "shape":
            clauses.append(f"{label} was {value} and is {now[setting]}")
        else:
            clauses.append(f"{label} differs")
    return clauses


def _is_input(kind: str, name: str, setting: str, inputs: set[tuple[str, str]]) -> bool:
    escaped = name.replace("\\", "\\\\").replace('"', '\\"')
    owner, path = {
        "modifier": (MESH_OBJECT, f'modifiers["{escaped}"].{setting}'),
        "shape key": (SHAPE_KEYS, f'key_blocks["{escaped}"].{setting}'),
    }.get(kind, ("", ""))
    return any(
        input_owner == owner and (input_path == path or input_path.startswith(f"{path}["))
        for input_owner, input_path in inputs
    )


def _is_same(value: object, now: object) -> bool:
    if isinstance(value, list) and isinstance(now, list):
        return len(value) == len(now) and all(map(_is_same, value, now))
    if isinstance(value, int | float) and isinstance(now, int | float):
        return math.isclose(value, now, rel_tol=SETTING_TOLERANCE, abs_tol=SETTING_TOLERANCE * SETTING_TOLERANCE)
    return value == now
