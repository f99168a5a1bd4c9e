# SPDX-License-Identifier: GPL-3.0-or-later
"""Reading and validation of the plan of a farm, `characters.toml` (docs/farm.md)."""

import math
import re
import tomllib
from dataclasses import dataclass, field, fields
from pathlib import Path
from typing import Any

from fdda_addon.core.errors import FDDAError
from fdda_addon.core.joint_option import ALL, parse_joints
from fdda_addon.core.poses import MAX_MARGIN
from fdda_addon.core.skin_fit import FIT_KINDS

MAX_PLAN_BYTES = 4 << 20
MAX_SHARDS, MAX_ROUNDS = 1000, 20
CHARACTER_NAME = re.compile(r"[A-Za-z0-9][A-Za-z0-9_-]{0,63}")
"""Valid names of characters. A name is also the name of a folder and part of task names."""
TRAIN_SETTING = re.compile(r"[a-z][a-z0-9_]*")


class PlanError(FDDAError):
    """The plan is invalid."""


@dataclass(frozen=True)
class Farm:
    """Settings of all characters.

    Attributes:
        work: folder of the files that tasks exchange; it has the same path on all machines.
        python: Python with the `bpy` wheel; empty for the Python that runs the task.
        blender: Blender program, with the add-on enabled, that runs the verbs instead of `python`; empty for none.
        trainer_python: Python for trainings; empty for the one that the add-on finds.
        threads: threads of one training. They affect its result, so they do not depend on the machine.
        gpu: whether trainings run only on machines with a GPU.
        retries: how often a task is repeated that failed because of its machine.
        retry_seconds: how long a worker waits before it repeats a task.
        pictures: whether to draw a heat map of each character for the report.
    """

    work: Path
    python: str = ""
    blender: str = ""
    trainer_python: str = ""
    threads: int = 1
    gpu: bool = False
    retries: int = 20
    retry_seconds: float = 10.0
    pictures: bool = True


@dataclass(frozen=True)
class Character:
    """Settings of one character.

    Attributes:
        name: name of the character: letters, digits, - and _.
        rig: .blend file of the rig.
        output: folder of the bound file, its models and their reports.
        objects: names of the mesh objects; empty where the file has only one.
        depends: files that the rig's file links. A change of them outdates the tasks of the character.
        poses, seed, spread, margin, actions, strips, mirror, sample, controls, fit_linear, joints,
            min_partition_vertices: options of `record`.
        shards: number of tasks that the poses are divided among.
        train: options of `train` by name.
        goal_mm: accuracy goal for 99.9 % of the vertices of held-out poses, mm; 0 for no goal.
        rounds: maximum number of rounds that add poses where the error is largest, until the goal is met.
        refine_poses: number of poses that a round adds.
        evaluate_poses: number of held-out poses that measure the error.
        use_in_render: whether final renders use the model too.
    """

    name: str
    rig: Path
    output: Path
    objects: tuple[str, ...] = ()
    depends: tuple[Path, ...] = ()
    poses: int = 1000
    seed: int = 0
    spread: float = 1.0
    margin: float = 1.0
    actions: tuple[str, ...] = ()
    strips: tuple[str, ...] = ()
    mirror: bool = False
    sample: tuple[str, ...] = ()
    controls: tuple[str, ...] = ()
    fit_linear: str = ""
    joints: str = ALL
    min_partition_vertices: int | None = None
    shards: int = 4
    train: dict[str, Any] = field(default_factory=dict, hash=False)
    goal_mm: float = 0.0
    rounds: int = 3
    refine_poses: int = 250
    evaluate_poses: int = 200
    use_in_render: bool = False


@dataclass(frozen=True)
class Plan:
    """Content of `characters.toml`, with absolute paths."""

    path: Path
    farm: Farm
    characters: tuple[Character, ...]


MIN_VALUES = {
    **{"poses": 0, "seed": 0, "rounds": 0},
    **{"shards": 1, "refine_poses": 1, "evaluate_poses": 1, "threads": 1, "margin": 1},
}
MAX_VALUES = {"shards": MAX_SHARDS, "rounds": MAX_ROUNDS, "threads": 1024, "retries": 10_000}
MAX_VALUES |= {"spread": 10, "margin": int(MAX_MARGIN)}


def read_plan(path: Path) -> Plan:
    """Read and check a plan.

    Raises:
        PlanError: the plan cannot be read or is invalid; the message names the section.
    """
    path = path.absolute()
    try:
        if path.stat().st_size > MAX_PLAN_BYTES:
            raise PlanError(f"'{path}' is larger than {MAX_PLAN_BYTES >> 20} MB; this is not a plan.")
        values = tomllib.loads(path.read_text(encoding="utf-8"))
    except OSError as error:
        raise PlanError(f"Cannot read the plan '{path}': {error.strerror}; give the path of a .toml file.") from error
    except (ValueError, RecursionError) as error:
        raise PlanError(f"The plan '{path}' is not TOML: {error}.") from error
    return _read_plan(path, values)


