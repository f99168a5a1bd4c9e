# SPDX-License-Identifier: GPL-3.0-or-later
"""Finds the objects, bones, drivers and datablocks on which the surface of an object depends, without an evaluation."""

import re
from collections.abc import Iterable, Iterator

import bpy

from ..core.controls import EVALUATION_TIME, SHAPE_KEY_PATH
from ..scene.compatibility import node_input_settings
from ..scene.controls import canonical_path, fcurve_target, owner_name
from ..scene.scene_rig import SceneRig
from .modifier_stack import is_fdda_modifier
from .references import deforming_bones, is_transform_channel, references, split_bone_path

_MODIFIER_PATH = re.compile(r'modifiers\["(?P<name>(?:[^"\\]|\\.)*)"\](?P<rest>.*)')
_CHANNEL_PATHS = {
    **{f"LOC_{axis}": f"location[{index}]" for index, axis in enumerate("XYZ")},
    **{f"ROT_{axis}": f"rotation_euler[{index}]" for index, axis in enumerate("XYZ")},
    **{f"SCALE_{axis}": f"scale[{index}]" for index, axis in enumerate("XYZ")},
}
"""Path of a transform channel by its type in a driver variable."""
TRANSFORM_PREFIXES = ("location", "rotation_", "scale", "delta_", "constraints[")
_GEOMETRY_CONSTRAINTS = {"SHRINKWRAP", "FOLLOW_PATH", "CLAMP_TO"}
"""Constraints that read the geometry of their target, not only its transform."""
_TRANSFORM_MODIFIERS = {"HOOK", "CAST", "WARP", "SIMPLE_DEFORM", "MIRROR", "DISPLACE", "WAVE", "UV_WARP", "UV_PROJECT"}
"""Modifiers that read the transform of an object, but not its geometry."""

OwnedCurve = tuple[bpy.types.ID, bpy.types.FCurve]
"""A datablock, and one of its F-curves or drivers."""


