# SPDX-License-Identifier: GPL-3.0-or-later
"""Reads what drivers need: the variables of every type, and the names in scripted expressions."""

import re
from collections.abc import Iterator
from typing import NamedTuple

import bpy

from .dependency_graph import DependencyGraph, Node
from .struct_reader import bone_node, datablock_node, is_armature, struct_needs

_BONE_PATH = re.compile(r'(?:^|\.)bones\["(?P<bone>(?:[^"\\]|\\.)*)"\]')
_QUOTED_TEXT = re.compile(r"""(["'])(?P<text>(?:(?!\1).)+)\1""")
_SEGMENT_PATH = re.compile(r"bones\[.*\]\.bbone_\w+$")
_PATH_PART = re.compile(r'\["(?:[^"\\]|\\.)*"\]|\[\d+\]|\w+')
_ELEMENT_INDEX = re.compile(r"\[\d+\]$")


class _Pointer(NamedTuple):
    """A pointer in a path: the datablock to which it points, and the end of its part of the path."""

    target: bpy.types.ID
    end: int


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
    return Node(datablock_node(owner).datablock, driven_path=_ELEMENT_INDEX.sub("", path))


def bone_of_path(path: str) -> str:
    """Return the name of the bone in a path of an armature object or of an armature; empty for other paths."""
    match = _BONE_PATH.search(path)
    return bpy.utils.unescape_identifier(match["bone"]) if match else ""


def is_segment_path(path: str, bone_names: frozenset[str]) -> bool:
    """Return whether a path of an armature object or of an armature is a B-Bone property of one of some bones."""
    return bool(_SEGMENT_PATH.search(path)) and bone_of_path(path) in bone_names


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
    drivers = drivers_of(datablock)
    if is_armature(datablock) or isinstance(datablock, bpy.types.Armature):
        optional_paths += ('["',)
    nodes = [(driven_node(owner, curve.data_path), bone_of_path(curve.data_path)) for owner, curve in drivers]
    for owner, curve in drivers:
        path = curve.data_path
        node = driven_node(owner, path)
        graph.add(node, *driver_needs(curve.driver))
        if curve.driver.use_self:
            # An expression with `self` may read all properties of the bone and of the datablock.
            graph.add(node, *(other for other, bone in nodes if bone in {"", bone_of_path(path)} and other != node))
        if is_segment_path(path, straight):
            continue
        if bone_name := bone_of_path(path):
            for armature_object in _armature_objects(datablock):
                graph.add(bone_node(armature_object, bone_name), node)
        elif not path.startswith(optional_paths):
            graph.add(datablock_node(datablock), node)


def driver_needs(driver: bpy.types.Driver) -> Iterator[Node]:
    """Yield the datablocks, bones and driven properties that a driver reads."""
    yield from struct_needs(driver)
    for variable in driver.variables:
        for target in variable.targets:
            if variable.type == "CONTEXT_PROP":
                yield from _context_needs(target)
            elif variable.type == "SINGLE_PROP" and target.id is not None:
                yield from _path_needs(target.id, target.data_path)
    if driver.type == "SCRIPTED":
        # Yield the objects and bones whose names are quoted in an expression, such as `bpy.data.objects["rig"]`.
        for match in _QUOTED_TEXT.finditer(driver.expression):
            name = match["text"]
            if (scene_object := bpy.data.objects.get(name)) is not None:
                yield datablock_node(scene_object)
            for armature_object in bpy.data.objects:
                if is_armature(armature_object) and name in armature_object.data.bones:
                    yield bone_node(armature_object, name)


def _context_needs(target: bpy.types.DriverTarget) -> Iterator[Node]:
    """Yield what a driver needs that reads a property of the active scene or of the active view layer."""
    scene, path = bpy.context.scene, target.data_path
    if target.context_property == "ACTIVE_SCENE":
        yield from _path_needs(scene, path)
        return
    separator = "" if path.startswith("[") else "."
    for view_layer in scene.view_layers:
        yield from _path_needs(scene, f"{view_layer.path_from_id()}{separator}{path}")


def _path_needs(datablock: bpy.types.ID, path: str) -> Iterator[Node]:
    """Yield the bones, the driven properties and the other datablocks through which a path of a datablock leads."""
    yield driven_node(datablock, path)
    pointer = _pointer(datablock, path)
    own_path = path if pointer is None else path[: pointer.end]
    if bone_name := bone_of_path(own_path):
        yield from (bone_node(armature_object, bone_name) for armature_object in _armature_objects(datablock))
    if pointer is not None:
        yield datablock_node(pointer.target)
        yield from _path_needs(pointer.target, path[pointer.end :].removeprefix("."))


def _pointer(datablock: bpy.types.ID, path: str) -> _Pointer | None:
    """Return the first pointer in a path to a datablock; None if there is none, or if the path is broken before it."""
    for part in _PATH_PART.finditer(path):
        try:
            value = datablock.path_resolve(path[: part.end()])
        except ValueError:
            return None
        if isinstance(value, bpy.types.ID):
            return _Pointer(value, part.end())
    return None


def _armature_objects(datablock: bpy.types.ID) -> list[bpy.types.Object]:
    """Return the armature objects whose bones a path of a datablock names: itself, or the users of an armature."""
    if isinstance(datablock, bpy.types.Armature):
        return [o for o in bpy.data.objects if o.data == datablock]
    return [datablock] if is_armature(datablock) else []
