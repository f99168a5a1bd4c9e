# SPDX-License-Identifier: GPL-3.0-or-later
"""What the surface of an object is computed from: objects, bones, drivers, other datablocks. Nothing is evaluated."""

import re
from collections.abc import Iterable, Iterator

import bpy

from ..scene.compatibility import node_input
from ..scene.controls import fcurve_target, owner_name
from ..scene.scene_rig import SceneRig

_OF_BONE = re.compile(r'pose\.bones\["(?P<bone>(?:[^"\\]|\\.)*)"\]')
_OF_MODIFIER = re.compile(r'modifiers\["(?P<name>(?:[^"\\]|\\.)*)"\](?P<rest>.*)')
_CHANNEL = re.compile(r"\.(?:location|rotation_\w+|scale)(?:\[\d\])?")
_CHANNELS = {
    **{f"LOC_{axis}": f"location[{place}]" for place, axis in enumerate("XYZ")},
    **{f"ROT_{axis}": f"rotation_euler[{place}]" for place, axis in enumerate("XYZ")},
    **{f"SCALE_{axis}": f"scale[{place}]" for place, axis in enumerate("XYZ")},
}
_TRANSFORM = ("location", "rotation_", "scale", "delta_", "constraints[")
_SHAPE_CONSTRAINTS = {"SHRINKWRAP", "FOLLOW_PATH", "CLAMP_TO"}
"""Constraints that read the shape of their target, not only its transform."""
_TRANSFORM_MODIFIERS = {"HOOK", "CAST", "WARP", "SIMPLE_DEFORM", "MIRROR", "DISPLACE", "WAVE", "UV_WARP", "UV_PROJECT"}
"""Modifiers that read the transform of an object, and not its shape."""

Curve = tuple[bpy.types.ID, bpy.types.FCurve]
"""An F-curve or a driver, after the datablock that it is of."""


