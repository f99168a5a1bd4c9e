# SPDX-License-Identifier: GPL-3.0-or-later
"""The exporters of Blender write skeleton, weights and rest pose of a character, also while it plays a model."""

import addon_utils
import bpy
import numpy as np
import pytest

from fdda_addon.runtime import gltf_export

from ..conftest import ELBOW_RIG, assert_plays, pose


def rest_positions() -> np.ndarray:
    """Return the positions of the imported mesh in the rest position of its armature, and check that it has one."""
    mesh_object = next(o for o in bpy.data.objects if o.type == "MESH" and len(o.data.vertices) > 100)
    assert [m.type for m in mesh_object.modifiers] == ["ARMATURE"] and len(mesh_object.vertex_groups) == 2
    mesh_object.modifiers[0].object.data.pose_position = "REST"
    bpy.context.view_layer.update()
    evaluated = mesh_object.evaluated_get(bpy.context.evaluated_depsgraph_get())
    return np.array([evaluated.matrix_world @ vertex.co for vertex in evaluated.data.vertices])


def assert_same_surface(imported: np.ndarray, mesh: np.ndarray) -> None:
    """Assert that each vertex lies on one of the mesh; importers sort and split vertices."""
    distances = np.linalg.norm(imported[:, None] - mesh[None], axis=2).min(axis=1)
    assert distances.max() < 1e-5


@pytest.mark.parametrize("use_in_render", [False, True], ids=["viewport", "render"])
@pytest.mark.parametrize("use_collection", [False, True], ids=["file", "collection"])
def test_gltf_with_applied_modifiers(use_collection, use_in_render, bound_elbow, elbow_files, tmp_path):
    addon_utils.enable("io_scene_gltf2")
    if gltf_export.__name__ not in bpy.context.preferences.addons:
        # Tests reset the preferences.
        bpy.context.preferences.addons.new().module = gltf_export.__name__
    bound_elbow.fdda.use_in_render = use_in_render
    bpy.data.objects[ELBOW_RIG].animation_data_clear()
    pose(angle=1.5)
    path, rest = str(tmp_path / "elbow.glb"), np.array([v.co for v in bound_elbow.data.vertices])
    if use_collection:
        collection = bpy.data.collections.new("export")
        bpy.context.scene.collection.children.link(collection)
        for scene_object in (bound_elbow, bpy.data.objects[ELBOW_RIG]):
            collection.objects.link(scene_object)
        layer_collection = bpy.context.view_layer.layer_collection.children["export"]
        bpy.context.view_layer.active_layer_collection = layer_collection
        bpy.ops.collection.exporter_add(name="IO_FH_gltf2")
        settings = collection.exporters[0].export_properties
        settings.filepath, settings.export_apply = path, True
        bpy.ops.collection.export_all()
    else:
        bpy.ops.export_scene.gltf(filepath=path, export_apply=True, export_skins=True)
    assert_plays(bound_elbow, elbow_files.model)
    assert not bound_elbow.fdda.status
    bpy.ops.wm.read_factory_settings(use_empty=True)
    addon_utils.enable("io_scene_gltf2")
    bpy.ops.import_scene.gltf(filepath=path)
    assert_same_surface(rest_positions(), rest)


@pytest.mark.parametrize("use_in_render", [False, True], ids=["viewport", "render"])
@pytest.mark.parametrize("evaluation", ["RENDER", "VIEWPORT"])
@pytest.mark.parametrize("animation", [False, True], ids=["frame", "animation"])
def test_usd(animation, evaluation, use_in_render, bound_elbow, elbow_files, tmp_path):
    bound_elbow.fdda.use_in_render = use_in_render
    bpy.data.objects[ELBOW_RIG].animation_data_clear()
    pose(angle=1.5)
    path, rest = str(tmp_path / "elbow.usda"), np.array([v.co for v in bound_elbow.data.vertices])
    bpy.context.scene.frame_end = 2
    bpy.ops.wm.usd_export(filepath=path, export_armatures=True, export_animation=animation, evaluation_mode=evaluation)
    assert_plays(bound_elbow, elbow_files.model)
    bpy.ops.wm.read_factory_settings(use_empty=True)
    bpy.ops.wm.usd_import(filepath=path)
    assert_same_surface(rest_positions(), rest)
