# SPDX-License-Identifier: GPL-3.0-or-later
"""Tests of `characters.toml`: its values, and the error messages of invalid plans."""

import string

import pytest

from farm.characters import PlanError, folder_of_mesh, read_plan

HERO_CHARACTER = '[characters.hero]\nrig = "rigs/hero.blend"\noutput = "out/hero"\n'


def test_paths_are_relative_to_the_folder_of_the_plan(write_plan, tmp_path):
    plan = write_plan(HERO_CHARACTER, "")
    hero = plan.characters[0]
    assert (hero.rig, hero.output) == (tmp_path / "rigs/hero.blend", tmp_path / "out/hero")
    assert plan.farm.work == tmp_path / "farm" and hero.poses == 1000


def test_settings_of_a_character_override_the_defaults(write_plan):
    settings = '[defaults]\nposes = 5\nactions = ["walk"]\ntrain = { epochs = 3 }\n[farm]\nthreads = 2\n'
    text = HERO_CHARACTER + HERO_CHARACTER.replace("hero", "other") + "poses = 7\n"
    plan = write_plan(text, settings)
    assert [(c.name, c.poses, c.actions) for c in plan.characters] == [("hero", 5, ("walk",)), ("other", 7, ("walk",))]
    assert plan.characters[1].train == {"epochs": 3} and plan.farm.threads == 2


@pytest.mark.parametrize(
    ("text", "message"),
    [
        ("", "has no characters; add a section [characters.NAME] with rig and output"),
        ("[caracters.a]", "has a section [caracters]; known are characters, defaults, farm"),
        ("farm = 3", "[farm] in 'characters.toml' is not a section"),
        ("[characters]\na = 3", "[characters.a] is not a section"),
        ('[characters.a]\nrig = "a"', "[characters.a] lacks output."),
        ('[characters."a/b"]\nrig = "a"\noutput = "b"', "has only letters, digits, - and _, at most 64, and not 'a/b'"),
        ('[characters.".."]\nrig = "a"\noutput = "b"', "and not '..'"),
        (HERO_CHARACTER + "pose = 3", "has the key 'pose'; known are actions, controls, depends"),
        (HERO_CHARACTER + "poses = '3'", "poses is a whole number, and not '3'"),
        (HERO_CHARACTER + "poses = true", "poses is a whole number, and not True"),
        (HERO_CHARACTER + "poses = 1.5", "poses is a whole number, and not 1.5"),
        (HERO_CHARACTER + "poses = -1", "poses is from 0 to 1,000,000,000, and not -1"),
        (HERO_CHARACTER + "shards = 0", "shards is from 1 to 1,000, and not 0"),
        (HERO_CHARACTER + "spread = nan", "spread is a number, and not nan"),
        (HERO_CHARACTER + "margin = 0.5", "margin is from 1 to 4, and not 0.5"),
        (HERO_CHARACTER + "goal_mm = -0.5", "goal_mm is from 0 to"),
        (HERO_CHARACTER + 'actions = "walk"', "actions is a list of texts, such as [\"a\"], and not 'walk'"),
        (HERO_CHARACTER + "actions = [3]", "actions is a text, and not 3"),
        (HERO_CHARACTER + "mirror = 1", "mirror is true or false, and not 1"),
        (HERO_CHARACTER + "poses = 0", "there is nothing to record; give poses or actions"),
        (HERO_CHARACTER + 'joints = "some"', "joints are auto, all, or a number from 1, and not 'some'"),
        (HERO_CHARACTER + 'fit_linear = "soft"', "fit_linear is hard or smooth, and not 'soft'"),
        (HERO_CHARACTER + "train = 3", "train is a section, and not 3"),
        (HERO_CHARACTER + 'train = { "x y" = 3 }', "train cannot have 'x y'"),
        (HERO_CHARACTER + "train = { goal_mm = 3 }", "goal_mm stands beside it"),
        (HERO_CHARACTER + "train = { hidden = [] }", "train.hidden is []; give a number, a text, or a list of them"),
        (HERO_CHARACTER + "train = { strict = false }", "train.strict is false; leave it out"),
        (HERO_CHARACTER + 'objects = ["a b", "a.b"]', "two of the objects would have the same folder"),
        (
            HERO_CHARACTER + HERO_CHARACTER.replace("hero]", "other]"),
            "[characters.other] has the same output as [characters.hero]",
        ),
        (
            HERO_CHARACTER + HERO_CHARACTER.replace("hero]", "Hero]"),
            "[characters.Hero] has the same name as [characters.hero]",
        ),
        (HERO_CHARACTER + 'rig = "b"', "is not TOML"),
        (HERO_CHARACTER + "[farm]\nworks = 3", "[farm] has the key 'works'"),
    ],
)
def test_an_invalid_plan_is_refused_with_a_message(write_plan, text, message):
    with pytest.raises(PlanError) as error:
        write_plan(text, "")
    assert message in str(error.value) and str(error.value).endswith(".")


def test_a_missing_or_too_large_plan_is_refused(tmp_path):
    with pytest.raises(PlanError, match=r"Cannot read the plan '.*no.toml': No such file or directory"):
        read_plan(tmp_path / "no.toml")
    (tmp_path / "large.toml").write_bytes(b"#" * (5 << 20))
    with pytest.raises(PlanError, match="larger than 4 MB"):
        read_plan(tmp_path / "large.toml")


def test_the_folder_of_a_mesh_has_the_name_that_record_gives_it():
    import bpy

    for name in (string.printable, "".join(map(chr, range(0x180))), "Körper.001", "日本 a-b"):
        assert folder_of_mesh(name) == bpy.path.clean_name(name)
