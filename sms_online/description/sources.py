"""The devices of a testbed as a system file describes them, on a CAN bus, a serial port or a network, and its logs."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Annotated, Any, ClassVar, Literal

from pydantic import Field, model_validator

from sms_online.description.record import NonNegative, Positive, Record

# What a recording holds of a device: CAN frames, the bytes of a serial port, or datagrams.
Recorded = Literal["can", "serial", "udp"]


class Signal(Record):
    """Where a number of a device goes: channel value = scale · number + offset.

    In a system file a mere channel name is short for { channel = name }.

    channel: the channel that it becomes.
    scale: the channel's unit for one count; a negative one turns the sign.
    offset: in the channel's unit.
    minimum, maximum: of the channel value before unwrapping, in its unit; what lies outside is dropped and counted.
    wrap: an encoder counts modulo this, in the number's own unit; its turns are counted from the first sample on.
    """

    channel: str
    scale: float = 1.0
    offset: float = 0.0
    minimum: float | None = None
    maximum: float | None = None
    wrap: Positive | None = None

    @model_validator(mode="before")
    @classmethod
    def _from_name(cls, given: Any) -> Any:
        return {"channel": given} if isinstance(given, str) else given


class SourceRecord(Record):
    """A device.

    name: of the device, in messages and recordings.
    latency: constant delay from the instant of a measurement to its stamp, s; it is corrected.
    """

    name: str
    latency: NonNegative = 0.0


class CanBus(SourceRecord):
    """A CAN bus by the names of python-can.

    interface: python-can's name of the interface: socketcan, pcan, kvaser, slcan, gs_usb, udp_multicast, …
    channel: python-can's name of the channel: can0, PCAN_USBBUS1, …
    bitrate: bit/s, where the interface sets it.
    options: further options, passed to python-can as they are.
    """

    recorded: ClassVar[Recorded] = "can"
    interface: str = "socketcan"
    channel: str = "can0"
    bitrate: Annotated[int, Field(gt=0)] | None = None
    options: dict[str, bool | int | float | str] = {}

    @property
    def address(self) -> str:
        """Where it is, for messages."""
        bitrate = [] if self.bitrate is None else [f"{self.bitrate} bit/s"]
        options = [f"{name} {value}" for name, value in self.options.items()]
        return ", ".join([f"{self.interface} {self.channel}", *bitrate, *options])


class CanSource(CanBus):
    """Messages that a DBC describes.

    kind: `can`.
    dbc: a file beside the system file, or a shipped one.
    signals: `MESSAGE.SIGNAL` of the DBC to the channel that it becomes.
    counters: the signals, at most one a message, in which a sender counts its frames; they show losses.
    """

    kind: Literal["can"]
    dbc: str
    signals: dict[str, Signal]
    counters: tuple[str, ...] = ()


class CanopenSource(CanBus):
    """Process data of CANopen nodes, as their EDS maps them.

    kind: `canopen`.
    nodes: node id to EDS, a file beside the system file.
    signals: `NODE.INDEX` or `NODE.INDEX:SUBINDEX`, the index in hexadecimal as in the EDS, to the channel that it
    becomes: "1.6064" is the position of the drive that is node 1.
    """

    kind: Literal["canopen"]
    nodes: dict[str, str]
    signals: dict[str, Signal]


class SerialField(Record):
    """One number of a serial frame or line: a channel, the device's time, a counter of frames, or nothing of interest.

    channel: the channel that it becomes, if any.
    scale: the channel's unit for one count; a negative one turns the sign.
    offset: in the channel's unit.
    minimum, maximum: of the channel value before unwrapping, in its unit; what lies outside is dropped and counted.
    wrap: of an encoder as for CAN signals; of tick or counter, where it starts again from 0. A word of a binary frame
    does so at its width without saying.
    tick: s a count, of the device's time, or of a counter of frames that are taken at a constant rate.
    counter: whether it counts frames; losses then show.
    """

    channel: str | None = None
    scale: float = 1.0
    offset: float = 0.0
    minimum: float | None = None
    maximum: float | None = None
    wrap: Positive | None = None
    tick: Positive | None = None
    counter: bool = False


class FrameField(SerialField):
    """A word of a binary frame, little-endian.

    type: u (unsigned), i (signed) or f (IEEE float), and its bits.
    """

    type: Literal["u8", "i8", "u16", "i16", "u32", "i32", "u64", "i64", "f32", "f64"]


class SerialPort(SourceRecord):
    """A serial port.

    kind: `serial`.
    port: as pyserial names it, a URL such as socket://host:port included.
    baudrate: bit/s.
    """

    recorded: ClassVar[Recorded] = "serial"
    kind: Literal["serial"]
    port: str
    baudrate: Annotated[int, Field(gt=0)] = 115200

    @property
    def address(self) -> str:
        """Where it is, for messages."""
        return f"{self.port} at {self.baudrate} bit/s"


class SerialFrames(SerialPort):
    """Binary frames: the words of `fields` without padding, then their CRC-32, COBS-encoded, a zero byte at the end.

    The CRC-32 is that of Ethernet and zlib, little-endian. Source: Cheshire and Baker, IEEE/ACM Trans. Networking 7
    (1999) 159.

    format: `frames`.
    fields: the words of a frame, in order.
    """

    format: Literal["frames"]
    fields: Annotated[tuple[FrameField, ...], Field(min_length=1)]


class SerialLines(SerialPort):
    """Lines of decimal numbers in ASCII.

    format: `lines`.
    fields: the numbers of a line, in order.
    separator: between the numbers; "" means blanks.
    checksum: `xor` expects * and two hexadecimal digits at the end, the exclusive or of the bytes before, without a
    leading $, as NMEA 0183 has it.
    """

    format: Literal["lines"]
    fields: Annotated[tuple[SerialField, ...], Field(min_length=1)]
    separator: str = ","
    checksum: Literal["none", "xor"] = "none"


class DatagramPort(SourceRecord):
    """A port that UDP datagrams come to.

    group: the multicast group that is sent to; "" where datagrams come to this machine's own address.
    port: the data port.
    interface: address of this machine's network card; "0.0.0.0" leaves the choice to the operating system.
    """

    recorded: ClassVar[Recorded] = "udp"
    group: str = ""
    port: Annotated[int, Field(gt=0, lt=65536)]
    interface: str = "0.0.0.0"

    @property
    def address(self) -> str:
        """Where it is, for messages."""
        return f"UDP {self.group or self.interface}:{self.port}"


class NatnetSource(DatagramPort):
    """Frames that a motion capture sends as UDP datagrams, in OptiTrack's protocol NatNet, with its z axis up.

    The keys of signals are "ASSET.PART", of the pose of a rigid body: x, y, z in m, its Euler parameters qx, qy, qz, qw
    or yaw, its angle about z in rad; and "ASSET.MARKER.x", .y or .z, the place of one of its markers. An asset is named
    by its streaming ID, a marker by its number in the asset: "1.yaw", "3.2.x".

    kind: `udp`.
    format: `natnet`.
    version: of the protocol, as the streaming settings state it; Motive 2 sends "3.1", Motive 3 "4.0" and later.
    signals: where each number of a frame goes.
    """

    kind: Literal["udp"]
    format: Literal["natnet"]
    version: Annotated[str, Field(pattern=r"^\d+\.\d+$")]
    group: str = "239.255.42.99"
    port: Annotated[int, Field(gt=0, lt=65536)] = 1511
    signals: dict[str, Signal]


class LogSignal(Signal):
    """Where a number of a log goes: channel value = scale · number / gear + offset, the number in its unit.

    In a system file a mere channel name is short for { channel = name }.

    scale: factor on the number; a negative one turns the sign.
    unit: of the number, as pint names it: "deg", "mN m", "rpm"; not stated: the channel's own, in SI.
    gear: divides what was measured on the other side of the gear: an angle at the motor, or a torque at the axis.
    """

    unit: str | None = None
    gear: Positive = 1.0


class LogSource(SourceRecord):
    """What a log holds, stamped by one clock. It is read by `replay`, `diagnose` and `import`; nothing is listened to.

    stamp_unit: of stamps that are mere numbers: "s", "ms", "µs" or "ns".
    signals: where each number of the log goes.
    """

    stamp_unit: Literal["s", "ms", "µs", "us", "ns"] = "s"
    signals: dict[str, LogSignal]


class TableSource(LogSource):
    """Columns with common instants, of a CSV, Parquet, HDF5 or MATLAB file.

    The keys of signals name columns. In HDF5 and .mat files a key is the path of an array, such as "motors/torque";
    "torque[2]" is column 2 of an array of several, counted from 0.

    kind: `table`.
    stamp: the column of the instants.
    """

    kind: Literal["table"]
    stamp: str = "t"


class BagSource(LogSource):
    """Topics of a ROS 1 or ROS 2 bag, or of an MCAP file with ROS 2 or JSON messages.

    The keys of signals are a topic and the path of a number in its messages: "/joint_states.position[0]", counted from
    0, or "/joint_states.position[elbow]", the place that the message's list `name` has for it.

    kind: `bag`.
    stamp: path of the instant in each message; messages without it have the time at which they were recorded, as all
    have with `recorded`.
    """

    kind: Literal["bag"]
    stamp: str = "header.stamp"


# Devices that their `kind` alone distinguishes: a further one is listed here.
OfOneKind = CanSource | CanopenSource | NatnetSource
Device = OfOneKind | SerialFrames | SerialLines
SerialSource = Annotated[SerialFrames | SerialLines, Field(discriminator="format")]
Source = Annotated[OfOneKind | SerialSource | TableSource | BagSource, Field(discriminator="kind")]


def numbers_of(source: Source) -> Mapping[str, Signal | SerialField]:
    """What is said of each number of a source, by its place in the table."""
    if isinstance(source, SerialPort):
        return {f"fields[{k}]": field for k, field in enumerate(source.fields, start=1)}
    return {f"signals.{key}": signal for key, signal in source.signals.items()}


def source_channels(source: Source) -> list[str]:
    """Channels that a source delivers."""
    return [number.channel for number in numbers_of(source).values() if number.channel is not None]
