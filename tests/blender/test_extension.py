# SPDX-License-Identifier: GPL-3.0-or-later
"""The zip that `make package` builds: installed, enabled, disabled, updated and uninstalled in a Blender of its own."""

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

from fdda_addon.runtime import model_files

from ..systems import WINDOWS
from .conftest import assert_plays, pose

ROOT = Path(__file__).resolve().parents[2]
LIFE = Path(__file__).with_name("extension_life.py")
VERSION = tomllib.loads((ROOT / "blender_manifest.toml").read_text())["version"]
PACKAGE = ROOT / "dist" / f"fdda_addon-{VERSION}.zip"
FOR_WINDOWS = PACKAGE.with_name(f"fdda_addon-{VERSION}-windows_x64.zip")
PLATFORM = "windows" if WINDOWS else {"darwin": "macos"}.get(sys.platform, sys.platform)
OF_DISTRIBUTIONS = PACKAGE.with_name(f"fdda_addon-{VERSION}-python3.14.zip")
START_SECONDS, START = 0.05, 0.65
"""Seconds of the processor; and on a machine that is slow just now, the part of what `PYTHONS_OWN` takes on it."""
PYTHONS_OWN = """
import time
begin = time.process_time()
import argparse, asyncio, concurrent.futures, ctypes.util, email.mime.multipart, http.server, logging.config
import multiprocessing.pool, pydoc, sqlite3, tarfile, unittest.mock, xmlrpc.client, zipfile
print(time.process_time() - begin)
"""
"""A start of as many modules, which are Python's: how fast the machine is just now."""
STALE = ("config/stale-pending", "extensions/user_default/.~stale~", "extensions/.local/.~stale~")
"""What Blender writes to remember that it has files to remove."""
STATE = ("classes", "operators", "properties", "handlers", "keymap_items", "additions", "commands", "preferences")


def manifest(path: Path) -> dict:
    """The manifest in a zip."""
    with zipfile.ZipFile(path) as archive:
        return tomllib.loads(archive.read("blender_manifest.toml").decode())


def stale(path: Path) -> list[str]:
    """The source files in a zip that are not those under test."""
    with zipfile.ZipFile(path) as archive:
        code = {name: archive.read(name) for name in archive.namelist() if name.startswith(("fdda_addon/", "trainer/"))}
    return [name for name in code if not (ROOT / name).is_file() or code[name] != (ROOT / name).read_bytes()]


@pytest.fixture(scope="module")
def package() -> Path:
    """The zip for this platform, if it holds the code that is under test."""
    built = [path for path in (PACKAGE, FOR_WINDOWS) if path.is_file() and PLATFORM in manifest(path)["platforms"][0]]
    if not built:
        pytest.skip(f"{PACKAGE.name} is not built for {PLATFORM}: make package")
    for path in built:
        if not (differing := stale(path)):
            return path
    pytest.skip(f"{path.name} was built from other sources ({differing[0]} differs): make package")


def blender(*arguments: object, user: Path) -> subprocess.CompletedProcess[str]:
    """Run extension_life.py in a Blender with a user folder of its own, and without a network."""
    environment = {**os.environ, "BLENDER_USER_RESOURCES": str(user), "no_proxy": "", "https_proxy": "http://[::1]:9"}
    environment.pop("PYTHONDONTWRITEBYTECODE", None)  # Blender compiles an add-on once, not at each start.
    command = [sys.executable, LIFE, *map(str, arguments)]
    # Not from the root of the sources: what is tested must come out of the zip.
    return subprocess.run(command, env=environment, cwd=user, capture_output=True, text=True, check=False, timeout=300)


@pytest.fixture(scope="module")
def story(package: Path, tmp_path_factory: pytest.TempPathFactory) -> dict[str, dict]:
    user = tmp_path_factory.mktemp("user")
    result = blender("live", package, user=user)
    assert result.returncode == 0, result.stdout + result.stderr
    assert "Traceback" not in result.stderr
    after = json.loads(blender("list", user=user).stdout.splitlines()[-1])
    return {**json.loads(result.stdout.splitlines()[-1]), "started again": after}


def state(moment: dict) -> dict:
    return {name: moment[name] for name in STATE}


def test_it_installs_without_being_enabled(story: dict):
    assert story["installed"]["result"] == ["FINISHED"]
    assert state(story["installed"]) == state(story["before"])
    assert "extensions/user_default/fdda/fdda_addon/__init__.py" in story["installed"]["files"]
    assert "extensions/user_default/fdda/trainer/__main__.py" in story["installed"]["files"]
    assert "extensions/user_default/fdda/requirements/python-3.11.txt" in story["installed"]["files"]


