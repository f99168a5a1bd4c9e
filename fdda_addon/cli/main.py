# SPDX-License-Identifier: GPL-3.0-or-later
"""The command line of the add-on, which runs a verb.

Exit status: 0 done, 1 failed with one sentence on stderr, 2 wrong usage, 75 failed because of the machine (disk,
memory, a killed process), so that the command may work later, 130 interrupted.
"""

import argparse
import sys
from importlib import import_module

from ..core.errors import TRY_AGAIN, FDDAError, WrongUsageError, exit_status, machine_fault_sentence
from ..core.stop_signals import INTERRUPTED
from ..core.terminal import escape_unencodable_output
from .interruption import interruptible

VERBS = {
    "build-arm": ("build_arm", "build the example rig: an arm with a hand"),
    "limits": ("limits", "set the range of motion of a rig from actions"),
    "record": ("record", "record random poses of a rig and their residuals"),
    "merge-recordings": ("merge_recordings", "join the shards of a recording"),
    "check-recording": ("check_recording", "say what is suspicious about a recording"),
    "check-trainer": ("check_trainer", "say whether the Python that trains has what it needs, and on which device"),
    "train": ("train", "train a model on a recording"),
    "bind": ("bind", "let a model play in place of a rig"),
    "evaluate": ("evaluate", "compare a model with its rig on poses that training never saw"),
    "benchmark": ("benchmark", "time a whole frame of rig, linear skinning and model"),
    "farm": ("farm", "record, train and bind many characters on many machines"),
    "bake": ("bake", "write an action as the model shows it, to play without the add-on"),
}
SUBPROCESS_VERBS = {"train", "farm"}
"""Verbs whose options are parsed by the process that they start."""
VERBS_WITHOUT_BLENDER = {"merge-recordings"}
"""Verbs that need no Blender."""


def main(arguments: list[str], program: str) -> int:
    """Run a verb.

    Args:
        arguments: the verb and its options.
        program: name of the program in usage lines.

    Returns:
        The exit status.
    """
    escape_unencodable_output()
    try:
        with interruptible():
            return _run(arguments, program)
    except KeyboardInterrupt:
        print("Interrupted.", file=sys.stderr)
        return INTERRUPTED


def _run(arguments: list[str], program: str) -> int:
    verb = arguments[0] if arguments and arguments[0] in VERBS else None
    parser = argparse.ArgumentParser(prog=program, description="Fast and Deep Deformation Approximations.")
    verbs = parser.add_subparsers(metavar="VERB", required=True)
    for name, (module_name, summary) in VERBS.items():
        subparser = verbs.add_parser(name, help=summary, description=summary[0].upper() + summary[1:] + ".")
        if name == verb and verb not in SUBPROCESS_VERBS:
            # Other verbs are not imported, so that a verb starts fast.
            import_module(f".{module_name}", __package__).add_options(subparser)
    try:
        if verb in SUBPROCESS_VERBS:
            return import_module(f".{verb}", __package__).run(arguments[1:])
        options = parser.parse_args(arguments)
        module = import_module(f".{VERBS[verb][0]}", __package__)
        if verb in VERBS_WITHOUT_BLENDER:
            module.run(options)
            return 0
        from .registered import registered

        with registered():
            module.run(options)
        return 0
    except SystemExit as usage:
        # A wrong option must not end Blender.
        return int(usage.code or 0)
    except FDDAError as error:
        status = exit_status(error)
        print(f"Error: {error}" if status != WrongUsageError.exit_status else error, file=sys.stderr)
        return status
    except (MemoryError, OSError) as error:
        if not (text := machine_fault_sentence(error)):
            raise
        print(f"Error: {text}", file=sys.stderr)
        return TRY_AGAIN
