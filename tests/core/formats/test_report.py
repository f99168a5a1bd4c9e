# SPDX-License-Identifier: GPL-3.0-or-later
"""Reports, messages and JSON from files: read back unchanged, and refused with the path of the damage."""

import json
from pathlib import Path

import pytest

from fdda_addon.core.errors import TrainingError
from fdda_addon.core.files.output import write_text
from fdda_addon.core.formats.messages import Message, MessageType
from fdda_addon.core.formats.report import checkpoint_path, page_path, read_report, report_path, report_text
from fdda_addon.core.json_check import COUNT, NUMBER, POSITIVE, Interval, check_json

ERRORS = {"mean": 0.1, "rms": 0.2, "p99": 0.5, "p999": 1, "max": 2.5}

REPORT = {
    "unit": "mm",
    "model": "elbow.onnx",
    "model_bytes": 1000,
    "recording": "recording",
    "meshes": [{"name": "Ellbogen ü", "vertices": 300, "held_out": ERRORS, "linear": ERRORS}],
    "vertices": 300,
    "joints": 2,
    "poses": 150,
    "training": {
        **{"seconds": 1.5, "device": "cpu", "passes": 2, "training_poses": 120, "held_out_poses": 15},
        "bones_to_read": "all",
    },
    "parity": 1e-4,
    "fdda": {"training": ERRORS, "held_out": ERRORS},
    "linear": {"held_out": ERRORS},
    "normals": None,
    "edges": {surface: {"inside": 0.1, "beside": None, "across": None} for surface in ("fdda", "linear")},
    "histogram": {"edges": [0.0, 1.0], "fdda": [3], "linear": [4]},
    "partitions": [
        {
            "joint": "upper",
            "vertices": 300,
            "influencing": ["lower"],
            "features": 12,
            "basis": 4,
            "truncation": 0.01,
            "training": ERRORS,
            "held_out": ERRORS,
            "linear": ERRORS,
            "histogram": [3],
            "largest_errors": {
                **{"poses": 1, "vertices": 1, "truncation": 0.5, "joint": "", "extreme": 1.0},
                **{"distance": 1.0, "generalization": 1.0, "cause": "none"},
            },
            "curve": {"training": [1.0, 0.5], "validation": [1.0, 0.6], "worst": [2.0, 1.0], "best_epoch": 2},
        }
    ],
    "warnings": [{"name": "flips", "text": "It jumps."}],
    "goal": {"goal": 0.5, "p999": 1.0, "verdict": "missed"},
}


def damaged_report(key_path: tuple, value: object) -> dict:
    """Return the report with another value at a path of keys; with the value `...`, the key is removed."""
    report = json.loads(json.dumps(REPORT))
    container = report
    for key in key_path[:-1]:
        container = container[key]
    if value is ...:
        del container[key_path[-1]]
    else:
        container[key_path[-1]] = value
    return report


def test_paths_next_to_a_model():
    model = Path("folder/arm.onnx")
    assert [path(model).as_posix() for path in (report_path, page_path, checkpoint_path)] == [
        *("folder/report.json", "folder/report.html", "folder/arm.checkpoint.npz")
    ]


def test_a_report_is_read_back_unchanged(tmp_path):
    write_text(tmp_path / "report.json", report_text(REPORT))
    assert read_report(tmp_path / "report.json") == {"format": "fdda-report", "version": 1, **REPORT}


@pytest.mark.parametrize("key", ["warnings", "goal", "normals", "edges"])
def test_optional_keys_may_be_missing(tmp_path, key):
    write_text(tmp_path / "report.json", report_text(damaged_report((key,), ...)))
    assert key not in read_report(tmp_path / "report.json")


DAMAGES = [
    (("fdda",), ..., "it lacks 'fdda'"),
    (("fdda", "held_out", "max"), "2", "fdda.held_out.max is '2'"),
    (("parity",), float("nan"), "parity is nan"),
    (("goal", "verdict"), "lunch", "goal.verdict is 'lunch'"),
]


@pytest.mark.parametrize(("key_path", "value", "sentence"), DAMAGES, ids=[sentence for *_, sentence in DAMAGES])
def test_a_damaged_report_is_neither_written_nor_read(tmp_path, key_path, value, sentence):
    path = tmp_path / "report.json"
    report = damaged_report(key_path, value)
    with pytest.raises(ValueError, match=sentence):
        write_text(path, report_text(report))
    assert not path.exists()
    path.write_text(json.dumps({"format": "fdda-report", "version": 1, **report}))
    with pytest.raises(TrainingError) as error:
        read_report(path)
    assert str(error.value) == f"The report '{path}' is damaged: {sentence}; train again."


@pytest.mark.parametrize("content", [b"", b"{", b"\xff\xfe{", b"[" * 200_000])
def test_unreadable_reports_are_refused(tmp_path, content):
    path = tmp_path / "report.json"
    path.write_bytes(content)
    with pytest.raises(TrainingError, match=r"The report '.*' cannot be read \(.*\); train again"):
        read_report(path)
    with pytest.raises(TrainingError, match="cannot be read"):
        read_report(tmp_path / "none.json")


