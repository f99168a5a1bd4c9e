# SPDX-License-Identifier: GPL-3.0-or-later
"""Finds the rigs of a scene, without evaluating anything."""

import re
from collections.abc import Iterable, Iterator, Mapping, Sequence
from dataclasses import dataclass

import bpy

from ..core.errors import RigError
from ..core.wording import format_with_noun
from .comparison import is_comparison
from .temporary_state import animated_paths

MODIFIER_NAME = "FDDA"
"""Name of the FDDA modifier, which shows a model's positions with Geometry Nodes and is never part of the rig."""

MIN_VOLUME = 1e-15
"""An object whose matrix has a smaller determinant is flat. The inverse that positions need does not exist."""


@dataclass(frozen=True)
class SceneRig:
    """Mesh objects and the armature object that deforms them. Holds RNA references, so do not store it.

    Attributes:
        mesh_object: the first or only mesh object.
        armature_object: the armature object.
        other_meshes: the further mesh objects, each after its name in the recording or model.
    """

    mesh_object: bpy.types.Object
    armature_object: bpy.types.Object
    other_meshes: tuple[tuple[str, bpy.types.Object], ...] = ()

    @property
    def mesh_objects(self) -> list[bpy.types.Object]:
        """Return all mesh objects."""
        return [self.mesh_object, *(mesh_object for _, mesh_object in self.other_meshes)]

    @property
    def parts(self) -> "list[tuple[str, SceneRig]]":
        """Return a rig for each mesh, after the mesh's name in owners of controls: empty for the first mesh."""
        meshes = (("", self.mesh_object), *self.other_meshes)
        return [(name, SceneRig(mesh_object, self.armature_object)) for name, mesh_object in meshes]


def name_without_number(mesh_object: bpy.types.Object) -> str:
    """Return the name of an object without the number that Blender appends to the name of a copy."""
    return re.sub(r"\.\d{3,}$", "", mesh_object.name)


def find_rig(name: str = "") -> SceneRig:
    """Find the rig of the current scene.

    Args:
        name: name of the mesh object; optional if only one mesh of the scene has an Armature modifier.

    Raises:
        RigError: there is no rig, or more than one.
    """
    meshes = [o for o in bpy.context.scene.objects if o.type == "MESH" and not is_comparison(o)]
    if name:
        named_object = bpy.context.scene.objects.get(name)
        if named_object is None or named_object.type != "MESH":
            names = ", ".join(f"'{o.name}'" for o in meshes) or "none"
            raise RigError(f"The scene has no mesh object '{name}'; its mesh objects: {names}.")
        meshes = [named_object]
    if not meshes:
        raise RigError("The scene has no mesh; open a file with a character that an armature deforms.")
    rigged_objects = [o for o in meshes if armature_modifier(o) is not None] or [
        o for o in meshes if armature_of(o) is not None
    ]
    if not rigged_objects:
        if messages := [message for o in meshes if (message := parenting_message(o))]:
            raise RigError(messages[0])
        subject = f"'{name}' has no" if name else "No mesh of the scene has an"
        raise RigError(f"{subject} Armature modifier with an armature; add one, or choose another object.")
    if len(rigged_objects) > 1:
        names = ", ".join(f"'{o.name}'" for o in rigged_objects)
        raise RigError(f"{len(rigged_objects)} meshes have an Armature modifier ({names}); choose one with --object.")
    return SceneRig(rigged_objects[0], armature_of(rigged_objects[0]))


def find_rigs() -> list[SceneRig]:
    """Find all rigs of the current scene: the meshes with an Armature modifier, in the order of the scene."""
    meshes = [o for o in bpy.context.scene.objects if o.type == "MESH" and not is_comparison(o)]
    rigged_objects = [o for o in meshes if armature_modifier(o) is not None]
    return [SceneRig(o, armature_of(o)) for o in rigged_objects] or [find_rig()]


