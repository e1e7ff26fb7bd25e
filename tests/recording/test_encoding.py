"""Messages that are filled by place are the messages that protobuf itself would write."""

import numpy as np

from gpmpc.recording import _messages
from gpmpc.recording._steps import DoublesEncoder

STATES, INPUTS = ("x", "vx", "a_name_with_field_number_over_fifteen", *(f"s{i}" for i in range(20))), ("u", "v")
CLASSES = _messages.message_classes(_messages.descriptor(STATES, INPUTS))


def stage(values, input_given):
    """The message, set field by field."""
    n = len(STATES)
    message = CLASSES["Stage"](time=values[0])
    for name, mean, std in zip(STATES, values[1 : n + 1], values[n + 1 : 2 * n + 1], strict=True):
        setattr(message.mean, name, mean)
        setattr(message.std, name, std)
    if input_given:
        for name, value in zip(INPUTS, values[2 * n + 1 :], strict=True):
            setattr(message.input, name, value)
    return message


def test_nested_messages_filled_by_place_equal_those_set_field_by_field():
    values = np.random.default_rng(0).standard_normal((4, 1 + 2 * len(STATES) + len(INPUTS)))
    encoded = DoublesEncoder(CLASSES["Stage"]).encode(values)
    assert encoded == [stage(row, input_given=True).SerializeToString() for row in values]


def test_a_field_can_be_absent():
    values = np.random.default_rng(1).standard_normal((2, 1 + 2 * len(STATES)))
    encoded = DoublesEncoder(CLASSES["Stage"], without="input").encode(values)
    assert encoded == [stage(row, input_given=False).SerializeToString() for row in values]


def test_zeros_infinities_and_what_is_no_number_come_back_as_they_are():
    values = np.zeros((1, len(STATES)))
    values[0, :3] = np.nan, -np.inf, -0.0
    message = CLASSES["State"].FromString(DoublesEncoder(CLASSES["State"]).encode(values)[0])
    np.testing.assert_array_equal([getattr(message, name) for name in STATES], values[0])
    assert np.signbit(getattr(message, STATES[2]))
