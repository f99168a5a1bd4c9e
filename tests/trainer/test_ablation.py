# SPDX-License-Identifier: GPL-3.0-or-later
"""The ablation switches each mechanism off, measures the model, and leaves the trainer as it was."""

import shutil

import numpy as np
import pytest

from benchmarks.ablation import format_table
from benchmarks.ablation_mechanisms import ALL, MECHANISMS
from benchmarks.ablation_trainings import WITHIN, Character
from trainer import compression, train
from trainer.fits.joint_fit import JointRegression

from .chain import write_chain

pytestmark = pytest.mark.slow


@pytest.fixture(scope="module")
def results(recording, tmp_path_factory) -> dict[str, list[dict]]:
    """Results of a character without each mechanism."""
    folder = tmp_path_factory.mktemp("ablation")
    shutil.copytree(recording, folder / "recording")
    write_chain(folder / "held_out", pose_count=40, seed=7)
    character = Character(folder, epochs=20)
    return {name: [character.result(name, seed=0)] for name in MECHANISMS}


def test_each_mechanism_is_measured(results):
    for name, (result,) in results.items():
        assert np.isfinite(result["errors"][WITHIN]).all() and result["errors"][WITHIN][0] < 1, name
        assert result["bytes"] > 0 and result["frame_ratio"] > 0, name
        assert (result["seconds"] == 0) == MECHANISMS[name].is_export, name


def test_networks_stay_the_same_without_a_mechanism_of_the_export(results):
    for name, (result,) in results.items():
        if MECHANISMS[name].is_export:
            assert result["errors"][WITHIN] == pytest.approx(results[ALL][0]["errors"][WITHIN], rel=1e-3), name


def test_switching_off_the_linear_fit_changes_the_model(results):
    assert results["linear fit"][0]["errors"][WITHIN][0] != pytest.approx(results[ALL][0]["errors"][WITHIN][0])


def test_the_trainer_is_as_before_after_an_error():
    before = JointRegression.fit, compression.may_factorize, train.build_model
    for mechanism in MECHANISMS.values():
        with pytest.raises(ZeroDivisionError), mechanism.switched_off():
            raise ZeroDivisionError
    assert before == (JointRegression.fit, compression.may_factorize, train.build_model)


def test_the_table_has_a_row_for_each_mechanism(results):
    lines = format_table("chain", results).splitlines()
    assert [line.split(" | ")[0].strip("| ") for line in lines[4:]] == ["nothing", *list(MECHANISMS)[1:]]