class Sources:
    """What the surface of an object is computed from. Holds RNA references: not to be kept.

    Neither the armature object of the rig is followed, whose pose is the input of a model, nor what carries the rig:
    the objects above its mesh and its armature.

    Attributes:
        objects: the object itself first; whether the shape of each counts, or its transform alone.
        datablocks: what else can be animated; the values are how a control names a path of it, without the path.
        bones: names of bones by armature object, that of the rig included; of others with the bones above them.
        drivers: those that set what is in here.
        numbers: datablock and RNA path of what the drivers read, bones of the rig's armature left out.
        scene_reads: drivers that read a scene, each with the scene and the path.
    """

    def __init__(self, scene_rig: SceneRig, root: bpy.types.Object, modifiers: Iterable[str] | None = None):
        """Args:
        scene_rig: the rig.
        root: its mesh object, or a target.
        modifiers: names of the modifiers of `root` that count, so that only what has an effect now is followed:
            modifiers that are on, drivers that move something. None for all that is there.
        """
        self._rig, self._root = scene_rig, root
        self._only_active, self._modifiers = modifiers is not None, frozenset(modifiers or ())
        self._carriers = _carriers(scene_rig)
        self.objects: dict[bpy.types.Object, bool] = {}
        self.datablocks: dict[bpy.types.ID, str] = {}
        self.bones: dict[bpy.types.Object, set[str]] = {}
        self.drivers: dict[tuple, Curve] = {}
        self.numbers: dict[tuple[bpy.types.ID, str], None] = {}
        self.scene_reads: list[tuple[Curve, bpy.types.ID, str]] = []
        self._waiting: list[bpy.types.Object] = []
        self._add_object(root, uses_geometry=True)
        while self._waiting:
            self._follow(self._waiting.pop(0))

    @property
    def rig_bones(self) -> set[str]:
        """Names of bones of the rig's own armature."""
        return self.bones.get(self._rig.armature_object, set())

    def affects_surface(self, datablock: bpy.types.ID, path: str) -> bool:
        """Whether what is at a path of one of these can move the surface; custom properties do not by themselves."""
        if path.startswith('["'):
            return False
        if isinstance(datablock, bpy.types.Key):
            return not any(block.mute and path == block.path_from_id("value") for block in datablock.key_blocks)
        if not isinstance(datablock, bpy.types.Object):
            return True
        if match := _OF_MODIFIER.fullmatch(path):
            name = bpy.utils.unescape_identifier(match["name"])
            is_used = self._uses(datablock, datablock.modifiers.get(name)) or match["rest"] == ".show_viewport"
            is_late = self._only_active and datablock == self._root and name not in self._modifiers
            return is_used and not is_late and match["rest"] not in {".show_render", ".show_in_editmode"}
        bone, rest = split_bone_path(path)
        if bone:
            return bone in self.bones.get(datablock, ()) and not rest.startswith('["')
        return datablock != self._root and path.startswith(_TRANSFORM)

    def control_name(self, datablock: bpy.types.ID, path: str) -> str:
        """The name of the control that a path of a datablock would be; empty where no control can belong to it."""
        if datablock in self.datablocks:
            return f"{self.datablocks[datablock]}{path}"
        owner = owner_name(self._rig, datablock)
        return f"{owner}/{path}" if owner else ""

    def _uses(self, scene_object: bpy.types.Object, modifier: bpy.types.Modifier | None) -> bool:
        if modifier is None or not self._only_active:
            return modifier is not None
        if scene_object == self._root and modifier.name not in self._modifiers:
            return False
        return modifier.show_viewport and self.objects.get(scene_object, False)

    def _add_object(self, found: bpy.types.Object | None, uses_geometry: bool) -> None:
        if found is None or found in self._carriers or (found != self._root and found == self._rig.mesh_object):
            return
        if found not in self.objects or (uses_geometry and not self.objects[found]):
            self.objects[found] = uses_geometry
            self._waiting.append(found)

    def _add_bones(self, armature_object: bpy.types.Object, names: Iterable[str], deforming: bool = False) -> None:
        is_own = armature_object == self._rig.armature_object
        if armature_object in self._carriers and not is_own and not deforming:
            return
        known = self.bones.setdefault(armature_object, set())
        new = {name for name in names if name in armature_object.pose.bones} - known
        if is_own:
            known |= new
            return
        new |= {above.name for name in new for above in armature_object.data.bones[name].parent_recursive} - known
        known |= new
        self._add_object(armature_object, uses_geometry=False)
        for bone in (armature_object.pose.bones[name] for name in sorted(new)):
            self._follow_constraints(bone.constraints)
        self._follow_drivers(armature_object)

    def _add_datablock(self, found: bpy.types.ID | None, name: str) -> None:
        if found is not None and found not in self.datablocks:
            self.datablocks[found] = name
            self._follow_drivers(found)

    def _follow(self, found: bpy.types.Object) -> None:
        parent = found.parent
        if parent is not None:
            if parent.type == "ARMATURE" and found.parent_type == "BONE":
                self._add_bones(parent, [found.parent_bone])
            elif parent.type == "ARMATURE" and found.parent_type == "ARMATURE":
                self._add_bones(parent, _deforming(found, parent), deforming=True)
            else:
                self._add_object(parent, uses_geometry=found.parent_type not in {"OBJECT", "BONE"})
        self._follow_constraints(found.constraints)
        self._follow_drivers(found)
        if not self.objects[found]:
            return
        owner = owner_name(self._rig, found)
        for modifier in found.modifiers:
            if self._uses(found, modifier):
                path = f'{owner}/modifiers["{bpy.utils.escape_identifier(modifier.name)}"].'
                self._follow_modifier(found, modifier, path)
        data = found.data
        if isinstance(data, bpy.types.ID) and found.type != "ARMATURE":
            self._add_datablock(data, f"{owner}/data.")
            keys = getattr(data, "shape_keys", None)
            self._add_datablock(keys, "shape_keys/" if found == self._rig.mesh_object else f"{owner}/data.shape_keys.")
            for name in ("bevel_object", "taper_object"):
                self._add_object(getattr(data, name, None), uses_geometry=True)

    def _follow_modifier(self, found: bpy.types.Object, modifier: bpy.types.Modifier, path: str) -> None:
        is_of_rig = found == self._rig.mesh_object and getattr(modifier, "object", None) == self._rig.armature_object
        for prop in modifier.bl_rna.properties:
            read = getattr(modifier, prop.identifier) if prop.type == "POINTER" else None
            if isinstance(read, bpy.types.Object):
                subtarget = getattr(modifier, "subtarget", "")
                if modifier.type == "ARMATURE":
                    # The bones of the rig that skin its mesh are those that have weights.
                    self._add_bones(read, () if is_of_rig else _deforming(found, read), deforming=True)
                elif read.type == "ARMATURE" and subtarget:
                    self._add_bones(read, [subtarget])
                else:
                    self._add_object(read, uses_geometry=modifier.type not in _TRANSFORM_MODIFIERS)
            elif isinstance(read, bpy.types.Collection):
                self._follow_values([read])
            elif isinstance(read, bpy.types.NodeTree):
                self._follow_nodes(read, f"{path}{prop.identifier}.")
                sockets = [i for i in read.interface.items_tree if i.item_type == "SOCKET" and i.in_out == "INPUT"]
                self._follow_values(node_input(modifier, socket.identifier) for socket in sockets)
            elif isinstance(read, bpy.types.Texture | bpy.types.CacheFile):
                self._add_datablock(read, f"{path}{prop.identifier}.")
                if getattr(read, "node_tree", None):
                    self._follow_nodes(read.node_tree, f"{path}{prop.identifier}.node_tree.")

    def _follow_nodes(self, tree: bpy.types.NodeTree, name: str) -> None:
        if tree in self.datablocks:
            return
        self._add_datablock(tree, name)
        for node in (node for node in tree.nodes if not node.mute):
            self._follow_values(getattr(socket, "default_value", None) for socket in node.inputs)
            if node.type == "GROUP" and node.node_tree:
                path = f'{name}nodes["{bpy.utils.escape_identifier(node.name)}"].node_tree.'
                self._follow_nodes(node.node_tree, path)

    def _follow_values(self, values: Iterable[object]) -> None:
        for value in values:
            if isinstance(value, bpy.types.Object):
                self._add_object(value, uses_geometry=True)
            elif isinstance(value, bpy.types.Collection):
                for found in value.all_objects:
                    self._add_object(found, uses_geometry=True)

    def _follow_constraints(self, constraints: Iterable[bpy.types.Constraint]) -> None:
        for constraint in constraints:
            if constraint.mute:
                continue
            for target, subtarget in _targets(constraint):
                if target.type == "ARMATURE" and subtarget:
                    self._add_bones(target, [subtarget])
                else:
                    uses_geometry = constraint.type in _SHAPE_CONSTRAINTS or bool(subtarget)
                    self._add_object(target, uses_geometry=uses_geometry)

    def _follow_drivers(self, datablock: bpy.types.ID) -> None:
        animation = datablock.animation_data
        for curve in animation.drivers if animation else ():
            # Of another armature only what its bones need; of all else, what is not asked for may be on later.
            is_any = not self._only_active and getattr(datablock, "type", "") != "ARMATURE"
            if is_any or (not curve.mute and self.affects_surface(datablock, curve.data_path)):
                self._add_driver(datablock, curve)

    def _add_driver(self, datablock: bpy.types.ID, curve: bpy.types.FCurve) -> None:
        place = (datablock, curve.data_path, curve.array_index)
        if place in self.drivers:
            return
        self.drivers[place] = datablock, curve
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

    def _follow_number(self, reader: Curve, datablock: bpy.types.ID, path: str) -> None:
        if isinstance(datablock, bpy.types.Scene):
            self.scene_reads.append((reader, datablock, path))
        bone, rest = split_bone_path(path)
        if bone and datablock == self._rig.armature_object and is_transform_channel(rest):
            self._add_bones(datablock, [bone])
            return
        self.numbers[datablock, path] = None
        own, array, index = fcurve_target(datablock, path)
        for curve in own.animation_data.drivers if own.animation_data else ():
            if (curve.data_path, curve.array_index) == (array, index) and not curve.mute:
                self._add_driver(own, curve)

    def _follow_transform(self, variable: bpy.types.DriverVariable, target: bpy.types.DriverTarget) -> None:
        if not isinstance(target.id, bpy.types.Object):
            return
        if target.id.type == "ARMATURE" and target.bone_target:
            self._add_bones(target.id, [target.bone_target])
        elif target.id != self._rig.armature_object:
            self._add_object(target.id, uses_geometry=False)
            if variable.type == "TRANSFORMS" and (path := _CHANNELS.get(target.transform_type)):
                self.numbers[target.id, path] = None


