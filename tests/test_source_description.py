"""The [[source]] tables of a system file: what is accepted, what is refused and in which words."""

from __future__ import annotations

import pytest

from sms_adapters.devices import DECODERS, READERS
from sms_online.description import explain
from sms_online.description.parse import parse_system
from sms_online.description.record import records_in
from sms_online.description.sources import CanSource, Device, SerialFrames, Source
from tests.refused import RIG, assert_refused, refusal

CAN = """
[[source]]
kind = "can"
name = "drives"
dbc = "rig.dbc"
signals = { "DRIVE.ANGLE" = "q_1" }
"""
SERIAL = """
[[source]]
kind = "serial"
name = "strain"
port = "/dev/ttyUSB0"
format = "frames"
fields = [{ type = "u16", counter = true }, { type = "i32", channel = "tau_1", scale = 1e-6 }]
"""
LINES = """
[[source]]
kind = "serial"
name = "strain"
port = "COM3"
format = "lines"
fields = [{ channel = "tau_1" }]
"""
ANGLE = "source 1.signals.DRIVE.ANGLE"
CANOPEN = """
[[source]]
kind = "canopen"
name = "drives"
nodes = { 1 = "a.eds" }
signals = { "1.6064" = "q_1" }
"""


def test_sources_are_read_with_their_defaults() -> None:
    can, serial = parse_system(RIG + CAN + SERIAL, "rig.toml").sources
    assert isinstance(can, CanSource)
    assert (can.interface, can.channel, can.bitrate, can.latency) == ("socketcan", "can0", None, 0.0)
    assert isinstance(serial, SerialFrames)
    assert [field.type for field in serial.fields] == ["u16", "i32"]


def test_a_mere_channel_is_short_for_a_signal() -> None:
    long = CAN.replace('"q_1"', '{ channel = "q_1", scale = 1.0 }')
    assert parse_system(RIG + long, "rig.toml") == parse_system(RIG + CAN, "rig.toml")


@pytest.mark.parametrize(
    ("old", "new", "place", "found", "expected"),
    [
        ('kind = "can"', 'kind = "cam"', "source 1.kind", "'cam'", "did you mean 'can'?"),
        ('kind = "can"', "", "source 1.kind", "missing", "'can', 'canopen', 'udp', 'table', 'bag' or 'serial'"),
        ('format = "frames"', "", "source 2.format", "missing", "'frames' or 'lines'"),
        ('name = "drives"', 'name = "my drives"', "source 1.name", "'my drives'", "letters, digits"),
        ('name = "drives"', 'name = "strain"', "source 2.name", "'strain' again", "a name of its own"),
        ('= "q_1"', '= { channel = "q_1", scal = 2 }', f"{ANGLE}.scal", "'scal'", "'scale'"),
        ('= "q_1"', '= { channel = "q_1", scale = 0 }', f"{ANGLE}.scale", "0", "other than 0"),
        ('= "q_1"', '= "tau_1"', "source 2.fields[2]", f"which {ANGLE} fills too", "filled once"),
        ('= "q_1"', '= { channel = "q_1", minimum = 2, maximum = 1 }', f"{ANGLE}.minimum", "2, not below", "below"),
        ('dbc = "rig', 'counters = ["A.N", "A.M"]\ndbc = "rig', "source 1.counters", "a second counter of A", "one"),
        ('dbc = "rig', 'options = { a = [1] }\ndbc = "rig', "source 1.options.a", "[1]", "true or false"),
        ('dbc = "rig', 'bitrate = 0\ndbc = "rig', "source 1.bitrate", "0", "greater than 0"),
        ('type = "i32"', 'type = "i31"', "source 2.fields[2].type", "'i31'", "did you mean 'i32'?"),
        ('type = "i32", ', "", "source 2.fields[2].type", "missing", "a value"),
        ('type = "u16"', 'type = "f32"', "source 2.fields[1].type", "'f32'", "an unsigned count"),
        ("counter = true", "counter = true, scale = 2.0", "source 2.fields[1].scale", "a key of a channel", "fills"),
        ("counter = true", 'counter = true, channel = "q_1"', "source 2.fields[1]", "channel and counter", "a channel"),
        ("counter = true", "counter = true, wrap = 9.5", "source 2.fields[1].wrap", "9.5", "whole number"),
        ('i32", channel = "tau_1", scale = 1e-6', 'u8", counter = true', "source 2.fields[2]", "a second", "one"),
        (', channel = "tau_1", scale = 1e-6', "", "source 2.fields", "no field with a channel", "at least one"),
        ('channel = "tau_1"', 'chanel = "tau_1"', "source 2.fields[2].chanel", "unknown key", "'channel'?"),
    ],
)  # fmt: skip
def test_a_wrong_source_is_refused_in_one_line(old: str, new: str, place: str, found: str, expected: str) -> None:
    text = CAN + SERIAL
    assert old in text
    assert_refused(RIG + text.replace(old, new, 1), "rig.toml", place, found, expected)


def test_a_single_table_is_refused() -> None:
    line = refusal(RIG + CAN.replace("[[source]]", "[source]"), "rig.toml")
    assert line.startswith("rig.toml, source: a table; expected a list")


@pytest.mark.parametrize(
    ("old", "new", "place", "found"),
    [
        ('1 = "a.eds"', '200 = "a.eds"', "source 1.nodes", "'200'"),
        ('1 = "a.eds"', '1 = "a.dbc"', "source 1.nodes.1", "'a.dbc'"),
        ("1.6064", "2.6064", "source 1.signals.2.6064", "node 2"),
        ("1.6064", "1.POSITION", "source 1.signals", "'1.POSITION'"),
        ('"1.6064" = "q_1"', "", "source 1.signals", "an empty table"),
    ],
)
def test_a_wrong_canopen_source_is_refused(old: str, new: str, place: str, found: str) -> None:
    assert refusal(RIG + CANOPEN.replace(old, new), "rig.toml").startswith(f"rig.toml, {place}: {found}")


def test_lines_need_a_separator_that_no_number_holds() -> None:
    for separator in (",", ";", "", "\\t", "|"):
        assert parse_system(f'{RIG}{LINES}separator = "{separator}"\n', "rig.toml").sources
    for separator in ("e", ".", "ab", " ", "*"):
        assert "source 1.separator" in refusal(f'{RIG}{LINES}separator = "{separator}"\n', "rig.toml")


def test_every_described_device_is_read_decoded_and_headed() -> None:
    records = records_in(Device)
    assert set(DECODERS) == set(records)
    for record in records:
        assert [base for base in record.__mro__ if base in READERS], record.__name__
    assert {*explain.SOURCES.values(), *explain.SERIAL.values()} == set(records_in(Source))
