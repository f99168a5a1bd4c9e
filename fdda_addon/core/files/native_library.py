# SPDX-License-Identifier: GPL-3.0-or-later
"""Libraries of Python packages that the operating system cannot load: advice by what its loader reports."""

import ctypes
import platform
import re
import sys
from importlib import metadata

OLD_CPP_LIBRARY, LAST_OLD_RUNTIME = (14, 40), (1, 20)
"""ONNX Runtime after the second version ends the process if the C++ library is older than the first.
The wheels of the extension are older for such a Blender, but another extension may have brought one."""
_ADVICE = {
    r"((?:GLIBC|GLIBCXX|CXXABI)_[\d.]+)' not found": (
        "this Linux is too old, or LD_LIBRARY_PATH names an older library: {0} is needed",
    ),
    r"(?:^|[\s(])([^\s:('\"/]+): cannot open shared object file": (
        "install the package of this Linux that has '{0}', or else the training environment again",
        "install the package of this Linux that has '{0}', or else the extension's zip for this platform again",
    ),
    r'DLL load failed|Error loading "|needs msvcp140\.dll': (
        "install Microsoft's Visual C++ runtime from {runtime}, or else the training environment again",
        "another extension may have brought a newer ONNX Runtime, or a virus scanner removed a file: remove that "
        "extension, use a newer Blender, or install the extension's zip for this platform again",
    ),
    r"dlopen\(|shared object|undefined symbol|ELF (?:class|header|load)|file too short|cannot read file data": (
        "a file is missing, damaged or made for another processor: install the training environment again",
        "a file is missing, damaged or made for another processor: install the extension's zip for this platform again",
    ),
}
"""Advice by patterns of loader errors: for the trainer's Python and, if it differs, for Blender, which brings the C++
runtime of Windows itself. {0} is the group of the pattern."""


def runtime_advice(error_text: str, in_blender: bool = False) -> str:
    """Return advice on a library that cannot be loaded, as the end of a sentence without its period.

    Args:
        error_text: text of the exception that the import raised.
        in_blender: whether the library belongs to the extension in Blender, not to the trainer's Python.

    Returns:
        The advice; empty where the text is no such error.
    """
    for pattern, advice in _ADVICE.items():
        if match := re.search(pattern, error_text):
            if lacks_memory(error_text):
                return "end other programs, or enlarge the paging file of Windows"
            return advice[-1 if in_blender else 0].format(*match.groups(), runtime=runtime_url())
    return ""


def lacks_memory(error_text: str) -> bool:
    """Return whether a system, torch or ONNX Runtime reports that memory ran out; 8, 14 and 1455 are Windows'."""
    pattern = r"WinError (?:8|14|1455)\b|(?:can't|cannot) allocate memory|not enough memory|bad.allocation|bad_alloc"
    return re.search(pattern, error_text, re.IGNORECASE) is not None


def runtime_url() -> str:
    """Return Microsoft's permanent URL of the Visual C++ runtime for this processor."""
    processor = "arm64" if platform.machine().lower() in ("arm64", "aarch64") else "x64"
    return f"https://aka.ms/vs/17/release/vc_redist.{processor}.exe"


def check_cpp_library() -> None:
    """Check that ONNX Runtime can be imported with the C++ library, MSVCP140.dll, that this process has loaded.

    Blender brings a copy, which all DLLs of the process get. If it is too old, the import ends the process.

    Raises:
        ImportError: ONNX Runtime needs a newer one, or is not installed.
    """
    loaded = loaded_cpp_library_version()
    if loaded is None or loaded >= OLD_CPP_LIBRARY:
        return
    version = metadata.version("onnxruntime")
    if tuple(map(int, version.split(".")[:2])) > LAST_OLD_RUNTIME:
        needed_text, loaded_text = ("{}.{}".format(*pair) for pair in (OLD_CPP_LIBRARY, loaded))
        raise ImportError(f"version {version} needs msvcp140.dll {needed_text}, and Blender has loaded {loaded_text}")


def loaded_cpp_library_version() -> tuple[int, int] | None:
    """Return the version of the C++ library in this process; None if none is loaded, or on another system."""
    if sys.platform != "win32":
        return None
    kernel, versions = ctypes.WinDLL("kernel32"), ctypes.WinDLL("version")
    kernel.GetModuleHandleW.restype = ctypes.c_void_p
    handle, path = kernel.GetModuleHandleW("msvcp140.dll"), ctypes.create_unicode_buffer(32768)
    if not handle or not kernel.GetModuleFileNameW(ctypes.c_void_p(handle), path, len(path)):
        return None
    information = ctypes.create_string_buffer(versions.GetFileVersionInfoSizeW(path, None))
    fields, size = ctypes.POINTER(ctypes.c_uint32)(), ctypes.c_uint()
    if not versions.GetFileVersionInfoW(path, 0, len(information), information) or not versions.VerQueryValueW(
        information, "\\", ctypes.byref(fields), ctypes.byref(size)
    ):
        return None
    return fields[2] >> 16, fields[2] & 0xFFFF
