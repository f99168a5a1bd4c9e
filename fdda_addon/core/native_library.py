# SPDX-License-Identifier: GPL-3.0-or-later
"""Detection of a missing Visual C++ runtime, without which Windows cannot import some packages."""

import platform
import re

_LOAD_ERROR = re.compile(r"DLL load failed|WinError 126\b|WinError 127\b", re.IGNORECASE)
"""Words of Python and error numbers of Windows. Windows translates the rest of the text into the user's language."""


def runtime_advice(error_text: str) -> str:
    """Return advice on a failed import, as the end of a sentence without its period; empty where no DLL is missing.

    Args:
        error_text: text of the exception that the import raised.
    """
    return f"install Microsoft's Visual C++ runtime from {runtime_url()}" if _LOAD_ERROR.search(error_text) else ""


def runtime_url() -> str:
    """Return Microsoft's permanent URL of the Visual C++ runtime for this processor."""
    processor = "arm64" if platform.machine().lower() in ("arm64", "aarch64") else "x64"
    return f"https://aka.ms/vs/17/release/vc_redist.{processor}.exe"
