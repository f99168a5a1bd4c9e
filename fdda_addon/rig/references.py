# SPDX-License-Identifier: GPL-3.0-or-later
"""Reads the datablocks, bones and driven properties on which structs, drivers and bones depend.

Of a struct, all properties count that RNA has: pointers to datablocks, and texts that name bones of an armature object.

The graph of what needs what in a .blend file is made of them.
"""

import re
from collections.abc import Hashable, Iterable, Iterator
from dataclasses import dataclass, field
from functools import cache
from typing import NamedTuple

import bpy

from ..scene.controls import canonical_path

_UNFOLLOWED_PROPERTIES = {"rna_type", "original", "library", "override_library", "animation_data"}
_CHAIN_CONSTRAINTS = {"IK", "SPLINE_IK"}
_ARMATURE_MODIFIERS = {"ARMATURE", "GREASE_PENCIL_ARMATURE"}
_HANDLES = ("bbone_custom_handle_start", "bbone_custom_handle_end")
_BONE_PATH = re.compile(r'(?:pose\.|data\.)?bones\["(?P<bone>(?:[^"\\]|\\.)*)"\]')
_TRANSFORM_CHANNEL = re.compile(r"\.(?:location|rotation_\w+|scale)(?:\[\d\])?")
_QUOTED_TEXT = re.compile(r"""(["'])(?P<text>(?:(?!\1).)+)\1""")
_PATH_PART = re.compile(r'\["(?:[^"\\]|\\.)*"\]|\[\d+\]|\w+')
_ELEMENT_INDEX = re.compile(r"\[\d+\]$")


class Node(NamedTuple):
    """A part of a .blend file.

    Attributes:
        datablock: the datablock.
        bone: name of a bone of the armature object `datablock`; empty for the datablock itself.
        driven_path: RNA path of a driven property of `datablock`; empty otherwise.
    """

    datablock: Hashable
    bone: str = ""
    driven_path: str = ""


@dataclass
class DependencyGraph:
    """What needs what. A node that occurs in no edge needs nothing.

    Attributes:
        needs: for each node, the nodes without which its evaluation would change.
    """

    needs: dict[Node, set[Node]] = field(default_factory=dict)

    def add(self, node: Node, *needed: Node) -> None:
        """Add that a node needs other nodes."""
        self.needs.setdefault(node, set()).update(needed)

    def add_chain(self, members: Iterable[Node]) -> None:
        """Add that nodes are solved together, so that each of them needs all others.

        An IK constraint moves the bones above its owner, so a bone in the chain depends on its descendant.
        """
        members = list(members)
        for first, second in zip(members, members[1:] + members[:1], strict=True):
            if first != second:
                self.add(first, second)

    @property
    def nodes(self) -> set[Node]:
        """Return all nodes that occur in an edge."""
        return set(self.needs).union(*self.needs.values())

    def kept(self, roots: Iterable[Node]) -> set[Node]:
        """Return the roots and all that they need, directly or through other nodes."""
        kept = set(roots)
        pending = list(kept)
        while pending:
            new_nodes = self.needs.get(pending.pop(), set()) - kept
            kept |= new_nodes
            pending += new_nodes
        return kept


def is_armature(datablock: object) -> bool:
    """Return whether a datablock is an armature object."""
    return isinstance(datablock, bpy.types.Object) and datablock.type == "ARMATURE"


def split_bone_path(datablock: bpy.types.ID, path: str) -> tuple[str, str]:
    """Split a path of a datablock into the name of a bone, empty for other paths, and the path in the bone."""
    path = canonical_path(datablock, path)
    match = _BONE_PATH.match(path)
    return (bpy.utils.unescape_identifier(match["bone"]), path[match.end() :]) if match else ("", path)


def is_transform_channel(subpath: str) -> bool:
    """Return whether a path relative to a bone is a location, a rotation or a scale."""
    return _TRANSFORM_CHANNEL.fullmatch(subpath) is not None


