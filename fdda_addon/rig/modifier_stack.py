# SPDX-License-Identifier: GPL-3.0-or-later
"""The modifiers of a rig: which of them a model replaces, which stay live, which are refused. numpy is not needed.

Up to the last modifier that moves vertices, a model stands in for all. What comes after and makes new vertices, a
subdivision for example, is live: it works on what the rig gives, and in the same way on what the model gives.
"""

from collections.abc import Iterable, Iterator
from contextlib import contextmanager
from dataclasses import dataclass
from enum import Enum, auto

import bpy

from ..core.errors import RigError
from ..scene.node_groups import GeometryEffect, find_time_node, geometry_effect
from ..scene.scene_rig import MODIFIER_NAME, SceneRig, armature_modifier

PLAYBACK_KEY = "fdda_playback"
"""Custom property of the node group that plays a model."""

DEFORMING = {
    "ARMATURE", "CAST", "CLOTH", "CORRECTIVE_SMOOTH", "CURVE", "DISPLACE", "HOOK", "LAPLACIANDEFORM",
    "LAPLACIANSMOOTH", "LATTICE", "MESH_CACHE", "MESH_DEFORM", "MESH_SEQUENCE_CACHE", "SHRINKWRAP", "SIMPLE_DEFORM",
    "SMOOTH", "SOFT_BODY", "SURFACE_DEFORM", "WARP", "WAVE",
}  # fmt: skip
TOPOLOGY_CHANGING = {
    "ARRAY", "BEVEL", "BOOLEAN", "BUILD", "DECIMATE", "EDGE_SPLIT", "EXPLODE", "MASK", "MIRROR", "MULTIRES",
    "PARTICLE_INSTANCE", "REMESH", "SCREW", "SKIN", "SOLIDIFY", "SUBSURF", "VOLUME_TO_MESH", "WELD", "WIREFRAME",
}  # fmt: skip
TIME_DEPENDENT = {
    "BUILD": "changes with time", "CLOTH": "is a simulation", "DYNAMIC_PAINT": "is a simulation",
    "EXPLODE": "is a simulation", "FLUID": "is a simulation", "MESH_CACHE": "plays a cache",
    "MESH_SEQUENCE_CACHE": "plays a cache", "OCEAN": "changes with time", "PARTICLE_INSTANCE": "is a simulation",
    "SOFT_BODY": "is a simulation", "WAVE": "changes with time",
}  # fmt: skip
BIND_PROPERTIES = {
    "CORRECTIVE_SMOOTH": "is_bind", "LAPLACIANDEFORM": "is_bind", "MESH_DEFORM": "is_bound",
    "SURFACE_DEFORM": "is_bound",
}  # fmt: skip
"""Modifiers that remember the rest pose, and the property that says whether they do."""
INDIRECT = {
    "DATA_TRANSFER", "TRIANGULATE", "VERTEX_WEIGHT_EDIT", "VERTEX_WEIGHT_MIX", "VERTEX_WEIGHT_PROXIMITY",
}  # fmt: skip
"""Modifiers that move no vertices, and change what those after them do: weights, edges."""
NEEDS_ORIGINAL_MESH = {"MULTIRES", "SOFT_BODY"}
"""Blender lets no modifier that makes a mesh, as the one that plays a model does, stand before these, on or off."""


class _Kind(Enum):
    NEUTRAL = auto()
    """Neither moves vertices nor changes them: UV maps, weights, normals, particles that are only emitted."""
    DEFORMS = auto()
    GENERATES = auto()
    UNSURE = auto()
    """Only an evaluation tells whether it deforms or generates."""


@dataclass(frozen=True)
class ModifierStack:
    """The modifiers of a rig, by name, in their order.

    Attributes:
        replaced: those that move vertices, switched on or not, up to the last of them that is on, and what a model
            cannot stand before. Of a bound object, up to the modifier that plays its model.
        misplaced: those that are on and change the topology before the last of `replaced`.
        downstream: those that are on after it. They change the topology or, after the FDDA modifier, deform.
        insert_index: index after the last of `replaced`, the modifier that plays a model not counted.
    """

    replaced: tuple[str, ...]
    misplaced: tuple[str, ...]
    downstream: tuple[str, ...]
    insert_index: int


