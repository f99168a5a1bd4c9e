# SPDX-License-Identifier: GPL-3.0-or-later
"""Which DLLs of wheels the zips for Windows may contain, by the C++ library that the oldest Blender brings."""

import importlib.util
import struct
import sys
import zipfile
from pathlib import Path

import pytest
import setuptools

from fdda_addon.core.files import native_library
from fdda_addon.core.files.native_library import check_cpp_library, loaded_cpp_library_version

from ..systems import WINDOWS
from .test_setup import package

SECTION_ADDRESS, SECTION_OFFSET = 0x1000, 0x200
INITIALIZED_MUTEX = {"msvcp140.dll": ["_Mtx_init_in_situ", "_Mtx_lock"]}
CONSTANT_MUTEX = {"msvcp140.dll": ["_Mtx_lock", "?_Xlength_error@std@@YAXPEBD@Z"]}
NO_MUTEX = {"msvcp140.dll": ["?_Xlength_error@std@@YAXPEBD@Z"], "vcruntime140.dll": ["memcpy"]}


def make_dll(
    imports: dict[str, list[str]], linker: tuple[int, int] = (14, 40), machine: int = 0x8664, delayed: bool = False
) -> bytes:
    """Make a DLL with one section, which imports functions, and one more by its number from each DLL."""
    layout = "<8I" if delayed else "<5I"
    section = bytearray(struct.calcsize(layout) * (len(imports) + 1))

    def append(data: bytes) -> int:
        section.extend(data)
        return SECTION_ADDRESS + len(section) - len(data)

    for index, (dll, functions) in enumerate(imports.items()):
        names = [append(b"\0\0" + function.encode() + b"\0") for function in functions]
        table = append(struct.pack(f"<{len(names) + 2}Q", 1 << 63 | 7, *names, 0))
        name = append(dll.upper().encode() + b"\0")
        fields = (1, name, 0, 0, table, 0, 0, 0) if delayed else (table, 0, 0, name, table)
        struct.pack_into(layout, section, index * struct.calcsize(layout), *fields)
    header = bytearray(SECTION_OFFSET)
    struct.pack_into("<2s58xI", header, 0, b"MZ", 0x40)
    struct.pack_into("<4s2H12xH2xH2B", header, 0x40, b"PE\0\0", machine, 1, 240, 0x20B, *linker)
    struct.pack_into("<I", header, 0x40 + 24 + 112 + 8 * (13 if delayed else 1), SECTION_ADDRESS)
    sizes = (len(section), SECTION_ADDRESS, len(section), SECTION_OFFSET)
    struct.pack_into("<8s4I", header, 0x40 + 24 + 240, b".rdata", *sizes)
    return bytes(header + section)


def test_imports_of_a_real_program_are_read():
    linker, imports = package.read_imports(Path(setuptools.__file__).with_name("cli-64.exe").read_bytes())
    assert linker >= (9, 0) and {"CreateProcessA", "WaitForSingleObject"} <= imports["kernel32.dll"]


@pytest.mark.parametrize(
    ("dlls", "name", "python", "lacking"),
    [
        ({"a.dll": make_dll(INITIALIZED_MUTEX)}, "windows-x64", "3.11", ""),
        ({"a.dll": make_dll(NO_MUTEX, (14, 44))}, "windows-x64", "3.11", ""),
        ({"a.dll": make_dll({"kernel32.dll": ["Sleep"]}, (14, 60))}, "windows-x64", "3.11", ""),
        ({"a.pyd": make_dll(CONSTANT_MUTEX)}, "windows-x64", "3.11", "msvcp140.dll 14.40"),
        ({"a.pyd": make_dll(CONSTANT_MUTEX, delayed=True)}, "windows-x64", "3.11", "msvcp140.dll 14.40"),
        ({"a.pyd": make_dll(CONSTANT_MUTEX)}, "windows-x64", "3.13", ""),
        ({"a.pyd": make_dll(CONSTANT_MUTEX, machine=0xAA64)}, "windows-arm64", "3.11", ""),
        ({"a.dll": make_dll(NO_MUTEX, (14, 50))}, "windows-x64", "3.13", "msvcp140.dll 14.50"),
        ({"a.dll": make_dll({"vcomp140.dll": ["omp_get_num_threads"]})}, "windows-x64", "3.13", "vcomp140.dll"),
        ({"a.dll": make_dll({"msvcp140-1a2b.dll": CONSTANT_MUTEX["msvcp140.dll"]})}, "windows-x64", "3.11", ""),
        (
            {"a.dll": make_dll({"vcomp140.dll": []}), "x.libs/VCOMP140.dll": make_dll(NO_MUTEX)},
            "windows-x64",
            "3.11",
            "",
        ),
        ({"a.so": b"ELF"}, "linux-x64", "3.11", ""),
    ],
)
def test_a_wheel_that_needs_more_than_blender_brings_is_refused(tmp_path: Path, dlls, name, python, lacking):
    wheel = tmp_path / "onnxruntime-9-cp311-cp311-win.whl"
    with zipfile.ZipFile(wheel, "w") as archive:
        for path, data in dlls.items():
            archive.writestr(f"onnxruntime/{path}", data)
    if not lacking:
        package.check_wheel(wheel, name, python)
        return
    with pytest.raises(package.PackageError, match=f"' of {wheel.name} needs {lacking}, and the Blenders with Python"):
        package.check_wheel(wheel, name, python)


@pytest.mark.parametrize("data", [b"MZ", make_dll(NO_MUTEX)[:-9], make_dll(NO_MUTEX).replace(b"\x0b\x02", b"\x0b\x01")])
def test_a_damaged_dll_is_refused(tmp_path: Path, data: bytes):
    with zipfile.ZipFile(tmp_path / "x.whl", "w") as archive:
        archive.writestr("a.dll", data)
    with pytest.raises(
        package.PackageError, match=r"'a\.dll' of x\.whl cannot be read \(.+\); download the wheel again"
    ):
        package.check_wheel(tmp_path / "x.whl", "windows-x64", "3.11")


@pytest.mark.parametrize(
    ("loaded", "version", "is_refused"),
    [
        ((14, 29), "1.21.0", True),
        ((14, 29), "1.20.1", False),
        ((14, 40), "1.31.1", False),
        (None, "1.31.1", False),
    ],
)
def test_a_runtime_that_would_end_the_process_is_not_imported(monkeypatch, loaded, version, is_refused):
    monkeypatch.setattr(native_library, "loaded_cpp_library_version", lambda: loaded)
    monkeypatch.setattr(native_library.metadata, "version", lambda _: version)
    if not is_refused:
        check_cpp_library()
        return
    with pytest.raises(ImportError, match=r"1\.21\.0 needs msvcp140\.dll 14\.40, and Blender has loaded 14\.29"):
        check_cpp_library()


@pytest.mark.skipif(not WINDOWS, reason="Only Windows has this library.")
@pytest.mark.skipif(importlib.util.find_spec("bpy") is None, reason="bpy is not installed.")
def test_the_version_of_the_loaded_library_is_read():
    import bpy  # noqa: F401 - loads Blender's library

    assert loaded_cpp_library_version() == ((14, 29) if sys.version_info < (3, 13) else (14, 44))
