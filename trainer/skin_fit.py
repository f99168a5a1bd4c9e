# SPDX-License-Identifier: GPL-3.0-or-later
"""Fits skin weights to poses that `record` has evaluated: `python -m trainer.skin_fit FOLDER hard|smooth`.

FOLDER is one that `core.recording.fit_folder` wrote; the fitted weights are written into it. Speaks in messages, and
exits as `python -m trainer` does.
"""

import argparse
import sys
from pathlib import Path

from fdda_addon.core.terminal import escape_unencodable_output

from .announcements import Announcer, MessageLines
from .process import StopRequest, missing_package, run_announced


def main(arguments: list[str] | None = None) -> int:
    """Fit as the arguments say; returns the exit status."""
    escape_unencodable_output()
    parser = argparse.ArgumentParser("trainer.skin_fit", description="Fit skin weights to the poses in a folder.")
    parser.add_argument("folder", type=Path, help="folder that record made")
    parser.add_argument("kind", choices=("hard", "smooth"), help="one joint a vertex, or at most four")
    parser.add_argument("--metres-per-unit", type=float, default=1.0, help="length of a unit of the mesh")
    options = parser.parse_args(arguments)
    announcer, stop = MessageLines(), StopRequest()
    return run_announced(lambda: _fit(options, announcer, stop), announcer)


def _fit(options: argparse.Namespace, announcer: Announcer, stop: StopRequest) -> None:
    try:
        with stop.at_once(announcer):
            from .fitted_skin import fit_folder
    except ModuleNotFoundError as error:
        raise missing_package("Fitting skin weights", error) from error
    fit_folder(options.folder, options.kind, announcer, stop, options.metres_per_unit)


if __name__ == "__main__":
    sys.exit(main())
