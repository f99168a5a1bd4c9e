# SPDX-License-Identifier: GPL-3.0-or-later
"""Finds objects that deform a mesh but do not move with its rig, such as a lattice that another armature carries."""

from collections.abc import Iterable

import bpy

from ..core.checks.warning import format_with_noun
from ..scene.scene_rig import SceneRig
from .sources import TRANSFORM_PREFIXES, Sources, constraint_targets


def describe_independent_objects(
    scene_rig: SceneRig, sources: Sources, controls: Iterable[tuple[bpy.types.ID, str, int]]
) -> str:
    """Describe the objects whose place deforms a mesh, although neither its rig nor a control or a driver moves them.

    Args:
        sources: everything on which its mesh depends.
        controls: the controls of the model, in the form that `scene.controls.fcurve_target` returns.

    Returns:
        A sentence for the user; empty if there are no such objects.
    """
    moved_by_inputs = {owner for owner, path, _ in (*controls, *sources.drivers) if path.startswith(TRANSFORM_PREFIXES)}
    followed = {scene_rig.mesh_object, *sources.carriers, *moved_by_inputs}
    names = [o.name for o in list(sources.objects)[1:] if not _follows(o, followed)]
    if not names:
        return ""
    return (
        f"The surface of '{scene_rig.mesh_object.name}' depends on the place of {format_with_noun(names, 'object')}, "
        f"which no parent or constraint attaches to '{scene_rig.armature_object.name}': the model keeps the place in "
        "the recording. If one has to move with the character, parent it to the armature or a bone; if something else "
        "moves it, make that an extra input (--control)."
    )


def _follows(scene_object: bpy.types.Object, followed: set[bpy.types.Object]) -> bool:
    """Return whether an object is one of others, or follows one by parents and constraints."""
    chain = [scene_object]
    for link in chain:
        if link in followed:
            return True
        targets = [target for c in link.constraints if not c.mute for target, _ in constraint_targets(c)]
        chain += [o for o in (link.parent, *targets) if o is not None and o not in chain]
    return False
