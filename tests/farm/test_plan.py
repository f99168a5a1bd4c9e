# SPDX-License-Identifier: GPL-3.0-or-later
"""`characters.toml`: what it means, and the sentences for what makes no sense."""

import string

import pytest

from farm.characters import PlanError, folder_of_mesh, read_plan

HERO = '[characters.hero]\nrig = "rigs/hero.blend"\noutput = "out/hero"\n'


def test_paths_are_those_of_the_plan_s_folder(written, tmp_path):
    plan = written(HERO, "")
    hero = plan.characters[0]
    assert (hero.rig, hero.output) == (tmp_path / "rigs/hero.blend", tmp_path / "out/hero")
    assert plan.farm.work == tmp_path / "farm" and hero.poses == 1000


def test_defaults_hold_for_all_and_give_way(written):
    head = '[defaults]\nposes = 5\nactions = ["walk"]\ntrain = { epochs = 3 }\n[farm]\nthreads = 2\n'
    text = HERO + HERO.replace("hero", "other") + "poses = 7\n"
    plan = written(text, head)
    assert [(c.name, c.poses, c.actions) for c in plan.characters] == [("hero", 5, ("walk",)), ("other", 7, ("walk",))]
    assert plan.characters[1].train == {"epochs": 3} and plan.farm.threads == 2


@pytest.mark.parametrize(
    ("text", "words"),
    [
        ("", "has no characters; add a section [characters.NAME] with rig and output"),
        ("[caracters.a]", "has a section [caracters]; known are characters, defaults, farm"),
        ("farm = 3", "[farm] in 'characters.toml' is no section"),
        ("[characters]\na = 3", "[characters.a] is no section"),
        ('[characters.a]\nrig = "a"', "[characters.a] lacks output."),
        ('[characters."a/b"]\nrig = "a"\noutput = "b"', "has only letters, digits, - and _, at most 64, and not 'a/b'"),
        ('[characters.".."]\nrig = "a"\noutput = "b"', "and not '..'"),
        (HERO + "pose = 3", "has the key 'pose'; known are actions, controls, depends"),
        (HERO + "poses = '3'", "poses is a whole number, and not '3'"),
        (HERO + "poses = true", "poses is a whole number, and not True"),
        (HERO + "poses = 1.5", "poses is a whole number, and not 1.5"),
        (HERO + "poses = -1", "poses is from 0 to 1,000,000,000, and not -1"),
        (HERO + "shards = 0", "shards is from 1 to 1,000, and not 0"),
        (HERO + "spread = nan", "spread is a number, and not nan"),
        (HERO + "margin = 0.5", "margin is from 1 to 4, and not 0.5"),
        (HERO + "goal_mm = -0.5", "goal_mm is from 0 to"),
        (HERO + 'actions = "walk"', "actions is a list of texts, such as [\"a\"], and not 'walk'"),
        (HERO + "actions = [3]", "actions is a text, and not 3"),
        (HERO + "mirror = 1", "mirror is true or false, and not 1"),
        (HERO + "poses = 0", "there is nothing to record; give poses or actions"),
        (HERO + 'fit_linear = "soft"', "fit_linear is hard or smooth, and not 'soft'"),
        (HERO + "train = 3", "train is a section, and not 3"),
        (HERO + 'train = { "x y" = 3 }', "train cannot have 'x y'"),
        (HERO + "train = { goal_mm = 3 }", "goal_mm stands beside it"),
        (HERO + "train = { hidden = [] }", "train.hidden is []; give a number, a text, or a list of them"),
        (HERO + "train = { strict = false }", "train.strict is false; leave it out"),
        (HERO + 'objects = ["a b", "a.b"]', "two of the objects would have the same folder"),
        (HERO + HERO.replace("hero]", "other]"), "[characters.other] has the same output as [characters.hero]"),
        (HERO + HERO.replace("hero]", "Hero]"), "[characters.Hero] has the same name as [characters.hero]"),
        (HERO + 'rig = "b"', "is no TOML"),
        (HERO + "[farm]\nworks = 3", "[farm] has the key 'works'"),
    ],
)
def test_what_makes_no_sense_is_named(written, text, words):
    with pytest.raises(PlanError) as error:
        written(text, "")
    assert words in str(error.value) and str(error.value).endswith(".")


def test_a_plan_that_cannot_be_read(tmp_path):
    with pytest.raises(PlanError, match=r"Cannot read the plan '.*no.toml': No such file or directory"):
        read_plan(tmp_path / "no.toml")
    (tmp_path / "large.toml").write_bytes(b"#" * (5 << 20))
    with pytest.raises(PlanError, match="larger than 4 MB"):
        read_plan(tmp_path / "large.toml")


def test_folders_of_meshes_are_those_that_record_makes():
    import bpy

    for name in (string.printable, "".join(map(chr, range(0x180))), "Körper.001", "日本 a-b"):
        assert folder_of_mesh(name) == bpy.path.clean_name(name)
