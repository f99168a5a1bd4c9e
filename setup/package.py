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
import struct
import subprocess
import sys
import sysconfig
import tomllib
import zipfile
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
# By platform and Python version: the oldest version of Microsoft's C++ library that a Blender from blender.org brings.
# Crash reports of Blender list the version of MSVCP140.dll: 4.5 and 5.0 have 14.29, 5.1 and 5.2 have 14.44. On ARM, the
# linker of the DLLs of Blender 4.5 has version 14.42.
CPP_LIBRARY_VERSIONS = {
    ("windows-x64", "3.11"): (14, 29),
    ("windows-x64", "3.13"): (14, 44),
    ("windows-arm64", "3.11"): (14, 42),
    ("windows-arm64", "3.13"): (14, 44),
}
CPP_LIBRARY = "msvcp140.dll"
# Version of the newest linker whose DLLs were tried with older C++ libraries.
NEWEST_KNOWN_TOOLSET = (14, 44)
# Since this version the compiler initializes mutexes, in a way that older C++ libraries cannot lock.
MUTEX_VERSION = (14, 40)
MUTEX_FUNCTIONS = {"_Mtx_lock", "_Mtx_trylock", "_Mtx_timedlock", "_Cnd_wait", "_Cnd_timedwait"}
# Function that initializes mutexes for earlier compilers, and for later ones if a build asks for it.
MUTEX_INITIALIZER = "_Mtx_init_in_situ"
IMPORT_DIRECTORY, DELAYED_IMPORT_DIRECTORY = 1, 13
# Names of libraries of Microsoft's compilers, and those that each Blender brings.
COMPILER_LIBRARY = re.compile(r"(msvc[pr]|vcruntime|concrt|vccorlib|vcomp|mfc|atl)\d+\w*\.dll")
BLENDERS_COMPILER_LIBRARIES = {
    "concrt140.dll",
    "msvcp140.dll",
    "msvcp140_1.dll",
    "msvcp140_2.dll",
    "msvcp140_atomic_wait.dll",
    "msvcp140_codecvt_ids.dll",
    "vccorlib140.dll",
    "vcruntime140.dll",
    "vcruntime140_1.dll",
}
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
        PackageError: a wheel does not run in all Blenders, as for `check_wheel`.
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
        for wheel in folder.glob("*.whl"):
            check_wheel(wheel, name, python)
            wheels.append(wheel)
    return wheels


def read_imports(data: bytes) -> tuple[tuple[int, int], dict[str, set[str]]]:
    """Read the import tables of a 64-bit DLL.

    Args:
        data: content of the file.

    Returns:
        The version of the linker, and the imported functions by the name of the DLL in lower case. Functions that are
        imported by number are left out.

    Raises:
        ValueError: the data is no DLL, is damaged, or is for 32 bits.

    References:
        https://learn.microsoft.com/en-us/windows/win32/debug/pe-format
    """
    try:
        (header,) = struct.unpack_from("<I", data, 0x3C)
        signature, section_count, optional_size, magic, *linker_version = struct.unpack_from(
            "<I2xH12xH2xH2B", data, header
        )
        if signature != 0x4550 or magic != 0x20B:
            raise ValueError("no 64-bit DLL")
        sections = [
            struct.unpack_from("<8x4I", data, header + 24 + optional_size + 40 * index)
            for index in range(section_count)
        ]

        def offset(address: int) -> int:
            for size, start, file_size, file_start in sections:
                if start <= address < start + max(size, file_size):
                    return address - start + file_start
            raise ValueError("an address outside of all sections")

        def text(address: int) -> str:
            start = offset(address)
            end = data.find(b"\0", start)
            if end < 0:
                raise ValueError("a name that does not end")
            return data[start:end].decode("ascii")

        imports: dict[str, set[str]] = {}
        # Of a descriptor: its format, and the positions of the address of the DLL's name and of its table of functions.
        layouts = {IMPORT_DIRECTORY: ("<5I", 3, 0), DELAYED_IMPORT_DIRECTORY: ("<8I", 1, 4)}
        for directory, (layout, name_position, table_position) in layouts.items():
            (address,) = struct.unpack_from("<I", data, header + 24 + 112 + 8 * directory)
            descriptor = offset(address) if address else None
            while descriptor is not None and any(fields := struct.unpack_from(layout, data, descriptor)):
                functions = imports.setdefault(text(fields[name_position]).lower(), set())
                entry = offset(fields[table_position])
                while function := struct.unpack_from("<Q", data, entry)[0]:
                    if not function >> 63:
                        functions.add(text(function + 2))
                    entry += 8
                descriptor += struct.calcsize(layout)
    except (struct.error, IndexError, UnicodeDecodeError) as error:
        raise ValueError("damaged") from error
    return tuple(linker_version), imports


def needed_cpp_library_version(data: bytes) -> tuple[int, int]:
    """Return the oldest version of the C++ library with which a DLL runs; (14, 0) where any will do.

    Microsoft promises only that a library as new as the linker will do. But all versions have the same functions, and
    those up to `NEWEST_KNOWN_TOOLSET` differ only in their mutexes.
    """
    linker_version, imports = read_imports(data)
    if CPP_LIBRARY not in imports:
        return (14, 0)
    if linker_version > NEWEST_KNOWN_TOOLSET:
        return linker_version
    functions = imports[CPP_LIBRARY]
    return MUTEX_VERSION if functions & MUTEX_FUNCTIONS and MUTEX_INITIALIZER not in functions else (14, 0)


def check_wheel(wheel: Path, name: str, python: str) -> None:
    """Check that each Blender with a Python version on a platform can load the DLLs of a wheel.

    Raises:
        PackageError: a DLL needs a library that Blender does not bring, or a newer one than Blender has.
    """
    if (name, python) not in CPP_LIBRARY_VERSIONS:
        return
    brought_version = CPP_LIBRARY_VERSIONS[name, python]
    with zipfile.ZipFile(wheel) as archive:
        dlls = [path for path in archive.namelist() if path.lower().endswith((".dll", ".pyd"))]
        available = BLENDERS_COMPILER_LIBRARIES | {path.rpartition("/")[2].lower() for path in dlls}
        for path in dlls:
            data = archive.read(path)
            try:
                needed_version, (_, imports) = needed_cpp_library_version(data), read_imports(data)
            except ValueError as error:
                raise PackageError(
                    f"'{path}' of {wheel.name} cannot be read ({error}); download the wheel again."
                ) from error
            lacking = sorted(
                library for library in imports if COMPILER_LIBRARY.fullmatch(library) and library not in available
            )
            if needed_version > brought_version:
                lacking = ["msvcp140.dll {}.{}".format(*needed_version)]
            if lacking:
                raise PackageError(
                    f"'{path}' of {wheel.name} needs {lacking[0]}, and the Blenders with Python {python} bring "
                    "msvcp140.dll {}.{}; ".format(*brought_version)
                    + f"pin another version in pyproject.toml for Python {python}, and try it with make test-windows."
                )


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
        PackageError: there are no wheels for a platform, one does not run in Blender, or a zip is too large.
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
