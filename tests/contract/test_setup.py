# SPDX-License-Identifier: GPL-3.0-or-later
"""The set-up: which Python it takes, what it says when there is none, and when an environment counts as complete."""

import importlib.util
import os
import re
import shutil
import subprocess
import sys
import tomllib
from pathlib import Path
from types import ModuleType

import pytest

from ..systems import WINDOWS, symbolic_links

ROOT = Path(__file__).resolve().parents[2]
PROJECT = tomllib.loads((ROOT / "pyproject.toml").read_text())
PINS = {version: (ROOT / f"requirements/python-{version}.txt").read_text() for version in ("3.11", "3.13", "3.14")}


def load(name: str) -> ModuleType:
    """A script of setup/ as a module."""
    spec = importlib.util.spec_from_file_location(f"setup_{name}", ROOT / "setup" / f"{name}.py")
    module = importlib.util.module_from_spec(spec)
    spec.loader.exec_module(module)
    return module


environment = load("environment")
package = load("package")
with_a_shell = pytest.mark.skipif(WINDOWS, reason="POSIX: setup/environment is a script of the shell")


def stamp(folder: Path, contents: str = "blender") -> None:
    """Make `folder` look like an environment that this Python has made."""
    for path in (environment.program(folder, "python"), folder / environment.STAMP):
        path.parent.mkdir(parents=True, exist_ok=True)
        path.write_text(environment.fingerprint(contents))


def script(path: Path, text: str) -> Path:
    path.parent.mkdir(parents=True, exist_ok=True)
    path.write_text(f"#!/bin/sh\n{text}\n")
    path.chmod(0o755)
    return path


def set_up(tmp_path: Path, version: str, **variables: str) -> subprocess.CompletedProcess[str]:
    """Run setup/environment for a Python version that no machine has, unless the test put it into tmp_path."""
    clean = {"PATH": f"{tmp_path}/bin:/usr/bin:/bin", "HOME": str(tmp_path), "PYENV_ROOT": f"{tmp_path}/pyenv"}
    command = [ROOT / "setup/environment", tmp_path / "venv", "blender", version]
    return subprocess.run(command, env=clean | variables, capture_output=True, text=True, check=False)


@with_a_shell
def test_without_a_python_one_sentence_names_the_packages(tmp_path: Path):
    result = set_up(tmp_path, "3.99")
    assert result.returncode == 3 and result.stdout == ""
    assert result.stderr.count("\n") == 1
    assert "Python 3.99" in result.stderr and "python3.11-venv" in result.stderr


@with_a_shell
def test_a_python_without_its_venv_module_is_named_with_the_package(tmp_path: Path):
    script(tmp_path / "bin/python3.99", "exit 3")
    result = set_up(tmp_path, "3.99")
    assert result.returncode == 3
    assert result.stderr.count("\n") == 1
    assert "apt-get install python3.99-venv libx11-6" in result.stderr


@with_a_shell
def test_a_name_on_path_that_does_not_run_is_passed_over(tmp_path: Path):
    script(tmp_path / "bin/python3.99", "echo 'this version is not selected' >&2; exit 127")
    real = script(tmp_path / "real/python", 'echo "set up by the real one: $*"')
    script(tmp_path / "pyenv/versions/3.99.1/bin/python", f"echo {real}")
    result = set_up(tmp_path, "3.99")
    assert result.returncode == 0, result.stderr
    assert result.stdout == f"set up by the real one: setup/environment.py make {tmp_path}/venv blender\n"


@with_a_shell
def test_a_python_that_is_asked_for_must_fit(tmp_path: Path):
    wrong = script(tmp_path / "python", "exit 2")
    command = [ROOT / "setup/environment", tmp_path / "venv", "everything"]
    result = subprocess.run(command, env=os.environ | {"PYTHON": wrong}, capture_output=True, text=True, check=False)
    assert result.returncode == 1
    assert f"PYTHON={wrong} is not a Python 3.13 or 3.11" in result.stderr


@pytest.mark.skipif(sys.platform != "linux", reason="Linux: elsewhere the wheels bring what they load")
def test_a_missing_system_library_is_named_with_its_package(tmp_path: Path):
    listing = tmp_path / "libraries.txt"
    listing.write_text("# comment\nlibc.so.6 libc6\nlibfdda-missing.so.1 libfdda1\nlibfdda-gone.so.2 libfdda2\n")
    with pytest.raises(environment.SetupError, match="apt-get install libfdda1 libfdda2"):
        environment.check_system_libraries(listing)


def test_an_environment_counts_only_with_the_stamp_of_these_requirements(tmp_path: Path):
    python = os.path.realpath(sys.executable)
    assert not environment.is_current(tmp_path, "blender", "")
    stamp(tmp_path)
    assert environment.is_current(tmp_path, "blender", "")
    assert environment.is_current(tmp_path, "blender", python)
    assert not environment.is_current(tmp_path, "blender", "/usr/bin/another-python")
    assert not environment.is_current(tmp_path, "everything", "")


