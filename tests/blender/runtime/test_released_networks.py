# SPDX-License-Identifier: GPL-3.0-or-later
"""Files that are opened one after the other release their networks, about 20 MB each."""

import gc
import shutil
import weakref

import bpy
import pytest

from fdda_addon.models.model_list import add_bound_model, bound_entry, pack_entry
from fdda_addon.runtime.model_files import network_of
from fdda_addon.scene.blend_file import save_copy

from ..conftest import ELBOW


def opened(path) -> weakref.ref:
    """Open a bound file and return a weak reference to its network."""
    bpy.ops.wm.open_mainfile(filepath=str(path))
    return weakref.ref(network_of(bpy.data.objects[ELBOW]))


def copy_of(elbow_files, folder):
    folder.mkdir()
    shutil.copy(elbow_files.model, folder / elbow_files.model.name)
    return shutil.copy(elbow_files.bound, folder / elbow_files.bound.name)


@pytest.mark.parametrize("packed", [False, True])
def test_the_networks_of_files_that_were_open_are_released(elbow_files, tmp_path, packed):
    bpy.ops.wm.open_mainfile(filepath=str(elbow_files.bound))
    paths = [copy_of(elbow_files, tmp_path / str(number)) for number in range(4)]
    if packed:
        for path in paths:
            opened(path)
            mesh_object = bpy.data.objects[ELBOW]
            add_bound_model(mesh_object)
            pack_entry(mesh_object, bound_entry(mesh_object))
            save_copy(path)
    networks = [opened(path) for path in paths]
    gc.collect()
    assert [network() is not None for network in networks] == [False, False, False, True]
    bpy.ops.wm.read_homefile(use_empty=True, use_factory_startup=True)
    gc.collect()
    assert networks[-1]() is None
