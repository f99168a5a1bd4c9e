# SPDX-License-Identifier: GPL-3.0-or-later
"""Sorts the modifiers of a rig into those that a model replaces, those that stay on, and those that prevent a model.

A model replaces all modifiers up to the last one that moves vertices. The modifiers after it that are on, such as a
subdivision, are downstream: they apply to the output of the rig, and in the same way to the output of the model.
"""

from collections.abc import Iterable, Iterator
from contextlib import contextmanager
from dataclasses import dataclass
from enum import Enum, auto

import bpy

from ..core.errors import RigError
from ..scene.compatibility import node_input_settings
from ..scene.mesh import topology
from ..scene.node_groups import (
    GeometryEffect,
    depends_on_shape,
    find_time_node,
    geometry_effect,
    read_texts,
    stored_attributes,
    tree_nodes,
)
from ..scene.scene_rig import MODIFIER_NAME, SceneRig, armature_modifier

PLAYBACK_GROUP_KEY = "fdda_playback_group"
"""Custom property of the node group of FDDA modifiers."""

UNDEFORMED_MODIFIER_NAME = f"{MODIFIER_NAME} Undeformed"
"""Name of the modifier after the FDDA modifier that makes Blender compute undeformed coordinates."""

ORIGINAL_MESH_TYPES = {"MULTIRES", "SOFT_BODY"}
"""Modifiers that need the original mesh: Blender allows no Geometry Nodes modifier, such as FDDA's, before them."""


DEFORMING_TYPES = {
    "ARMATURE", "CAST", "CLOTH", "CORRECTIVE_SMOOTH", "CURVE", "DISPLACE", "HOOK", "LAPLACIANDEFORM",
    "LAPLACIANSMOOTH", "LATTICE", "MESH_CACHE", "MESH_DEFORM", "MESH_SEQUENCE_CACHE", "SHRINKWRAP", "SIMPLE_DEFORM",
    "SMOOTH", "SOFT_BODY", "SURFACE_DEFORM", "WARP", "WAVE",
}  # fmt: skip
TOPOLOGY_CHANGING_TYPES = {
    "ARRAY", "BEVEL", "BOOLEAN", "BUILD", "DECIMATE", "EDGE_SPLIT", "EXPLODE", "MASK", "MIRROR", "MULTIRES",
    "PARTICLE_INSTANCE", "REMESH", "SCREW", "SKIN", "SOLIDIFY", "SUBSURF", "VOLUME_TO_MESH", "WELD", "WIREFRAME",
}  # fmt: skip
TIME_DEPENDENT_TYPES = {
    "BUILD": "changes with time", "CLOTH": "is a simulation", "DYNAMIC_PAINT": "is a simulation",
    "EXPLODE": "is a simulation", "FLUID": "is a simulation", "MESH_CACHE": "plays a cache",
    "MESH_SEQUENCE_CACHE": "plays a cache", "OCEAN": "changes with time", "PARTICLE_INSTANCE": "is a simulation",
    "SOFT_BODY": "is a simulation", "WAVE": "changes with time",
}  # fmt: skip
BIND_PROPERTIES = {
    "CORRECTIVE_SMOOTH": "is_bind", "LAPLACIANDEFORM": "is_bind", "MESH_DEFORM": "is_bound",
    "SURFACE_DEFORM": "is_bound",
}  # fmt: skip
"""Types of modifiers that must be bound to a rest pose, and their property that is true if they are bound."""
INDIRECT_TYPES = {
    "DATA_TRANSFER", "TRIANGULATE", "VERTEX_WEIGHT_EDIT", "VERTEX_WEIGHT_MIX", "VERTEX_WEIGHT_PROXIMITY",
}  # fmt: skip
"""Modifiers that move no vertices, but change the effect of later modifiers: they edit weights or edges."""


class ModifierEffect(Enum):
    NEUTRAL = auto()
    """Keeps the vertices and their positions: it changes UV maps, weights or normals, or emits particles."""
    DEFORMS = auto()
    """Moves vertices."""
    GENERATES = auto()
    """Changes the topology."""
    UNKNOWN = auto()
    """Only an evaluation shows whether it deforms or generates."""


