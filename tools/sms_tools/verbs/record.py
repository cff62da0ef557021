"""record: what devices send, to disk as it is; no system file, no estimate."""

from __future__ import annotations

import argparse
import math
import re
from pathlib import Path
from urllib.parse import parse_qsl

from can.util import cast_from_string

from sms_adapters.devices import make_reader
from sms_adapters.recorder import Recorder
from sms_adapters.session_log import SessionHeader
from sms_online.description.sources import CanSource, Device, SerialField, SerialLines
from sms_online.errors import InputError
from sms_tools.exit_codes import INTERRUPTED, NOTHING_RECEIVED, OK
from sms_tools.interruption import Interruption
from sms_tools.live.feed import Feed, SessionClock, check_feeds
from sms_tools.live.testbed import versions
from sms_tools.report import Document, report_console, say, show
from sms_tools.results_file import results_directory

BAUDRATE = 115200
EXPECTED = "[NAME=]INTERFACE:CHANNEL[:BITRATE][?OPTION=VALUE&…], such as socketcan:can0"
# A look at the devices, s.
INTERVAL = 0.1
# A line on what has come, s.
LINE_INTERVAL = 5.0


def run(args: argparse.Namespace) -> int:
    """Record until interrupted (130) or for --duration (0); 1 where nothing came."""
    sources: list[Device] = [*(_can(text) for text in args.can), *(_serial(text) for text in args.serial)]
    if not sources:
        raise InputError("record", "", "no device", "--can or --serial, once for each device")
    sources = _named_apart(sources)
    directory = results_directory(args.out)
    clock = SessionClock()
    header = SessionHeader(clock.epoch, {source.name: source.recorded for source in sources}, 0.0, versions())
    recorder = Recorder(directory, header)
    feeds = [Feed(make_reader(source, clock), recorder, queued=False) for source in sources]
    console = report_console(args.json)
    end = math.inf if args.duration is None else args.duration
    with Interruption() as interruption:
        for feed in feeds:
            feed.start()
        said = 0.0
        while not interruption.requested and clock() < end:
            check_feeds(feeds, recorder)
            interruption.sleep(min(INTERVAL, end - clock()))
            if clock() >= said + LINE_INTERVAL:
                said = clock()
                show(console, "; ".join([f"{said:8.1f} s", *(_line(feed) for feed in feeds)]))
        for feed in feeds:
            feed.stop()
    warnings = [warning for feed in feeds for warning in feed.warnings]
    recorder.close(clock(), warnings)
    if recorder.unrecorded:
        warnings.append(f"{recorder.unrecorded} items could not be recorded ({recorder.problem})")
    document: Document = {
        "schema": "sms-online/record/1",
        "recording": str(directory),
        "duration_s": clock(),
        "sources": {feed.name: feed.received for feed in feeds},
        "warnings": warnings,
    }
    parts = [f"{name}: {count} items" for name, count in document["sources"].items()]
    lines = [*parts, *(f"warning: {warning}" for warning in warnings), f"recording: {directory}"]
    received = any(document["sources"].values())
    if not received:
        listened = ", ".join(f"{source.name} ({source.address})" for source in sources)
        lines.append(f"nothing was received from {listened}")
    say(args, *lines, document=document)
    if not received:
        return NOTHING_RECEIVED
    return INTERRUPTED if interruption.requested else OK


def _line(feed: Feed) -> str:
    return f"{feed.name}: {feed.received} items" if feed.lost is None else f"{feed.name}: gone ({feed.lost})"


def _can(text: str) -> CanSource:
    """[NAME=]INTERFACE:CHANNEL[:BITRATE][?OPTION=VALUE&…]; the channel may be a path or a group's address."""
    text, _, query = text.partition("?")
    name, address = _split_name(text)
    try:
        options = {key: cast_from_string(value) for key, value in parse_qsl(query, strict_parsing=bool(query))}
    except ValueError:
        raise InputError("--can", "", repr(query), "options as OPTION=VALUE, & between them, such as fd=true") from None
    interface, _, rest = address.partition(":")
    channel, _, bitrate = rest.rpartition(":")
    if not (channel and bitrate.isdecimal()):
        channel, bitrate = rest, ""
    if not (interface and channel):
        raise InputError("--can", "", repr(text), EXPECTED)
    bus = {"name": name or _name(channel), "interface": interface, "channel": channel}
    # Nothing is decoded.
    rate = int(bitrate) if bitrate else None
    return CanSource(kind="can", dbc="", signals={}, bitrate=rate, options=options, **bus)


def _serial(text: str) -> SerialLines:
    """[NAME=]PATH[:BAUDRATE], or a URL of pyserial."""
    name, port = _split_name(text)
    baudrate = BAUDRATE
    path, _, number = port.rpartition(":")
    if "://" not in port and path and number.isdecimal():
        port, baudrate = path, int(number)
    fields = (SerialField(),)  # nothing is decoded
    return SerialLines(
        kind="serial", format="lines", name=name or _name(port), port=port, baudrate=baudrate, fields=fields
    )


def _split_name(text: str) -> tuple[str, str]:
    """The name before =, where there is one, and what is after."""
    name, equals, rest = text.partition("=")
    return (name, rest) if equals and re.fullmatch(r"[A-Za-z0-9_-]+", name) else ("", text)


def _name(text: str) -> str:
    """What a device is called in its recording: the last part of its path, in characters that file names have."""
    return re.sub(r"[^A-Za-z0-9_-]+", "-", Path(text).name).strip("-") or "device"


def _named_apart(sources: list[Device]) -> list[Device]:
    """Two devices of one name get numbers."""
    names = [source.name for source in sources]
    apart = [f"{name}-{names[:k].count(name) + 1}" if names.count(name) > 1 else name for k, name in enumerate(names)]
    return [source.model_copy(update={"name": name}) for source, name in zip(sources, apart, strict=True)]
