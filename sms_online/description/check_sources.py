"""Sources of a description: names, channels that exist and are fed once, and numbers that can be read as described."""

from __future__ import annotations

import re
from collections.abc import Sequence
from ipaddress import AddressValueError, IPv4Address

from sms_online.description.explain import expected_channel, hint, nearest
from sms_online.description.schema import System
from sms_online.description.sources import (
    BagSource,
    CanopenSource,
    CanSource,
    DatagramPort,
    FrameField,
    LogSource,
    NatnetSource,
    SerialField,
    SerialFrames,
    SerialLines,
    SerialPort,
    Signal,
    numbers_of,
)
from sms_online.errors import InputError

# A source's name also names its files in a recording.
NAME = re.compile(r"[A-Za-z0-9_-]+")
CAN_SIGNAL = re.compile(r"\w+\.\w+")
CANOPEN_SIGNAL = re.compile(r"(?P<node>\d+)\.[0-9A-Fa-f]{4}(:[0-9A-Fa-f]{1,2})?")
# A topic, and the path of a number in its messages: names and, in brackets, a number or a name.
BAG_SIGNAL = re.compile(r"[^.\[\]]+(\.\w+(\[[^\[\].]+\])*)+")
NATNET_SHOWN = '"ASSET.PART" or "ASSET.MARKER.AXIS", such as "3.2.x",'
NATNET_SIGNAL = re.compile(r"\d+\.([xyz]|q[xyzw]|yaw)|\d+\.[1-9]\d*\.[xyz]")
STAMP = re.compile(r"\w+(\.\w+)*")
MOST_NODES = 127  # CiA 301
# One character between numbers that no number holds; "" means blanks.
SEPARATOR = re.compile(r"[!-~\t]?")
IN_NUMBERS = "0123456789+-.eE*$"
# Words that hold a count or a time.
UNSIGNED = ("u8", "u16", "u32")
# What a field says of the number of a channel; of the others only where it wraps.
CONVERSION = ("scale", "offset", "minimum", "maximum", "wrap")


def check_sources(system: System, names: Sequence[str], source: str) -> None:
    """Raise InputError at the first contradiction in [[source]]; names: the channels that the system has."""
    fed: dict[str, str] = {}
    taken: set[str] = set()
    for k, device in enumerate(system.sources, start=1):
        place = f"source {k}"
        if not NAME.fullmatch(device.name):
            raise InputError(source, f"{place}.name", repr(device.name), "letters, digits, - and _")
        if device.name in taken:
            raise InputError(source, f"{place}.name", f"{device.name!r} again", "a name of its own for each source")
        taken.add(device.name)
        if isinstance(device, CanSource):
            _check_can(device, place, source)
        elif isinstance(device, CanopenSource):
            _check_canopen(device, place, source)
        elif isinstance(device, LogSource):
            _check_log(device, place, source)
        elif isinstance(device, SerialPort):
            _check_serial(device, place, source)
        elif isinstance(device, NatnetSource):
            _check_keys(device, f"{place}.signals", NATNET_SIGNAL, NATNET_SHOWN, source)
        if isinstance(device, DatagramPort):
            _check_addresses(device, place, source)
        if not numbers_of(device):
            raise InputError(source, f"{place}.signals", "an empty table", '"NAME" = "channel", at least once')
        for where, number in numbers_of(device).items():
            _check_number(number, f"{place}.{where}", names, fed, source)


def _check_number(
    signal: Signal | SerialField, where: str, names: Sequence[str], fed: dict[str, str], source: str
) -> None:
    if signal.channel is None:
        return
    if signal.channel not in names:
        expected = expected_channel(signal.channel, names)
        raise InputError(source, where, f"unknown channel {signal.channel!r}", expected)
    if signal.channel in fed:
        found = f"{signal.channel!r}, which {fed[signal.channel]} fills too"
        raise InputError(source, where, found, "each channel filled once")
    fed[signal.channel] = where
    if signal.scale == 0.0:
        raise InputError(source, f"{where}.scale", "0", "a scale other than 0")
    if signal.minimum is not None and signal.maximum is not None and signal.minimum >= signal.maximum:
        found = f"{signal.minimum:g}, not below the maximum {signal.maximum:g}"
        raise InputError(source, f"{where}.minimum", found, "a minimum below the maximum")


def _check_can(device: CanSource, place: str, source: str) -> None:
    if not device.dbc.endswith(".dbc"):
        raise InputError(source, f"{place}.dbc", repr(device.dbc), "the name of a .dbc file")
    _check_keys(device, f"{place}.signals", CAN_SIGNAL, '"MESSAGE.SIGNAL"', source)
    counted: set[str] = set()
    for name in device.counters:
        if not CAN_SIGNAL.fullmatch(name):
            raise InputError(source, f"{place}.counters", repr(name), '"MESSAGE.SIGNAL" in quotes')
        message = name.split(".")[0]
        if message in counted:
            raise InputError(source, f"{place}.counters", f"a second counter of {message}", "one counter a message")
        counted.add(message)