def effect_of(modifier: bpy.types.Modifier) -> ModifierEffect:
    """Return what a modifier does to the mesh, on or off, judged without an evaluation."""
    if modifier.type == "NODES":
        kinds = {
            GeometryEffect.ATTRIBUTES: ModifierEffect.NEUTRAL,
            GeometryEffect.POSITIONS: ModifierEffect.DEFORMS,
            GeometryEffect.ANY: ModifierEffect.UNKNOWN,
        }
        return kinds[geometry_effect(modifier.node_group)]
    if modifier.type == "OCEAN":
        return ModifierEffect.DEFORMS if modifier.geometry_mode == "DISPLACE" else ModifierEffect.GENERATES
    if modifier.type == "FLUID":
        return ModifierEffect.GENERATES if modifier.fluid_type == "DOMAIN" else ModifierEffect.NEUTRAL
    if modifier.type == "DYNAMIC_PAINT":
        surfaces = modifier.canvas_settings.canvas_surfaces if modifier.canvas_settings else ()
        return (
            ModifierEffect.DEFORMS
            if any(s.surface_type in {"DISPLACE", "WAVE"} for s in surfaces)
            else ModifierEffect.NEUTRAL
        )
    if modifier.type in DEFORMING_TYPES:
        return ModifierEffect.DEFORMS
    return ModifierEffect.GENERATES if modifier.type in TOPOLOGY_CHANGING_TYPES else ModifierEffect.NEUTRAL


def time_dependence(modifier: bpy.types.Modifier) -> str:
    """Describe how a modifier depends on time, as a verb phrase; empty if it does not."""
    if modifier.type == "NODES":
        node = find_time_node(modifier.node_group)
        return f"changes with time (node '{node.name}' of '{node.id_data.name}')" if node else ""
    if effect_of(modifier) is ModifierEffect.NEUTRAL:
        return ""
    return TIME_DEPENDENT_TYPES.get(modifier.type, "")


def is_unbound(modifier: bpy.types.Modifier) -> bool:
    """Return whether a modifier does nothing, because it has not been bound to a rest pose."""
    if modifier.type not in BIND_PROPERTIES or (
        modifier.type == "CORRECTIVE_SMOOTH" and modifier.rest_source != "BIND"
    ):
        return False
    return not getattr(modifier, BIND_PROPERTIES[modifier.type])


def reads_shape(modifier: bpy.types.Modifier) -> bool:
    """Return whether the result of a neutral modifier depends on the positions of the vertices.

    This is assumed of each type that is not known to depend on nothing but weights, UV maps and transforms.
    """
    if modifier.type == "NODES":
        tree = modifier.node_group
        return tree is not None and (depends_on_shape(tree) or "position" in _node_input_texts(modifier))
    if modifier.type in {"VERTEX_WEIGHT_EDIT", "VERTEX_WEIGHT_MIX", "VERTEX_WEIGHT_PROXIMITY"}:
        if modifier.mask_texture is not None and modifier.mask_tex_mapping != "UV":
            return True
        return modifier.type == "VERTEX_WEIGHT_PROXIMITY" and modifier.proximity_mode == "GEOMETRY"
    if modifier.type == "DATA_TRANSFER":
        mappings = {
            getattr(modifier, f"{kind}_mapping")
            for kind in ("vert", "edge", "loop", "poly")
            if getattr(modifier, f"use_{kind}_data")
        }
        return modifier.object is not None and not mappings <= {"TOPOLOGY"}
    return not {
        "COLLISION": lambda: not modifier.settings.use,
        "DYNAMIC_PAINT": lambda: not (modifier.canvas_settings or modifier.brush_settings),
        "FLUID": lambda: modifier.fluid_type == "NONE",
        "TRIANGULATE": lambda: True,
        "UV_PROJECT": lambda: not any(projector.object for projector in modifier.projectors),
        "UV_WARP": lambda: True,
    }.get(modifier.type, lambda: False)()


