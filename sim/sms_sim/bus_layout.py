"""A bus for any described system: which CAN messages and serial frames a simulated testbed of it sends.

Drives and joints are on CAN, two channels of 24 bits and a counter of 16 bits a message; the base's pose and the
markers are on a serial port each, as 64-bit floats behind a clock in microseconds.
"""

from __future__ import annotations

import json
from collections.abc import Mapping, Sequence

# Numbers of 24 bits: 1e-6 rad reach ±8 rad, 1e-5 N m at the motor shaft ±84 N m, 1e-3 N ±8 kN.
SCALES = {"tau_": 1e-5, "force_": 1e-3, "theta_m_": 1e-6, "q_": 1e-6}
FIRST_ID = 0x100
# Torque commands to the arm: the same words as those of the drives' messages, in messages of these identifiers.
FIRST_COMMAND_ID, COMMAND = 0x080, "COMMAND_"
DBC = "simulated-bus.dbc"
CAN, BASE, MARKERS = "can", "base", "markers"


def messages(channels: Sequence[str]) -> list[tuple[str, ...]]:
    """Channels of each CAN message: one or two."""
    drives = [channel for channel in channels if channel.startswith(("tau_", "force_"))]
    joints = [channel for channel in channels if channel.startswith(("theta_m_", "q_"))]
    joints.sort(key=lambda channel: (int(channel.rsplit("_", 1)[1]), channel))
    return [tuple(group[k : k + 2]) for group in (drives, joints) for k in range(0, len(group), 2)]


def commands(channels: Sequence[str]) -> dict[str, str]:
    """`MESSAGE.SIGNAL` of a torque command to the drive's channel that it sets."""
    drives = [group for group in messages(channels) if group[0].startswith(("tau_", "force_"))]
    return {f"{COMMAND}{number}.{channel}": channel for number, group in enumerate(drives) for channel in group}


def dbc_text(channels: Sequence[str]) -> str:
    """The DBC of the messages, and of the commands that the arm obeys."""
    lines = ['VERSION ""', "NS_ :", "BS_:", "BU_: ARM", ""]
    for number, group in enumerate(messages(channels)):
        lines += [f"BO_ {FIRST_ID + number} ARM_{number}: 8 ARM", *_signals(group)]
        lines += [' SG_ COUNT : 48|16@1+ (1,0) [0|0] "" Vector__XXX', ""]
        if group[0].startswith(("tau_", "force_")):
            lines += [f"BO_ {FIRST_COMMAND_ID + number} {COMMAND}{number}: 6 Vector__XXX", *_signals(group), ""]
    return "\n".join(lines) + "\n"


def _signals(group: Sequence[str]) -> list[str]:
    """Channels as words of 24 bits, one after the other."""
    scales = [next(scale for prefix, scale in SCALES.items() if channel.startswith(prefix)) for channel in group]
    return [
        f' SG_ {channel} : {24 * k}|24@1- ({scale!r},0) [0|0] "" Vector__XXX'
        for k, (channel, scale) in enumerate(zip(group, scales, strict=True))
    ]


def source_tables(channels: Sequence[str], options: Mapping[str, str | int], ports: Mapping[str, str]) -> str:
    """[[source]] tables of the bus, to be put at the end of a system file.

    channels: what the testbed measures. options: interface, channel and port of the CAN bus, as for python-can. ports:
    path of the serial port by the source's name.
    """
    groups = messages(channels)
    signals = [f'"ARM_{number}.{channel}" = "{channel}"' for number, group in enumerate(groups) for channel in group]
    counters = [f'"ARM_{number}.COUNT"' for number in range(len(groups))]
    further = {key: value for key, value in options.items() if key not in ("interface", "channel")}
    lines = ["", "[[source]]", 'kind = "can"', f'name = "{CAN}"', f'dbc = "{DBC}"']
    lines += [f"{key} = {json.dumps(options[key])}" for key in ("interface", "channel")]
    if further:
        lines.append(f"options = {{ {', '.join(f'{key} = {json.dumps(value)}' for key, value in further.items())} }}")
    lines += [f"signals = {{ {', '.join(signals)} }}", f"counters = [{', '.join(counters)}]"]
    for name, mine in serial_channels(channels).items():
        lines += ["", "[[source]]", 'kind = "serial"', f'name = "{name}"', f"port = {json.dumps(ports[name])}"]
        lines += ['format = "frames"', "fields = [", '    { type = "u32", tick = 1e-6 },']
        lines += [f'    {{ type = "f64", channel = "{channel}" }},' for channel in mine]
        lines.append("]")
    return "\n".join(lines) + "\n"


def serial_channels(channels: Sequence[str]) -> dict[str, tuple[str, ...]]:
    """Channels of each serial port by the source's name; a port without channels is left out."""
    on_can = {channel for group in messages(channels) for channel in group}
    rest = [channel for channel in channels if channel not in on_can]
    markers = tuple(channel for channel in rest if ".marker_" in channel)
    ports = {BASE: tuple(channel for channel in rest if channel not in markers), MARKERS: markers}
    return {name: mine for name, mine in ports.items() if mine}