def test_a_set_up_that_fails_leaves_no_stamp(tmp_path: Path, monkeypatch: pytest.MonkeyPatch):
    stamp(tmp_path)
    monkeypatch.setenv("PYTHONHOME", str(tmp_path / "nowhere"))  # the Python that is started ends at once
    monkeypatch.setattr(environment, "check_system_libraries", lambda: None)
    with pytest.raises(environment.SetupError, match="could not be made a virtual environment"):
        environment.make(tmp_path, "blender")
    assert not (tmp_path / environment.STAMP).exists()


def made(folder: Path, monkeypatch: pytest.MonkeyPatch) -> bool:
    """Whether environment.py makes `folder` anew."""
    calls: list[tuple[Path, str]] = []
    monkeypatch.setattr(environment, "make", lambda *arguments: calls.append(arguments))
    monkeypatch.setattr(sys, "argv", ["environment.py", "make", str(folder), "blender"])
    assert environment.main() == 0
    return calls == [(folder, "blender")]


def test_only_an_environment_that_this_python_has_made_is_kept(tmp_path: Path, monkeypatch: pytest.MonkeyPatch):
    folder = tmp_path / "venv"
    assert made(folder, monkeypatch), "there is none"
    stamp(folder)
    assert not made(folder, monkeypatch)
    environment.program(folder, "python").unlink()
    assert made(folder, monkeypatch), "without a Python"
    stamp(folder)
    monkeypatch.setattr(sys, "version", sys.version + " of another build")
    assert made(folder, monkeypatch), "of another Python"


def test_a_python_that_no_blender_has_is_refused(capsys: pytest.CaptureFixture, monkeypatch: pytest.MonkeyPatch):
    monkeypatch.setattr(sys, "version_info", (3, 12, 4))
    monkeypatch.setattr(sys, "argv", ["environment.py", "make", "nowhere", "blender"])
    assert environment.main() == 1
    assert re.fullmatch(r"FDDA needs Python 3\.13 or 3\.11 and this is 3\.12; .*\n", capsys.readouterr().err)


def test_two_set_ups_of_a_folder_take_turns(tmp_path: Path):
    waits = (
        "import importlib.util, sys\n"
        "spec = importlib.util.spec_from_file_location('environment', sys.argv[1])\n"
        "environment = importlib.util.module_from_spec(spec)\n"
        "spec.loader.exec_module(environment)\n"
        "with open(sys.argv[2], 'w') as file:\n"
        "    print('begins', flush=True)\n"
        "    environment.lock(file)\n"
        "    print('goes on', flush=True)\n"
    )
    command = [sys.executable, "-c", waits, environment.__file__, tmp_path / "venv.lock"]
    with open(tmp_path / "venv.lock", "w") as file:
        environment.lock(file)
        with subprocess.Popen(command, stdout=subprocess.PIPE, text=True) as other:
            assert other.stdout.readline() == "begins\n"
            with pytest.raises(subprocess.TimeoutExpired):
                other.wait(0.3)
            file.close()
            assert other.communicate(timeout=60)[0] == "goes on\n"


@symbolic_links
def test_an_environment_that_a_link_leads_to_is_left_as_it_is(tmp_path: Path, monkeypatch: pytest.MonkeyPatch):
    """Working trees may share one: making it anew through the link would empty it for all of them."""
    shared, link = tmp_path / "shared", tmp_path / ".venv"
    (shared / "bin").mkdir(parents=True)
    (shared / "bin" / "python").write_text("in use")
    (shared / environment.STAMP).write_text("of other requirements")
    link.symlink_to(shared)
    monkeypatch.setattr(environment, "run", lambda *_, **__: pytest.fail("a step was run"))
    with pytest.raises(environment.SetupError, match=r"\.venv is a link to '.*shared' and is not up to date"):
        environment.make(link, "everything")
    assert (shared / "bin" / "python").read_text() == "in use" and (shared / environment.STAMP).exists()


def test_uv_is_told_what_pip_was_told(monkeypatch: pytest.MonkeyPatch):
    for name in environment.UV_SETTINGS.values():
        monkeypatch.delenv(name, raising=False)
    monkeypatch.setenv("PIP_INDEX_URL", "file:///mirror/simple")
    monkeypatch.setenv("PIP_EXTRA_INDEX_URL", "file:///a file:///b")
    monkeypatch.setenv("PIP_FIND_LINKS", "/wheels /more")
    monkeypatch.setenv("PIP_CERT", "/from/pip.pem")
    monkeypatch.setenv("SSL_CERT_FILE", "/of/its/own.pem")
    told = environment.uv_environment(Path(sys.executable))
    assert told["UV_DEFAULT_INDEX"] == "file:///mirror/simple"
    assert told["UV_INDEX"] == "file:///a file:///b"
    assert told["UV_FIND_LINKS"] == "/wheels,/more"
    assert told["SSL_CERT_FILE"] == "/of/its/own.pem"


