# SPDX-License-Identifier: GPL-3.0-or-later
"""Build dist/fdda_addon-VERSION.zip, the extension for Blender, for one platform or for all.

For Linux it builds a second zip, dist/fdda_addon-VERSION-python3.14.zip. The Blender of a Linux distribution runs on
the system's Python, and one zip for all Python versions would be too large.

Blender expects the manifest of an extension beside its `__init__.py`. Here the manifest is at the root and the code is
in `fdda_addon/`, so the files are first copied to dist/stage. The copy includes the trainer, its pinned requirements,
and the wheels of onnxruntime for the Python versions. Blender's extension tool then builds and validates the zip.
"""

import argparse
import json
import platform
import re
import shutil
import subprocess
import sys
import sysconfig
import tomllib
from pathlib import Path

from manual_page import make_page

ROOT = Path(__file__).resolve().parent.parent
DIST_FOLDER = ROOT / "dist"
STAGE_FOLDER = DIST_FOLDER / "stage"

# By Blender's name of a platform: platform tags of pip, oldest system first. onnxruntime has no wheels for macos-x64.
PLATFORMS = {
    "linux-x64": ("manylinux_2_27_x86_64", "manylinux_2_28_x86_64"),
    "linux-arm64": ("manylinux_2_27_aarch64", "manylinux_2_28_aarch64"),
    "macos-arm64": ("macosx_14_0_arm64",),
    "windows-x64": ("win_amd64",),
    "windows-arm64": ("win_arm64",),
}
ALL_PLATFORMS = "all"
# Blender 4.5 and 5.0 from blender.org run on Python 3.11, later versions on 3.13. The Blender of a distribution runs on
# the system's Python: in 2026 Debian, Arch and Fedora have 3.14.
PYTHON_VERSIONS = ("3.11", "3.13")
SYSTEM_PYTHON_VERSIONS = ("3.14",)
# Limit for the size of a zip. Users download the zip by hand, and Blender keeps a second copy when it installs it.
MAX_PACKAGE_MB = 60

INIT_CODE = '''# SPDX-License-Identifier: GPL-3.0-or-later
"""Entry point of the extension: Blender calls `register` and `unregister`."""

from .fdda_addon import register, unregister

__all__ = ["register", "unregister"]
'''


class PackageError(Exception):
    """The extension cannot be built; the message says what to do."""


def current_platform() -> str:
    """Return Blender's name of the current platform."""
    system = {"darwin": "macos"}.get(platform.system().lower(), platform.system().lower())
    machine = {"x86_64": "x64", "amd64": "x64", "aarch64": "arm64"}.get(platform.machine().lower(), platform.machine())
    return f"{system}-{machine}"


def select_platforms(names: list[str]) -> list[str]:
    """Return the platforms to build for: the named platforms, all platforms, or by default the current one.

    Raises:
        PackageError: onnxruntime has no wheels for one of the platforms.
    """
    platforms = list(PLATFORMS) if ALL_PLATFORMS in names else names or [current_platform()]
    if unknown := sorted(set(platforms) - set(PLATFORMS)):
        platform_names = ", ".join(PLATFORMS)
        raise PackageError(
            f"ONNX Runtime has no wheels for the platform {unknown[0]}; "
            f"set PLATFORM to {ALL_PLATFORMS} or one of {platform_names}."
        )
    return platforms


def python_versions_of_zips(name: str) -> list[tuple[str, ...]]:
    """Return the Python versions of each zip for a platform; Linux has an extra zip for Blenders of distributions."""
    return [PYTHON_VERSIONS, *((python,) for python in SYSTEM_PYTHON_VERSIONS if name.startswith("linux"))]


def fetch_wheels(name: str, pythons: tuple[str, ...]) -> list[Path]:
    """Return the pinned onnxruntime wheels of a platform; pip downloads those that are not in dist/wheels.

    The dependencies of onnxruntime are left out: Blender includes numpy, and playback needs no other package.

    Raises:
        CalledProcessError: pip failed.
    """
    wheels = []
    for python in pythons:
        # The version of Python 3.11 has no wheel for Windows on ARM, where Blender's C++ library is newer.
        pinned_python = "3.13" if name == "windows-arm64" else python
        pins = (ROOT / "requirements" / f"python-{pinned_python}.txt").read_text().splitlines()
        requirement = next(pin for pin in pins if pin.startswith("onnxruntime=="))
        folder = DIST_FOLDER / "wheels" / f"{requirement}-{python}-{name}"
        if not list(folder.glob("*.whl")):
            command = [sys.executable, "-m", "pip", "download", "--quiet", "--no-deps", "--only-binary=:all:"]
            command += [f"--dest={folder}", f"--python-version={python}", requirement]
            command += [f"--platform={tag}" for tag in PLATFORMS[name]]
            subprocess.run(command, check=True)
        wheels += folder.glob("*.whl")
    return wheels


