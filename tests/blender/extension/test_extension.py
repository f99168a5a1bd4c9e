# SPDX-License-Identifier: GPL-3.0-or-later
"""The zip of `make package` is installed, enabled, disabled, updated and uninstalled in another Blender process."""

import json
import os
import re
import subprocess
import sys
import tomllib
import zipfile
from pathlib import Path

import bpy
import numpy as np
import pytest

from fdda_addon.runtime.session import session

from ...systems import WINDOWS
from ..conftest import assert_plays, pose

ROOT = Path(__file__).resolve().parents[3]
LIFE_PROGRAM = Path(__file__).with_name("extension_life.py")
VERSION = tomllib.loads((ROOT / "blender_manifest.toml").read_text())["version"]
PACKAGE = ROOT / "dist" / f"fdda_addon-{VERSION}.zip"
WINDOWS_PACKAGE = PACKAGE.with_name(f"fdda_addon-{VERSION}-windows_x64.zip")
PLATFORM = "windows" if WINDOWS else {"darwin": "macos"}.get(sys.platform, sys.platform)
PYTHON_3_14_PACKAGE = PACKAGE.with_name(f"fdda_addon-{VERSION}-python3.14.zip")
MAX_START_SECONDS, MAX_START_RATIO = 0.05, 0.65
"""Limits for the CPU time of enabling the add-on: seconds, and a ratio of the time of `STANDARD_LIBRARY_IMPORTS`."""
STANDARD_LIBRARY_IMPORTS = """
import time
begin = time.process_time()
import argparse, asyncio, concurrent.futures, ctypes.util, email.mime.multipart, http.server, logging.config
import multiprocessing.pool, pydoc, sqlite3, tarfile, unittest.mock, xmlrpc.client, zipfile
print(time.process_time() - begin)
"""
"""Code that imports about as many modules of Python, to measure the current speed of the machine."""
REMOVAL_MARKERS = ("config/stale-pending", "extensions/user_default/.~stale~", "extensions/.local/.~stale~")
"""Files in which Blender lists files that it will remove at the next start."""
STATE_KEYS = ("classes", "operators", "properties", "handlers", "keymap_items", "additions", "commands", "preferences")


def read_manifest(path: Path) -> dict:
    """Read the manifest in a zip."""
    with zipfile.ZipFile(path) as archive:
        return tomllib.loads(archive.read("blender_manifest.toml").decode())


def outdated_files(path: Path) -> list[str]:
    """Return the source files in a zip that differ from the files under test."""
    with zipfile.ZipFile(path) as archive:
        contents = {
            name: archive.read(name) for name in archive.namelist() if name.startswith(("fdda_addon/", "trainer/"))
        }
    return [name for name in contents if not (ROOT / name).is_file() or contents[name] != (ROOT / name).read_bytes()]


@pytest.fixture(scope="module")
def package() -> Path:
    """Return the zip for this platform, or skip the test if the zip does not contain the code under test."""
    built = [
        path
        for path in (PACKAGE, WINDOWS_PACKAGE)
        if path.is_file() and PLATFORM in read_manifest(path)["platforms"][0]
    ]
    if not built:
        pytest.skip(f"{PACKAGE.name} is not built for {PLATFORM}: make package")
    for path in built:
        if not (differing := outdated_files(path)):
            return path
    pytest.skip(f"{path.name} was built from other sources ({differing[0]} differs): make package")


def blender(*arguments: object, user: Path) -> subprocess.CompletedProcess[str]:
    """Run extension_life.py in another Blender process, with another user folder and without a network."""
    environment = {**os.environ, "BLENDER_USER_RESOURCES": str(user), "no_proxy": "", "https_proxy": "http://[::1]:9"}
    environment.pop("PYTHONDONTWRITEBYTECODE", None)  # Blender compiles an add-on only once.
    command = [sys.executable, LIFE_PROGRAM, *map(str, arguments)]
    # The current folder must not contain the sources, so that modules come from the zip.
    return subprocess.run(command, env=environment, cwd=user, capture_output=True, text=True, check=False, timeout=300)


@pytest.fixture(scope="module")
def states(package: Path, tmp_path_factory: pytest.TempPathFactory) -> dict[str, dict]:
    """Return what is registered and which files exist after each step of the extension's life cycle."""
    user = tmp_path_factory.mktemp("user")
    result = blender("live", package, user=user)
    assert result.returncode == 0, result.stdout + result.stderr
    assert "Traceback" not in result.stderr
    files_after = json.loads(blender("list", user=user).stdout.splitlines()[-1])
    return {**json.loads(result.stdout.splitlines()[-1]), "started again": files_after}


def registered_state(moment: dict) -> dict:
    return {name: moment[name] for name in STATE_KEYS}


def test_an_installed_extension_registers_nothing(states: dict):
    assert states["installed"]["result"] == ["FINISHED"]
    assert registered_state(states["installed"]) == registered_state(states["before"])
    assert "extensions/user_default/fdda/fdda_addon/__init__.py" in states["installed"]["files"]
    assert "extensions/user_default/fdda/trainer/__main__.py" in states["installed"]["files"]
    assert "extensions/user_default/fdda/requirements/python-3.11.txt" in states["installed"]["files"]


def test_an_enabled_extension_is_registered(states: dict):
    enabled = states["enabled"]
    assert {"FDDA_PG_binding", "FDDA_AP_preferences", "FDDA_OT_create_trainer_environment"} <= set(enabled["classes"])
    assert "Object.fdda" in enabled["properties"]
    assert any(line.startswith("frame_change_post") for line in enabled["handlers"])
    assert enabled["commands"] and enabled["preferences"]


