# SPDX-License-Identifier: GPL-3.0-or-later
"""Story: install the extension from a repository, play a bound file, update, and keep playing.

`run_update.py` offers FOLDER/site on the loopback interface, and writes its address to FOLDER/address.txt. FOLDER/next
is the repository of the next version, and FOLDER/bound has a file with a bound arm. When a user drops a link on the
window, Blender calls the operator `extensions.package_install` with the address of the link, as the steps do here.
"""

import json
from collections.abc import Iterator
from pathlib import Path
from urllib.parse import quote

import bpy
import numpy as np
from arm import BENT_FRAME, arm_object, arm_positions, check_model_plays, frame_object
from window import (
    click,
    describe_button_below_mouse,
    main_screen,
    main_window,
    move_mouse,
    park_mouse,
    press_keys,
    region_override,
    require,
    save_screenshot,
    start_playback,
    stop_playback,
    wait_for_events,
    wait_until,
)

EXTENSION_ID = "fdda"
SYNC_SECONDS, INSTALL_SECONDS, PLAY_SECONDS = 30, 120, 3
DIALOG_SECONDS = 1.5
"""Time until a dialog is complete: it first synchronizes with the repository."""
SEARCH_STEP_PIXELS = 12
OTHER_FRAME = 52

_old_positions: np.ndarray | None = None


def _preferences_area() -> bpy.types.Area:
    """Return the area that shows the preferences."""
    return next(area for area in main_screen().areas if area.type == "PREFERENCES")


def _address(folder: Path) -> str:
    return (folder / "address.txt").read_text(encoding="utf-8")


def _offered_version(folder: Path) -> str:
    return json.loads((folder / "site" / "index.json").read_text(encoding="utf-8"))["data"][0]["version"]


def _repository(folder: Path) -> bpy.types.UserExtensionRepo | None:
    """Return the repository in the preferences; None before it is added."""
    repositories = bpy.context.preferences.extensions.repos
    return next((repo for repo in repositories if repo.remote_url == f"{_address(folder)}/index.json"), None)


def _installed_version(folder: Path) -> str:
    """Return the version in the manifest of the installed extension; empty without one."""
    import tomllib

    repository = _repository(folder)
    manifest = Path(repository.directory) / EXTENSION_ID / "blender_manifest.toml" if repository else None
    return tomllib.loads(manifest.read_text(encoding="utf-8"))["version"] if manifest and manifest.is_file() else ""


def _is_enabled(folder: Path) -> bool:
    repository = _repository(folder)
    module = f"bl_ext.{repository.module}.{EXTENSION_ID}" if repository else ""
    return module in bpy.context.preferences.addons and hasattr(bpy.types.Object, "fdda")


def _drop_link(folder: Path) -> Iterator[float]:
    """Drop the link of the page for this system, and wait for the dialog."""
    (entry,) = json.loads((folder / "site" / "index.json").read_text(encoding="utf-8"))["data"]
    query = {
        "repository": "./index.json",
        "blender_version_min": entry["blender_version_min"],
        "platforms": ",".join(entry["platforms"]),
        "python_versions": ",".join(entry["python_versions"]),
    }
    parameters = "&".join(f"{name}={quote(value, safe='')}" for name, value in query.items())
    area = _preferences_area()
    move_mouse(area.x + area.width / 2, area.y + area.height / 2)
    yield from wait_for_events()
    region = next(region for region in area.regions if region.type == "WINDOW")
    with bpy.context.temp_override(window=main_window(), area=area, region=region):
        link = f"{_address(folder)}/{entry['archive_url'].removeprefix('./')}?{parameters}"
        bpy.ops.extensions.package_install("INVOKE_DEFAULT", url=link)
    yield DIALOG_SECONDS


def open_the_preferences(folder: Path) -> Iterator[float]:
    bpy.context.preferences.system.use_online_access = True
    with region_override("WINDOW"):
        bpy.ops.screen.area_split(direction="HORIZONTAL", factor=0.55)
    areas = [area for area in main_screen().areas if area.type == "VIEW_3D"]
    min(areas, key=lambda area: area.y).type = "PREFERENCES"
    bpy.context.preferences.active_section = "EXTENSIONS"
    yield 1.0
    require(not hasattr(bpy.types.Object, "fdda"), "the extension is installed before the story begins")