def written_names(modifier: bpy.types.Modifier) -> set[str] | None:
    """Return the names of the vertex groups and attributes that a neutral modifier writes; None if it writes more."""
    if modifier.type == "NODES":
        return stored_attributes(modifier.node_group)
    if modifier.type == "DATA_TRANSFER":
        writes_weights = modifier.use_vert_data and modifier.data_types_verts == {"VGROUP_WEIGHTS"}
        writes_more = modifier.use_edge_data or modifier.use_loop_data or modifier.use_poly_data
        return set(modifier.id_data.vertex_groups.keys()) if writes_weights and not writes_more else None
    if modifier.type == "VERTEX_WEIGHT_MIX":
        return {modifier.vertex_group_a}
    return {modifier.vertex_group} if modifier.type in {"VERTEX_WEIGHT_EDIT", "VERTEX_WEIGHT_PROXIMITY"} else None


def read_names(modifier: bpy.types.Modifier) -> set[str]:
    """Return the names of the vertex groups and attributes that a modifier may read."""
    structs = [modifier, modifier.particle_system] if modifier.type == "PARTICLE_SYSTEM" else [modifier]
    names = {
        getattr(struct, prop.identifier)
        for struct in structs
        for prop in struct.bl_rna.properties
        if prop.type == "STRING" and prop.identifier != "name"
    }
    if modifier.type == "ARMATURE" and modifier.use_vertex_groups:
        names |= set(modifier.id_data.vertex_groups.keys())
    if modifier.type == "NODES" and modifier.node_group is not None:
        names |= {*read_texts(modifier.node_group), *_node_input_texts(modifier)}
    return names - {""}


def _node_input_texts(modifier: bpy.types.NodesModifier) -> set[str]:
    """Return the texts in the inputs of Geometry Nodes, among them the names of the attributes that inputs read."""
    return {value for _, value in node_input_settings(modifier).values() if isinstance(value, str)}


@dataclass(frozen=True)
class ModifierStack:
    """The modifiers of a rig, by name, in their order.

    Attributes:
        replaced: modifiers that move vertices, on or off, up to the last one that is on, and those that need the
            original mesh. For a bound object, all such modifiers before the FDDA modifier.
        misplaced: modifiers that are on and change the topology before the last of `replaced`.
        downstream: modifiers that are on after the last of `replaced`, and change the topology or move vertices.
        insert_index: index after the last of `replaced`, not counting the FDDA modifier.
    """

    replaced: tuple[str, ...]
    misplaced: tuple[str, ...]
    downstream: tuple[str, ...]
    insert_index: int


def is_fdda_modifier(modifier: bpy.types.Modifier) -> bool:
    """Return whether a modifier was added with a model, so that it is never part of the rig."""
    return is_playback_modifier(modifier) or is_undeformed_modifier(modifier)


def is_undeformed_modifier(modifier: bpy.types.Modifier) -> bool:
    """Return whether a modifier is the one that makes Blender compute undeformed coordinates."""
    return modifier.type == "SMOOTH" and modifier.name.startswith(UNDEFORMED_MODIFIER_NAME)


def is_playback_modifier(modifier: bpy.types.Modifier) -> bool:
    """Return whether a modifier is an FDDA modifier, with or without its node group."""
    if modifier.type != "NODES":
        return False
    return modifier.name == MODIFIER_NAME if modifier.node_group is None else PLAYBACK_GROUP_KEY in modifier.node_group


