# SPDX-License-Identifier: GPL-3.0-or-later
"""Fitted skin weights are read back unchanged from recordings and models; damaged ones are refused."""

import base64
import json

import numpy as np
import pytest

from fdda_addon.core.errors import ModelError
from fdda_addon.core.formats.model import SKIN_KEY, read_model, read_skin
from fdda_addon.core.mathematics.skin_fit import FitReport, SkinFit, skin_to_text

from .tiny_model import VERTEX_COUNT, tiny_info, tiny_model

FIT = SkinFit(
    "smooth",
    25,
    FitReport({"rig": 4.25, "fitted": 1.5}, {"rig": 40.0, "fitted": 21.25}),
    FitReport({"rig": 4.0, "fitted": 1.25}, {"rig": 39.0, "fitted": 20.0}),
)
SKIN_JOINTS = np.array([[0, 2, 0, 0], [1, 0, 0, 0], [2, 1, 0, 0], [0, 1, 2, 0]], np.int32)
SKIN_WEIGHTS = np.array([[0.75, 0.25, 0, 0], [1, 0, 0, 0], [0.5, 0.5, 0, 0], [0.5, 0.3, 0.2, 0]], np.float32)


def test_sentence_about_a_fit():
    assert FIT.sentence() == (
        "Linear skinning with fitted weights (smooth), mm: 1.50 rms and 21.2 max on 12 held-out poses, 4.25 rms and "
        "40.0 max with the rig's own weights; 1.25 rms and 20.0 max on the 13 poses of the fit, 4.00 rms and 39.0 max "
        "with the rig's own."
    )


def test_a_fit_is_read_back_from_json_and_a_damaged_one_refused():
    assert SkinFit.from_json(json.loads(json.dumps(FIT.to_json()))) == FIT
    with pytest.raises(ValueError, match=r"fit\.training is None"):
        SkinFit.from_json({**FIT.to_json(), "training": None})


def changed_skin_text(**changes) -> str:
    """Return the text of the skin weights with changed JSON keys."""
    return json.dumps({**json.loads(skin_to_text(SKIN_JOINTS, SKIN_WEIGHTS)), **changes})


def base64_of_array(array: np.ndarray) -> str:
    """Encode the bytes of an array as the metadata of a model does."""
    return base64.b64encode(array.tobytes()).decode()


@pytest.mark.parametrize(
    ("text", "words"),
    [
        ("", "its skin weights cannot be read"),
        ("[" * 100_000, "its skin weights cannot be read"),
        ("{}", "its skin weights cannot be read ('influences')"),
        (changed_skin_text(influences=0), "its skin weights are damaged: they have 0 joints per vertex"),
        (changed_skin_text(influences=10**9), "they have 1000000000 joints per vertex"),
        (changed_skin_text(weights="AAAA"), f"they are not for {VERTEX_COUNT} vertices"),
        (changed_skin_text(joints=base64_of_array(SKIN_JOINTS + 1)), "its skin weights are no weights of its joints"),
        (changed_skin_text(weights=base64_of_array(SKIN_WEIGHTS * 2)), "its skin weights are no weights of its joints"),
        (
            changed_skin_text(weights=base64_of_array(SKIN_WEIGHTS * np.float32("nan"))),
            "its skin weights are no weights of its joints",
        ),
    ],
)
def test_damaged_weights_of_a_model_are_refused(tmp_path, text, words):
    model = tiny_model()
    model.metadata_props.add(key=SKIN_KEY, value=text)
    path = tmp_path / "m.onnx"
    path.write_bytes(model.SerializeToString())
    info, data = read_model(path)
    with pytest.raises(ModelError) as error:
        read_skin(data, info, path)
    assert str(error.value).startswith(f"The model '{path}' cannot be used: its skin weights ")
    assert words in str(error.value) and str(error.value).endswith("; train it again.")


def test_skin_weights_are_read_from_a_model():
    model = tiny_model()
    assert read_skin(model.SerializeToString(), tiny_info(), "m") is None
    model.metadata_props.add(key=SKIN_KEY, value=skin_to_text(SKIN_JOINTS, SKIN_WEIGHTS))
    joints, weights = read_skin(model.SerializeToString(), tiny_info(), "m")
    assert (joints == SKIN_JOINTS).all() and (weights == SKIN_WEIGHTS).all()