def is_fdda_modifier(modifier: bpy.types.Modifier) -> bool:
    """Whether a modifier plays a model: it is never part of the rig."""
    if modifier.type != "NODES":
        return False
    return modifier.name == MODIFIER_NAME if modifier.node_group is None else PLAYBACK_KEY in modifier.node_group


def read_stack(mesh_object: bpy.types.Object) -> ModifierStack:
    """Sort the modifiers of a mesh object that its rig deforms, not a model.

    Geometry Nodes that could do either are evaluated, to see whether they keep the vertices and faces of the mesh.

    Raises:
        RigError: they would have to be evaluated, and the object is hidden.
    """
    modifiers = [m for m in mesh_object.modifiers if not is_fdda_modifier(m)]
    kinds = [_kind(m) for m in modifiers]
    moving = {_Kind.DEFORMS, _Kind.UNSURE}
    unsure = [i for i, m in enumerate(modifiers) if kinds[i] is _Kind.UNSURE and m.show_viewport]
    generating = [m for m, kind in zip(modifiers, kinds, strict=True) if kind in {_Kind.GENERATES, _Kind.UNSURE}]
    for i in unsure:
        with _switched_off(mesh_object, [m for m in generating if m != modifiers[i]]):
            kinds[i] = _Kind.DEFORMS if _keeps_topology(mesh_object) else _Kind.GENERATES
    deforming = [i for i, kind in enumerate(kinds) if kind in moving]
    original = [i for i, m in enumerate(modifiers) if m.type in NEEDS_ORIGINAL_MESH]
    # Where all are off, the last of all: what the user switches on later is replaced.
    shown = [i for i in deforming if modifiers[i].show_viewport] or deforming
    last = max(shown + original, default=-1)
    bound = _playback_place(mesh_object)
    if bound is not None and any(i < bound for i in deforming):
        last = bound - 1
    generating = [i for i, kind in enumerate(kinds) if kind is _Kind.GENERATES and modifiers[i].show_viewport]
    behind = sorted({*generating, *shown})
    return ModifierStack(
        replaced=tuple(m.name for i, m in enumerate(modifiers[: last + 1]) if i in deforming + original),
        misplaced=tuple(modifiers[i].name for i in generating if i <= last),
        downstream=tuple(modifiers[i].name for i in behind if i > last and modifiers[i].show_viewport),
        insert_index=last + 1,
    )


def deforming_modifiers(mesh_object: bpy.types.Object) -> list[bpy.types.Modifier]:
    """What a model replaces, in its order, switched on or not.

    Of a bound object it is what stands before the modifier that plays the model, and nothing is evaluated: whatever
    stands after it works on what the model gives.

    Raises:
        RigError: as `read_stack`.
    """
    place = _playback_place(mesh_object)
    if place is not None:
        return [m for m in mesh_object.modifiers[:place] if _kind(m) is not _Kind.NEUTRAL]
    return [mesh_object.modifiers[name] for name in read_stack(mesh_object).replaced]


def recorded_modifiers(mesh_object: bpy.types.Object) -> list[bpy.types.Modifier]:
    """The modifiers whose work a model stands in for, in their order: those that are on, or will be with the rig.

    Raises:
        RigError: as `read_stack`.
    """
    place = _playback_place(mesh_object)
    if place is None:
        place = read_stack(mesh_object).insert_index
    candidates = [m for m in mesh_object.modifiers[:place] if _kind(m) is not _Kind.NEUTRAL or m.type in INDIRECT]
    binding = getattr(mesh_object, "fdda", None)
    if binding is None or not binding.is_playing:
        return [m for m in candidates if m.show_viewport]
    stored = {saved.uid: saved for saved in binding.modifiers}
    found = []
    for modifier in candidates:
        shown = stored.get(modifier.persistent_uid, modifier)
        # One that a render shows makes other vertices there, before the model could give them positions.
        generates = _kind(modifier) is _Kind.GENERATES and binding.use_in_render and shown.show_render
        if shown.show_viewport or generates:
            found.append(modifier)
    return found


