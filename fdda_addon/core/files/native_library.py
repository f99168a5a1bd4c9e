# SPDX-License-Identifier: GPL-3.0-or-later
"""Libraries of Python packages that the operating system cannot load: advice by what its loader reports."""

import ctypes
import platform
import re
import sys
from importlib import metadata
from typing import NamedTuple

OLD_CPP_LIBRARY, LAST_OLD_RUNTIME = (14, 40), (1, 20)
"""ONNX Runtime after the second version ends the process if the C++ library is older than the first.
`setup/package.py` refuses wheels that need more than Blender brings, but another extension may have brought one."""
_REINSTALL = "install the training environment again", "install the extension's zip for this platform again"
"""Replaces {again} in advice for the trainer's Python, and for Blender."""
_INSTALL_RUNTIME = "install Microsoft's Visual C++ runtime from {runtime}"
_OTHER_FILE = "the file is damaged or made for another processor: {again}"


class _Cause(NamedTuple):
    """A reason why a library cannot be loaded.

    Attributes:
        pattern: regular expression for the text of the error. Its group is {0} in the advice.
        winerrors: error numbers of Windows.
        advice: {runtime} is the URL of Microsoft's runtime.
        blender_advice: advice for a library of the extension, if it differs. Blender brings Microsoft's runtime itself.
    """

    pattern: str
    winerrors: tuple[int, ...]
    advice: str
    blender_advice: str | None = None


_CAUSES = (
    _Cause("", (126, 1157, 14001), _INSTALL_RUNTIME, "a virus scanner may have removed a file: {again}"),
    _Cause(
        r"needs msvcp140\.dll",
        (127, 998, 1114),
        _INSTALL_RUNTIME,
        "another extension may have brought a newer ONNX Runtime: remove that extension, or use a newer Blender",
    ),
    _Cause(
        r"shared object.*: Cannot allocate memory",
        (8, 14, 1455),
        "enlarge the paging file of Windows, or end other programs",
    ),
    _Cause(
        r"ELF (?:class|header|load)|file too short|cannot read file data|/[^\s:]+: cannot open shared object|mach-o",
        (193, 216),
        f"{_OTHER_FILE}, with a Python for this processor",
        _OTHER_FILE,
    ),
    _Cause(r"(GLIBC_[\d.]+)' not found", (), "this Linux is too old: use one whose C library has {0}"),
    _Cause(
        r"((?:GLIBCXX|CXXABI)_[\d.]+)' not found",
        (),
        "an older C++ library is loaded: unset LD_LIBRARY_PATH, or use a Linux whose libstdc++ has {0}",
    ),
    _Cause(
        r"([^\s:('\"/]+): cannot open shared object file",
        (),
        "install the package of this Linux that has '{0}', or {again}",
    ),
    _Cause(r'Error loading "|DLL load failed|dlopen\(|shared object|undefined symbol', (), "{again}", ""),
)
_ENGLISH_TEXTS = {
    8: "Not enough memory resources",
    126: "The specified module could not be found",
    127: "The specified procedure could not be found",
    193: "is not a valid Win32 application",
    998: "Invalid access to memory location",
    1114: "initialization routine failed",
    1455: "The paging file is too small",
}
"""Texts of error numbers. Python names no number where an import fails, and Windows translates the text."""


def runtime_advice(error_text: str, in_blender: bool = False) -> str:
    """Return advice on a library that cannot be loaded, as the end of a sentence without its period.

    Args:
        error_text: text of the exception that the import raised.
        in_blender: whether the library belongs to the extension in Blender, not to the trainer's Python.

    Returns:
        The advice; empty where the text is no such error, or nothing is known about it.
    """
    winerror = loader_winerror(error_text)
    for cause in _CAUSES:
        match = re.search(cause.pattern, error_text) if cause.pattern else None
        if match or winerror in cause.winerrors:
            advice = cause.advice if cause.blender_advice is None or not in_blender else cause.blender_advice
            return advice.format(*match.groups() if match else (), runtime=runtime_url(), again=_REINSTALL[in_blender])
    return ""


def loader_winerror(error_text: str) -> int | None:
    """Return the error number of Windows in the text of a failed import; None where the text has none."""
    if match := re.search(r"WinError (\d+)", error_text):
        return int(match[1])
    for winerror in sorted({winerror for cause in _CAUSES for winerror in cause.winerrors}):
        local_text = ctypes.FormatError(winerror).strip().rstrip(".") if sys.platform == "win32" else ""
        if any(text and text in error_text for text in (_ENGLISH_TEXTS.get(winerror), local_text)):
            return winerror
    return 126 if "DLL load failed" in error_text else None


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