def test_enabled_it_is_all_there(story: dict):
    enabled = story["enabled"]
    assert {"FDDA_PG_binding", "FDDA_AP_preferences", "FDDA_OT_create_trainer_environment"} <= set(enabled["classes"])
    assert "Object.fdda" in enabled["properties"]
    assert any(line.startswith("frame_change_post") for line in enabled["handlers"])
    assert enabled["commands"] and enabled["preferences"]


def test_enabled_it_imports_no_library_before_a_model_plays(package: Path, tmp_path: Path):
    assert blender("install", package, user=tmp_path).returncode == 0
    assert json.loads(blender("start", user=tmp_path).stdout.splitlines()[-1])["modules"] == []


@pytest.mark.slow
def test_blender_starts_as_fast_with_it(package: Path, tmp_path: Path):
    """The best of five starts: the first compiles the modules, and the machine may be busy, or slow in all it does."""
    assert blender("install", package, user=tmp_path).returncode == 0
    starts, own = [], []
    for _ in range(5):
        starts.append(json.loads(blender("start", user=tmp_path).stdout.splitlines()[-1]))
        own.append(float(subprocess.check_output([sys.executable, "-I", "-c", PYTHONS_OWN], text=True)))
    assert min(start["seconds"] for start in starts) < max(START_SECONDS, START * min(own))


def test_installed_with_its_wheels_it_plays_a_bound_file(package: Path, elbow, bound, tmp_path: Path):
    pose(angle=1.0)
    shown = assert_plays(bound, elbow.model)
    result = blender("play", package, elbow.bound, user=tmp_path)
    assert result.returncode == 0, result.stdout + result.stderr
    played = json.loads(result.stdout.splitlines()[-1])
    assert played["status"] == "" and "extensions/.local/lib" in played["onnxruntime"]
    assert np.abs(np.array(played["positions"]) - shown).max() < 1e-5


def test_disabled_it_leaves_nothing_registered(story: dict):
    assert state(story["disabled"]) == state(story["before"])


def test_enabled_again_it_is_as_it_was(story: dict):
    assert state(story["used"]) == state(story["enabled"])
    assert "extensions/.local/lib" in story["used"]["onnxruntime"].replace(os.sep, "/")


def test_installed_twice_it_is_there_once_and_keeps_the_users_files(story: dict):
    assert story["updated"]["result"] == ["FINISHED"]
    assert state(story["updated"]) == state(story["enabled"])
    assert story["updated"]["files"] == story["used"]["files"] and story["updated"]["kept"]


def test_uninstalled_it_leaves_nothing(story: dict):
    assert story["uninstalled"]["result"] == ["FINISHED"]
    assert state(story["uninstalled"]) == state(story["before"])
    assert not story["uninstalled"]["kept"]
    left = set(story["uninstalled"]["files"]) - set(story["before"]["files"])
    if WINDOWS:  # which removes no library that is loaded: Blender does, when it starts again
        left = {path for path in left if path not in STALE and not path.startswith("extensions/.local/lib/")}
    assert left == set() and story["started again"]["files"] == story["before"]["files"]


def pythons(told: dict) -> list[str]:
    """Which Pythons the wheels are for, by a manifest."""
    return [wheel.split("-")[2] for wheel in told["wheels"]]


@pytest.mark.skipif(sys.platform != "linux", reason="Elsewhere than on Linux Blender has a Python of its own.")
def test_distributions_have_a_zip_of_their_own(package: Path):
    """The same but for the wheels."""
    contents = []
    for path in (package, OF_DISTRIBUTIONS):
        with zipfile.ZipFile(path) as archive:
            names = {name for name in archive.namelist() if not name.startswith("wheels/")} - {"blender_manifest.toml"}
            contents.append({name: archive.read(name) for name in names})
    assert contents[0] == contents[1]
    assert pythons(manifest(OF_DISTRIBUTIONS)) == ["cp314"] and OF_DISTRIBUTIONS.stat().st_size < 60e6


def test_it_is_small_enough_and_says_what_it_may_do(package: Path):
    assert package.stat().st_size < 60e6
    with zipfile.ZipFile(package) as archive:
        names = archive.namelist()
    assert set(manifest(package)["permissions"]) == {"files", "network"}
    assert pythons(manifest(package)) == ["cp311", "cp313"]
    assert not [name for name in names if "__pycache__" in name]


def test_without_its_wheels_a_bound_file_shows_the_true_rig(elbow, monkeypatch: pytest.MonkeyPatch):
    """In a Blender whose Python none of the wheels is for."""
    monkeypatch.setitem(sys.modules, "onnxruntime", None)
    monkeypatch.setattr(model_files, "_networks", {})
    bpy.ops.wm.open_mainfile(filepath=str(elbow.bound))
    mesh_object = bpy.data.objects["elbow"]
    pose(angle=1.0)
    assert mesh_object.fdda.mode == "RIG"
    assert re.match(r"ONNX Runtime cannot be loaded by Python 3\.1\d \(.+\); install the", mesh_object.fdda.status)
