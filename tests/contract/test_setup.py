# SPDX-License-Identifier: GPL-3.0-or-later
"""The setup scripts: which Python they choose, their messages without one, and when an environment is complete."""

import importlib.util
import re
import subprocess
import sys
import tomllib
from pathlib import Path
from types import ModuleType

import pytest
from packaging.markers import Marker

from fdda_addon.core.files.native_library import LAST_OLD_RUNTIME

from ..systems import WINDOWS, symbolic_links

ROOT = Path(__file__).resolve().parents[2]
PROJECT = tomllib.loads((ROOT / "pyproject.toml").read_text())
PINS = {version: (ROOT / f"requirements/python-{version}.txt").read_text() for version in ("3.11", "3.13", "3.14")}


def load_script(name: str) -> ModuleType:
    """Import a script of setup/ as a module."""
    spec = importlib.util.spec_from_file_location(f"setup_{name}", ROOT / "setup" / f"{name}.py")
    module = importlib.util.module_from_spec(spec)
    spec.loader.exec_module(module)
    return module


sys.path.append(str(ROOT / "setup"))
environment = load_script("environment")
package = load_script("package")
retired_words = load_script("retired_words")
posix_only = pytest.mark.skipif(WINDOWS, reason="setup/environment is a POSIX shell script.")


def write_shell_script(path: Path, text: str) -> Path:
    """Write an executable shell script and return its path."""
    path.parent.mkdir(parents=True, exist_ok=True)
    path.write_text(f"#!/bin/sh\n{text}\n")
    path.chmod(0o755)
    return path


def run_setup(tmp_path: Path, version: str, **variables: str) -> subprocess.CompletedProcess[str]:
    """Run setup/environment for a Python version, which it finds only in tmp_path."""
    environment_variables = {
        "PATH": f"{tmp_path}/bin:/usr/bin:/bin",
        "HOME": str(tmp_path),
        "PYENV_ROOT": f"{tmp_path}/pyenv",
    }
    command = [ROOT / "setup/environment", tmp_path / "venv", "blender", version]
    return subprocess.run(command, env=environment_variables | variables, capture_output=True, text=True, check=False)


@posix_only
def test_a_missing_python_is_reported_with_its_packages(tmp_path: Path):
    result = run_setup(tmp_path, "3.99")
    assert result.returncode == 3 and result.stdout == ""
    assert result.stderr.count("\n") == 1
    assert "Python 3.99" in result.stderr and "python3.11-venv" in result.stderr


@posix_only
def test_a_python_on_path_that_does_not_start_is_skipped(tmp_path: Path):
    write_shell_script(tmp_path / "bin/python3.99", "echo 'this version is not selected' >&2; exit 127")
    working_python = write_shell_script(tmp_path / "real/python", 'echo "set up by the real one: $*"')
    write_shell_script(tmp_path / "pyenv/versions/3.99.1/bin/python", f"echo {working_python}")
    result = run_setup(tmp_path, "3.99")
    assert result.returncode == 0, result.stderr
    assert result.stdout == f"set up by the real one: setup/environment.py make {tmp_path}/venv blender\n"


@pytest.mark.skipif(sys.platform != "linux", reason="On other systems, wheels contain the libraries that they load.")
def test_a_missing_system_library_is_reported_with_its_package(tmp_path: Path):
    listing = tmp_path / "libraries.txt"
    listing.write_text("# comment\nlibc.so.6 libc6\nlibfdda-missing.so.1 libfdda1\nlibfdda-gone.so.2 libfdda2\n")
    with pytest.raises(environment.SetupError, match="apt-get install libfdda1 libfdda2"):
        environment.check_system_libraries(listing)


@symbolic_links
def test_a_linked_environment_is_not_changed(tmp_path: Path, monkeypatch: pytest.MonkeyPatch):
    """Working trees may share an environment by a link; making it again would empty it for all of them."""
    shared_environment, link = tmp_path / "shared", tmp_path / ".venv"
    (shared_environment / "bin").mkdir(parents=True)
    (shared_environment / "bin" / "python").write_text("in use")
    (shared_environment / environment.STAMP).write_text("of other requirements")
    link.symlink_to(shared_environment)
    monkeypatch.setattr(environment, "run_step", lambda *_, **__: pytest.fail("A setup step was run."))
    with pytest.raises(environment.SetupError, match=r"\.venv is a link to '.*shared' and is not up to date"):
        environment.make(link, "everything")
    assert (shared_environment / "bin" / "python").read_text() == "in use" and (
        shared_environment / environment.STAMP
    ).exists()


