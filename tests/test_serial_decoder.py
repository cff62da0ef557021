"""Serial frames and lines to samples: values, device times, every fault counted, the same however the bytes come."""

from __future__ import annotations

import struct
import zlib
from collections.abc import Sequence
from typing import Any

import numpy as np
import pytest
from cobs import cobs

from sms_adapters.devices import make_decoder
from sms_adapters.raw import CanFrames, DecodedSamples, Decoder, SerialChunk
from sms_adapters.serial_decoder import LONGEST_LINE, encode_frames, frame_layout
from sms_online.description.sources import FrameField, SerialField, SerialFrames, SerialLines

FIELDS = (
    FrameField(type="u8"),
    FrameField(type="u16", counter=True),
    FrameField(type="u32", tick=1e-6),
    FrameField(type="i32", channel="q", scale=-1e-6, offset=0.25),
    FrameField(type="f32", channel="tau", minimum=-50.0, maximum=50.0),
)
FRAMES = SerialFrames(kind="serial", name="strain", port="loop://", format="frames", fields=FIELDS)


def lines(*fields: dict[str, Any], **options: Any) -> SerialLines:
    described = tuple(SerialField(**field) for field in fields)
    return SerialLines(kind="serial", name="strain", port="loop://", format="lines", fields=described, **options)


def frame(count: int, ticks: int = 0, q: int = 0, tau: float = 0.0) -> bytes:
    """As a device would send it, written with nothing of ours."""
    payload = struct.pack("<BHIif", 7, count, ticks, q, tau)
    return bytes(cobs.encode(payload + struct.pack("<I", zlib.crc32(payload)))) + b"\0"


def push(decoder: Decoder, *pieces: bytes) -> DecodedSamples:
    """The samples of some chunks, which arrive at 0, 1, 2 … s."""
    parts = [decoder.push(SerialChunk(float(k), piece)) for k, piece in enumerate(pieces)]
    return DecodedSamples(
        *(np.concatenate([getattr(p, n) for p in parts]) for n in ("t_arrival", "t_device", "values"))
    )


def faults(decoder: Decoder) -> dict[str, int]:
    return {kind: count for kind, count in decoder.counters.items() if count}


def test_frames_become_channels_in_si_with_the_devices_time() -> None:
    decoder = make_decoder(FRAMES, None)
    samples = push(decoder, frame(1, 1000, 250_000, 1.5), frame(2, 2000, -500_000, -2.5) + frame(3, 3000, 0, 0.0))
    assert decoder.channels == ("q", "tau")
    assert samples.values.tolist() == [[0.0, 1.5], [0.75, -2.5], [0.25, 0.0]]
    assert samples.t_arrival.tolist() == [0.0, 1.0, 1.0]
    assert samples.t_device.tolist() == [1000 * 1e-6, 2000 * 1e-6, 3000 * 1e-6]
    assert not faults(decoder)


def test_ticks_and_counter_go_on_where_their_words_end() -> None:
    """32 bits of microseconds last 71.6 minutes; the frame before the roll-over may come after it."""
    decoder = make_decoder(FRAMES, None)
    samples = push(
        decoder, frame(65534, 2**32 - 500), frame(65535, 2**32 - 1), frame(0, 499), frame(1, 2**32 - 2), frame(2, 999)
    )
    assert np.round(np.diff(samples.t_device) * 1e6).tolist() == [499, 500, -501, 1001]
    assert not faults(decoder)


def test_every_word_of_a_frame_reads_as_struct_reads_it() -> None:
    """All types, random bytes, seed 7."""
    codes = dict(zip(["u8", "i8", "u16", "i16", "u32", "i32", "u64", "i64", "f32", "f64"], "BbHhIiQqfd", strict=True))
    fields = tuple(FrameField.model_validate({"type": name, "channel": name}) for name in codes)
    decoder = make_decoder(SerialFrames(kind="serial", name="s", port="x", format="frames", fields=fields), None)
    layout = frame_layout(fields)
    payloads = np.random.default_rng(7).integers(0, 256, (50, layout.itemsize), dtype=np.uint8)
    payloads[:, [-1, -9]] &= 0x3F  # below NaN and infinity
    samples = push(decoder, b"".join(encode_frames(payloads.view(layout).ravel())))
    expected = [struct.unpack("<" + "".join(codes.values()), bytes(payload)) for payload in payloads]
    assert samples.values.tolist() == [[float(word) for word in row] for row in expected]


