# SPDX-License-Identifier: GPL-3.0-or-later
"""Advice on libraries of Python packages that the operating system cannot load, by what its loader reports."""

import ctypes
import platform
import re
import sys
from typing import NamedTuple

_REINSTALL_TRAINER = "install the training environment again"
_REINSTALL_EXTENSION = "install the extension's zip for this platform again"
_ALLOW = "the security settings of this system block the file: allow it there, or ask your administrator"
_MEMORY = "enlarge the paging file of Windows, or end other programs"
_OTHER_FILE = "the file is damaged or made for another processor: "
_OTHER_PROGRAM = (
    "a DLL of another program is loaded in its place: remove that program's folder from the variable PATH, or "
)
_NO_PROGRAMS = "its drive is mounted with the option noexec: mount it without"


class _Cause(NamedTuple):
    """A reason why a library cannot be loaded.

    Attributes:
        pattern: regular expression for the text of the error. Its group is {0} in the advice.
        winerrors: error numbers of Windows.
        for_trainer: advice for a library of the trainer's Python; {runtime} is the URL of Microsoft's runtime.
        for_blender: advice for a library of the extension. Blender brings Microsoft's runtime itself.
    """

    pattern: str
    winerrors: tuple[int, ...]
    for_trainer: str
    for_blender: str


_CAUSES = (
    _Cause(
        r"",
        (126, 1157, 14001),
        "install Microsoft's Visual C++ runtime from {runtime}",
        f"a virus scanner may have removed a file: {_REINSTALL_EXTENSION}",
    ),
    _Cause(
        r"needs msvcp140\.dll",
        (127, 998, 1114),
        "install Microsoft's Visual C++ runtime from {runtime}",
        "another extension may have brought a newer ONNX Runtime: remove that extension, or use a newer Blender",
    ),
    _Cause(r"", (182,), _OTHER_PROGRAM + _REINSTALL_TRAINER, _OTHER_PROGRAM + _REINSTALL_EXTENSION),
    _Cause(r"shared object.*: Cannot allocate memory", (8, 14, 1455), _MEMORY, _MEMORY),
    _Cause(r"code signature|disallowed by system policy", (225, 577, 1260, 4551), _ALLOW, _ALLOW),
    _Cause(
        r"ELF (?:class|header|load)|file too short|cannot read file data|/[^\s:]+: cannot open shared object|mach-o",
        (193, 216),
        f"{_OTHER_FILE}{_REINSTALL_TRAINER}, with a Python for this processor",
        _OTHER_FILE + _REINSTALL_EXTENSION,
    ),
    _Cause(
        r"(GLIBC_[\d.]+)' not found",
        (),
        "this Linux is too old: use one whose C library has {0}",
        "this Linux is too old: use one whose C library has {0}",
    ),
    _Cause(
        r"((?:GLIBCXX|CXXABI)_[\d.]+)' not found",
        (),
        "an older C++ library is loaded: unset LD_LIBRARY_PATH, or use a Linux whose libstdc++ has {0}",
        "an older C++ library is loaded: unset LD_LIBRARY_PATH, or use a Linux whose libstdc++ has {0}",
    ),
    _Cause(
        r"built for macOS ([\d.]+)",
        (),
        "update macOS to version {0} or later",
        "update macOS to version {0} or later",
    ),
    _Cause(
        r"(?s)Symbol not found.*Expected in: \S*/(?:usr/lib|System)/",
        (),
        "update macOS to version 14 or later",
        "update macOS to version 14 or later",
    ),
    _Cause(
        r"([^\s:('\"/]+): cannot open shared object file",
        (),
        f"install the package of this Linux that has '{{0}}', or {_REINSTALL_TRAINER}",
        f"install the package of this Linux that has '{{0}}', or {_REINSTALL_EXTENSION}",
    ),
    _Cause(r"failed to map segment from shared object", (), _NO_PROGRAMS, _NO_PROGRAMS),
    _Cause(r'Error loading "|DLL load failed|dlopen\(|shared object|undefined symbol', (), _REINSTALL_TRAINER, ""),
)
_ENGLISH_TEXTS = {
    8: "Not enough memory resources",
    126: "The specified module could not be found",
    127: "The specified procedure could not be found",
    182: "The operating system cannot run",
    193: "is not a valid Win32 application",
    998: "Invalid access to memory location",
    1114: "initialization routine failed",
    1455: "The paging file is too small",
    4551: "An Application Control policy has blocked this file",
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
            advice = cause.for_blender if in_blender else cause.for_trainer
            return advice.format(*match.groups() if match else (), runtime=runtime_url())
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