class Sources:
    """Everything on which the surface of an object depends. Holds RNA references, so do not store it.

    It does not include the armature object of the rig, whose pose is the input of a model. It also does not include the
    carriers of the rig: the parents and constraint targets that move its mesh and armature objects as a whole.

    Attributes:
        objects: the object itself, then the objects on which it depends. The value is True if the geometry is read,
            False if only the transform is read.
        datablocks: other datablocks that can be animated; the values are the prefixes of their controls' names.
        bones: names of bones by armature object, including the rig's; for other armatures with all their ancestors.
        drivers: the drivers that set properties of any of these.
        numbers: datablock and RNA path of each number that the drivers read, except bones of the rig's armature.
        scene_reads: drivers that read a scene, each with the scene and the path.
        carriers: the armature object of the rig, and the carriers of the rig.
    """

    def __init__(
        self,
        scene_rig: SceneRig,
        root: bpy.types.Object,
        modifiers: Iterable[str] | None = None,
        *,
        follows_shape_keys: bool = True,
    ):
        """Find everything on which the surface of an object depends.

        Args:
            root: one of its mesh objects, or a target.
            modifiers: names of the modifiers of `root` to follow. If they are given, only modifiers that are on and
                drivers that can move the surface are followed. None to follow everything.
            follows_shape_keys: follow the drivers of the shape keys of the rig's meshes. Their values are inputs of a
                model.
        """
        self._rig, self._root = scene_rig, root
        self._follows_shape_keys = follows_shape_keys
        self._only_active, self._modifiers = modifiers is not None, frozenset(modifiers or ())
        carriers = [scene_rig.mesh_object, scene_rig.armature_object]
        for scene_object in carriers:
            carriers += [o for o in followed_objects(scene_object) if o not in carriers]
        self.carriers = set(carriers) - {*scene_rig.mesh_objects}
        self.objects: dict[bpy.types.Object, bool] = {}
        self.datablocks: dict[bpy.types.ID, str] = {}
        self.bones: dict[bpy.types.Object, set[str]] = {}
        self.drivers: dict[tuple, OwnedCurve] = {}
        self.numbers: dict[tuple[bpy.types.ID, str], None] = {}
        self.scene_reads: list[tuple[OwnedCurve, bpy.types.ID, str]] = []
        self._queue: list[bpy.types.Object] = []
        self._add_object(root, uses_geometry=True)
        while self._queue:
            self._follow_object(self._queue.pop(0))

    @property
    def rig_bones(self) -> set[str]:
        """Return the names of the bones of the rig's own armature."""
        return self.bones.get(self._rig.armature_object, set())

    def affects_surface(self, datablock: bpy.types.ID, path: str) -> bool:
        """Return whether a property of a found datablock can move the surface; a custom property alone cannot."""
        path = canonical_path(datablock, path)
        if path.startswith('["'):
            return False
        if isinstance(datablock, bpy.types.Key):
            return not any(block.mute and path == block.path_from_id("value") for block in datablock.key_blocks)
        if not isinstance(datablock, bpy.types.Object):
            return True
        if match := _MODIFIER_PATH.fullmatch(path):
            name = bpy.utils.unescape_identifier(match["name"])
            is_used = self._is_followed(datablock, datablock.modifiers.get(name)) or match["rest"] == ".show_viewport"
            is_ignored = self._only_active and datablock == self._root and name not in self._modifiers
            return is_used and not is_ignored and match["rest"] not in {".show_render", ".show_in_editmode"}
        bone_name, subpath = split_bone_path(datablock, path)
        if bone_name:
            return bone_name in self.bones.get(datablock, ()) and not subpath.startswith('["')
        return datablock != self._root and path.startswith(TRANSFORM_PREFIXES)

    def control_name(self, datablock: bpy.types.ID, path: str) -> str:
        """Return the name of the control at a path of a datablock; empty if the datablock cannot have controls."""
        if datablock in self.datablocks:
            return f"{self.datablocks[datablock]}{path}"
        owner = owner_name(self._rig, datablock)
        return f"{owner}/{path}" if owner else ""

    def _is_followed(self, scene_object: bpy.types.Object, modifier: bpy.types.Modifier | None) -> bool:
        """Return whether a modifier of an object is followed. The FDDA modifier is not: it replaces the rig."""
        if modifier is not None and is_fdda_modifier(modifier):
            return False
        if modifier is None or not self._only_active:
            return modifier is not None
        if scene_object == self._root and modifier.name not in self._modifiers:
            return False
        return modifier.show_viewport and self.objects.get(scene_object, False)

    def _add_object(self, scene_object: bpy.types.Object | None, uses_geometry: bool) -> None:
        # The other meshes of a rig are roots themselves.
        is_rig_mesh = scene_object != self._root and scene_object in self._rig.mesh_objects
        if scene_object is None or scene_object in self.carriers or is_rig_mesh:
            return
        if scene_object not in self.objects or (uses_geometry and not self.objects[scene_object]):
            self.objects[scene_object] = uses_geometry
            self._queue.append(scene_object)

    def _add_bones(self, armature_object: bpy.types.Object, names: Iterable[str], is_deforming: bool = False) -> None:
        is_rig_armature = armature_object == self._rig.armature_object
        if armature_object in self.carriers and not is_rig_armature and not is_deforming:
            return
        followed = self.bones.setdefault(armature_object, set())
        new_names = {name for name in names if name in armature_object.pose.bones} - followed
        if is_rig_armature:
            followed |= new_names
            return
        bones = armature_object.data.bones
        new_names |= {parent.name for name in new_names for parent in bones[name].parent_recursive} - followed
        followed |= new_names
        self._add_object(armature_object, uses_geometry=False)
        for bone in (armature_object.pose.bones[name] for name in sorted(new_names)):
            self._follow_constraints(bone.constraints)
        self._follow_drivers(armature_object)

    def _add_datablock(self, datablock: bpy.types.ID | None, name_prefix: str) -> None:
        if datablock is not None and datablock not in self.datablocks:
            self.datablocks[datablock] = name_prefix
            self._follow_drivers(datablock)

    def _follow_object(self, scene_object: bpy.types.Object) -> None:
        """Add what an object depends on."""
        parent = scene_object.parent
        if parent is not None:
            if parent.type == "ARMATURE" and scene_object.parent_type == "BONE":
                self._add_bones(parent, [scene_object.parent_bone])
            elif parent.type == "ARMATURE" and scene_object.parent_type == "ARMATURE":
                names = (bone for _, bone, _ in deforming_bones(scene_object, parent))
                self._add_bones(parent, names, is_deforming=True)
            else:
                self._add_object(parent, uses_geometry=scene_object.parent_type not in {"OBJECT", "BONE"})
        self._follow_constraints(scene_object.constraints)
        self._follow_drivers(scene_object)
        if not self.objects[scene_object]:
            return
        owner = owner_name(self._rig, scene_object)
        for modifier in scene_object.modifiers:
            if self._is_followed(scene_object, modifier):
                path = f'{owner}/modifiers["{bpy.utils.escape_identifier(modifier.name)}"].'
                self._follow_modifier(scene_object, modifier, path)
        data = scene_object.data
        if isinstance(data, bpy.types.ID) and scene_object.type != "ARMATURE":
            self._add_datablock(data, f"{owner}/data.")
            shape_keys = getattr(data, "shape_keys", None)
            is_rig_mesh = scene_object in self._rig.mesh_objects
            key_prefix = f"{owner_name(self._rig, shape_keys)}/" if is_rig_mesh else f"{owner}/data.shape_keys."
            self._add_datablock(shape_keys, key_prefix)
            for name in ("bevel_object", "taper_object"):
                self._add_object(getattr(data, name, None), uses_geometry=True)

    def _follow_modifier(self, scene_object: bpy.types.Object, modifier: bpy.types.Modifier, path: str) -> None:
        reads_rig = getattr(modifier, "object", None) == self._rig.armature_object
        is_rig_skinning = scene_object in self._rig.mesh_objects and reads_rig
        for armature_object, bone, _ in references(modifier):
            if bone:
                self._add_bones(armature_object, [bone])
        for prop in modifier.bl_rna.properties:
            value = getattr(modifier, prop.identifier) if prop.type == "POINTER" else None
            if isinstance(value, bpy.types.Object):
                if modifier.type == "ARMATURE":
                    # The weighted bones of the rig are joints in any case.
                    bones = () if is_rig_skinning else deforming_bones(scene_object, value)
                    self._add_bones(value, (bone for _, bone, _ in bones), is_deforming=True)
                else:
                    self._add_object(value, uses_geometry=modifier.type not in _TRANSFORM_MODIFIERS)
            elif isinstance(value, bpy.types.Collection):
                self._follow_values([value])
            elif isinstance(value, bpy.types.NodeTree):
                self._follow_nodes(value, f"{path}{prop.identifier}.")
                self._follow_values(setting for _, setting in node_input_settings(modifier).values())
            elif isinstance(value, bpy.types.Texture | bpy.types.CacheFile):
                self._add_datablock(value, f"{path}{prop.identifier}.")
                if getattr(value, "node_tree", None):
                    self._follow_nodes(value.node_tree, f"{path}{prop.identifier}.node_tree.")

    def _follow_nodes(self, tree: bpy.types.NodeTree, name_prefix: str) -> None:
        if tree in self.datablocks:
            return
        self._add_datablock(tree, name_prefix)
        for node in (node for node in tree.nodes if not node.mute):
            self._follow_values(getattr(socket, "default_value", None) for socket in node.inputs)
            if node.type == "GROUP" and node.node_tree:
                node_prefix = f'{name_prefix}nodes["{bpy.utils.escape_identifier(node.name)}"].node_tree.'
                self._follow_nodes(node.node_tree, node_prefix)

    def _follow_values(self, values: Iterable[object]) -> None:
        for value in values:
            if isinstance(value, bpy.types.Object):
                self._add_object(value, uses_geometry=True)
            elif isinstance(value, bpy.types.Collection):
                for member in value.all_objects:
                    self._add_object(member, uses_geometry=True)

    def _follow_constraints(self, constraints: Iterable[bpy.types.Constraint]) -> None:
        for constraint in constraints:
            if constraint.mute:
                continue
            has_subtarget = bool(getattr(constraint, "subtarget", "") or getattr(constraint, "pole_subtarget", ""))
            for target, bone, _ in references(constraint):
                if bone:
                    self._add_bones(target, [bone])
                elif isinstance(target, bpy.types.Object):
                    uses_geometry = constraint.type in _GEOMETRY_CONSTRAINTS or has_subtarget
                    self._add_object(target, uses_geometry=uses_geometry and target.type != "ARMATURE")

    def _follow_drivers(self, datablock: bpy.types.ID) -> None:
        animation = datablock.animation_data
        for curve in animation.drivers if animation else ():
            # Of another armature, follow only the drivers that its bones need.
            follows_all = not self._only_active and getattr(datablock, "type", "") != "ARMATURE"
            if follows_all or (not curve.mute and self.affects_surface(datablock, curve.data_path)):
                self._add_driver(datablock, curve)

    def _add_driver(self, datablock: bpy.types.ID, curve: bpy.types.FCurve) -> None:
        driven_property = (datablock, curve.data_path, curve.array_index)
        meshes = self._rig.mesh_objects
        is_input = any(is_shape_key_value(mesh_object, datablock, curve.data_path) for mesh_object in meshes)
        if driven_property in self.drivers or (is_input and not self._follows_shape_keys):
            return
        self.drivers[driven_property] = datablock, curve
        for variable in curve.driver.variables:
            for target in variable.targets:
                if variable.type == "CONTEXT_PROP":
                    self.scene_reads.append(((datablock, curve), bpy.context.scene, target.data_path))
                elif target.id is None:
                    continue
                elif variable.type == "SINGLE_PROP":
                    self._follow_number((datablock, curve), target.id, target.data_path)
                else:
                    self._follow_transform(variable, target)

    def _follow_number(self, reader: OwnedCurve, datablock: bpy.types.ID, path: str) -> None:
        if isinstance(datablock, bpy.types.Scene):
            self.scene_reads.append((reader, datablock, path))
        path = canonical_path(datablock, path)
        bone_name, subpath = split_bone_path(datablock, path)
        if bone_name and datablock == self._rig.armature_object and is_transform_channel(subpath):
            self._add_bones(datablock, [bone_name])
            return
        self.numbers[datablock, path] = None
        owner, array_path, index = fcurve_target(datablock, path)
        for curve in owner.animation_data.drivers if owner.animation_data else ():
            driven_path = canonical_path(owner, curve.data_path)
            if (driven_path, curve.array_index) == (array_path, index) and not curve.mute:
                self._add_driver(owner, curve)

    def _follow_transform(self, variable: bpy.types.DriverVariable, target: bpy.types.DriverTarget) -> None:
        if not isinstance(target.id, bpy.types.Object):
            return
        if target.id.type == "ARMATURE" and target.bone_target:
            self._add_bones(target.id, [target.bone_target])
        elif target.id != self._rig.armature_object:
            self._add_object(target.id, uses_geometry=False)
            if variable.type == "TRANSFORMS" and (path := _CHANNEL_PATHS.get(target.transform_type)):
                self.numbers[target.id, path] = None


def is_shape_key_value(mesh_object: bpy.types.Object, datablock: bpy.types.ID, path: str) -> bool:
    """Return whether a path of a datablock leads to a shape key's value, or the evaluation time, of a mesh object."""
    if datablock != mesh_object.data.shape_keys:
        return False
    path = canonical_path(datablock, path)
    return path == EVALUATION_TIME or SHAPE_KEY_PATH.fullmatch(path) is not None


def followed_objects(scene_object: bpy.types.Object) -> Iterator[bpy.types.Object]:
    """Yield the parent of an object, and the objects that its constraints read."""
    if scene_object.parent is not None:
        yield scene_object.parent
    nodes = (node for c in scene_object.constraints if not c.mute for node in references(c))
    yield from (node.datablock for node in nodes if isinstance(node.datablock, bpy.types.Object))
