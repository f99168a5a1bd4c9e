# SPDX-License-Identifier: GPL-3.0-or-later
"""Trainer messages: one line each way, and what is no message is refused."""

import pytest

from fdda_addon.core.messages import Message, MessageType

SAMPLES = [
    Message(MessageType.STARTED, {"partitions": 3, "poses": 100, "vertices": 90, "device": "cpu"}),
    Message(MessageType.PREPARING, {"done": 1, "total": 3}),
    Message(MessageType.PROGRESS, {"epoch": 1, "epochs": 200, "training_mm": 0.25, "validation_mm": 0.125}),
    Message(MessageType.PARTITION_FINISHED, {"joint": "elbow.L ü", "basis": 24, "held_out_mm": 0.125}),
    Message(MessageType.LOG, {"text": 'two\nlines, "quoted"'}),
    Message(MessageType.WARNING, {"name": "flips", "text": "The joint 'a' flips."}),
    Message(MessageType.MODEL_FINISHED, {"model": "/a.onnx", "seconds": 1, "held_out_mm": 0.1, "held_out_p999_mm": 1}),
    Message(MessageType.FINISHED, {"model": "/a b.onnx", "seconds": 1.5, "held_out_mm": 0.1, "held_out_p999_mm": 1}),
    Message(MessageType.CANCELLED),
    Message(MessageType.FAILED, {"text": "The disk is full."}),
]


@pytest.mark.parametrize("message", SAMPLES, ids=lambda message: message.type.value)
def test_round_trip(message):
    line = message.encode()
    assert "\n" not in line
    assert Message.decode(line) == message
    assert Message.decode(line + "\n") == message


def test_there_is_a_sample_of_each():
    assert [message.type for message in SAMPLES] == list(MessageType)


def test_last_messages():
    last = {MessageType.FINISHED, MessageType.CANCELLED, MessageType.FAILED}
    assert {kind for kind in MessageType if kind.is_last} == last


@pytest.mark.parametrize(
    "line", ["", "hello", "{", "[]", "3", "null", "{}", '{"type": "lunch"}', '{"type": null}', '{"type": ["log"]}']
)
def test_what_is_no_message_is_refused(line):
    with pytest.raises(ValueError):
        Message.decode(line)