def _playback_place(mesh_object: bpy.types.Object) -> int | None:
    """Where the modifier that plays a model stands, None when there is none."""
    return next((place for place, modifier in enumerate(mesh_object.modifiers) if is_fdda_modifier(modifier)), None)


def check_stack(mesh_object: bpy.types.Object) -> ModifierStack:
    """Fail when a modifier that is on does what no model can stand in for.

    Raises:
        RigError: names a modifier that depends on time, that is not bound, or that changes the topology before
            another deforms the mesh.
    """
    stack = read_stack(mesh_object)
    for name in (m.name for m in mesh_object.modifiers if m.show_viewport):
        modifier = mesh_object.modifiers[name]
        what = f"Modifier '{name}' of '{mesh_object.name}'"
        if name in stack.replaced + stack.misplaced and (verb := time_dependence(modifier)):
            raise RigError(
                f"{what} {verb}, so its result does not follow from the pose; switch it off in the viewport, or "
                "remove it."
            )
        if _is_unbound(modifier):
            raise RigError(f"{what} is not bound, so it does nothing; bind it first, or switch it off in the viewport.")
    for name in stack.misplaced:
        what = f"Modifier '{name}' of '{mesh_object.name}' changes the topology of the mesh"
        if mesh_object.modifiers[name].type in NEEDS_ORIGINAL_MESH:
            raise RigError(
                f"{what}, and Blender lets nothing that plays a model stand before it; switch it off in the viewport, "
                "or apply it."
            )
        raise RigError(
            f"{what} before '{stack.replaced[-1]}', which a model replaces, so its vertices cannot be followed; move "
            "it to the end of the modifiers, switch it off in the viewport, or apply it."
        )
    return stack


def check_evaluable(scene_rig: SceneRig) -> ModifierStack:
    """Fail when what the graph evaluates the mesh to could not be compared with the mesh; gives its modifiers.

    Raises:
        RigError: edit mode, the NLA's tweak mode, a hidden object, an Armature modifier that is off, or a modifier
            that no model can stand in for.
    """
    mesh_object = scene_rig.mesh_object
    if mesh_object.mode == "EDIT" or scene_rig.armature_object.mode == "EDIT":
        raise RigError(f"'{mesh_object.name}' or its armature is in edit mode; leave it first.")
    animation = scene_rig.armature_object.animation_data
    if animation is not None and animation.use_tweak_mode:
        raise RigError(f"'{scene_rig.armature_object.name}' is in tweak mode of the NLA editor; leave it first.")
    modifier = armature_modifier(mesh_object)
    if modifier is not None and not modifier.show_viewport:
        raise RigError(f"The Armature modifier of '{mesh_object.name}' is switched off in the viewport; switch it on.")
    if scene_rig.armature_object.data.pose_position == "REST":
        raise RigError(f"The armature '{scene_rig.armature_object.name}' shows its rest position; set it to pose.")
    _evaluated(mesh_object)
    stack = check_stack(mesh_object)
    if not stack.downstream:
        _check_count(mesh_object, stack)
    return stack


@contextmanager
def downstream_disabled(mesh_object: bpy.types.Object) -> Iterator[None]:
    """Switch the live modifiers off: inside, the mesh is evaluated to its own vertices, as the rig deforms them.

    Raises:
        RigError: it still has other vertices.
    """
    stack = read_stack(mesh_object)
    with _switched_off(mesh_object, [mesh_object.modifiers[name] for name in stack.downstream]):
        _check_count(mesh_object, stack)
        yield


@contextmanager
def downstream_disabled_unchecked(mesh_object: bpy.types.Object) -> Iterator[None]:
    """As `downstream_disabled`, whatever vertices are left."""
    stack = read_stack(mesh_object)
    with _switched_off(mesh_object, [mesh_object.modifiers[name] for name in stack.downstream]):
        yield