def add_the_repository(folder: Path) -> Iterator[float]:
    yield from _drop_link(folder)
    yield from save_screenshot(folder / "unknown_repository.png")
    yield from press_keys("Return")
    yield DIALOG_SECONDS
    yield from save_screenshot(folder / "add_repository.png")
    yield from press_keys("Return")  # ends the edit of the address
    yield 0.5
    yield from press_keys("Return")
    yield from wait_until(lambda: _repository(folder), SYNC_SECONDS, "the dialog does not add the repository")
    yield 1.0


def install_from_the_repository(folder: Path) -> Iterator[float]:
    yield from _drop_link(folder)
    yield DIALOG_SECONDS
    yield from save_screenshot(folder / "install.png")
    yield from press_keys("Return")
    yield from wait_until(lambda: _is_enabled(folder), INSTALL_SECONDS, "the extension is not installed")
    require(
        _installed_version(folder) == _offered_version(folder), f"version {_installed_version(folder)} is installed"
    )
    yield 1.0


def play_a_bound_file(folder: Path) -> Iterator[float]:
    global _old_positions
    (bound_file,) = (folder / "bound").glob("*.blend")
    bpy.ops.wm.open_mainfile(filepath=str(bound_file), load_ui=False)
    yield 1.0
    check_model_plays()
    frame_object(arm_object())
    _old_positions = arm_positions(BENT_FRAME)
    moved = np.linalg.norm(arm_positions(OTHER_FRAME) - _old_positions, axis=1).max()
    require(moved > 0.01, "the arm does not move between two frames")
    yield from start_playback()
    yield PLAY_SECONDS
    yield from stop_playback()
    bpy.context.scene.frame_set(BENT_FRAME)
    yield 0.5


def offer_the_next_version(folder: Path) -> Iterator[float]:
    (folder / "site").rename(folder / "previous")
    (folder / "next").rename(folder / "site")
    bpy.ops.extensions.repo_sync_all("INVOKE_DEFAULT")
    manager = bpy.context.window_manager
    yield from wait_until(lambda: manager.extensions_updates == 1, SYNC_SECONDS, "Blender offers no update")
    yield 1.0


def press_update(folder: Path) -> Iterator[float]:
    area, scale = _preferences_area(), bpy.context.preferences.system.ui_scale
    region = next(region for region in area.regions if region.type == "WINDOW")
    x = region.x + region.width - 70 * scale
    for y in range(region.y + region.height - 10, region.y, -SEARCH_STEP_PIXELS):
        move_mouse(x, y)
        yield from wait_for_events()
        with bpy.context.temp_override(window=main_window(), area=area, region=region):
            description = describe_button_below_mouse()
        if "extensions.package_install" in description:
            break
    else:
        require(False, "there is no button Update")
    yield from save_screenshot(folder / "update.png")
    yield from click(x, y)
    version = _offered_version(folder)
    yield from wait_until(lambda: _installed_version(folder) == version, INSTALL_SECONDS, "there is no update")
    yield from wait_until(lambda: _is_enabled(folder), INSTALL_SECONDS, "the new version is not enabled")
    yield 2.0


def keep_playing_the_open_file(folder: Path) -> Iterator[float]:
    yield 1.0
    check_model_plays()
    frame_object(arm_object())
    yield from start_playback()
    yield PLAY_SECONDS
    yield from stop_playback()
    difference = np.abs(arm_positions(BENT_FRAME) - _old_positions).max()
    require(difference < 1e-6, f"after the update the arm has moved by {difference} m")
    yield 0.5


def open_the_file_again(folder: Path) -> Iterator[float]:
    (bound_file,) = (folder / "bound").glob("*.blend")
    bpy.ops.wm.open_mainfile(filepath=str(bound_file), load_ui=False)
    yield 1.0
    check_model_plays()
    frame_object(arm_object())
    require(np.abs(arm_positions(BENT_FRAME) - _old_positions).max() < 1e-6, "the opened file plays other positions")
    yield from park_mouse()


STEPS = (
    open_the_preferences,
    add_the_repository,
    install_from_the_repository,
    play_a_bound_file,
    offer_the_next_version,
    press_update,
    keep_playing_the_open_file,
    open_the_file_again,
)
