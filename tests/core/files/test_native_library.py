# SPDX-License-Identifier: GPL-3.0-or-later
"""The advice on libraries that cannot be loaded, by the texts of the loaders of Windows, Linux and macOS."""

import ctypes

import pytest

from fdda_addon.core.files.native_library import loader_winerror, runtime_advice

from ...systems import WINDOWS

RUNTIME = "install Microsoft's Visual C++ runtime from https://aka.ms/vs/17/release/vc_redist."
PYBIND = "DLL load failed while importing onnxruntime_pybind11_state: "
TORCH = '. Error loading "C:\\torch\\lib\\c10.dll" or one of its dependencies.'


@pytest.mark.parametrize(
    ("text", "for_trainer", "for_blender"),
    [
        (f"[WinError 126] Das angegebene Modul wurde nicht gefunden{TORCH}", RUNTIME, "virus scanner may have removed"),
        (f"{PYBIND}The specified module could not be found.", RUNTIME, "virus scanner may have removed"),
        (f"{PYBIND}Le module spécifié est introuvable.", RUNTIME, "virus scanner may have removed"),
        (f"[WinError 127] The specified procedure could not be found{TORCH}", RUNTIME, "another extension may have"),
        (f"[WinError 1114] Eine DLL-Initialisierungsroutine ist fehlgeschlagen{TORCH}", RUNTIME, "another extension"),
        (f"{PYBIND}A dynamic link library (DLL) initialization routine failed.", RUNTIME, "use a newer Blender"),
        ("'x.pyd' needs msvcp140.dll 14.40 or later, and Blender has loaded 14.29", RUNTIME, "or use a newer"),
        (f"{PYBIND}%1 is not a valid Win32 application.", "with a Python for this processor", "zip for this platform"),
        (f"[WinError 1455] The paging file is too small{TORCH}", "enlarge the paging file", "enlarge the paging file"),
        ("/lib/libc.so.6: version `GLIBC_2.28' not found (required by /x.so)", "has GLIBC_2.28", "Linux is too old: "),
        ("libstdc++.so.6: version `GLIBCXX_3.4.32' not found", "libstdc++ has GLIBCXX_3.4.32", "unset LD_LIBRARY_PATH"),
        ("libgomp.so.1: cannot open shared object file: No such file", "has 'libgomp.so.1', or install", "has 'libg"),
        ("/x/a.so: failed to map segment from shared object: Cannot allocate memory", "end other", "end other"),
        ("/x/a.so: invalid ELF header", "install the training environment again", "install the extension's zip"),
        ("/x/a.so: cannot read file data", "file is damaged", "file is damaged"),
        ("/x/a.so: cannot open shared object file: No such file", "another processor", "another processor"),
        (f"[WinError 4551] An Application Control policy{TORCH}", "install the training environment again", ""),
        ("/x/a.so: undefined symbol: iJIT_NotifyEvent", "install the training environment again", ""),
        ("dlopen(a.so): tried: 'a.so' (mach-o file, but is an incompatible architecture (have 'arm64', need 'x86_64'))",
         "made for another processor", "made for another processor"),
        ("dlopen(a.so, 0x2): Library not loaded: @rpath/libomp.dylib", "install the training environment again", ""),
        ("No module named 'torch'", "", ""),
        ("f() got an unexpected keyword argument 'self'", "", ""),
        ("[Errno 2] No such file or directory: 'x.npy'", "", ""),
    ],
)  # fmt: skip
def test_each_cause_has_its_advice(text: str, for_trainer: str, for_blender: str):
    for advice, expected in ((runtime_advice(text), for_trainer), (runtime_advice(text, in_blender=True), for_blender)):
        assert expected in advice and bool(advice) == bool(expected)
        assert not advice.endswith(".") and "{" not in advice and ("vc_redist" in advice) == (expected == RUNTIME)


@pytest.mark.skipif(not WINDOWS, reason="Windows translates the texts of errors.")
@pytest.mark.parametrize("winerror", [8, 127, 193, 1114, 1455])
def test_an_import_error_is_known_by_the_text_of_this_windows(winerror: int):
    assert loader_winerror(f"{PYBIND}{ctypes.FormatError(winerror)}") == winerror