def test_uv_gets_the_settings_of_pip(monkeypatch: pytest.MonkeyPatch):
    for name in environment.UV_SETTINGS.values():
        monkeypatch.delenv(name, raising=False)
    monkeypatch.setenv("PIP_INDEX_URL", "file:///mirror/simple")
    monkeypatch.setenv("PIP_EXTRA_INDEX_URL", "file:///a file:///b")
    monkeypatch.setenv("PIP_FIND_LINKS", "/wheels /more")
    monkeypatch.setenv("PIP_CERT", "/from/pip.pem")
    monkeypatch.setenv("SSL_CERT_FILE", "/of/its/own.pem")
    variables = environment.uv_environment(Path(sys.executable))
    assert variables["UV_DEFAULT_INDEX"] == "file:///mirror/simple"
    assert variables["UV_INDEX"] == "file:///a file:///b"
    assert variables["UV_FIND_LINKS"] == "/wheels,/more"
    assert variables["SSL_CERT_FILE"] == "/of/its/own.pem"


@pytest.mark.parametrize("version", PINS)
def test_requirements_of_the_project_are_pinned(version: str):
    requirements = [requirement for group in PROJECT["dependency-groups"].values() for requirement in group]
    for requirement in requirements:
        package, _, marker = requirement.partition("; ")
        if not marker or Marker(marker).evaluate({"python_version": version}):
            assert re.search(rf"^{re.escape(package)}(==|$)", PINS[version], re.MULTILINE), requirement


def test_the_pinned_runtimes_run_with_the_cpp_library_of_each_blender():
    """On Windows, a runtime that needs a newer one ends Blender (docs/release.md, Microsoft's libraries)."""
    newest = {"3.11": LAST_OLD_RUNTIME, "3.13": (1, 31)}
    for version, known in newest.items():
        pinned = re.search(r"^onnxruntime==(\d+)\.(\d+)", PINS[version], re.MULTILINE)
        assert tuple(map(int, pinned.groups())) <= known, "look at the DLLs of its wheel for Windows first"


def test_the_staged_extension_has_the_files_that_blender_expects(tmp_path: Path, monkeypatch: pytest.MonkeyPatch):
    monkeypatch.setattr(package, "STAGE_FOLDER", tmp_path / "stage")
    wheel = tmp_path / "onnxruntime-1-cp311-cp311-linux.whl"
    wheel.write_bytes(b"wheel")
    package.stage_files("linux-x64", [wheel])
    manifest = tomllib.loads((tmp_path / "stage/blender_manifest.toml").read_text())
    assert manifest["version"] == package.read_version() and "website" not in manifest
    assert manifest["platforms"] == ["linux-x64"]
    assert [(tmp_path / "stage" / path).read_bytes() for path in manifest["wheels"]] == [b"wheel"]
    assert set(manifest["permissions"]) == {"files", "network"}
    # Blender refuses reasons that are longer, and reasons that end with a period.
    assert all(0 < len(reason) <= 64 and reason[-1].isalpha() for reason in manifest["permissions"].values())
    assert "from .fdda_addon import register" in (tmp_path / "stage/__init__.py").read_text()
    assert (tmp_path / "stage/trainer/__init__.py").is_file()
    page = (tmp_path / "stage/docs/manual.html").read_text(encoding="utf-8")
    references = set(re.findall(r'(?:src|href)="([\w./-]+)["#]', page))
    assert (
        len(references) > 10 and [name for name in references if not (tmp_path / "stage/docs" / name).is_file()] == []
    )
    assert {f"python-{version}.txt" for version in PINS} <= {
        p.name for p in (tmp_path / "stage/requirements").iterdir()
    }


def test_a_platform_without_wheels_is_refused():
    command = [sys.executable, ROOT / "setup/package.py", "macos-x64"]
    result = subprocess.run(command, capture_output=True, text=True, check=False)
    assert result.returncode == 1 and result.stdout == ""
    assert result.stderr == (
        "ONNX Runtime has no wheels for the platform macos-x64; set PLATFORM to all or one of linux-x64, linux-arm64, "
        "macos-arm64, windows-x64, windows-arm64.\n"
    )


def test_a_package_that_is_too_large_is_refused(tmp_path: Path):
    zip_path = tmp_path / "large.zip"
    with zip_path.open("wb") as file:
        file.truncate(60_000_000)
        package.check_size(zip_path)
        file.truncate(61_000_000)
    with pytest.raises(package.PackageError, match=r"large\.zip has 61 MB, more than the limit of 60 MB; look for"):
        package.check_size(zip_path)