def read_stack(mesh_object: bpy.types.Object) -> ModifierStack:
    """Sort the modifiers of a mesh object while no model plays.

    Geometry Nodes with an unknown effect are evaluated, to find out whether they keep the topology of the mesh.
    """
    modifiers = [m for m in mesh_object.modifiers if not is_fdda_modifier(m)]
    effects = [effect_of(m) for m in modifiers]
    generating = {ModifierEffect.GENERATES, ModifierEffect.UNKNOWN}
    generating_modifiers = [m for m, effect in zip(modifiers, effects, strict=True) if effect in generating]
    for i, modifier in enumerate(modifiers):
        if effects[i] is ModifierEffect.UNKNOWN and modifier.show_viewport:
            with _modifiers_disabled(mesh_object, [m for m in generating_modifiers if m != modifier]):
                effects[i] = ModifierEffect.DEFORMS if _keeps_topology(mesh_object) else ModifierEffect.GENERATES
    deforming = {ModifierEffect.DEFORMS, ModifierEffect.UNKNOWN}
    deforming_indices = [i for i, effect in enumerate(effects) if effect in deforming]
    original_mesh_modifier_indices = [i for i, m in enumerate(modifiers) if m.type in ORIGINAL_MESH_TYPES]
    # If all deforming modifiers are off, all of them count, because the user may switch them on later.
    effective_indices = [i for i in deforming_indices if modifiers[i].show_viewport] or deforming_indices
    last_replaced_index = max(effective_indices + original_mesh_modifier_indices, default=-1)
    fdda_index = _fdda_modifier_index(mesh_object)
    if fdda_index is not None and any(i < fdda_index for i in deforming_indices):
        last_replaced_index = fdda_index - 1
    generating_indices = [
        i for i, effect in enumerate(effects) if effect is ModifierEffect.GENERATES and modifiers[i].show_viewport
    ]
    downstream_candidates = sorted({*generating_indices, *effective_indices})
    return ModifierStack(
        replaced=tuple(
            m.name
            for i, m in enumerate(modifiers[: last_replaced_index + 1])
            if i in deforming_indices + original_mesh_modifier_indices
        ),
        misplaced=tuple(modifiers[i].name for i in generating_indices if i <= last_replaced_index),
        downstream=tuple(
            modifiers[i].name for i in downstream_candidates if i > last_replaced_index and modifiers[i].show_viewport
        ),
        insert_index=last_replaced_index + 1,
    )


def deforming_modifiers(mesh_object: bpy.types.Object) -> list[bpy.types.Modifier]:
    """Return the modifiers that a model replaces, in their order, on or off.

    For a bound object these are the modifiers before the FDDA modifier, and nothing is evaluated.
    """
    fdda_index = _fdda_modifier_index(mesh_object)
    if fdda_index is not None:
        return [m for m in mesh_object.modifiers[:fdda_index] if effect_of(m) is not ModifierEffect.NEUTRAL]
    return [mesh_object.modifiers[name] for name in read_stack(mesh_object).replaced]


def recorded_modifiers(mesh_object: bpy.types.Object) -> list[bpy.types.Modifier]:
    """Return the modifiers whose effect a model includes, in their order: all that are on while the rig is shown."""
    index = _fdda_modifier_index(mesh_object)
    if index is None:
        index = read_stack(mesh_object).insert_index
    candidates = [
        m
        for m in mesh_object.modifiers[:index]
        if effect_of(m) is not ModifierEffect.NEUTRAL or m.type in INDIRECT_TYPES
    ]
    binding = getattr(mesh_object, "fdda", None)
    if binding is None or not binding.is_playing:
        return [m for m in candidates if m.show_viewport]
    stored_visibilities = {saved.uid: saved for saved in binding.modifiers}
    modifiers = []
    for modifier in candidates:
        visibility = stored_visibilities.get(modifier.persistent_uid, modifier)
        # A modifier that is on in renders alone changes the topology there, before the FDDA modifier.
        generates = effect_of(modifier) is ModifierEffect.GENERATES and binding.use_in_render and visibility.show_render
        if visibility.show_viewport or generates:
            modifiers.append(modifier)
    return modifiers


def replaced_range(mesh_object: bpy.types.Object) -> tuple[list[bpy.types.Modifier], int]:
    """Return the last two arguments of `find_shape_readers` for a bound object."""
    deforming = [m for m in recorded_modifiers(mesh_object) if effect_of(m) is not ModifierEffect.NEUTRAL]
    return deforming, _fdda_modifier_index(mesh_object) or 0