def _check_canopen(device: CanopenSource, place: str, source: str) -> None:
    for node, eds in device.nodes.items():
        if not (node.isascii() and node.isdigit() and 1 <= int(node) <= MOST_NODES):
            raise InputError(source, f"{place}.nodes", repr(node), f"node ids from 1 to {MOST_NODES}")
        if not eds.lower().endswith(".eds"):
            raise InputError(source, f"{place}.nodes.{node}", repr(eds), "the name of an .eds file")
    _check_keys(device, f"{place}.signals", CANOPEN_SIGNAL, '"NODE.INDEX", such as "1.6064",', source)
    for name in device.signals:
        node = name.split(".")[0]
        if node not in device.nodes:
            expected = f"a node of [{place}.nodes]{hint(nearest(node, tuple(device.nodes)))}"
            raise InputError(source, f"{place}.signals.{name}", f"node {node}", expected)


def _check_log(device: LogSource, place: str, source: str) -> None:
    """A log's paths; what lies at them the file alone can say."""
    if not device.signals:
        raise InputError(
            source, f"{place}.signals", "an empty table", '"column or topic path" = "channel", at least once'
        )
    if isinstance(device, BagSource):
        if not STAMP.fullmatch(device.stamp):
            raise InputError(
                source, f"{place}.stamp", repr(device.stamp), 'the path of a field, such as "header.stamp"'
            )
        for name in device.signals:
            if not BAG_SIGNAL.fullmatch(name):
                expected = 'a topic and a path, such as "/joint_states.position[0]", in quotes'
                raise InputError(source, f"{place}.signals", repr(name), expected)


def _check_addresses(device: DatagramPort, place: str, source: str) -> None:
    for key, value, several in (("group", device.group, True), ("interface", device.interface, False)):
        if not value and several:
            continue
        try:
            address = IPv4Address(value)
        except AddressValueError:
            raise InputError(source, f"{place}.{key}", repr(value), "an IPv4 address") from None
        if several and not address.is_multicast:
            raise InputError(source, f"{place}.group", repr(value), 'a multicast address, 224.0.0.0 and above, or ""')


def _check_keys(
    device: CanSource | CanopenSource | NatnetSource, place: str, form: re.Pattern[str], shown: str, source: str
) -> None:
    if not device.signals:
        raise InputError(source, place, "an empty table", f'{shown} = "channel", at least once')
    for name in device.signals:
        if not form.fullmatch(name):
            raise InputError(source, place, repr(name), f"{shown} in quotes")


def _check_serial(device: SerialFrames | SerialLines, place: str, source: str) -> None:
    seen: set[str] = set()
    for k, field in enumerate(device.fields, start=1):
        where = f"{place}.fields[{k}]"
        roles = [role for role in ("channel", "tick", "counter") if getattr(field, role)]
        if "channel" in roles and len(roles) > 1:
            raise InputError(source, where, " and ".join(roles), f"a channel or a {roles[1]}")
        for key in CONVERSION:
            stated = getattr(field, key) != SerialField.model_fields[key].default
            if stated and "channel" not in roles and not (roles and key == "wrap"):
                raise InputError(source, f"{where}.{key}", "a key of a channel", "a field that fills a channel")
        if "tick" in roles or "counter" in roles:
            _check_count(field, where, source)
        for role in roles:
            if role in seen and role != "channel":
                raise InputError(source, where, f"a second {role}", f"one {role} in {device.format}")
        seen.update(roles)
    if "channel" not in seen:
        raise InputError(source, f"{place}.fields", "no field with a channel", "at least one")
    if isinstance(device, SerialLines) and (
        not SEPARATOR.fullmatch(device.separator) or (device.separator and device.separator in IN_NUMBERS)
    ):
        expected = 'one character that no number holds, or "" for blanks'
        raise InputError(source, f"{place}.separator", repr(device.separator), expected)


def _check_count(field: SerialField, where: str, source: str) -> None:
    """A tick or counter: an unsigned word, and a wrap in whole counts."""
    if isinstance(field, FrameField) and field.type not in UNSIGNED:
        raise InputError(source, f"{where}.type", repr(field.type), "an unsigned count, 'u8', 'u16' or 'u32'")
    if field.wrap is not None and not field.wrap.is_integer():
        raise InputError(source, f"{where}.wrap", f"{field.wrap:g}", "a whole number of counts")
