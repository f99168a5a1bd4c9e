# SPDX-License-Identifier: GPL-3.0-or-later
"""Shortens bone names for narrow tables, by the prefix that nearly all bones of an armature share."""

import re
from collections import Counter
from collections.abc import Sequence

import bpy

from ..scene.draw_cache import draw_cached

MIN_PREFIX_LENGTH = 4
MAX_UNPREFIXED_RATIO = 0.3
"""Ratio of the bones that may lack the prefix, such as helper bones."""


def common_prefix(names: Sequence[str]) -> str:
    """Return the prefix that nearly all names share, such as "mixamorig:" or "DEF-"; empty without one."""
    namespaces = Counter(name[: name.rindex(":") + 1] for name in names if ":" in name)
    for prefix, count in namespaces.most_common(1):
        if count >= max(2, (1 - MAX_UNPREFIXED_RATIO) * len(names)):
            return prefix
    first, last = min(names, default=""), max(names, default="")
    count = next((n for n, pair in enumerate(zip(first, last, strict=False)) if pair[0] != pair[1]), 0)
    match = re.match(r".*[-_. ]", first[:count])
    return match[0] if match and len(match[0]) >= MIN_PREFIX_LENGTH else ""


def short_bone_name(armature_object: bpy.types.Object, name: str) -> str:
    """Return the name of a bone without the common prefix."""
    return name.removeprefix(_cached_prefix(armature_object)) or name


@draw_cached
def _cached_prefix(armature_object: bpy.types.Object) -> str:
    return common_prefix([bone.name for bone in armature_object.data.bones])
