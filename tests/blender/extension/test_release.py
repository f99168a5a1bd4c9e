# SPDX-License-Identifier: GPL-3.0-or-later
"""The repository of a release: built from small zips, offered on this machine, and read by Blender's extension tool."""

import functools
import hashlib
import http.server
import importlib
import json
import re
import subprocess
import sys
import sysconfig
import threading
import tomllib
import zipfile
from collections.abc import Iterator
from pathlib import Path

import pytest

ROOT = Path(__file__).resolve().parents[3]
sys.path.append(str(ROOT / "setup"))  # The scripts of setup/ import each other as a program does.
package, release = (importlib.import_module(name) for name in ("package", "release"))

(EXTENSION_TOOL,) = Path(sysconfig.get_path("platlib")).glob("bpy/*/scripts/addons_core/bl_pkg/cli/blender_ext.py")
SYSTEMS = (("linux-x64", ("3.11", "3.13")), ("linux-x64", ("3.14",)), ("windows-x64", ("3.11", "3.13")))
WEBSITE = "https://example.org/fdda"


def build_small_zips(folder: Path) -> list[Path]:
    """Build zips with the code of the extension and empty wheels; return their paths."""
    zips = []
    for platform, pythons in SYSTEMS:
        tags = [f"cp{python.replace('.', '')}" for python in pythons]
        wheels = [folder / f"onnxruntime-1.31.1-{tag}-{tag}-{package.PLATFORMS[platform][0]}.whl" for tag in tags]
        for wheel in wheels:
            with zipfile.ZipFile(wheel, "w") as archive:
                archive.writestr("onnxruntime/__init__.py", "")
        zips.append(folder / f"fdda_addon-{package.read_version()}-{platform}-{pythons[-1]}.zip")
        package.stage_files(platform, wheels, WEBSITE)
        package.build(zips[-1])
    return zips


@pytest.fixture(scope="module")
def zips(tmp_path_factory: pytest.TempPathFactory) -> Iterator[list[Path]]:
    folder = tmp_path_factory.mktemp("zips")
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(package, "STAGE_FOLDER", folder / "stage")
        yield build_small_zips(folder)


@pytest.fixture
def repository(zips: list[Path], tmp_path: Path) -> Path:
    release.make_repository(zips, tmp_path / "repository")
    return tmp_path / "repository"


@pytest.fixture
def address(repository: Path) -> Iterator[str]:
    """Offer the repository on the loopback interface; return the address of its list."""
    handler = functools.partial(http.server.SimpleHTTPRequestHandler, directory=str(repository))
    server = http.server.ThreadingHTTPServer(("127.0.0.1", 0), handler)
    threading.Thread(target=server.serve_forever, daemon=True).start()
    yield f"http://127.0.0.1:{server.server_port}/index.json"
    server.shutdown()
    server.server_close()


def install(address: str, folder: Path, python: str = "3.13.0") -> subprocess.CompletedProcess[str]:
    """Synchronize with a repository and install the extension from it, as Blender does on this machine."""
    folder.mkdir(exist_ok=True)
    client = [sys.executable, EXTENSION_TOOL]
    place = ["--remote-url", address, "--local-dir", str(folder)]
    subprocess.run([*client, "sync", *place], check=True)
    versions = ["--blender-version", "5.2.0", "--python-version", python]
    return subprocess.run([*client, "install", *place, *versions, "fdda"], capture_output=True, text=True, check=False)


def test_the_list_has_every_zip_with_its_hash(repository: Path, zips: list[Path]):
    entries = json.loads((repository / "index.json").read_text())["data"]
    listed = {entry["archive_url"].removeprefix("./"): entry for entry in entries}
    assert set(listed) == {path.name for path in zips}
    for path, (platform, pythons) in zip(zips, SYSTEMS, strict=True):
        entry = listed[path.name]
        assert entry["archive_hash"] == "sha256:" + hashlib.sha256(path.read_bytes()).hexdigest()
        assert entry["archive_size"] == path.stat().st_size
        assert entry["platforms"] == [platform] and entry["python_versions"] == list(pythons)
        assert entry["version"] == tomllib.loads((ROOT / "blender_manifest.toml").read_text())["version"]
        assert entry["website"] == WEBSITE and entry["copyright"]


@pytest.mark.skipif(not sys.platform.startswith("linux"), reason="The repository of this test has zips for Linux.")
@pytest.mark.skipif(package.current_platform() != "linux-x64", reason="The repository of this test has zips for x64.")
def test_blender_installs_the_zip_of_its_python(address: str, tmp_path: Path):
    for python, tag in (("3.13.0", "cp313"), ("3.14.0", "cp314")):
        result = install(address, tmp_path / tag, python)
        assert result.returncode == 0, result.stdout + result.stderr
        manifest = tomllib.loads((tmp_path / tag / "fdda/blender_manifest.toml").read_text())
        assert any(tag in wheel for wheel in manifest["wheels"]) and manifest["version"] == package.read_version()
    result = install(address, tmp_path / "cp315", "3.15.0")
    assert "not compatible with this system" in result.stdout, result.stdout
    assert not (tmp_path / "cp315/fdda").exists()


@pytest.mark.skipif(package.current_platform() != "linux-x64", reason="The repository of this test has zips for x64.")
def test_blender_refuses_a_zip_that_was_changed_on_the_server(address: str, repository: Path, tmp_path: Path):
    for path in repository.glob("*.zip"):
        content = bytearray(path.read_bytes())
        content[len(content) // 2] ^= 1
        path.write_bytes(content)
    result = install(address, tmp_path / "client")
    assert re.search("expected sha256:.*, was sha256:", result.stdout) and not (tmp_path / "client/fdda").exists()


def test_a_zip_that_blender_cannot_read_is_not_released(repository: Path, zips: list[Path], tmp_path: Path):
    before = sorted((path.name, path.read_bytes()) for path in repository.iterdir())
    damaged = tmp_path / zips[0].name
    damaged.write_bytes(zips[0].read_bytes()[:-1000])
    with pytest.raises(release.ReleaseError, match=rf"list of the repository lacks {damaged.name}; see"):
        release.make_repository([damaged, *zips[1:]], repository)
    assert sorted((path.name, path.read_bytes()) for path in repository.iterdir()) == before
    assert [path.name for path in tmp_path.iterdir() if path.name.startswith(".")] == []
