# SPDX-License-Identifier: GPL-3.0-or-later
"""Asks a Python whether it can train: its version, torch and what else the trainer imports, the device."""

import json
import os
import subprocess

from ...core.errors import os_error_text
from ...core.native_library import runtime_advice
from ..endings import explain_status
from .check_result import CheckResult
from .folder import PACKAGES, ROOT
from .subprocesses import UTF8_OUTPUT, hidden

OLDEST = (3, 11)
TIMEOUT_SECONDS = 180.0
"""torch takes half a minute to load from a cold or remote disk."""

# Runs in whatever the user named, an ancient Python too. Its last line is the answer; a library may print before it.
_QUESTION = """
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
    import torch
    answer["device"] = torch.cuda.get_device_name(0) if torch.cuda.is_available() else "cpu"
print()
print(json.dumps(answer))
"""


def check(python: str, advice: str) -> CheckResult:
    """Ask a Python whether it can train. Takes seconds: never while drawing.

    Args:
        python: path of the interpreter.
        advice: what to do when it cannot, ending the sentence.
    """
    command = [python, "-c", _QUESTION, *PACKAGES]
    try:
        # -c imports from the current folder; the trainer finds its modules in ours.
        result = subprocess.run(
            command,
            stdin=subprocess.DEVNULL,
            capture_output=True,
            timeout=TIMEOUT_SECONDS,
            cwd=ROOT,
            env={**os.environ, **UTF8_OUTPUT},
            check=False,
            **hidden(),
        )
    except OSError as error:
        return CheckResult(
            "ERROR", f"The trainer's Python '{python}' cannot be started ({os_error_text(error)}); {advice}."
        )
    except subprocess.TimeoutExpired:
        return CheckResult(
            "ERROR", f"The trainer's Python '{python}' did not answer in {TIMEOUT_SECONDS:.0f} s; {advice}."
        )
    said = result.stdout.decode("utf-8", "replace").strip().splitlines()
    try:
        answer = json.loads(said[-1])
        return _judge(python, answer, advice)
    except (IndexError, ValueError, TypeError, KeyError):
        text = result.stderr.decode("utf-8", "replace").strip().splitlines()
        ending = explain_status(result.returncode, is_silent=True)
        reason = ending.text if ending.is_machines else f"status {result.returncode}"
        reason = text[-1].strip() if text else reason
        return CheckResult("ERROR", f"'{python}' does not answer as a Python does ({reason}); {advice}.")


def _judge(python: str, answer: dict, advice: str) -> CheckResult:
    version = ".".join(str(number) for number in answer["version"])
    packages, broken = answer["packages"], answer["broken"]
    details = [f"Python {version}: {python}"]
    details += [f"{name} {packages[name] or 'is missing'}" for name in PACKAGES if name in packages]
    details += [f"{name} cannot be imported: {reason}" for name, reason in broken.items()]
    if tuple(answer["version"]) < OLDEST:
        oldest = ".".join(str(number) for number in OLDEST)
        message = f"'{python}' is Python {version}, and the trainer needs {oldest} or later; {advice}."
        return CheckResult("ERROR", message, tuple(details))
    if missing := [name for name in PACKAGES if name in packages and packages[name] is None]:
        names = " and ".join([", ".join(missing[:-1]), missing[-1]] if missing[:-1] else missing)
        return CheckResult("ERROR", f"'{python}' (Python {version}) lacks {names}; {advice}.", tuple(details))
    if broken:
        name, reason = next(iter(broken.items()))
        advice = runtime_advice(reason) or advice
        return CheckResult("ERROR", f"{name} of '{python}' cannot be imported ({reason}); {advice}.", tuple(details))
    device = answer["device"]
    details.append(f"Device: {'the CPU' if device == 'cpu' else f'{device} (CUDA)'}")
    where = "on the CPU" if device == "cpu" else f"on {device}"
    return CheckResult("INFO", f"Ready to train {where}: Python {version}, torch {packages['torch']}.", tuple(details))
