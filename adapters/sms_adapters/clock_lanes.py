"""The lanes of a described system's sources: which decoder, which streams, which periods."""

from __future__ import annotations

from collections.abc import Sequence
from fnmatch import fnmatchcase
from pathlib import Path

from sms_adapters.can_signals import WantedMessage, wanted_messages
from sms_adapters.canopen_signals import pdo_messages
from sms_adapters.clock_merge import Merger, SourceLane, Steps, Stream
from sms_adapters.devices import make_decoder
from sms_online.description.schema import System
from sms_online.description.sources import CanopenSource, CanSource, Device
from sms_online.errors import InputError
from sms_online.pipeline.blocks import blocks


def lanes(system: System, directory: Path | None) -> list[SourceLane]:
    """A lane for each source of the system; directory: where its file lies, with the files that it names.

    Raises InputError for a system without devices, and as the decoders do.
    """
    if not system.devices:
        found = (
            f"only logs: {', '.join(source.name for source in system.sources)}" if system.sources else "no such table"
        )
        raise InputError(system.name, "source", found, "a table [[source]] for each device of the testbed")
    return [_lane(system, source, directory) for source in system.devices]


def merger(system: System, directory: Path | None, start: float = 0.0) -> Merger:
    """Merger of the system's sources, in step with the estimator's blocks; raises InputError as `lanes` does."""
    sources = lanes(system, directory)
    slowest = max(stream.period for lane in sources for stream in lane.streams)
    steps = None
    if system.balance != "energy":
        first, block = blocks(system, slowest)
        steps = Steps(first + 1.0 / system.sample_rate, block)  # the sample behind an end shows that it is one
    return Merger(sources, start, steps)


def period(system: System, channel: str) -> float:
    """Nominal period of a channel, s: that of the sensor which fills it."""
    rates = [s.rate for s in system.sensors if any(fnmatchcase(channel, pattern) for pattern in s.channels)]
    return 1.0 / (next((rate for rate in rates if rate is not None), None) or system.sample_rate)


def _message_period(system: System, channels: Sequence[str], message: WantedMessage) -> float:
    """Nominal period of a message, s: multiplexed parts without signals in every frame come one after the other."""
    periods = {part.condition: period(system, channels[part.columns[0]]) for part in message.parts}
    return periods[()] if () in periods else 1.0 / sum(1.0 / each for each in periods.values())


def _lane(system: System, source: Device, directory: Path | None) -> SourceLane:
    decoder = make_decoder(source, directory)
    messages: list[WantedMessage] = []
    if isinstance(source, CanSource):
        messages = wanted_messages(source, directory)
    elif isinstance(source, CanopenSource):
        messages = pdo_messages(source, directory)
    streams = [Stream(m.columns, _message_period(system, decoder.channels, m), m) for m in messages]
    everything = Stream(tuple(range(len(decoder.channels))), period(system, decoder.channels[0]))
    return SourceLane(source.name, decoder, streams or [everything], source.latency)