def _read_plan(path: Path, values: dict) -> Plan:
    section_names = {"farm", "defaults", "characters"}
    if unknown := sorted(set(values) - section_names):
        raise PlanError(f"'{path.name}' has a section [{unknown[0]}]; known are {', '.join(sorted(section_names))}.")
    sections = {name: values.get(name, {}) for name in section_names}
    for name, section in sections.items():
        if not isinstance(section, dict):
            raise PlanError(f"[{name}] in '{path.name}' is not a section; write its keys below [{name}].")
    character_sections = sections["characters"]
    if not character_sections:
        raise PlanError(f"'{path.name}' has no characters; add a section [characters.NAME] with rig and output.")
    folder, used_values = path.parent, {}
    farm = Farm(**{"work": folder / "farm", **_read_fields(Farm, sections["farm"], "[farm]", folder)})
    characters = []
    for name, settings in character_sections.items():
        section = f"[characters.{name}]"
        if not CHARACTER_NAME.fullmatch(name):
            raise PlanError(
                f"{section}: a character's name has only letters, digits, - and _, at most 64, and not {name!r}."
            )
        if not isinstance(settings, dict):
            raise PlanError(f"{section} is not a section; write rig and output below it.")
        merged = {**sections["defaults"], **settings}
        if missing_keys := [key for key in ("rig", "output") if key not in merged]:
            raise PlanError(f"{section} lacks {' and '.join(missing_keys)}.")
        character = Character(name, **_read_fields(Character, merged, section, folder))
        _check_character(character, section)
        for key_value in (("name", name.lower()), ("output", character.output)):
            if key_value in used_values:
                raise PlanError(
                    f"{section} has the same {key_value[0]} as [characters.{used_values[key_value]}]; give it its own."
                )
            used_values[key_value] = name
        characters.append(character)
    return Plan(path, farm, tuple(characters))


def _check_character(character: Character, section: str) -> None:
    if len(set(map(folder_of_mesh, character.objects))) < len(character.objects):
        raise PlanError(f"{section}: two of the objects would have the same folder; rename one of them.")
    if not character.poses and not character.actions and not character.strips:
        raise PlanError(f"{section}: there is nothing to record; give poses or actions.")
    if character.fit_linear not in ("", *FIT_KINDS):
        kinds = " or ".join(FIT_KINDS)
        raise PlanError(f"{section}: fit_linear is {kinds}, and not {character.fit_linear!r}.")
    try:
        parse_joints(character.joints)
    except ValueError as error:
        raise PlanError(f"{section}: {error}.") from error
    for key, value in character.train.items():
        if not TRAIN_SETTING.fullmatch(key) or key in ("messages", "warm_start", "goal_mm"):
            raise PlanError(
                f"{section}: train cannot have {key!r}; it takes settings of train, and goal_mm stands beside it."
            )
        values = value if isinstance(value, list) else [value]
        if not values or not all(isinstance(item, int | float | str) for item in values):
            raise PlanError(f"{section}: train.{key} is {value!r}; give a number, a text, or a list of them.")
        if isinstance(value, bool) and not value:
            raise PlanError(f"{section}: train.{key} is false; leave it out.")


def _read_fields(kind: type, settings: dict, section: str, folder: Path) -> dict:
    """Read the fields of a dataclass, and check their types."""
    types = {each.name: each.type for each in fields(kind) if each.name != "name"}
    values = {}
    for key, value in settings.items():
        if key not in types:
            raise PlanError(f"{section} has the key {key!r}; known are {', '.join(sorted(types))}.")
        values[key] = _read_value(key, value, types[key], section, folder)
    return values


def _read_value(key: str, value: Any, kind: Any, section: str, folder: Path) -> Any:
    if kind in (tuple[str, ...], tuple[Path, ...]):
        if not isinstance(value, list):
            raise PlanError(f'{section}: {key} is a list of texts, such as ["a"], and not {value!r}.')
        return tuple(_read_value(key, item, kind.__args__[0], section, folder) for item in value)
    if kind is Path:
        return (folder / _read_text(key, value, section)).absolute()
    if kind is str:
        return _read_text(key, value, section)
    if kind is bool or kind == dict[str, Any]:
        expected_type = bool if kind is bool else dict
        if not isinstance(value, expected_type):
            raise PlanError(
                f"{section}: {key} is {'true or false' if kind is bool else 'a section'}, and not {value!r}."
            )
        return value
    is_whole = kind in (int, int | None)
    if isinstance(value, bool) or not isinstance(value, int if is_whole else int | float) or not math.isfinite(value):
        raise PlanError(f"{section}: {key} is a {'whole ' if is_whole else ''}number, and not {value!r}.")
    minimum, maximum = MIN_VALUES.get(key, 0), MAX_VALUES.get(key, 10**9)
    if not minimum <= value <= maximum:
        raise PlanError(f"{section}: {key} is from {minimum:,} to {maximum:,}, and not {value!r}.")
    return value


def _read_text(key: str, value: Any, section: str) -> str:
    if not isinstance(value, str) or "\0" in value:
        raise PlanError(f"{section}: {key} is a text, and not {value!r}.")
    return value


def folder_of_mesh(name: str) -> str:
    """Return the subfolder of a mesh in a recording of several meshes, as `bpy.path.clean_name` makes it."""
    return re.sub(r"(?![A-Za-z0-9-])[\x00-\xfe]", "_", name)
