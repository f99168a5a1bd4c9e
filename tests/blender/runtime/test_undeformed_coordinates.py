# SPDX-License-Identifier: GPL-3.0-or-later
"""Generated texture coordinates of a character that plays a model are the same in every pose, as with its rig."""

import bpy
import numpy as np
import pytest

from fdda_addon.runtime.binding import unbind

from ..conftest import ELBOW_RIG, assert_plays, evaluated_positions, pose
from ..linked import overridden_meshes
from ..playback import add_shape_key


class CoordinateEngine(bpy.types.RenderEngine):
    """A render engine that reads the vertices of the elbow as other engines do."""

    bl_idname = "FDDA_COORDINATES"
    bl_label = "Coordinates"

    def render(self, depsgraph):
        meshes = [i.object.data for i in depsgraph.object_instances if i.object.type == "MESH"]
        (mesh,) = [mesh for mesh in meshes if len(mesh.vertices) > 100]
        type(self).shown = np.array([vertex.co for vertex in mesh.vertices])
        type(self).undeformed = np.array([vertex.undeformed_co for vertex in mesh.vertices])
        type(self).attributes = set(mesh.attributes.keys())


@pytest.fixture
def render():
    bpy.utils.register_class(CoordinateEngine)

    def render() -> type[CoordinateEngine]:
        scene = bpy.context.scene
        scene.render.engine, scene.render.resolution_x, scene.render.resolution_y = "FDDA_COORDINATES", 8, 8
        scene.camera = bpy.data.objects.new("camera", bpy.data.cameras.new("camera"))
        scene.collection.objects.link(scene.camera)
        bpy.ops.render.render()
        return CoordinateEngine

    yield render
    bpy.utils.unregister_class(CoordinateEngine)


CHANGES = {
    "full": lambda _: None,
    "strength": lambda o: setattr(o.fdda, "strength", 0.5),
    "mask": lambda o: setattr(o.fdda, "mask", "lower"),
    "linear": lambda o: setattr(o.fdda, "mode", "LINEAR"),
    "rig": lambda o: setattr(o.fdda, "mode", "RIG"),
    "subdivided": lambda o: o.modifiers.new("Subdivision", "SUBSURF"),
    "displaced": lambda o: setattr(o.modifiers.new("Displace", "DISPLACE"), "strength", 0.02),
    "shape key": add_shape_key,
}


@pytest.mark.parametrize("change", CHANGES.values(), ids=CHANGES)
def test_undeformed_coordinates_do_not_follow_the_pose(change, bound_elbow, render):
    # Rendering would set the pose of the action again.
    bpy.data.objects[ELBOW_RIG].animation_data_clear()
    change(bound_elbow)
    bound_elbow.fdda.use_in_render = True
    pose(angle=0.0)
    bound_elbow.fdda.mode, mode = "RIG", bound_elbow.fdda.mode
    at_rest = render().undeformed
    bound_elbow.fdda.mode = mode
    for angle in (0.3, 1.5):
        pose(angle=angle)
        rendered = render()
        np.testing.assert_allclose(rendered.undeformed, at_rest, atol=1e-6)
        assert np.abs(rendered.shown - at_rest).max() > 0.01
        assert "rest_position" not in rendered.attributes


def test_add_rest_position_stays_as_the_user_sets_it(bound_elbow, elbow_files, render):
    bound_elbow.fdda.use_in_render = True
    bound_elbow.fdda.mode = "RIG"
    assert not bound_elbow.add_rest_position_attribute
    bound_elbow.add_rest_position_attribute = True
    bound_elbow.fdda.mode = "FDDA"
    pose(angle=1.0)
    assert "rest_position" in render().attributes
    bound_elbow.fdda.mode = "RIG"
    assert bound_elbow.add_rest_position_attribute
    bound_elbow.fdda.mode = "FDDA"
    # Switched off while the model plays.
    bound_elbow.add_rest_position_attribute = False
    pose(angle=0.7)
    assert_plays(bound_elbow, elbow_files.model)
    assert "rest_position" not in render().attributes
    unbind(bound_elbow)
    assert not bound_elbow.add_rest_position_attribute
    assert [m.name for m in bound_elbow.modifiers] == ["Armature", "CorrectiveSmooth"]


def test_an_attribute_of_the_mesh_with_the_same_name_is_kept(bound_elbow, elbow_files):
    """Blender must not overwrite it, so the coordinates of such a mesh follow the pose."""
    stored = np.random.default_rng(0).random((len(bound_elbow.data.vertices), 3), np.float32)
    bound_elbow.fdda.mode = "RIG"
    attribute = bound_elbow.data.attributes.new("rest_position", "FLOAT_VECTOR", "POINT")
    attribute.data.foreach_set("vector", stored.ravel())
    bound_elbow.fdda.mode = "FDDA"
    pose(angle=1.0)
    assert_plays(bound_elbow, elbow_files.model)
    shown = np.empty(stored.size, np.float32)
    evaluated = bound_elbow.evaluated_get(bpy.context.evaluated_depsgraph_get()).data
    evaluated.attributes["rest_position"].data.foreach_get("vector", shown)
    assert (shown.reshape(-1, 3) == stored).all()
    bound_elbow.data.attributes.remove(bound_elbow.data.attributes["rest_position"])
    for angle in (0.5, 0.6):
        pose(angle=angle)
    assert_plays(bound_elbow, elbow_files.model)


def test_overridden_characters(pair, render):
    mesh_object = overridden_meshes()[0]
    mesh_object.fdda.use_in_render = True
    mesh_object.name = "elbow 0"
    for other in pair:
        if other != mesh_object:
            other.hide_render = True
    at_rest = np.array([vertex.co for vertex in mesh_object.data.vertices])
    pose(mesh_object.parent.name if mesh_object.parent else mesh_object.modifiers[0].object.name, angle=1.2)
    rendered = render()
    np.testing.assert_allclose(rendered.undeformed, at_rest, atol=1e-6)
    assert np.abs(rendered.shown - at_rest).max() > 0.01
    assert np.abs(evaluated_positions(mesh_object) - at_rest).max() > 0.01