def rigs_of_armature(armature_object: bpy.types.Object) -> list[SceneRig]:
    """Return the rigs of all meshes of the current scene that follow an armature, in the order of the scene."""
    meshes = [o for o in bpy.context.scene.objects if o.type == "MESH" and armature_of(o) == armature_object]
    return [SceneRig(o, armature_object) for o in meshes if not is_comparison(o)]


def find_character(names: Iterable[str]) -> SceneRig:
    """Find the rig of several mesh objects by their names.

    Raises:
        RigError: as `find_rig`, or the meshes follow different armatures.
    """
    return join_rigs([find_rig(name) for name in dict.fromkeys(names)])


def join_rigs(rigs: Sequence[SceneRig]) -> SceneRig:
    """Join the rigs of several meshes of one armature, those with an Armature modifier first.

    Raises:
        RigError: the meshes follow different armatures.
    """
    first, *others = rigs = sorted(rigs, key=lambda rig: armature_modifier(rig.mesh_object) is None)
    for other in others:
        if other.armature_object != first.armature_object:
            raise RigError(
                f"'{first.mesh_object.name}' follows the armature '{first.armature_object.name}' and "
                f"'{other.mesh_object.name}' follows '{other.armature_object.name}'; record the meshes of each "
                "armature by themselves, with --object."
            )
    meshes = [(o.name, o) for rig in rigs for o in rig.mesh_objects]
    return SceneRig(first.mesh_object, first.armature_object, tuple(meshes[1:]))


def find_whole_character() -> tuple[SceneRig, str]:
    """Find the rig of all meshes of the scene that follow its armature by modifiers.

    Returns:
        The rig, as of `join_rigs`; and a sentence about the meshes that are left out, empty for none.

    Raises:
        RigError: there is no such mesh, or the meshes follow different armatures.
    """
    meshes = [o for o in bpy.context.scene.objects if o.type == "MESH" and not is_comparison(o)]
    rigs = [SceneRig(o, armature) for o in meshes if (armature := armature_of(o)) is not None]
    learnable_rigs = [rig for rig in rigs if not left_out_reason(rig.mesh_object)]
    if not learnable_rigs:
        return find_rig(), ""
    character = join_rigs(learnable_rigs)
    return character, describe_left_out(left_out_meshes(character.armature_object))


def left_out_reason(mesh_object: bpy.types.Object) -> str:
    """Say why a mesh that follows an armature is left out of recordings of all meshes; empty if it is not."""
    if not mesh_object.fdda.in_model:
        return "unchecked in the sidebar"
    return "" if mesh_object.visible_get() else "hidden"


def left_out_meshes(armature_object: bpy.types.Object) -> dict[bpy.types.Object, str]:
    """Return why meshes that belong to an armature are left out of recordings of all meshes, by mesh object."""
    followers = [rig.mesh_object for rig in rigs_of_armature(armature_object)]
    reasons = {o: reason for o in followers if (reason := left_out_reason(o))}
    carriers = {armature_object, *followers}
    carried = (o for o in bpy.context.scene.objects if o.type == "MESH" and o.parent in carriers and o not in carriers)
    for mesh_object in carried:
        if not is_comparison(mesh_object) and armature_of(mesh_object) is None:
            reasons[mesh_object] = "moved as a whole, which is nothing to learn"
    return reasons


def describe_left_out(reasons: Mapping[bpy.types.Object, str]) -> str:
    """Name the meshes that are left out, with their reasons; empty for none."""
    names: dict[str, list[str]] = {}
    for mesh_object, reason in reasons.items():
        names.setdefault(reason, []).append(mesh_object.name)
    clauses = [
        f"{format_with_noun(group, 'mesh', 'meshes')}, {'which is' if len(group) == 1 else 'which are'} {reason}"
        for reason, group in names.items()
    ]
    return f"Left out: {'; '.join(clauses)}." if clauses else ""


def check_full_rig(mesh_object: bpy.types.Object) -> None:
    """Raise a RigError if a mesh belongs to a fast rig: what is left of its modifiers and bones is no reference."""
    if mesh_object.fdda.is_fast_rig:
        raise RigError(
            f"'{mesh_object.name}' belongs to a fast rig, which lacks modifiers and bones of the full rig; open the "
            "file of the full rig."
        )


