# SPDX-License-Identifier: GPL-3.0-or-later
"""Tiny wheels with the names and versions of the trainer's packages, which can be installed and imported."""

import re
import sys
import zipfile
from pathlib import Path

from fdda_addon.training.environment.folder import PACKAGES, requirements_file

TORCH = """__version__ = "{version}"
class cuda:
    is_available = staticmethod(lambda: False)
"""


def pinned_version(package: str) -> str:
    """Return the version of a package that the requirements for this Python pin."""
    return re.search(rf"^{package}==(\S+)$", requirements_file(sys.version_info[:2]).read_text(), re.MULTILINE)[1]


def write_wheel(folder: Path, package: str, text: str = '__version__ = "{version}"\n', requires: str = "") -> Path:
    """Write the wheel of a package."""
    version = pinned_version(package)
    information = f"{package}-{version}.dist-info"
    path = folder / f"{package}-{version}-py3-none-any.whl"
    with zipfile.ZipFile(path, "w") as archive:
        archive.writestr(f"{package}/__init__.py", text.replace("{version}", version))
        metadata = f"Metadata-Version: 2.1\nName: {package}\nVersion: {version}\n"
        archive.writestr(f"{information}/METADATA", metadata + (f"Requires-Dist: {requires}\n" if requires else ""))
        archive.writestr(f"{information}/WHEEL", "Wheel-Version: 1.0\nRoot-Is-Purelib: true\nTag: py3-none-any\n")
        archive.writestr(f"{information}/RECORD", "")
    return path


def write_wheels(folder: Path) -> Path:
    """Write a wheel for each package that the trainer needs, and return the folder."""
    folder.mkdir()
    for package in PACKAGES:
        write_wheel(folder, package, *([TORCH] if package == "torch" else []))
    return folder