def references(struct: bpy.types.bpy_struct, *skipped: str) -> Iterator[Node]:
    """Yield the datablocks to which a struct and the structs in it point, and the bones that they name.

    A bone is named by a pointer, or by a text in a struct that points to its armature object.

    Args:
        struct: the struct, such as a constraint, a modifier or an object.
        skipped: names of properties of the struct that do not count.
    """
    pending, found = [struct], {struct}
    while pending:
        struct = pending.pop()
        followed = [name for name, leads in _properties(struct.bl_rna) if leads and name not in skipped]
        values = [value for name in followed for value in _elements(getattr(struct, name))]
        armature_objects = [value for value in values if is_armature(value)]
        for value in values:
            if isinstance(value, bpy.types.PoseBone):
                yield Node(value.id_data, value.name)
            elif isinstance(value, bpy.types.ID) and not value.is_embedded_data:
                yield Node(value)
            elif value not in found:
                found.add(value)
                pending.append(value)
        texts = [getattr(struct, name) for name, leads in _properties(struct.bl_rna) if not leads]
        for armature_object in armature_objects:
            yield from (Node(armature_object, text) for text in texts if text in armature_object.data.bones)
        skipped = ()


def _elements(value: object) -> list[bpy.types.bpy_struct]:
    """Return the structs of a collection, or the struct to which a pointer points."""
    elements = value if isinstance(value, bpy.types.bpy_prop_collection) else [value]
    return [element for element in elements if element is not None]


def _properties(rna: bpy.types.Struct) -> list[tuple[str, bool]]:
    """Return the properties of a type of structs that are texts or lead to datablocks: the name, and if it leads."""
    if hasattr(bpy.types, rna.identifier):
        return _static_properties(rna.identifier, len(rna.properties))
    return _read_properties(rna)


@cache
def _static_properties(identifier: str, _count: int) -> list[tuple[str, bool]]:
    """Read the properties of a type of Blender's; add-ons change their number."""
    return _read_properties(getattr(bpy.types, identifier).bl_rna)


def _read_properties(rna: bpy.types.Struct) -> list[tuple[str, bool]]:
    return [
        (prop.identifier, prop.type != "STRING")
        for prop in rna.properties
        if (prop.type == "STRING" and prop != rna.name_property)
        or (_is_followed(prop) and _leads_to_datablocks(prop.fixed_type))
    ]


def _leads_to_datablocks(rna: bpy.types.Struct) -> bool:
    """Return whether structs of a type are datablocks or pose bones, or contain pointers to some."""
    if hasattr(bpy.types, rna.identifier):
        return rna.identifier in _leading_types()
    # Properties of add-ons and of node groups have types of their own.
    return any(_leads_to_datablocks(prop.fixed_type) for prop in rna.properties if _is_followed(prop))


@cache
def _leading_types() -> set[str]:
    """Return the names of the types for which `_leads_to_datablocks` is true, except those of add-ons."""
    users: dict[str, set[str]] = {}
    pending = ["PoseBone"]
    for rna in (t.bl_rna for name in dir(bpy.types) if hasattr(t := getattr(bpy.types, name), "bl_rna")):
        if issubclass(getattr(bpy.types, rna.identifier), bpy.types.ID):
            pending.append(rna.identifier)
        if rna.base is not None:
            users.setdefault(rna.identifier, set()).add(rna.base.identifier)
        for prop in filter(_is_followed, rna.properties):
            users.setdefault(prop.fixed_type.identifier, set()).add(rna.identifier)
    leading = set()
    while pending:
        name = pending.pop()
        if name not in leading:
            leading.add(name)
            pending += users.get(name, ())
    return leading


def _is_followed(prop: bpy.types.Property) -> bool:
    return prop.type in {"POINTER", "COLLECTION"} and prop.identifier not in _UNFOLLOWED_PROPERTIES


