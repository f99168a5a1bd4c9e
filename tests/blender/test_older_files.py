# SPDX-License-Identifier: GPL-3.0-or-later
"""Files bound by a version of the add-on that saved its cache objects play on, and lose what was left of it."""

import shutil
from pathlib import Path

import bpy
import numpy as np
import pytest

import fdda_addon
from fdda_addon.runtime import nodes

from .conftest import ELBOW, assert_plays, evaluated, pose, without_deformation

FIXTURES = Path(__file__).resolve().parents[2] / "blend_fixtures"
FILES = ["bound_by_handlers.blend", "caught_playing.blend"]


@pytest.fixture(params=FILES)
def path(request, elbow, tmp_path) -> Path:
    shutil.copy(without_deformation(elbow.model), tmp_path / "elbow.onnx")
    return Path(shutil.copy(FIXTURES / request.param, tmp_path / request.param))


def shape_key_state(mesh_object):
    return mesh_object.show_only_shape_key, mesh_object.active_shape_key_index


def test_it_plays_and_nothing_old_is_left(path, elbow):
    bpy.ops.wm.open_mainfile(filepath=str(path))
    mesh_object = bpy.data.objects[ELBOW]
    bpy.context.view_layer.update()
    assert_plays(mesh_object, elbow.model)
    pose(angle=1.3)
    assert_plays(mesh_object, elbow.model)
    cache = nodes.cache_of(nodes.find_modifier(mesh_object))
    assert cache.is_runtime_data and cache.data.is_runtime_data
    assert {o.name for o in bpy.data.objects} == {ELBOW, "elbow_rig", cache.name}
    assert {m.name for m in bpy.data.meshes} == {mesh_object.data.name, cache.data.name}
    assert [group[nodes.PLAYBACK_KEY] for group in bpy.data.node_groups] == [nodes.GROUP_VERSION]
    assert shape_key_state(mesh_object) == (False, 1)


def test_saved_again_it_holds_the_rig_and_no_positions(path):
    bpy.ops.wm.open_mainfile(filepath=str(path))
    mesh_object = bpy.data.objects[ELBOW]
    mesh_object.fdda.mode = "RIG"
    bpy.context.view_layer.update()
    true = evaluated(mesh_object)
    mesh_object.fdda.mode = "FDDA"
    bpy.context.view_layer.update()
    bpy.ops.wm.save_mainfile()
    fdda_addon.unregister()
    bpy.ops.wm.open_mainfile(filepath=str(path))
    mesh_object = bpy.data.objects[ELBOW]
    assert {o.name for o in bpy.data.objects} == {ELBOW, "elbow_rig"}
    assert [mesh.name for mesh in bpy.data.meshes] == [mesh_object.data.name]
    assert shape_key_state(mesh_object) == (False, 1)
    assert np.abs(evaluated(mesh_object) - true).max() < 1e-6


@pytest.mark.parametrize("name", FILES)
def test_appended_it_brings_no_positions(elbow, tmp_path, name):
    shutil.copy(without_deformation(elbow.model), tmp_path / "elbow.onnx")
    bpy.ops.wm.save_as_mainfile(filepath=str(tmp_path / "shot.blend"))
    with bpy.data.libraries.load(str(shutil.copy(FIXTURES / name, tmp_path / name))) as (found, wanted):
        wanted.objects = found.objects
    for appended in wanted.objects:
        bpy.context.scene.collection.objects.link(appended)
    bpy.context.view_layer.update()
    mesh_object = bpy.data.objects[ELBOW]
    assert_plays(mesh_object, elbow.model)
    cache = nodes.cache_of(nodes.find_modifier(mesh_object))
    assert {o.name for o in bpy.data.objects} == {ELBOW, "elbow_rig", cache.name}
    assert {o.name for o in bpy.context.scene.objects} == {ELBOW, "elbow_rig"}
