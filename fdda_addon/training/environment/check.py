# SPDX-License-Identifier: GPL-3.0-or-later
"""Checks whether a Python can train: its version, its packages, and the device that torch would use."""

import json
import subprocess
from typing import NamedTuple

from ...core.errors import os_error_text
from ...core.files.child_process import child_options
from ...core.files.native_library import runtime_advice
from ..process_exit import explain_exit_status
from .folder import PACKAGES, ROOT

MIN_VERSION = (3, 11)
TIMEOUT_SECONDS = 180.0
"""Time limit of the check. torch takes half a minute to load from a slow disk."""

# Runs in any Python, including old versions. The last output line is the report; libraries may print lines before it.
_PROBE_SCRIPT = """
import json, sys
answer = {"version": list(sys.version_info[:3]), "packages": {}, "broken": {}}
for name in sys.argv[1:] if sys.version_info[:2] >= (3, 11) else []:
    try:
        answer["packages"][name] = str(getattr(__import__(name), "__version__", "?"))
    except ImportError as error:
        if getattr(error, "name", None) == name:
            answer["packages"][name] = None
        else:
            answer["broken"][name] = str(error)
    except Exception as error:
        answer["broken"][name] = repr(error)
if answer["packages"].get("torch"):
    from trainer.device import choose_device
    device, answer["card"], answer["problem"] = choose_device()
print()
print(json.dumps(answer))
"""


class CheckResult(NamedTuple):
    """Result of a check, or of an operation on the environment.

    Attributes:
        level: 'INFO', 'WARNING' (works, but needs attention) or 'ERROR' (does not work), as in operator reports.
        message: one sentence; for a problem, with what to do.
        details: further lines.
    """

    level: str
    message: str
    details: tuple[str, ...] = ()


def check(python: str, advice: str) -> CheckResult:
    """Check whether a Python can train. Takes seconds, so never call it while drawing.

    Args:
        python: path of the interpreter.
        advice: end of the error message, which tells the user what to do.
    """
    command = [python, "-c", _PROBE_SCRIPT, *PACKAGES]
    try:
        # With -c Python imports from the current folder, which must contain the trainer's modules.
        result = subprocess.run(
            command, capture_output=True, timeout=TIMEOUT_SECONDS, cwd=ROOT, check=False, **child_options(ROOT)
        )
    except OSError as error:
        return CheckResult(
            "ERROR", f"The trainer's Python '{python}' cannot be started ({os_error_text(error)}); {advice}."
        )
    except subprocess.TimeoutExpired:
        return CheckResult(
            "ERROR", f"The trainer's Python '{python}' did not answer in {TIMEOUT_SECONDS:.0f} s; {advice}."
        )
    try:
        report = json.loads(result.stdout.strip().splitlines()[-1])
        return _evaluate_report(python, report, advice)
    except (IndexError, ValueError, TypeError, KeyError):
        error_lines = result.stderr.strip().splitlines()
        process_exit = explain_exit_status(result.returncode, is_silent=True)
        reason = process_exit.text if process_exit.is_machine_fault else f"status {result.returncode}"
        reason = error_lines[-1].strip() if error_lines else reason
        return CheckResult("ERROR", f"'{python}' does not answer as a Python does ({reason}); {advice}.")


def _evaluate_report(python: str, report: dict, advice: str) -> CheckResult:
    version = ".".join(str(number) for number in report["version"])
    packages, broken = report["packages"], report["broken"]
    details = [f"Python {version}: {python}"]
    details += [f"{name} {packages[name] or 'is missing'}" for name in PACKAGES if name in packages]
    details += [f"{name} cannot be imported: {reason}" for name, reason in broken.items()]
    if tuple(report["version"]) < MIN_VERSION:
        min_version = ".".join(str(number) for number in MIN_VERSION)
        message = f"'{python}' is Python {version}, and the trainer needs {min_version} or later; {advice}."
        return CheckResult("ERROR", message, tuple(details))
    if missing := [name for name in PACKAGES if name in packages and packages[name] is None]:
        names = " and ".join([", ".join(missing[:-1]), missing[-1]] if missing[:-1] else missing)
        return CheckResult("ERROR", f"'{python}' (Python {version}) lacks {names}; {advice}.", tuple(details))
    if broken:
        name, reason = next(iter(broken.items()))
        advice = runtime_advice(reason) or advice
        return CheckResult("ERROR", f"{name} of '{python}' cannot be imported ({reason}); {advice}.", tuple(details))
    card, problem = report["card"], report["problem"]
    details.append(f"Device: {f'{card} (CUDA)' if card and not problem else 'the CPU'}")
    where = f"the CPU, because {card} cannot be used ({problem})" if problem else card or "the CPU"
    message = f"Ready to train on {where}: Python {version}, torch {packages['torch']}."
    return CheckResult("INFO", message, tuple(details))