def remaining_rig_note(mesh_object: bpy.types.Object) -> str:
    """Say when no model deforms a mesh of a fast rig; empty if a model always does, or for a full rig."""
    binding = mesh_object.fdda
    if not binding.is_fast_rig:
        return ""
    if not binding.is_bound or binding.mode == "RIG":
        condition, remedy = "without a model", "Bind a model"
    elif "fdda.mode" in animated_paths(mesh_object):
        condition, remedy = "where its keyed or driven mode is Rig", "Remove these keys or the driver"
    elif not binding.use_in_render:
        condition, remedy = "in renders, where the model is off", "Switch Use in Render on"
    else:
        return ""
    return (
        f"'{mesh_object.name}' belongs to a fast rig: {condition}, only what is left of its bones and modifiers "
        f"deforms it. {remedy}, or open the file of the full rig."
    )


def is_flat(scene_object: bpy.types.Object) -> bool:
    """Return whether an object or one of its parents has a scale of zero along an axis."""
    return abs(scene_object.matrix_world.to_3x3().determinant()) < MIN_VOLUME


def armature_modifier(mesh_object: bpy.types.Object) -> bpy.types.ArmatureModifier | None:
    """Return the first Armature modifier that has an armature; None if there is none."""
    for modifier in mesh_object.modifiers:
        if modifier.type == "ARMATURE" and modifier.object is not None:
            return modifier
    return None


def parenting_message(mesh_object: bpy.types.Object) -> str:
    """Explain why a mesh with an armature as its parent, but no modifier, is no rig; empty if it has no such parent."""
    parent = mesh_object.parent
    if parent is None or parent.type != "ARMATURE":
        return ""
    if mesh_object.parent_type == "BONE":
        return (
            f"'{mesh_object.name}' is parented to the bone '{mesh_object.parent_bone}' of '{parent.name}' and moves "
            "with it as a whole, so there is nothing to learn; choose a mesh with an Armature modifier."
        )
    if mesh_object.parent_type == "ARMATURE":
        return (
            f"'{mesh_object.name}' is deformed by '{parent.name}' as its parent, without a modifier; set the type of "
            f"its parent to Object and add an Armature modifier with '{parent.name}'."
        )
    return (
        f"'{mesh_object.name}' is parented to the armature '{parent.name}', and no modifier deforms it with that; add "
        f"an Armature modifier with '{parent.name}', or choose another mesh."
    )


def armature_of(mesh_object: bpy.types.Object) -> bpy.types.Object | None:
    """Find the armature object that deforms a mesh; return None if there is none.

    It is the armature of the first Armature modifier. Without such a modifier, the search follows the objects that the
    modifiers read, such as a cage with an Armature modifier or an empty that is the child of a bone. It returns the
    first armature on which these objects depend, else that of the bound model.
    """
    modifier = armature_modifier(mesh_object)
    if modifier is not None:
        return modifier.object
    visited = {mesh_object}
    queue = list(objects_read_by_modifiers(mesh_object))
    while queue:
        candidate = queue.pop(0)
        if candidate.type == "ARMATURE":
            return candidate
        if candidate not in visited:
            visited.add(candidate)
            targets = [getattr(c, "target", None) for c in candidate.constraints if not c.mute]
            inputs = (*objects_read_by_modifiers(candidate), candidate.parent, *targets)
            queue += [scene_object for scene_object in inputs if scene_object is not None]
    return mesh_object.fdda.armature


def objects_read_by_modifiers(owner: bpy.types.Object) -> Iterator[bpy.types.Object]:
    """Yield the objects that the modifiers of an object read."""
    for modifier in owner.modifiers:
        for prop in modifier.bl_rna.properties:
            if prop.type == "POINTER" and prop.fixed_type.identifier == "Object":
                scene_object = getattr(modifier, prop.identifier)
                if scene_object is not None:
                    yield scene_object