def test_faults_of_frames_are_counted_and_the_next_one_is_read() -> None:
    decoder = make_decoder(FRAMES, None)
    corrupt = bytearray(frame(2))
    corrupt[1] ^= 0x40
    stream = (
        frame(1)
        + bytes(corrupt)  # one bit
        + frame(3)[:-4] + b"\0"  # its end missing
        + b"\xff\x01\0"  # no COBS
        + b"\0\0"  # idle line
        + frame(4, tau=float("nan"))
        + frame(4)  # again
        + frame(5, tau=51.0)
        + b"\x01" * 500 + b"\0"  # noise
        + frame(6)
    )  # fmt: skip
    samples = push(decoder, stream)
    assert len(samples.values) == 4
    assert np.isnan(samples.values[:, 1]).tolist() == [False, True, True, False]
    assert faults(decoder) == {
        "crc": 1,
        "framing": 2,
        "non_finite": 1,
        "repeated_counter": 1,
        "out_of_range": 1,
        "too_long": 1,
        "lost_counter": 2,
    }


def test_after_a_break_what_was_cut_is_dropped() -> None:
    """The port was lost in the middle of one frame and came back in the middle of another."""
    decoder = make_decoder(FRAMES, None)
    samples = push(decoder, b"", frame(0)[5:] + frame(1) + frame(2)[:9], b"", frame(3)[9:] + frame(4, q=1))
    assert len(samples.values) == 2
    assert faults(decoder) == {"cut_line": 2, "lost_counter": 2}


def test_a_leading_delimiter_loses_nothing_after_a_break() -> None:
    decoder = make_decoder(FRAMES, None)
    samples = push(decoder, b"", b"\0" + frame(0) + frame(1))
    assert len(samples.values) == 2
    assert faults(decoder) == {}


def test_lines_become_channels() -> None:
    decoder = make_decoder(
        lines({"tick": 1e-3, "wrap": 1000}, {}, {"channel": "q", "scale": 2.0}, {"channel": "tau"}), None
    )
    samples = push(decoder, b"998,7, 1.5,-.5e1\r\n999,7,+2,3.\n", b"0,x", b"\n1,7,0,nan\n")
    assert samples.values[:3].tolist() == [[3.0, -5.0], [4.0, 3.0], [0.0, pytest.approx(np.nan, nan_ok=True)]]
    assert np.round(samples.t_device * 1e3, 9).tolist() == [998.0, 999.0, 1001.0]
    assert samples.t_arrival.tolist() == [0.0, 0.0, 2.0]
    assert faults(decoder) == {"bad_number": 1, "non_finite": 1}


@pytest.mark.parametrize(
    ("line", "fault"),
    [
        (b"1,2,3", "bad_number"),
        (b"1", "bad_number"),
        (b"1,", "bad_number"),
        (b"1,2_0", "bad_number"),
        (b"1,0x10", "bad_number"),
        (b"1,1.2.3", "bad_number"),
        (b"-1,2", "bad_number"),  # a counter
        (b"1.5,2", "bad_number"),
        (b"nan,2", "bad_number"),
        (b"1e300,2", "bad_number"),
        (b"1,\xc3\xa9", "bad_number"),
        (b"1,\xff", "non_utf8"),
        (b"1,1e999", "non_finite"),
        (b"1,-inf", "non_finite"),
        (b"1," + b"0" * LONGEST_LINE, "too_long"),
    ],
)
def test_a_line_that_is_not_as_described_is_counted(line: bytes, fault: str) -> None:
    decoder = make_decoder(lines({"counter": True}, {"channel": "q"}), None)
    samples = push(decoder, b"0,5\n" + line + b"\n", b"2,6\n")
    assert samples.values.tolist() == [[5.0], [6.0]]
    assert {kind: count for kind, count in faults(decoder).items() if kind != "lost_counter"} == {fault: 1}


