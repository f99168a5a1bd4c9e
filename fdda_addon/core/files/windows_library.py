# SPDX-License-Identifier: GPL-3.0-or-later
"""The versions of Microsoft's C++ library, MSVCP140.dll, that DLLs need and that a process of Windows has loaded.

Blender brings a copy of this library. A process has one library of a name, so the DLLs of Python packages get Blender's
copy, even if Windows has a newer one. If that copy is too old for a DLL, importing the package can end the process
without an exception.
"""

import ctypes
import importlib.util
import mmap
import struct
import sys
from pathlib import Path

CPP_LIBRARY = "msvcp140.dll"
NEWEST_KNOWN_TOOLSET = (14, 44)
"""Version of the newest linker whose DLLs were tried with older C++ libraries."""
MUTEX_VERSION = (14, 40)
"""Since this version the compiler initializes mutexes, in a way that older C++ libraries cannot lock."""
MUTEX_FUNCTIONS = {"_Mtx_lock", "_Mtx_trylock", "_Mtx_timedlock", "_Cnd_wait", "_Cnd_timedwait"}
MUTEX_INITIALIZER = "_Mtx_init_in_situ"
"""Function that initializes mutexes for earlier compilers, and for later ones if a build asks for it."""
_IMPORT_DIRECTORY, _DELAYED_IMPORT_DIRECTORY = 1, 13


def read_imports(data: bytes | mmap.mmap) -> tuple[tuple[int, int], dict[str, set[str]]]:
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
        layouts = {_IMPORT_DIRECTORY: ("<5I", 3, 0), _DELAYED_IMPORT_DIRECTORY: ("<8I", 1, 4)}
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


def needed_cpp_library_version(data: bytes | mmap.mmap) -> tuple[int, int]:
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


def loaded_cpp_library_version() -> tuple[int, int] | None:
    """Return the version of the C++ library in this process; None if none is loaded, or on another system."""
    if sys.platform != "win32":
        return None
    kernel, versions = ctypes.WinDLL("kernel32"), ctypes.WinDLL("version")
    kernel.GetModuleHandleW.restype = ctypes.c_void_p
    handle, path = kernel.GetModuleHandleW(CPP_LIBRARY), ctypes.create_unicode_buffer(32768)
    if not handle or not kernel.GetModuleFileNameW(ctypes.c_void_p(handle), path, len(path)):
        return None
    information = ctypes.create_string_buffer(versions.GetFileVersionInfoSizeW(path, None))
    fields, size = ctypes.POINTER(ctypes.c_uint32)(), ctypes.c_uint()
    if not versions.GetFileVersionInfoW(path, 0, len(information), information) or not versions.VerQueryValueW(
        information, "\\", ctypes.byref(fields), ctypes.byref(size)
    ):
        return None
    return fields[2] >> 16, fields[2] & 0xFFFF


def check_cpp_library(package: str) -> None:
    """Check that a package can be imported with the C++ library that this process has loaded.

    Raises:
        ImportError: it needs a newer one.
    """
    loaded_version = loaded_cpp_library_version()
    spec = importlib.util.find_spec(package) if loaded_version and package not in sys.modules else None
    for folder in (spec and spec.submodule_search_locations) or ():
        for path in (path for pattern in ("*.pyd", "*.dll") for path in Path(folder).rglob(pattern)):
            try:
                with path.open("rb") as file, mmap.mmap(file.fileno(), 0, access=mmap.ACCESS_READ) as data:
                    needed_version = needed_cpp_library_version(data)
            except (OSError, ValueError):  # The import reports a file that cannot be read, or does not use it.
                continue
            if needed_version > loaded_version:
                needed, loaded = ("{}.{}".format(*version) for version in (needed_version, loaded_version))
                raise ImportError(f"'{path}' needs {CPP_LIBRARY} {needed} or later, and Blender has loaded {loaded}")
