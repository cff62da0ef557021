"""The hand-over to the view never waits for it, loses only the oldest, and says how many."""

from __future__ import annotations

import io
import os
import pickle
from threading import Event as Flag
from time import sleep
from typing import Any

import pytest

from sms_tools.view.choice import Choice, parse_choice
from sms_tools.view.handover import Handover


class Gate(io.RawIOBase):
    """A pipe that takes nothing until it is opened."""

    def __init__(self) -> None:
        super().__init__()
        self.open = Flag()
        self.taken = bytearray()

    def writable(self) -> bool:
        return True

    def write(self, data: Any) -> int:
        self.open.wait(10.0)
        self.taken += data
        return len(data)

    def items(self) -> list[Any]:
        stream = io.BytesIO(bytes(self.taken))
        found = []
        while True:
            try:
                found.append(pickle.load(stream))
            except EOFError:
                return found


def wait_for(condition: Any) -> None:
    for _ in range(500):
        if condition():
            return
        sleep(0.01)
    raise AssertionError("it never came")


def test_everything_arrives_in_order_where_the_pipe_takes_it() -> None:
    gate = Gate()
    gate.open.set()
    handover = Handover(gate)  # type: ignore[arg-type]
    for k in range(200):
        assert handover.put(k, patience=10.0)
    wait_for(lambda: len(gate.items()) == 200)
    assert gate.items() == list(range(200))
    assert handover.dropped == 0


def test_the_oldest_are_dropped_and_counted_where_it_does_not() -> None:
    gate = Gate()
    handover = Handover(gate, capacity=4)  # type: ignore[arg-type]
    handover.put("in the pipe")
    wait_for(lambda: not handover._waiting)
    taken = [handover.put(k) for k in range(10)]
    assert taken == [True] * 4 + [False] * 6
    assert handover.dropped == 6
    gate.open.set()
    wait_for(lambda: len(gate.items()) == 5)
    assert gate.items() == ["in the pipe", 6, 7, 8, 9]


def test_a_broken_pipe_is_noticed_and_then_costs_nothing() -> None:
    reading, writing = os.pipe()
    handover = Handover(os.fdopen(writing, "wb"))
    os.close(reading)
    handover.put("first")
    wait_for(lambda: handover.broken)
    assert not handover.put("second", patience=10.0)
    assert not handover._waiting


def test_a_closed_hand_over_ends_its_thread() -> None:
    handover = Handover(Gate())  # type: ignore[arg-type]
    handover.close()
    handover._thread.join(10.0)
    assert not handover._thread.is_alive()


@pytest.mark.parametrize(
    ("text", "choice"),
    [
        ("off", Choice("off")),
        ("save", Choice("save")),
        ("serve", Choice("serve", "127.0.0.1")),
        ("serve=0.0.0.0", Choice("serve", "0.0.0.0")),
        ("connect=lab-pc", Choice("connect", "lab-pc", 9876)),
        ("connect=127.0.0.1:80", Choice("connect", "127.0.0.1", 80)),
        ("connect=rerun+http://[::1]:9999/proxy", Choice("connect", "[::1]", 9999)),
    ],
)
def test_choices(text: str, choice: Choice) -> None:
    assert parse_choice(text) == choice


@pytest.mark.parametrize(
    "text", ["", "file", "connect", "connect=", "connect=host:0", "connect=host:99999", "save=x", "serve=", "serve=all"]
)
def test_wrong_choices_say_what_was_expected(text: str) -> None:
    with pytest.raises(ValueError, match="expected off, save, serve, serve=ADDRESS "):
        parse_choice(text)