def find_shape_readers(
    mesh_object: bpy.types.Object, deforming: Iterable[bpy.types.Modifier], end: int
) -> list[bpy.types.Modifier]:
    """Return the neutral modifiers before the last deforming one whose result depends on the positions of the vertices.

    They stay on while a model plays, and then see the rest pose. Those are left out whose result only deforming
    modifiers read, such as weights.

    Args:
        deforming: the modifiers that a model replaces and that are on while the rig is shown.
        end: index after the last modifier that a model replaces.
    """
    binding, deforming_names = getattr(mesh_object, "fdda", None), {modifier.name for modifier in deforming}
    in_render = binding is not None and binding.is_bound and binding.use_in_render
    enabled = [
        (index, modifier)
        for index, modifier in enumerate(mesh_object.modifiers)
        if modifier.name not in deforming_names
        and not is_fdda_modifier(modifier)
        and (modifier.show_viewport or (in_render and modifier.show_render))
    ]
    readers = []
    for index, modifier in enabled:
        if index >= end or effect_of(modifier) is not ModifierEffect.NEUTRAL or not reads_shape(modifier):
            continue
        names = written_names(modifier)
        later_names = {m.name for m in mesh_object.modifiers[index + 1 :]} & deforming_names
        rig_reads = {name for each in later_names for name in read_names(mesh_object.modifiers[each])}
        others_read = {name for _, other in enabled if other != modifier for name in read_names(other)}
        if names is None or not names <= rig_reads - others_read - _material_attributes(mesh_object):
            readers.append(modifier)
    return readers


def check_shape_readers(mesh_object: bpy.types.Object, deforming: Iterable[bpy.types.Modifier], end: int) -> None:
    """Check that no neutral modifier sees the rest pose only while a model plays.

    Args:
        mesh_object, deforming, end: as for `find_shape_readers`.

    Raises:
        RigError: a modifier does.
    """
    first_index = min((mesh_object.modifiers.find(modifier.name) for modifier in deforming), default=end)
    last = next((m for m in mesh_object.modifiers[end:] if is_playback_modifier(m)), mesh_object.modifiers[end - 1])
    for modifier in find_shape_readers(mesh_object, deforming, end):
        if mesh_object.modifiers.find(modifier.name) > first_index:
            raise RigError(
                f"Modifier '{modifier.name}' of '{mesh_object.name}' depends on the shape of the mesh, and stands "
                f"between modifiers that a model replaces, so it would see the rest pose; move it behind "
                f"'{last.name}', or switch it off in the viewport."
            )


def _fdda_modifier_index(mesh_object: bpy.types.Object) -> int | None:
    """Return the index of the FDDA modifier; None if there is none."""
    return next((index for index, modifier in enumerate(mesh_object.modifiers) if is_playback_modifier(modifier)), None)


def check_stack(mesh_object: bpy.types.Object) -> ModifierStack:
    """Sort the modifiers of a mesh object, and check that a model can replace those that are on.

    Raises:
        RigError: a modifier depends on time or is not bound, or one that changes the topology or depends on the shape
            of the mesh stands before another one that deforms.
    """
    stack = read_stack(mesh_object)
    for name in (m.name for m in mesh_object.modifiers if m.show_viewport):
        modifier = mesh_object.modifiers[name]
        subject = f"Modifier '{name}' of '{mesh_object.name}'"
        if name in stack.replaced + stack.misplaced and (verb := time_dependence(modifier)):
            raise RigError(
                f"{subject} {verb}, so its result does not follow from the pose; switch it off in the viewport, or "
                "remove it."
            )
        if is_unbound(modifier):
            raise RigError(
                f"{subject} is not bound, so it does nothing; bind it first, or switch it off in the viewport."
            )
    for name in stack.misplaced:
        subject = f"Modifier '{name}' of '{mesh_object.name}' changes the topology of the mesh"
        if mesh_object.modifiers[name].type in ORIGINAL_MESH_TYPES:
            raise RigError(
                f"{subject}, and Blender lets nothing that plays a model stand before it; switch it off in the "
                "viewport, or apply it."
            )
        raise RigError(
            f"{subject} before '{stack.replaced[-1]}', which a model replaces, so its vertices cannot be followed; "
            "move it to the end of the modifiers, switch it off in the viewport, or apply it."
        )
    deforming = [mesh_object.modifiers[name] for name in stack.replaced if mesh_object.modifiers[name].show_viewport]
    check_shape_readers(mesh_object, deforming, stack.insert_index)
    return stack