def test_an_enabled_extension_imports_no_library_before_a_model_plays(package: Path, tmp_path: Path):
    assert blender("install", package, user=tmp_path).returncode == 0
    assert json.loads(blender("start", user=tmp_path).stdout.splitlines()[-1])["modules"] == []


@pytest.mark.slow
def test_the_enabled_extension_starts_fast(package: Path, tmp_path: Path):
    """The shortest of five starts counts: the first start compiles the modules, and the machine may be busy."""
    assert blender("install", package, user=tmp_path).returncode == 0
    starts, import_seconds = [], []
    for _ in range(5):
        starts.append(json.loads(blender("start", user=tmp_path).stdout.splitlines()[-1]))
        import_seconds.append(
            float(subprocess.check_output([sys.executable, "-I", "-c", STANDARD_LIBRARY_IMPORTS], text=True))
        )
    assert min(start["seconds"] for start in starts) < max(MAX_START_SECONDS, MAX_START_RATIO * min(import_seconds))


def test_an_installed_extension_plays_a_bound_file(package: Path, elbow_files, bound_elbow, tmp_path: Path):
    pose(angle=1.0)
    shown = assert_plays(bound_elbow, elbow_files.model)
    result = blender("play", package, elbow_files.bound, user=tmp_path)
    assert result.returncode == 0, result.stdout + result.stderr
    played = json.loads(result.stdout.splitlines()[-1])
    assert played["status"] == "" and "extensions/.local/lib" in played["onnxruntime"]
    # The wheels of a zip may have different versions; Blender installs the wheel for its Python.
    pins = (ROOT / "requirements" / "python-{}.{}.txt".format(*sys.version_info)).read_text()
    (information,) = Path(played["onnxruntime"]).parents[1].glob("onnxruntime-*.dist-info")
    assert information.stem.replace("-", "==") in pins.splitlines()
    assert np.abs(np.array(played["positions"]) - shown).max() < 1e-5


def test_a_disabled_extension_leaves_nothing_registered(states: dict):
    assert registered_state(states["disabled"]) == registered_state(states["before"])


def test_enabling_again_registers_the_same_items(states: dict):
    assert registered_state(states["used"]) == registered_state(states["enabled"])
    assert "extensions/.local/lib" in states["used"]["onnxruntime"].replace(os.sep, "/")


def test_an_update_keeps_files_of_the_user(states: dict):
    assert states["updated"]["result"] == ["FINISHED"]
    assert registered_state(states["updated"]) == registered_state(states["enabled"])
    assert states["updated"]["files"] == states["used"]["files"] and states["updated"]["kept"]


def test_an_uninstalled_extension_leaves_nothing(states: dict):
    assert states["uninstalled"]["result"] == ["FINISHED"]
    assert registered_state(states["uninstalled"]) == registered_state(states["before"])
    assert not states["uninstalled"]["kept"]
    remaining = set(states["uninstalled"]["files"]) - set(states["before"]["files"])
    if WINDOWS:  # A loaded library cannot be removed. Blender removes it at the next start.
        remaining = {
            path for path in remaining if path not in REMOVAL_MARKERS and not path.startswith("extensions/.local/lib/")
        }
    assert remaining == set() and states["started again"]["files"] == states["before"]["files"]


def wheel_pythons(manifest: dict) -> list[str]:
    """Return the Python tags of the wheels in a manifest."""
    return [wheel.split("-")[2] for wheel in manifest["wheels"]]


@pytest.mark.skipif(sys.platform != "linux", reason="Only Linux distributions build Blender with their own Python.")
def test_the_zip_for_linux_distributions_differs_only_in_its_wheels(package: Path):
    """Linux distributions build Blender with Python 3.14."""
    contents = []
    for path in (package, PYTHON_3_14_PACKAGE):
        with zipfile.ZipFile(path) as archive:
            names = {name for name in archive.namelist() if not name.startswith("wheels/")} - {"blender_manifest.toml"}
            contents.append({name: archive.read(name) for name in names})
    assert contents[0] == contents[1]
    assert wheel_pythons(read_manifest(PYTHON_3_14_PACKAGE)) == ["cp314"] and PYTHON_3_14_PACKAGE.stat().st_size < 60e6


def test_the_zip_is_small_and_declares_its_permissions(package: Path):
    assert package.stat().st_size < 60e6
    with zipfile.ZipFile(package) as archive:
        names = archive.namelist()
    assert set(read_manifest(package)["permissions"]) == {"files", "network"}
    assert wheel_pythons(read_manifest(package)) == ["cp311", "cp313"]
    assert not [name for name in names if "__pycache__" in name]


def test_a_bound_file_shows_its_rig_without_onnx_runtime(elbow_files, monkeypatch: pytest.MonkeyPatch):
    """No wheel of the extension may fit the Python of a Blender."""
    monkeypatch.setitem(sys.modules, "onnxruntime", None)
    monkeypatch.setattr(session, "networks", {})
    bpy.ops.wm.open_mainfile(filepath=str(elbow_files.bound))
    mesh_object = bpy.data.objects["elbow"]
    pose(angle=1.0)
    assert mesh_object.fdda.mode == "RIG"
    assert re.match(r"ONNX Runtime cannot be loaded by Python 3\.1\d \(.+\); install the", mesh_object.fdda.status)
