# SPDX-License-Identifier: GPL-3.0-or-later
"""The advice on libraries that cannot be loaded, by the texts of the loaders of Windows, Linux and macOS."""

import pytest

from fdda_addon.core.files.native_library import runtime_advice

RUNTIME = "install Microsoft's Visual C++ runtime from https://aka.ms/vs/17/release/vc_redist."
PYBIND = "DLL load failed while importing onnxruntime_pybind11_state: "
TORCH = '. Error loading "C:\\torch\\lib\\c10.dll" or one of its dependencies.'
AGAIN = ("install the training environment again", "install the extension's zip")


@pytest.mark.parametrize(
    ("text", "for_trainer", "for_blender"),
    [
        (f"[WinError 126] Das angegebene Modul wurde nicht gefunden{TORCH}", RUNTIME, "virus scanner removed"),
        (f"{PYBIND}Le module spécifié est introuvable.", RUNTIME, "virus scanner removed"),
        ("'x.pyd' needs msvcp140.dll 14.40 or later, and Blender has loaded 14.29", RUNTIME, "use a newer Blender"),
        (f"[WinError 1455] Die Auslagerungsdatei ist zu klein{TORCH}", "enlarge the paging", "enlarge the paging file"),
        ("/x/a.so: failed to map segment from shared object: Cannot allocate memory", "end other", "end other"),
        ("libstdc++.so.6: version `GLIBCXX_3.4.32' not found", "GLIBCXX_3.4.32 is needed", "names an older library"),
        ("/x/a.so: invalid ELF header", *AGAIN),
        ("libgomp.so.1: cannot open shared object file: No such file", *AGAIN),
        ("dlopen(a.so, 0x2): Library not loaded: @rpath/libomp.dylib", *AGAIN),
        ("No module named 'torch'", "", ""),
        ("f() got an unexpected keyword argument 'self'", "", ""),
        ("[WinError 112] There is not enough space on the disk: 'x.npy'", "", ""),
    ],
)
def test_each_cause_has_its_advice(text: str, for_trainer: str, for_blender: str):
    for advice, expected in ((runtime_advice(text), for_trainer), (runtime_advice(text, in_blender=True), for_blender)):
        assert expected in advice and bool(advice) == bool(expected)
        assert not advice.endswith(".") and "{" not in advice and ("vc_redist" in advice) == (expected == RUNTIME)