@pytest.mark.parametrize("text", ["[]", "{}", "3", '{"format": "fdda-report", "version": 2}'])
def test_other_formats_and_versions_are_refused(tmp_path, text):
    (tmp_path / "report.json").write_text(text)
    with pytest.raises(TrainingError, match="is not a training report of this version; train again"):
        read_report(tmp_path / "report.json")


SAMPLE_MESSAGES = [
    Message(MessageType.STARTED, {"partitions": 3, "poses": 100, "vertices": 90, "device": "cpu"}),
    Message(MessageType.PREPARING, {"done": 1, "total": 3}),
    Message(MessageType.PROGRESS, {"epoch": 1, "epochs": 200, "training_mm": 0.25, "validation_mm": 0.125}),
    Message(MessageType.PARTITION_FINISHED, {"joint": "elbow.L ü", "basis": 24, "held_out_mm": 0.125}),
    Message(MessageType.LOG, {"text": 'two\nlines, "quoted"'}),
    Message(MessageType.WARNING, {"name": "flips", "text": "The joint 'a' flips."}),
    Message(MessageType.FINISHED, {"model": "/a b.onnx", "seconds": 1.5, "held_out_mm": 0.1, "held_out_p999_mm": 1}),
    Message(MessageType.CANCELLED),
    Message(MessageType.FAILED, {"text": "The disk is full."}),
]


@pytest.mark.parametrize("message", SAMPLE_MESSAGES, ids=lambda message: message.type.value)
def test_encoding_and_decoding_keep_a_message(message):
    line = message.encode()
    assert "\n" not in line
    assert Message.decode(line) == message
    assert Message.decode(line + "\n") == message


def test_every_type_has_a_sample_message():
    assert [message.type for message in SAMPLE_MESSAGES] == list(MessageType)


@pytest.mark.parametrize(
    "line", ["", "hello", "{", "[]", "3", "null", "{}", '{"type": "lunch"}', '{"type": null}', '{"type": ["log"]}']
)
def test_invalid_lines_are_refused(line):
    with pytest.raises(ValueError):
        Message.decode(line)


DESCRIPTION = {
    "name": str,
    "is_key?": bool,
    "count": COUNT,
    "joints": [range(-1, 3)],
    "kind": {"hard", "smooth"},
    "error": (NUMBER, None),
    "unit?": POSITIVE,
    "sources": {str: [{"factor": Interval(1, 4)}]},
}

VALUE = {
    **{"name": "a", "count": 3, "joints": [-1, 2], "kind": "hard", "error": 0.5, "other": []},
    **{"sources": {"b": [{"factor": 2}]}},
}


@pytest.mark.parametrize("change", [{}, {"error": None}, {"is_key": True, "unit": 0.01}, {"joints": [], "sources": {}}])
def test_a_value_as_described_is_accepted(change):
    check_json(VALUE | change, DESCRIPTION)


@pytest.mark.parametrize(
    ("value", "words"),
    [
        ([], "it is []"),
        ({"name": "a"}, "it lacks 'count'"),
        (VALUE | {"name": 3}, "name is 3"),
        (VALUE | {"name": None}, "name is None"),
        (VALUE | {"name": "x" * 10**6}, "name is 'xxxxxxxxxxxx...xxxxxxxxxxxxx'"),
        (VALUE | {"is_key": 1}, "is_key is 1"),
        (VALUE | {"count": -1}, "count is -1"),
        (VALUE | {"count": True}, "count is True"),
        (VALUE | {"count": 1.0}, "count is 1.0"),
        (VALUE | {"count": 10**30}, "count is 1000000000000000000000000000000"),
        (VALUE | {"joints": {}}, "joints is {}"),
        (VALUE | {"joints": [0, 3]}, "joints[1] is 3"),
        (VALUE | {"kind": []}, "kind is []"),
        (VALUE | {"error": float("nan")}, "error is nan"),
        (VALUE | {"error": True}, "error is True"),
        (VALUE | {"unit": 0}, "unit is 0"),
        (VALUE | {"unit": float("inf")}, "unit is inf"),
        (VALUE | {"sources": {"b": [{"factor": "2"}]}}, "sources.b[0].factor is '2'"),
        (VALUE | {"sources": {"b": [{}]}}, "sources.b[0] lacks 'factor'"),
    ],
)
def test_another_value_is_refused_with_its_path(value, words):
    with pytest.raises(ValueError, match=r".") as error:
        check_json(value, DESCRIPTION)
    assert str(error.value) == words


def test_a_long_value_is_quoted_in_part():
    with pytest.raises(ValueError, match=r"^it is \['x+\.\.\.x+'\]$") as error:
        check_json(["x" * 10**6], {})
    assert len(str(error.value)) < 100
