# SPDX-License-Identifier: GPL-3.0-or-later
"""Building of dist/fdda_addon-VERSION.zip, the extension for Blender, for one platform or all.

On Linux there is a second one, dist/fdda_addon-VERSION-python3.14.zip: Blender as distributions build it runs on the
system's Python, and all Pythons together would be too large a zip.

An extension is a package with the manifest beside its `__init__.py`, but here the manifest is at the root and the code
in `fdda_addon/`. So a copy is staged, with the trainer, its pinned requirements and the wheels of onnxruntime for the
Pythons of these Blenders, and Blender's own extension tool, which comes with the bpy wheel and does not import it,
builds and checks the zip.
"""

import argparse
import json
import platform
import shutil
import subprocess
import sys
import sysconfig
import tomllib
from pathlib import Path

ROOT = Path(__file__).resolve().parent.parent
DIST = ROOT / "dist"
STAGE = DIST / "stage"

# Blender's names of the platforms, and pip's, oldest system first. Not macos-x64: onnxruntime has no wheels for it.
PLATFORMS = {
    "linux-x64": ("manylinux_2_27_x86_64", "manylinux_2_28_x86_64"),
    "linux-arm64": ("manylinux_2_27_aarch64", "manylinux_2_28_aarch64"),
    "macos-arm64": ("macosx_14_0_arm64",),
    "windows-x64": ("win_amd64",),
    "windows-arm64": ("win_arm64",),
}
ALL = "all"
# Of blender.org: 4.5 and 5.0 run on Python 3.11, later ones on 3.13. Of distributions: on the system's, in 2026 that of
# Debian, Arch and Fedora is 3.14.
PYTHONS = ("3.11", "3.13")
SYSTEM_PYTHONS = ("3.14",)
# What a zip may have at most: it is downloaded by hand, and kept a second time where it is installed.
MAX_PACKAGE_MB = 60

INIT = '''# SPDX-License-Identifier: GPL-3.0-or-later
"""The extension's entry: Blender calls `register` and `unregister`."""

from .fdda_addon import register, unregister

__all__ = ["register", "unregister"]
'''


class PackageError(Exception):
    """The extension cannot be built; the message says what to do."""


def this_platform() -> str:
    """Return Blender's name of the current platform."""
    system = {"darwin": "macos"}.get(platform.system().lower(), platform.system().lower())
    machine = {"x86_64": "x64", "amd64": "x64", "aarch64": "arm64"}.get(platform.machine().lower(), platform.machine())
    return f"{system}-{machine}"


def asked_platforms(names: list[str]) -> list[str]:
    """Return the platforms to build for: the named ones, all, or the current one.

    Raises:
        PackageError: there are no wheels for one of them.
    """
    platforms = list(PLATFORMS) if ALL in names else names or [this_platform()]
    if unknown := sorted(set(platforms) - set(PLATFORMS)):
        known = ", ".join(PLATFORMS)
        raise PackageError(
            f"ONNX Runtime has no wheels for the platform {unknown[0]}; set PLATFORM to {ALL} or one of {known}."
        )
    return platforms


def builds(name: str) -> list[tuple[str, ...]]:
    """Return the Python versions of each zip of a platform: Blender's own, and on Linux that of distributions."""
    return [PYTHONS, *((python,) for python in SYSTEM_PYTHONS if name.startswith("linux"))]


def fetch_wheels(name: str, pythons: tuple[str, ...]) -> list[Path]:
    """Return the pinned onnxruntime wheels of a platform; pip downloads those that are not in dist/wheels.

    Its dependencies are left out: numpy is Blender's, and playing a model needs no other.
    """
    wheels = []
    for python in pythons:
        pins = (ROOT / "requirements" / f"python-{python}.txt").read_text().splitlines()
        requirement = next(pin for pin in pins if pin.startswith("onnxruntime=="))
        folder = DIST / "wheels" / f"{requirement}-{python}-{name}"
        if not list(folder.glob("*.whl")):
            command = [sys.executable, "-m", "pip", "download", "--quiet", "--no-deps", "--only-binary=:all:"]
            command += [f"--dest={folder}", f"--python-version={python}", requirement]
            command += [f"--platform={tag}" for tag in PLATFORMS[name]]
            subprocess.run(command, check=True)
        wheels += folder.glob("*.whl")
    return wheels


def stage(name: str, wheels: list[Path]) -> None:
    """Copy the files of the extension for a platform to dist/stage."""
    shutil.rmtree(STAGE, ignore_errors=True)
    for folder in ("fdda_addon", "trainer", "requirements"):
        shutil.copytree(ROOT / folder, STAGE / folder, ignore=shutil.ignore_patterns("__pycache__"))
    # The help buttons open the manual.
    (STAGE / "docs").mkdir()
    shutil.copy(ROOT / "docs" / "manual.md", STAGE / "docs")
    (STAGE / "__init__.py").write_text(INIT)
    shutil.copy(ROOT / "LICENSE", STAGE)
    (STAGE / "wheels").mkdir()
    for wheel in wheels:
        shutil.copy(wheel, STAGE / "wheels")
    manifest = (ROOT / "blender_manifest.toml").read_text()
    built = f"platforms = {json.dumps([name])}\nwheels = {json.dumps([f'./wheels/{w.name}' for w in wheels])}\n"
    (STAGE / "blender_manifest.toml").write_text(manifest.replace("\n[permissions]", f"\n{built}\n[permissions]"))


def build(package: Path) -> None:
    """Build and validate the zip from dist/stage with the extension tool of the bpy wheel.

    Raises:
        PackageError: it is too large.
    """
    blender = Path(sysconfig.get_path("platlib")) / "bpy"
    (tool,) = blender.glob("*/scripts/addons_core/bl_pkg/cli/blender_ext.py")
    subprocess.run([sys.executable, tool, "build", "--source-dir", STAGE, "--output-filepath", package], check=True)
    subprocess.run([sys.executable, tool, "validate", package], check=True)
    check_size(package)


def check_size(package: Path) -> None:
    """Check that a zip is not too large.

    Raises:
        PackageError: it is.
    """
    size = package.stat().st_size / 1e6
    if size > MAX_PACKAGE_MB:
        raise PackageError(
            f"{package.name} has {size:.0f} MB and may have {MAX_PACKAGE_MB}; look for what is too much in dist/stage."
        )


def main() -> int:
    parser = argparse.ArgumentParser(description=__doc__)
    known = ", ".join(PLATFORMS)
    parser.add_argument("platforms", nargs="*", help=f"{ALL}, or of {known}; when left out, the one that runs this")
    names = parser.parse_args().platforms
    version = tomllib.loads((ROOT / "blender_manifest.toml").read_text())["version"]
    try:
        for name in asked_platforms(names):
            for pythons in builds(name):
                # As Blender's `--split-platforms` calls them, where there are several.
                suffix = f"-{name.replace('-', '_')}" if names else ""
                suffix += "" if pythons == PYTHONS else f"-python{pythons[0]}"
                package = DIST / f"fdda_addon-{version}{suffix}.zip"
                stage(name, fetch_wheels(name, pythons))
                build(package)
                size = package.stat().st_size / 1e6
                print(f"{package.relative_to(ROOT)} ({size:.0f} MB) for {name}, Python {' and '.join(pythons)}")
    except PackageError as error:
        print(error, file=sys.stderr)
        return 1
    except subprocess.CalledProcessError as error:
        print(f"The extension was not built: '{Path(error.cmd[1]).name}' failed (see above).", file=sys.stderr)
        return 1
    return 0


if __name__ == "__main__":
    sys.exit(main())