def deforming_bones(
    scene_object: bpy.types.Object, armature_object: bpy.types.Object, use_envelopes: bool = False
) -> Iterator[Node]:
    """Yield the bones with which an armature object deforms an object: those of its vertex groups, or all."""
    group_names = {group.name for group in scene_object.vertex_groups}
    for bone in armature_object.data.bones:
        if bone.use_deform and (use_envelopes or not group_names or bone.name in group_names):
            yield Node(armature_object, bone.name)


def bones_of_modifier(scene_object: bpy.types.Object, modifier: bpy.types.Modifier) -> Iterator[Node]:
    """Yield the bones with which an Armature modifier deforms a mesh, a curve, a lattice or a Grease Pencil object."""
    if modifier.type in _ARMATURE_MODIFIERS and is_armature(modifier.object):
        yield from deforming_bones(scene_object, modifier.object, modifier.use_bone_envelopes)


def ik_chain(pose_bone: bpy.types.PoseBone, constraint: bpy.types.Constraint) -> list[str]:
    """Return the names of the bones that an IK or Spline IK constraint of a bone moves; empty for another constraint.

    They begin at the owner, or at its parent if the constraint does not use the tail of the owner.
    """
    if constraint.type not in _CHAIN_CONSTRAINTS:
        return []
    chain = [pose_bone, *pose_bone.parent_recursive][not getattr(constraint, "use_tail", True) :]
    return [bone.name for bone in chain[: constraint.chain_count or len(chain)]]


def add_bones(
    graph: DependencyGraph,
    armature_object: bpy.types.Object,
    animated_paths: set[str],
    straight: frozenset[str] = frozenset(),
    *,
    only_transforms: bool = False,
) -> None:
    """Add what each bone of an armature object needs, except for drivers.

    Args:
        animated_paths: RNA paths of the armature object that actions or drivers set. A muted constraint counts unless
            its mute state is constant.
        straight: names of the bones that need no handles, because nothing reads their curve.
        only_transforms: leave out what draws custom shapes, and children that only bend the curve of a B-Bone.
    """
    unused = ("child", "constraints", *(("custom_shape", "custom_shape_transform") if only_transforms else ()))
    for pose_bone in armature_object.pose.bones:
        node, bone = Node(armature_object, pose_bone.name), pose_bone.bone
        is_straight = pose_bone.name in straight
        graph.add(node, Node(armature_object))
        graph.add(node, *references(pose_bone, *unused, *(_HANDLES if is_straight else ())))
        is_curved = bone.bbone_segments > 1 and not is_straight and not only_transforms
        if is_curved and bone.bbone_handle_type_end == "AUTO":
            graph.add(node, *(Node(armature_object, child.name) for child in bone.children if child.use_connect))
        for constraint in pose_bone.constraints:
            path = constraint.path_from_id()
            if not constraint.mute or {f"{path}.mute", f"{path}.enabled"} & animated_paths:
                graph.add(node, *references(constraint))
                graph.add_chain(
                    Node(armature_object, name)
                    for name in dict.fromkeys((pose_bone.name, *ik_chain(pose_bone, constraint)))
                )


def drivers_of(datablock: bpy.types.ID) -> list[tuple[bpy.types.ID, bpy.types.FCurve]]:
    """Return the drivers of a datablock and of its embedded node tree, each with its owner."""
    owners = [datablock]
    node_tree = getattr(datablock, "node_tree", None)
    if isinstance(node_tree, bpy.types.NodeTree) and node_tree.is_embedded_data:
        owners.append(node_tree)
    # Some types of datablocks cannot be animated.
    animations = [(owner, getattr(owner, "animation_data", None)) for owner in owners]
    return [(owner, curve) for owner, animation in animations if animation for curve in animation.drivers]


def driven_node(owner: bpy.types.ID, path: str) -> Node:
    """Return the node of a driven property, given a path of it or of one of its elements."""
    return Node(owner, driven_path=_ELEMENT_INDEX.sub("", path))


