# SPDX-License-Identifier: GPL-3.0-or-later
"""Builds dist/fdda-VERSION.zip, the extension that Blender installs.

An extension is a package with the manifest beside its `__init__.py`, but here the manifest is at the root and the code
in `fdda_addon/`. So a copy is staged, with the trainer and the wheels of onnxruntime for the Python of every Blender,
and Blender's own extension tool, which comes with the bpy wheel and does not import it, builds and checks the zip.
"""

import argparse
import json
import shutil
import subprocess
import sys
import sysconfig
import tomllib
from pathlib import Path

ROOT = Path(__file__).resolve().parent.parent
DIST = ROOT / "dist"
STAGE = DIST / "stage"

# Blender's names of the platforms, and pip's, oldest system first.
PLATFORMS = {
    "linux-x64": ("manylinux_2_27_x86_64", "manylinux_2_28_x86_64"),
    "macos-arm64": ("macosx_14_0_arm64",),
    "windows-x64": ("win_amd64",),
}
# Blender 4.2 to 5.0 run on Python 3.11, later ones on 3.13.
PYTHONS = ("3.11", "3.13")

INIT = '''# SPDX-License-Identifier: GPL-3.0-or-later
"""The extension's entry: Blender calls `register` and `unregister`."""

from .fdda_addon import register, unregister

__all__ = ["register", "unregister"]
'''


def fetch_wheels(platforms: list[str]) -> list[Path]:
    """The onnxruntime wheels for `platforms`, as pinned; pip fetches those that dist/wheels does not have yet.

    Its dependencies are left out: numpy is Blender's, and playing a model needs no other.
    """
    wheels = []
    for python in PYTHONS:
        pins = (ROOT / "requirements" / f"python-{python}.txt").read_text().splitlines()
        requirement = next(pin for pin in pins if pin.startswith("onnxruntime=="))
        for platform in platforms:
            folder = DIST / "wheels" / f"{requirement}-{python}-{platform}"
            if not list(folder.glob("*.whl")):
                command = [sys.executable, "-m", "pip", "download", "--quiet", "--no-deps", "--only-binary=:all:"]
                command += [f"--dest={folder}", f"--python-version={python}", requirement]
                command += [f"--platform={name}" for name in PLATFORMS[platform]]
                subprocess.run(command, check=True)
            wheels += folder.glob("*.whl")
    return wheels


def stage(platforms: list[str], wheels: list[Path]) -> None:
    """Lay out the extension in dist/stage."""
    shutil.rmtree(STAGE, ignore_errors=True)
    for package in ("fdda_addon", "trainer"):
        shutil.copytree(ROOT / package, STAGE / package, ignore=shutil.ignore_patterns("__pycache__"))
    (STAGE / "__init__.py").write_text(INIT)
    shutil.copy(ROOT / "LICENSE", STAGE)
    (STAGE / "wheels").mkdir()
    for wheel in wheels:
        shutil.copy(wheel, STAGE / "wheels")
    manifest = (ROOT / "blender_manifest.toml").read_text()
    built = f"platforms = {json.dumps(platforms)}\nwheels = {json.dumps([f'./wheels/{w.name}' for w in wheels])}\n"
    (STAGE / "blender_manifest.toml").write_text(manifest.replace("\n[permissions]", f"\n{built}\n[permissions]"))


def build() -> Path:
    """Build the zip from dist/stage and have it checked, by the extension tool of the bpy wheel."""
    manifest = tomllib.loads((STAGE / "blender_manifest.toml").read_text())
    package = DIST / f"{manifest['id']}-{manifest['version']}.zip"
    blender = Path(sysconfig.get_path("platlib")) / "bpy"
    (tool,) = blender.glob("*/scripts/addons_core/bl_pkg/cli/blender_ext.py")
    subprocess.run([sys.executable, tool, "build", "--source-dir", STAGE, "--output-filepath", package], check=True)
    subprocess.run([sys.executable, tool, "validate", package], check=True)
    return package


def main() -> int:
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("platforms", nargs="*", default=["linux-x64"], help=f"of {', '.join(PLATFORMS)}")
    platforms = parser.parse_args().platforms
    if unknown := set(platforms) - set(PLATFORMS):
        parser.error(f"no such platform: {', '.join(sorted(unknown))}; there is {', '.join(PLATFORMS)}")
    try:
        stage(platforms, fetch_wheels(platforms))
        package = build()
    except subprocess.CalledProcessError as error:
        print(f"The extension was not built: '{Path(error.cmd[1]).name}' failed (see above).", file=sys.stderr)
        return 1
    print(f"{package.relative_to(ROOT)} ({package.stat().st_size / 1e6:.0f} MB) for {', '.join(platforms)}")
    return 0


if __name__ == "__main__":
    sys.exit(main())
