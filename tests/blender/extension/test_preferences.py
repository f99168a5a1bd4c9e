# SPDX-License-Identifier: GPL-3.0-or-later
"""The add-on's preferences: how they are drawn, the trusted folders, and the log of the training environment."""

from pathlib import Path
from types import SimpleNamespace

import bpy
import pytest

from fdda_addon.properties import preferences as preferences_module
from fdda_addon.properties.preferences import FDDA_AP_preferences, trusted_folders

from ..drawing import Context, Layout, texts_of
from ..refusals import refused


def test_trusted_folders_are_drawn_with_a_button_to_remove_each(preferences, monkeypatch: pytest.MonkeyPatch):
    # Without a window, Blender has no scale of the interface to wrap text by.
    monkeypatch.setattr(preferences_module, "draw_lines", lambda layout, text, *_, **__: layout.label(text=text))
    preferences.folders.add()
    drawn = []
    panel = SimpleNamespace(
        layout=Layout(drawn),
        bl_rna=preferences.bl_rna,
        folders=preferences.folders,
        trainer_python="",
        wheels_folder="",
    )
    FDDA_AP_preferences.draw(panel, Context())
    texts = texts_of(drawn)
    assert texts.count("Folder") == texts.count("Remove Folder") == 1
    assert {"Add Folder…", "Check Setup", "Training Environment"} <= set(texts)


def test_a_trusted_folder_is_added_and_removed(preferences, tmp_path: Path):
    for name in ("first", "second"):
        assert bpy.ops.fdda.add_trusted_folder(directory=str(tmp_path / name)) == {"FINISHED"}
    assert bpy.ops.fdda.remove_trusted_folder(index=0) == {"FINISHED"}
    assert trusted_folders() == [(tmp_path / "second").resolve()]
    refused(lambda: bpy.ops.fdda.remove_trusted_folder(index=1), "No trusted folder has the index 1; the list has 1.")
    refused(bpy.ops.fdda.add_trusted_folder, "No folder was chosen")


def test_trusted_folders_need_an_installed_extension():
    refused(bpy.ops.fdda.remove_trusted_folder, "has no preferences; install the extension")
