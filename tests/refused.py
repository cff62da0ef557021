"""System files that are refused, in one line that names place, what was found and what was expected."""

from __future__ import annotations

import pytest

from sms_online.description.parse import parse_system
from sms_online.errors import InputError

# The least that sources can be added to.
RIG = """
name = "rig"
[joint_1]
stiffness = 100.0
[motor_1]
rotor_inertia = 0.001
[link_1]
kind = "rigid"
"""


def refusal(text: str, file: str) -> str:
    """The line to which a system file's text leads."""
    with pytest.raises(InputError) as caught:
        parse_system(text, file)
    line = str(caught.value)
    assert "\n" not in line
    assert line.startswith(file)
    return line


def assert_refused(text: str, file: str, place: str, found: str, expected: str) -> None:
    """A text is refused at a place, with parts of what is said of what was found and of what was expected."""
    line = refusal(text, file)
    assert line.startswith(f"{file}, {place}: ")
    said, wanted = line.removeprefix(f"{file}, {place}: ").split("; expected ", 1)
    assert found in said
    assert expected in wanted