def test_a_line_that_was_not_seen_from_its_beginning_is_dropped() -> None:
    """Half of -1.25 is a number too."""
    decoder = make_decoder(lines({"channel": "q"}), None)
    assert push(decoder, b"", b".25\n3\n-1", b"", b".5\n4\n").values.tolist() == [[3.0], [4.0]]
    assert faults(decoder) == {"cut_line": 2}


def test_a_checksum_is_that_of_nmea() -> None:
    decoder = make_decoder(lines({"channel": "q"}, {"channel": "tau"}, checksum="xor", separator=""), None)
    body = b"1.5  -2"
    check = b"%02X" % int(np.bitwise_xor.reduce(np.frombuffer(body, np.uint8)))
    stream = b"$" + body + b"*" + check + b"\r\n" + body + b"*" + check.lower() + b"\n" + body + b"*00\n" + body + b"\n"
    assert push(decoder, stream).values.tolist() == [[1.5, -2.0], [1.5, -2.0]]
    assert faults(decoder) == {"crc": 2}


def test_a_counter_of_steady_frames_is_a_clock() -> None:
    decoder = make_decoder(lines({"counter": True, "tick": 0.25, "wrap": 8}, {"channel": "q"}), None)
    samples = push(decoder, b"6,1\n7,1\n0,1\n2,1\n")
    assert samples.t_device.tolist() == [1.5, 1.75, 2.0, 2.5]
    assert faults(decoder) == {"lost_counter": 1}


def cuts(stream: bytes, rng: np.random.Generator) -> Sequence[bytes]:
    """The stream in pieces of 1 to 40 bytes."""
    places = np.cumsum(rng.integers(1, 40, len(stream)))
    return [stream[a:b] for a, b in zip([0, *places], places, strict=False) if a < len(stream)]


@pytest.mark.parametrize("source", [FRAMES, lines({"counter": True, "wrap": 65536}, {"channel": "q", "wrap": 6.0})])
def test_the_same_samples_however_the_bytes_come(source: SerialFrames | SerialLines) -> None:
    """A stream with corrupt bytes, whole and in pieces; seed 8."""
    rng = np.random.default_rng(8)
    if isinstance(source, SerialFrames):
        stream = bytearray(b"".join(frame(k, 100 * k, k, 0.1 * k) for k in range(400)))
    else:
        stream = bytearray(b"".join(b"%d,%.3f\n" % (k, 0.7 * k % 6.0) for k in range(400)))
    stream[:] = [byte ^ 0x81 if rng.random() < 0.002 else byte for byte in stream]
    stream[3000:3000] = b"7" * 2 * LONGEST_LINE
    whole = make_decoder(source, None)
    expected = push(whole, bytes(stream))
    parted = make_decoder(source, None)
    pieces = cuts(bytes(stream), rng)
    samples = [push(parted, *pieces[:100]), push(parted, *pieces[100:])]
    for name in ("t_device", "values"):
        got = np.concatenate([getattr(part, name) for part in samples])
        assert np.array_equal(got, getattr(expected, name), equal_nan=True)
    assert parted.counters == whole.counters
    assert faults(whole).keys() >= {"too_long", "lost_counter"}


def test_frames_of_can_are_no_bytes() -> None:
    empty = np.empty(0)
    frames = CanFrames(
        empty, empty, empty.astype("u4"), empty.astype("u1"), np.empty((0, 64), "u1"), empty.astype("u1")
    )
    with pytest.raises(TypeError, match="CanFrames"):
        make_decoder(FRAMES, None).push(frames)