def check_posable(scene_rig: SceneRig) -> None:
    """Check that animation moves a rig.

    Raises:
        RigError: the rig is in edit mode, in the NLA's tweak mode or in its rest position, or its Armature modifier is
            off.
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


def check_evaluable(scene_rig: SceneRig) -> ModifierStack:
    """Sort the modifiers of a rig, and check that its evaluated mesh can be compared with a model."""
    check_posable(scene_rig)
    mesh_object = scene_rig.mesh_object
    _evaluated_object(mesh_object)
    stack = check_stack(mesh_object)
    if not stack.downstream:
        _check_vertex_count(mesh_object, stack)
    return stack


@contextmanager
def downstream_disabled(mesh_object: bpy.types.Object, *, checks_vertices: bool = True) -> Iterator[None]:
    """Switch the downstream modifiers off, and check that the evaluated mesh has the vertices of the original one."""
    stack = read_stack(mesh_object)
    with _modifiers_disabled(mesh_object, [mesh_object.modifiers[name] for name in stack.downstream]):
        if checks_vertices:
            _check_vertex_count(mesh_object, stack)
        yield


@contextmanager
def _modifiers_disabled(mesh_object: bpy.types.Object, modifiers: Iterable[bpy.types.Modifier]) -> Iterator[None]:
    # Find the modifiers by their identifiers, because the user may add modifiers while a job runs.
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


def _evaluated_object(mesh_object: bpy.types.Object) -> bpy.types.Object:
    evaluated = mesh_object.evaluated_get(bpy.context.evaluated_depsgraph_get())
    if not evaluated.is_evaluated:
        raise RigError(f"'{mesh_object.name}' is hidden, so Blender does not evaluate it; show it in the viewport.")
    return evaluated


def _keeps_topology(mesh_object: bpy.types.Object) -> bool:
    original_mesh, evaluated_mesh = mesh_object.data, _evaluated_object(mesh_object).data
    if any(
        len(getattr(original_mesh, name)) != len(getattr(evaluated_mesh, name))
        for name in ("vertices", "edges", "loops")
    ):
        return False
    return all(
        (original_array == evaluated_array).all()
        for original_array, evaluated_array in zip(topology(original_mesh), topology(evaluated_mesh), strict=True)
    )


def _check_vertex_count(mesh_object: bpy.types.Object, stack: ModifierStack) -> None:
    evaluated_count = len(_evaluated_object(mesh_object).data.vertices)
    if evaluated_count != len(mesh_object.data.vertices):
        other_names = [m.name for m in mesh_object.modifiers if m.name not in stack.replaced and m.show_viewport]
        suspect_names = stack.downstream or other_names or stack.replaced
        raise RigError(
            f"The modifiers of '{mesh_object.name}' turn {len(mesh_object.data.vertices)} vertices into "
            f"{evaluated_count}; switch off the one that changes the topology ({', '.join(suspect_names)})."
        )


def _material_attributes(mesh_object: bpy.types.Object) -> set[str]:
    """Return the names of the attributes and UV maps that the materials of an object read."""
    materials = [slot.material for slot in mesh_object.material_slots if slot.material is not None]
    nodes = [node for material in materials for node in tree_nodes(material.node_tree)]
    properties = ("attribute_name", "layer_name", "uv_map")
    return {getattr(node, name) for node in nodes for name in properties if hasattr(node, name)}
