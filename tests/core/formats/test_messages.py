# SPDX-License-Identifier: GPL-3.0-or-later
"""Trainer messages: each is encoded as one line and decoded unchanged; other lines are refused."""

import pytest

from fdda_addon.core.formats.messages import Message, MessageType

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
