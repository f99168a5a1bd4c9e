# SPDX-License-Identifier: GPL-3.0-or-later
"""Bakes animated meshes as their models deform them, with Blender's exporters for Alembic and USD.

Blender's exporters cannot be canceled, and Blender ends if one finds the disk full. So they run in another Blender
(`bake_file`), which may change the open file (`export.write_bake`).
"""

from collections.abc import Iterable
from dataclasses import dataclass
from pathlib import Path

import bpy

from ..core.errors import OutputError, WrongUsageError
from ..core.files import file_kind
from ..core.files.output import atomic_write_all, check_outputs
from ..core.progress import Job
from ..jobs.verb_process import VerbProcess

ALEMBIC_SUFFIX, BLEND_SUFFIX = ".abc", ".blend"
KINDS = {
    ALEMBIC_SUFFIX: file_kind.ALEMBIC,
    **dict.fromkeys((".usd", ".usda", ".usdc"), file_kind.USD),
    BLEND_SUFFIX: file_kind.BLEND,
}
"""Kinds of the files that a bake writes, by suffix."""
MAX_FRAME = 1048574
"""Largest frame number of Blender; the smallest frame number is -MAX_FRAME."""


@dataclass(frozen=True)
class BakeSettings:
    """Settings of a bake.

    Attributes:
        action: name of the action; empty for the animation of the scene.
        frames: first and last frame; None for the frames of the action, or of the scene if there is no action.
        samples: number of samples per frame. Motion blur shows the samples between frames.
        overwrite: whether to replace existing files (`core.files.output.check_outputs`).
        linear: names of mesh objects that show linear skinning alone.
    """

    action: str = ""
    frames: tuple[int, int] | None = None
    samples: int = 1
    overwrite: bool = False
    linear: tuple[str, ...] = ()


def output_files(out: Path, settings: BakeSettings, inputs: Iterable[Path]) -> tuple[Path, ...]:
    """Return the paths of the files that a bake writes, and check that the files can be written.

    Args:
        out: path of the .abc, .usd or .blend file to write.
        settings: settings of the bake.
        inputs: paths of the files that the bake reads.

    Returns:
        `out`, and beside a .blend file the Alembic file that it plays.

    Raises:
        WrongUsageError: the extension, the frames or the samples are invalid.
        OutputError: a file cannot be written, is an input, or exists as another kind of file; or this Blender lacks
            the exporter.
    """
    suffix = out.suffix.lower()
    if suffix not in KINDS:
        raise WrongUsageError(f"'{out}' ends in neither .abc, .usd nor .blend; give it the extension of what to write.")
    format_name, is_built_in = (
        ("USD", bpy.app.build_options.usd)
        if KINDS[suffix] is file_kind.USD
        else ("Alembic", bpy.app.build_options.alembic)
    )
    if not is_built_in:
        raise OutputError(
            f"This Blender was built without {format_name}; use Blender from blender.org, or "
            f"{'an .abc file' if format_name == 'USD' else 'a .usdc file'}."
        )
    if settings.samples < 1:
        raise WrongUsageError(f"A frame cannot have {settings.samples} samples; give 1 or more.")
    if KINDS[suffix] is file_kind.USD and settings.samples > 1:
        raise WrongUsageError("USD files have one sample per frame; write an .abc file for more.")
    if settings.frames:
        first, last = settings.frames
        if first > last:
            raise WrongUsageError(f"There is nothing to bake from frame {first} to {last}; give the first frame first.")
        if max(abs(first), abs(last)) > MAX_FRAME:
            raise WrongUsageError(f"Blender has frames up to {MAX_FRAME}, not from {first} to {last}; give fewer.")
    files = (out, out.with_suffix(ALEMBIC_SUFFIX)) if suffix == BLEND_SUFFIX else (out,)
    check_outputs([(path, KINDS[path.suffix.lower()]) for path in files], inputs, settings.overwrite)
    return files


def bake_file(rig: Path, model: Path, out: Path, settings: BakeSettings, object_name: str = "") -> Job[str]:
    """Bake the character of a .blend file in another Blender; leave no incomplete file.

    Args:
        rig: the .blend file.
        model: the model, or a folder of models.
        out, settings: as for `output_files`.
        object_name: name of the mesh object; empty for the rig of the model, or the rigs of all models.

    Returns:
        A description of the written files, one per line.
    """
    files = output_files(out, settings, (rig, model))
    arguments = [str(rig), str(model), str(out), f"--samples={settings.samples}"]
    arguments += [f"--object={object_name}"] if object_name else []
    arguments += [f"--action={settings.action}"] if settings.action else []
    arguments += ["--frames", *map(str, settings.frames)] if settings.frames else []
    arguments += [f"--linear={name}" for name in settings.linear]
    with (
        atomic_write_all(*files) as temporaries,
        VerbProcess("bake", [*arguments, "--write-to", *map(str, temporaries)]) as process,
    ):
        output = yield from process.steps()
    # Blender's exporters print too.
    starts = tuple(f"{path}: " for path in files)
    return "".join(line for line in output.splitlines(keepends=True) if line.startswith(starts))
