# SPDX-License-Identifier: GPL-3.0-or-later
"""`build-model RIG.blend FOLDER`: records a character, trains a model and binds it, as Record, Train & Bind does.

FOLDER gets `recording`, `model.onnx` with its report, and `bound.blend`. A recording that it has already is used, or
continued if it was interrupted.
"""

import argparse
from pathlib import Path

from ..core.files.file_kind import BLEND, CHECKPOINT, MODEL, PAGE, REPORT
from ..core.files.output import check_folder_writable, check_outputs
from ..core.formats.report import checkpoint_path, page_path, report_path
from ..core.recording.folder import is_recorded
from ..core.recording.index import INDEX_NAME, read_index
from . import bind, check_trainer, record, train
from .files import check_file


def add_options(parser: argparse.ArgumentParser) -> None:
    record.add_recording_options(parser, "instead of all that follow the armature by their modifiers")
    parser.add_argument("folder", metavar="FOLDER", type=Path, help="folder of the recording, model and bound file")
    parser.add_argument("--overwrite", action="store_true", help="record again, and overwrite files of another kind")


def run(options: argparse.Namespace) -> None:
    recording, model, bound = (options.folder / name for name in ("recording", "model.onnx", "bound.blend"))
    resume = (recording / INDEX_NAME).exists() and not options.overwrite
    values = vars(options) | {"recording": recording, "resume": resume, "refine": None, "all": not options.object}
    # What can fail at once is checked before minutes of recording; the check of the trainer's Python takes seconds.
    record.check_options(argparse.Namespace(**values))
    check_file(options.rig)
    kinds = {checkpoint_path(model): CHECKPOINT, report_path(model): REPORT, page_path(model): PAGE}
    kinds |= {model: MODEL, bound: BLEND}
    check_folder_writable(options.folder, [recording.name, *(path.name for path in kinds)])
    if options.folder.is_dir():
        check_outputs(kinds, [options.rig], options.overwrite)
    check_trainer.run(options)
    if resume and is_recorded(recording) and not _has_recording_options(options):
        print(f"{recording}: used as it is; --overwrite records again")
    else:
        record.run(argparse.Namespace(**values))
    overwrite = ["--overwrite"] if options.overwrite else []
    if train.run([str(recording), str(model), *overwrite]):
        raise KeyboardInterrupt
    meshes = read_index(recording)["meshes"]
    # The only mesh of a model has to be named in a file with further rigs.
    name = meshes[0]["name"] if len(meshes) == 1 else ""
    values = vars(options) | {"object": name, "model": model, "out": bound, "use_in_render": False}
    bind.run(argparse.Namespace(**values))


def _has_recording_options(options: argparse.Namespace) -> bool:
    """Return whether options choose meshes or poses, with which a recording has to be recorded."""
    parser = argparse.ArgumentParser()
    add_options(parser)
    defaults = vars(parser.parse_args([str(options.rig), str(options.folder)]))
    return any(getattr(options, name) != value for name, value in defaults.items())