def split_bone_path(path: str) -> tuple[str, str]:
    """The bone that a path of an armature object begins with, empty for none, and the rest of the path."""
    match = _OF_BONE.match(path)
    return (bpy.utils.unescape_identifier(match["bone"]), path[match.end() :]) if match else ("", path)


def is_transform_channel(rest: str) -> bool:
    """Whether what follows the bone in a path is a location, a rotation or a scale."""
    return _CHANNEL.fullmatch(rest) is not None


def _carriers(scene_rig: SceneRig) -> set[bpy.types.Object]:
    """The armature object of a rig, and the objects that mesh and armature follow as a whole."""
    found = [scene_rig.mesh_object, scene_rig.armature_object]
    for scene_object in found:
        targets = [target for c in scene_object.constraints if not c.mute for target, _ in _targets(c)]
        found += [o for o in (scene_object.parent, *targets) if o is not None and o not in found]
    return set(found) - {scene_rig.mesh_object}


def _targets(constraint: bpy.types.Constraint) -> Iterator[tuple[bpy.types.Object, str]]:
    """The objects that a constraint reads, each with the name of a bone or of a vertex group."""
    owners = [(constraint, "target", "subtarget"), (constraint, "pole_target", "pole_subtarget")]
    owners += [(target, "target", "subtarget") for target in getattr(constraint, "targets", ())]
    for owner, target, subtarget in owners:
        if (found := getattr(owner, target, None)) is not None:
            yield found, getattr(owner, subtarget, "")


def _deforming(scene_object: bpy.types.Object, armature_object: bpy.types.Object) -> set[str]:
    """Names of the bones of an armature that deform an object."""
    groups = {group.name for group in scene_object.vertex_groups}
    return {b.name for b in armature_object.data.bones if b.use_deform and (b.name in groups or not groups)}
