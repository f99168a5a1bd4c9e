# SPDX-License-Identifier: GPL-3.0-or-later
"""Names as the narrow tables of the sidebar show them: without what all bones of an armature begin with."""

import re
from collections import Counter
from collections.abc import Sequence

import bpy

from ..scene.draw_cache import draw_cached

MIN_PREFIX_LENGTH = 4
MAX_UNPREFIXED_RATIO = 0.3
"""So large a part of the bones may lack the prefix: helpers beside those of a library, for example."""


def common_prefix(names: Sequence[str]) -> str:
    """What names begin with and what says nothing in a table: "mixamorig:", "DEF-"; empty where there is nothing."""
    namespaces = Counter(name[: name.rindex(":") + 1] for name in names if ":" in name)
    for prefix, count in namespaces.most_common(1):
        if count >= max(2, (1 - MAX_UNPREFIXED_RATIO) * len(names)):
            return prefix
    first, last = min(names, default=""), max(names, default="")
    count = next((n for n, pair in enumerate(zip(first, last, strict=False)) if pair[0] != pair[1]), 0)
    shared = re.match(r".*[-_. ]", first[:count])
    return shared[0] if shared and len(shared[0]) >= MIN_PREFIX_LENGTH else ""


def short_bone_name(armature_object: bpy.types.Object, name: str) -> str:
    """The name of a bone in a table."""
    return name.removeprefix(_cached_prefix(armature_object)) or name


@draw_cached
def _cached_prefix(armature_object: bpy.types.Object) -> str:
    return common_prefix([bone.name for bone in armature_object.data.bones])