def is_segment_path(datablock: bpy.types.ID, path: str, bone_names: frozenset[str]) -> bool:
    """Return whether a path of an armature object or of an armature is a B-Bone property of one of some bones."""
    bone_name, subpath = split_bone_path(datablock, path)
    return bone_name in bone_names and subpath.startswith(".bbone_")


def add_drivers(
    graph: DependencyGraph,
    datablock: bpy.types.ID,
    optional_paths: tuple[str, ...] = (),
    straight: frozenset[str] = frozenset(),
) -> None:
    """Add what the drivers of a datablock need, and what needs them.

    Shaders may read custom properties, but not those of armatures: of these, a driver needs another one that reads it.

    Args:
        optional_paths: prefixes of paths whose drivers the datablock does not need.
        straight: names of bones that do not need the drivers of their B-Bone properties.
    """
    if is_armature(datablock) or isinstance(datablock, bpy.types.Armature):
        optional_paths += ('["',)
    drivers = [
        (curve, driven_node(owner, curve.data_path), split_bone_path(owner, curve.data_path)[0])
        for owner, curve in drivers_of(datablock)
    ]
    for curve, node, bone_name in drivers:
        graph.add(node, *driver_references(curve.driver))
        if curve.driver.use_self:
            # An expression with `self` may read all properties of the bone and of the datablock.
            graph.add(node, *(other for _, other, bone in drivers if bone in {"", bone_name} and other != node))
        if is_segment_path(datablock, curve.data_path, straight):
            continue
        if bone_name:
            for armature_object in _armature_objects(datablock):
                graph.add(Node(armature_object, bone_name), node)
        elif not curve.data_path.startswith(optional_paths):
            graph.add(Node(datablock), node)


def driver_references(driver: bpy.types.Driver) -> Iterator[Node]:
    """Yield the datablocks, bones and driven properties that a driver reads."""
    yield from references(driver)
    for variable in driver.variables:
        for target in variable.targets:
            if variable.type == "CONTEXT_PROP":
                yield from _context_references(target)
            elif variable.type == "SINGLE_PROP" and target.id is not None:
                yield from _path_references(target.id, target.data_path)
    if driver.type == "SCRIPTED":
        # Yield the objects and bones whose names are quoted in an expression, such as `bpy.data.objects["rig"]`.
        for match in _QUOTED_TEXT.finditer(driver.expression):
            name = match["text"]
            if (scene_object := bpy.data.objects.get(name)) is not None:
                yield Node(scene_object)
            yield from (Node(o, name) for o in bpy.data.objects if is_armature(o) and name in o.data.bones)


def _context_references(target: bpy.types.DriverTarget) -> Iterator[Node]:
    """Yield what a driver needs that reads a property of the active scene or of the active view layer."""
    scene, path = bpy.context.scene, target.data_path
    if target.context_property == "ACTIVE_SCENE":
        yield from _path_references(scene, path)
        return
    separator = "" if path.startswith("[") else "."
    for view_layer in scene.view_layers:
        yield from _path_references(scene, f"{view_layer.path_from_id()}{separator}{path}")


def _path_references(datablock: bpy.types.ID, path: str) -> Iterator[Node]:
    """Yield the bones, the driven properties and the other datablocks through which a path of a datablock leads."""
    yield driven_node(datablock, path)
    for part in _PATH_PART.finditer(path):
        try:
            value = datablock.path_resolve(path[: part.end()])
        except ValueError:
            break
        if isinstance(value, bpy.types.ID):
            yield Node(value)
            yield from _path_references(value, path[part.end() :].removeprefix("."))
            path = path[: part.end()]
            break
    if bone_name := split_bone_path(datablock, path)[0]:
        yield from (Node(armature_object, bone_name) for armature_object in _armature_objects(datablock))


def _armature_objects(datablock: bpy.types.ID) -> list[bpy.types.Object]:
    """Return the armature objects whose bones a path of a datablock names: itself, or the users of an armature."""
    if isinstance(datablock, bpy.types.Armature):
        return [o for o in bpy.data.objects if o.data == datablock]
    return [datablock] if is_armature(datablock) else []