def stage_manual(folder: Path) -> None:
    """Write the manual as an HTML page into a folder, and copy the pictures and pages that it refers to."""
    text = (ROOT / "docs" / "manual.md").read_text(encoding="utf-8")
    folder.mkdir(parents=True)
    (folder / "manual.html").write_text(make_page(text), encoding="utf-8")
    references = re.findall(r"\]\(([\w./-]+)(?:#[^)]*)?\)|<img src=\"([^\"]+)\"", text)
    for name in set(map("".join, references)):
        (folder / name).parent.mkdir(parents=True, exist_ok=True)
        shutil.copy(ROOT / "docs" / name, folder / name)


def stage_files(name: str, wheels: list[Path], website: str = "") -> None:
    """Copy the files of the extension for a platform to dist/stage.

    Args:
        name: Blender's name of the platform.
        wheels: paths of the wheels.
        website: address that Blender opens with *Visit Website*; empty for none.
    """
    shutil.rmtree(STAGE_FOLDER, ignore_errors=True)
    for folder in ("fdda_addon", "trainer", "requirements"):
        shutil.copytree(ROOT / folder, STAGE_FOLDER / folder, ignore=shutil.ignore_patterns("__pycache__"))
    # The help buttons of the sidebar open the manual.
    stage_manual(STAGE_FOLDER / "docs")
    (STAGE_FOLDER / "__init__.py").write_text(INIT_CODE)
    shutil.copy(ROOT / "LICENSE", STAGE_FOLDER)
    (STAGE_FOLDER / "wheels").mkdir()
    for wheel in wheels:
        shutil.copy(wheel, STAGE_FOLDER / "wheels")
    manifest = (ROOT / "blender_manifest.toml").read_text()
    built_tables = f"platforms = {json.dumps([name])}\nwheels = {json.dumps([f'./wheels/{w.name}' for w in wheels])}\n"
    built_tables += f"website = {json.dumps(website)}\n" if website else ""
    (STAGE_FOLDER / "blender_manifest.toml").write_text(
        manifest.replace("\n[permissions]", f"\n{built_tables}\n[permissions]")
    )


def run_extension_tool(*arguments: object) -> None:
    """Run Blender's extension tool, which is part of the bpy wheel and does not import bpy.

    Raises:
        CalledProcessError: the tool failed; it has printed the reason.
    """
    bpy_folder = Path(sysconfig.get_path("platlib")) / "bpy"
    (tool,) = bpy_folder.glob("*/scripts/addons_core/bl_pkg/cli/blender_ext.py")
    subprocess.run([sys.executable, tool, *arguments], check=True)


def build(package: Path) -> None:
    """Build and validate the zip from dist/stage.

    Raises:
        PackageError: the zip is too large.
        CalledProcessError: the zip cannot be built, or is not valid.
    """
    run_extension_tool("build", "--source-dir", STAGE_FOLDER, "--output-filepath", package)
    run_extension_tool("validate", package)
    check_size(package)


def check_size(package: Path) -> None:
    """Check the size of a zip.

    Raises:
        PackageError: the zip is larger than `MAX_PACKAGE_MB`.
    """
    size = package.stat().st_size / 1e6
    if size > MAX_PACKAGE_MB:
        raise PackageError(
            f"{package.name} has {size:.0f} MB, more than the limit of {MAX_PACKAGE_MB} MB; "
            "look for large files in dist/stage."
        )


def read_version() -> str:
    """Return the version of the extension. The manifest at the root is the only place that has it."""
    return tomllib.loads((ROOT / "blender_manifest.toml").read_text())["version"]


def build_packages(names: list[str], website: str = "") -> list[Path]:
    """Build and validate the zips for platforms, and print their sizes.

    Args:
        names: as for `select_platforms`.
        website: as for `stage_files`.

    Returns:
        The paths of the zips.

    Raises:
        PackageError: there are no wheels for a platform, or a zip is too large.
        CalledProcessError: pip or the extension tool failed.
    """
    packages = []
    for name in select_platforms(names):
        for pythons in python_versions_of_zips(name):
            # Several zips are named as Blender's option `--split-platforms` names them.
            suffix = f"-{name.replace('-', '_')}" if names else ""
            suffix += "" if pythons == PYTHON_VERSIONS else f"-python{pythons[0]}"
            package = DIST_FOLDER / f"fdda_addon-{read_version()}{suffix}.zip"
            stage_files(name, fetch_wheels(name, pythons), website)
            build(package)
            size = package.stat().st_size / 1e6
            print(f"{package.relative_to(ROOT)} ({size:.0f} MB) for {name}, Python {' and '.join(pythons)}")
            packages.append(package)
    return packages


def main() -> int:
    parser = argparse.ArgumentParser(description=__doc__)
    platform_names = ", ".join(PLATFORMS)
    parser.add_argument(
        "platforms", nargs="*", help=f"{ALL_PLATFORMS}, or some of {platform_names}; by default the current platform"
    )
    try:
        build_packages(parser.parse_args().platforms)
    except PackageError as error:
        print(error, file=sys.stderr)
        return 1
    except subprocess.CalledProcessError as error:
        print(f"The extension was not built: '{Path(error.cmd[1]).name}' failed (see above).", file=sys.stderr)
        return 1
    return 0


if __name__ == "__main__":
    sys.exit(main())
