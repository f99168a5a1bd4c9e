# SPDX-License-Identifier: GPL-3.0-or-later
"""The command line of the add-on: parses the arguments and runs a verb.

Exit status:
- 0: success.
- 1: failure, with one sentence on stderr.
- 2: wrong usage.
- 75: failure of the machine (disk, memory, a killed process); the same command may succeed later.
- 130: interrupted.
"""

import argparse
import sys
from collections.abc import Iterator
from contextlib import contextmanager
from importlib import import_module

from ..core.errors import TRY_AGAIN, FDDAError, WrongUsageError, exit_status, machine_fault_sentence
from ..core.files.stop_signals import INTERRUPTED
from ..core.files.terminal import escape_unencodable_output
from .interruption import interruptible, raise_pending

VERBS = {
    "build-arm": ("build_arm", "build the example rig: an arm with a hand"),
    "build-model": ("build_model", "record a character, train a model and bind it, with one command"),
    "record": ("record", "record how a rig deforms its mesh in random poses and actions"),
    "check-recording": ("check_recording", "check a recording for problems before training"),
    "check-trainer": ("check_trainer", "check the Python that trains, and show its device"),
    "train": ("train", "train a model on a recording"),
    "bind": ("bind", "save a file in which a model replaces the modifiers of a rig"),
    "fast-rig": ("fast_rig", "save a fast rig: the character without what its model and controls do not need"),
    "evaluate": ("evaluate", "compare a model with its rig on poses that are in no recording"),
    "benchmark": ("benchmark", "measure the time per frame of rig, linear skinning and model"),
    "export-skinning": (
        "export_skinning",
        "save a copy whose meshes follow fitted skin weights alone, for game engines",
    ),
    "poses": ("poses", "save a copy of a file with an action of recorded or random poses, one per frame"),
    "bake": ("bake", "write the deformed mesh of an action to a file that plays without the add-on"),
}
INTERNAL_VERBS = {"encode-video": "encode_video"}
"""Verbs that only the add-on runs, in another Blender, with their modules."""
TRAIN = "train"
"""The verb that starts another process, which parses its options."""


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
    modules = {name: module for name, (module, _) in VERBS.items()} | INTERNAL_VERBS
    verb = arguments[0] if arguments and arguments[0] in modules else None
    parser = argparse.ArgumentParser(prog=program, description="Fast and Deep Deformation Approximations.")
    verbs = parser.add_subparsers(metavar="VERB", required=True)
    for name, (_, summary) in VERBS.items():
        verbs.add_parser(name, help=summary, description=summary[0].upper() + summary[1:] + ".")
    if verb in INTERNAL_VERBS:
        verbs.add_parser(verb)
    if verb not in (None, TRAIN):
        # The modules of other verbs are not imported, so that the verb starts fast.
        import_module(f".{modules[verb]}", __package__).add_options(verbs.choices[verb])
    try:
        if verb == TRAIN:
            return import_module(f".{verb}", __package__).run(arguments[1:])
        options = parser.parse_args(arguments)
        module = import_module(f".{modules[verb]}", __package__)
        with registered():
            module.run(options)
        return 0
    except SystemExit as usage:
        # argparse raises SystemExit for a wrong option, which must not end Blender.
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


@contextmanager
def registered() -> Iterator[None]:
    """Register the add-on for a `with` block. It stays registered if it was before."""
    # Imported here, because a training without refinement needs no Blender.
    from .. import registration

    was_registered = registration.is_registered()
    registration.register()
    try:
        raise_pending()
        yield
    finally:
        if not was_registered:
            registration.unregister()