@contextmanager
def _switched_off(mesh_object: bpy.types.Object, modifiers: Iterable[bpy.types.Modifier]) -> Iterator[None]:
    # By identifier: while a job runs in the window, the modifiers may be added to.
    uids = {m.persistent_uid for m in modifiers if m.show_viewport}
    for modifier in mesh_object.modifiers:
        if modifier.persistent_uid in uids:
            modifier.show_viewport = False
    try:
        yield
    finally:
        for modifier in mesh_object.modifiers:
            if modifier.persistent_uid in uids:
                modifier.show_viewport = True
        if uids:
            bpy.context.view_layer.update()


def _kind(modifier: bpy.types.Modifier) -> _Kind:
    if modifier.type == "NODES":
        kinds = {
            GeometryEffect.ATTRIBUTES: _Kind.NEUTRAL,
            GeometryEffect.POSITIONS: _Kind.DEFORMS,
            GeometryEffect.ANY: _Kind.UNSURE,
        }
        return kinds[geometry_effect(modifier.node_group)]
    if modifier.type == "OCEAN":
        return _Kind.DEFORMS if modifier.geometry_mode == "DISPLACE" else _Kind.GENERATES
    if modifier.type == "FLUID":
        return _Kind.GENERATES if modifier.fluid_type == "DOMAIN" else _Kind.NEUTRAL
    if modifier.type == "DYNAMIC_PAINT":
        surfaces = modifier.canvas_settings.canvas_surfaces if modifier.canvas_settings else ()
        return _Kind.DEFORMS if any(s.surface_type in {"DISPLACE", "WAVE"} for s in surfaces) else _Kind.NEUTRAL
    if modifier.type in DEFORMING:
        return _Kind.DEFORMS
    return _Kind.GENERATES if modifier.type in TOPOLOGY_CHANGING else _Kind.NEUTRAL


def time_dependence(modifier: bpy.types.Modifier) -> str:
    """Say what a modifier does that depends on time, empty when it does not."""
    if modifier.type == "NODES":
        node = find_time_node(modifier.node_group)
        return f"changes with time (node '{node.name}' of '{node.id_data.name}')" if node else ""
    if _kind(modifier) is _Kind.NEUTRAL:
        return ""
    return TIME_DEPENDENT.get(modifier.type, "")


def _is_unbound(modifier: bpy.types.Modifier) -> bool:
    if modifier.type not in BIND_PROPERTIES or (
        modifier.type == "CORRECTIVE_SMOOTH" and modifier.rest_source != "BIND"
    ):
        return False
    return not getattr(modifier, BIND_PROPERTIES[modifier.type])


def _evaluated(mesh_object: bpy.types.Object) -> bpy.types.Object:
    evaluated = mesh_object.evaluated_get(bpy.context.evaluated_depsgraph_get())
    if not evaluated.is_evaluated:
        raise RigError(f"'{mesh_object.name}' is hidden, so Blender does not evaluate it; show it in the viewport.")
    return evaluated


def _keeps_topology(mesh_object: bpy.types.Object) -> bool:
    # Blender starts without numpy.
    from ..scene.mesh import topology

    before, after = mesh_object.data, _evaluated(mesh_object).data
    if any(len(getattr(before, name)) != len(getattr(after, name)) for name in ("vertices", "edges", "loops")):
        return False
    return all((a == b).all() for a, b in zip(topology(before), topology(after), strict=True))


def _check_count(mesh_object: bpy.types.Object, stack: ModifierStack) -> None:
    count = len(_evaluated(mesh_object).data.vertices)
    if count != len(mesh_object.data.vertices):
        others = [m.name for m in mesh_object.modifiers if m.name not in stack.replaced and m.show_viewport]
        names = stack.downstream or others or stack.replaced
        raise RigError(
            f"The modifiers of '{mesh_object.name}' turn {len(mesh_object.data.vertices)} vertices into {count}; "
            f"switch off the one that changes the topology ({', '.join(names)})."
        )
