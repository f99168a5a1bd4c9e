# SPDX-License-Identifier: GPL-3.0-or-later
"""Builds dist/fdda_addon-VERSION.zip, the extension that Blender installs, for one platform or for all.

An extension is a package with the manifest beside its `__init__.py`, but here the manifest is at the root and the code
in `fdda_addon/`. So a copy is staged, with the trainer, its pinned requirements and the wheels of onnxruntime for the
Python of every Blender, and Blender's own extension tool, which comes with the bpy wheel and does not import it, builds
and checks the zip.
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
    "macos-arm64": ("macosx_14_0_arm64",),
    "windows-x64": ("win_amd64",),
}
ALL = "all"
# Blender 4.5 and 5.0 run on Python 3.11, later ones on 3.13.
PYTHONS = ("3.11", "3.13")
# What a zip may have at most: it is downloaded by hand, and kept a second time where it is installed.
LARGEST_MB = 60

INIT = '''# SPDX-License-Identifier: GPL-3.0-or-later
"""The extension's entry: Blender calls `register` and `unregister`."""

from .fdda_addon import register, unregister

__all__ = ["register", "unregister"]
'''


class PackageError(Exception):
    """The extension cannot be built; the text says what to do about it."""


def this_platform() -> str:
    """Blender's name of the platform that runs this."""
    system = {"darwin": "macos"}.get(platform.system().lower(), platform.system().lower())
    machine = {"x86_64": "x64", "amd64": "x64", "aarch64": "arm64"}.get(platform.machine().lower(), platform.machine())
    return f"{system}-{machine}"


def asked_platforms(names: list[str]) -> list[str]:
    """The platforms to build for: those named, all of them, or the one that runs this.

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


def fetch_wheels(name: str) -> list[Path]:
    """The onnxruntime wheels for a platform, as pinned; pip fetches those that dist/wheels does not have yet.

    Its dependencies are left out: numpy is Blender's, and playing a model needs no other.
    """
    wheels = []
    for python in PYTHONS:
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
    """Lay out the extension for a platform in dist/stage."""
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
    """Build the zip from dist/stage and have it checked, by the extension tool of the bpy wheel.

    Raises:
        PackageError: it is too large.
    """
    blender = Path(sysconfig.get_path("platlib")) / "bpy"
    (tool,) = blender.glob("*/scripts/addons_core/bl_pkg/cli/blender_ext.py")
    subprocess.run([sys.executable, tool, "build", "--source-dir", STAGE, "--output-filepath", package], check=True)
    subprocess.run([sys.executable, tool, "validate", package], check=True)
    check_size(package)


def check_size(package: Path) -> None:
    """Raises:
    PackageError: the zip is too large.
    """
    size = package.stat().st_size / 1e6
    if size > LARGEST_MB:
        raise PackageError(
            f"{package.name} has {size:.0f} MB and may have {LARGEST_MB}; look for what is too much in dist/stage."
        )


def main() -> int:
    parser = argparse.ArgumentParser(description=__doc__)
    known = ", ".join(PLATFORMS)
    parser.add_argument("platforms", nargs="*", help=f"{ALL}, or of {known}; when left out, the one that runs this")
    names = parser.parse_args().platforms
    version = tomllib.loads((ROOT / "blender_manifest.toml").read_text())["version"]
    try:
        for name in asked_platforms(names):
            # As Blender's `--split-platforms` calls them, where there are several.
            suffix = f"-{name.replace('-', '_')}" if names else ""
            package = DIST / f"fdda_addon-{version}{suffix}.zip"
            stage(name, fetch_wheels(name))
            build(package)
            print(f"{package.relative_to(ROOT)} ({package.stat().st_size / 1e6:.0f} MB) for {name}")
    except PackageError as error:
        print(error, file=sys.stderr)
        return 1
    except subprocess.CalledProcessError as error:
        print(f"The extension was not built: '{Path(error.cmd[1]).name}' failed (see above).", file=sys.stderr)
        return 1
    return 0


if __name__ == "__main__":
    sys.exit(main())
