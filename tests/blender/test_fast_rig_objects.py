# SPDX-License-Identifier: GPL-3.0-or-later
"""Which objects and actions a fast rig keeps: those that renders show, what these collide with, and all actions."""

import bpy
import pytest

from blend_fixtures.characters.base import link
from blend_fixtures.characters.dependencies import studio_arm
from fdda_addon.fast_rig.removal import remove_unneeded
from fdda_addon.scene.blend_file import save_copy
from fdda_addon.scene.scene_rig import SceneRig


def add_mesh_object(name: str, is_rendered: bool = True) -> bpy.types.Object:
    """Add an object with a mesh of one vertex."""
    mesh = bpy.data.meshes.new(name)
    mesh.from_pydata([(0.0, 0.0, 0.0)], [], [])
    scene_object = link(bpy.data.objects.new(name, mesh))
    scene_object.hide_render = not is_rendered
    return scene_object


def remove(scene_rig: SceneRig) -> tuple[str, ...]:
    """Remove what `lower` and `control` do not need, and return the names of the removed objects."""
    return remove_unneeded([scene_rig], ["lower"], ["control"]).objects


@pytest.mark.parametrize("is_driven", [False, True])
def test_objects_that_renders_show_in_some_frames_stay(is_driven):
    scene_rig = SceneRig(*studio_arm())
    prop = add_mesh_object("prop", is_rendered=False)
    add_mesh_object("never shown", is_rendered=False)
    if is_driven:
        prop.driver_add("hide_render").driver.expression = "1"
    else:
        prop.keyframe_insert("hide_render", frame=1)
    assert remove(scene_rig) == ("cage", "never shown")


@pytest.mark.parametrize("surface", ["none", "bevel", "extrusion", "fill", "NODES", "SCREW"])
def test_a_curve_that_deforms_the_mesh_stays_if_renders_show_it(surface):
    scene_rig = SceneRig(*studio_arm())
    data = bpy.data.curves.new("path", "CURVE")
    data.dimensions, data.fill_mode = ("2D", "BOTH") if surface == "fill" else ("3D", "FULL")
    spline = data.splines.new("POLY")
    spline.points.add(2)
    spline.use_cyclic_u = surface == "fill"
    data.bevel_depth, data.extrude = 0.01 * (surface == "bevel"), 0.01 * (surface == "extrusion")
    curve = link(bpy.data.objects.new("path", data))
    if surface.isupper():
        curve.modifiers.new("Surface", surface)
    scene_rig.mesh_object.modifiers.new("Curve", "CURVE").object = curve
    assert remove(scene_rig) == (("cage", "path") if surface == "none" else ("cage",))


@pytest.mark.parametrize("modifier", ["CLOTH", "SOFT_BODY", "PARTICLE_SYSTEM"])
def test_what_simulations_collide_with_stays(modifier):
    scene_rig = SceneRig(*studio_arm())
    simulated, collider = add_mesh_object("simulated"), add_mesh_object("collider", is_rendered=False)
    simulated.modifiers.new("Simulation", modifier)
    collider.modifiers.new("Collision", "COLLISION")
    wind = link(bpy.data.objects.new("wind", None))
    wind.hide_render = True
    bpy.context.view_layer.objects.active = wind
    bpy.ops.object.forcefield_toggle()
    assert remove(scene_rig) == ("cage",)
    # Without the simulation, nothing needs them.
    simulated.modifiers.clear()
    assert set(remove(scene_rig)) == {"collider", "wind"}


def test_rigid_bodies_and_their_constraints_stay_with_a_shown_one():
    scene_rig = SceneRig(*studio_arm())
    bpy.ops.rigidbody.world_add()
    bodies = {name: add_mesh_object(name, is_rendered=name == "falling") for name in ("falling", "floor", "weight")}
    for body in bodies.values():
        bpy.context.view_layer.objects.active = body
        bpy.ops.rigidbody.object_add(type="PASSIVE" if body.name == "floor" else "ACTIVE")
    rope = link(bpy.data.objects.new("rope", None))
    rope.hide_render = True
    bpy.context.view_layer.objects.active = rope
    bpy.ops.rigidbody.constraint_add()
    rope.rigid_body_constraint.object1, rope.rigid_body_constraint.object2 = bodies["falling"], bodies["weight"]
    assert remove(scene_rig) == ("cage",)
    # Without a shown rigid body, nothing needs them.
    bodies["falling"].hide_render = True
    assert set(remove(scene_rig)) == {"falling", "floor", "weight", "rope"}


def test_actions_that_only_removed_objects_use_are_saved(tmp_path):
    scene_rig = SceneRig(*studio_arm())
    cage = bpy.data.objects["cage"]
    cage.keyframe_insert("location", frame=1)
    cage.animation_data.action.name = "of the cage"
    assert cage.animation_data.action.users == 1
    remove(scene_rig)
    save_copy(tmp_path / "fast.blend")
    bpy.ops.wm.open_mainfile(filepath=str(tmp_path / "fast.blend"))
    assert "cage" not in bpy.data.objects and "of the cage" in bpy.data.actions
