# SPDX-License-Identifier: GPL-3.0-or-later
"""The command line: one verb a file, each with its options and what it runs.

Exit status: 0 done, 1 failed with one sentence on stderr, 2 wrong usage, 130 interrupted.
"""

import argparse
import sys
from importlib import import_module

from ..core.errors import FDDAError
from .registration import registered

VERBS = {
    "build-arm": ("build_arm", "build the example rig: an arm with a hand"),
    "limits": ("limits", "set the range of motion of a rig from actions"),
    "record": ("record", "record random poses of a rig and their residuals"),
    "check-recording": ("check_recording", "say what is suspicious about a recording"),
    "check-trainer": ("check_trainer", "say whether the Python that trains has what it needs, and on which device"),
    "train": ("train", "train a model on a recording"),
    "bind": ("bind", "let a model play in place of a rig"),
    "evaluate": ("evaluate", "compare a model with its rig on poses that training never saw"),
    "benchmark": ("benchmark", "time a whole frame of rig, linear layer and model"),
    "bake": ("bake", "write an action as the model shows it, to play without the add-on"),
}
TRAIN = "train"
INTERRUPTED = 130


def main(arguments: list[str], program: str) -> int:
    """Run a verb.

    Args:
        arguments: the verb and its options.
        program: how the user called it, for the usage lines.

    Returns:
        The exit status.
    """
    verb = arguments[0] if arguments and arguments[0] in VERBS else None
    parser = argparse.ArgumentParser(prog=program, description="Fast and Deep Deformation Approximations.")
    verbs = parser.add_subparsers(metavar="VERB", required=True)
    for name, (module_name, summary) in VERBS.items():
        subparser = verbs.add_parser(name, help=summary, description=summary[0].upper() + summary[1:] + ".")
        if name == verb != TRAIN:
            # The other verbs are not imported: a verb costs what it needs.
            import_module(f".{module_name}", __name__).add_options(subparser)
    try:
        if verb == TRAIN:
            # The trainer reads its own options.
            from .train import run

            return run(arguments[1:])
        options = parser.parse_args(arguments)
        with registered():
            import_module(f".{VERBS[verb][0]}", __name__).run(options)
        return 0
    except SystemExit as usage:
        # Blender must not be ended by a wrong option of ours.
        return int(usage.code or 0)
    except FDDAError as error:
        print(f"Error: {error}" if error.exit_status == 1 else error, file=sys.stderr)
        return error.exit_status
    except KeyboardInterrupt:
        print("Interrupted.", file=sys.stderr)
        return INTERRUPTED