@pytest.mark.parametrize("version", PINS)
def test_requirement_files_hold_pins_alone(version: str):
    lines = [line for line in PINS[version].splitlines() if not line.startswith("#")]
    assert len(lines) > 20
    assert [line for line in lines if not re.fullmatch(r"[a-z0-9.-]+==[a-z0-9.]+", line)] == []


@pytest.mark.parametrize("version", PINS)
def test_the_pins_are_what_the_project_asks_for(version: str):
    asked = [requirement for group in PROJECT["dependency-groups"].values() for requirement in group]
    for requirement in asked:
        package, _, marker = requirement.partition("; ")
        if marker in ("", f"python_version == '{version}'"):
            assert re.search(rf"^{re.escape(package)}(==|$)", PINS[version], re.MULTILINE), requirement


def test_the_groups_of_an_environment_exist():
    for groups, _ in environment.CONTENTS.values():
        assert set(groups) <= set(PROJECT["dependency-groups"])


def test_the_farm_is_in_no_environment_but_its_own():
    assert [name for name, (groups, _) in environment.CONTENTS.items() if "farm" in groups] == ["farm"]
    farm = {requirement.partition("==")[0] for requirement in PROJECT["dependency-groups"]["farm"]}
    others = {name for group, own in PROJECT["dependency-groups"].items() if group != "farm" for name in own}
    assert farm and not farm & {requirement.partition("==")[0] for requirement in others}
    assert "farm" not in (ROOT / "setup/package.py").read_text(), "nor in the extension"


@pytest.mark.skipif(shutil.which("make") is None, reason="make is not here: Windows has none")
def test_make_alone_prints_a_line_for_each_target():
    # Without the flags that a make around these tests hands down.
    outside = {name: value for name, value in os.environ.items() if not name.startswith("MAKE")}
    shown = subprocess.run(["make"], cwd=ROOT, env=outside, capture_output=True, text=True, check=True).stdout
    targets = re.findall(r"^([a-z-]+):", (ROOT / "Makefile").read_text(), re.MULTILINE)
    assert {"demo", "test", "test-all", "lint", "package"} <= set(targets)
    assert [target for target in targets if f"  make {target} " not in shown] == []


def test_the_extension_is_staged_as_blender_expects_it(tmp_path: Path, monkeypatch: pytest.MonkeyPatch):
    monkeypatch.setattr(package, "STAGE", tmp_path / "stage")
    wheel = tmp_path / "onnxruntime-1-cp311-cp311-linux.whl"
    wheel.write_bytes(b"wheel")
    package.stage("linux-x64", [wheel])
    manifest = tomllib.loads((tmp_path / "stage/blender_manifest.toml").read_text())
    assert manifest["version"] == PROJECT["project"]["version"]
    assert manifest["platforms"] == ["linux-x64"]
    assert [(tmp_path / "stage" / path).read_bytes() for path in manifest["wheels"]] == [b"wheel"]
    assert set(manifest["permissions"]) == {"files", "network"}
    # Blender refuses longer reasons, and those that end like a sentence.
    assert all(0 < len(reason) <= 64 and reason[-1].isalpha() for reason in manifest["permissions"].values())
    assert "from .fdda_addon import register" in (tmp_path / "stage/__init__.py").read_text()
    assert (tmp_path / "stage/trainer/__init__.py").is_file()
    assert {f"python-{version}.txt" for version in PINS} <= {
        p.name for p in (tmp_path / "stage/requirements").iterdir()
    }


def test_a_package_is_for_this_platform_or_for_all():
    assert package.asked_platforms([]) == [package.this_platform()]
    everywhere = ["linux-x64", "linux-arm64", "macos-arm64", "windows-x64", "windows-arm64"]
    assert package.asked_platforms(["all"]) == everywhere
    assert package.asked_platforms(["windows-x64"]) == ["windows-x64"]


def test_linux_has_a_zip_for_the_python_of_distributions():
    """Three wheels of 24 MB are more than a zip may have."""
    assert package.builds("linux-x64") == package.builds("linux-arm64") == [("3.11", "3.13"), ("3.14",)]
    assert package.builds("windows-x64") == package.builds("macos-arm64") == [("3.11", "3.13")]


def test_a_platform_without_wheels_is_refused_in_a_sentence():
    command = [sys.executable, ROOT / "setup/package.py", "macos-x64"]
    result = subprocess.run(command, capture_output=True, text=True, check=False)
    assert result.returncode == 1 and result.stdout == ""
    assert result.stderr == (
        "ONNX Runtime has no wheels for the platform macos-x64; set PLATFORM to all or one of linux-x64, linux-arm64, "
        "macos-arm64, windows-x64, windows-arm64.\n"
    )


def test_a_package_that_is_too_large_is_refused(tmp_path: Path):
    large = tmp_path / "large.zip"
    with large.open("wb") as file:
        file.truncate(60_000_000)
        package.check_size(large)
        file.truncate(61_000_000)
    with pytest.raises(package.PackageError, match=r"large\.zip has 61 MB and may have 60; look for"):
        package.check_size(large)
