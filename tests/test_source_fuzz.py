"""Whatever comes over a wire or is in a file: no crash, no hang, no memory without bound, everything counted.

The suite draws a few hundred examples of each kind; the same with a million frames, lines and pieces is marked long.
"""

from __future__ import annotations

import pickle
import re
import struct
import zlib
from collections.abc import Callable
from pathlib import Path

import can
import numpy as np
import pytest
from cobs import cobs
from hypothesis import HealthCheck, given, settings
from hypothesis import strategies as st

from sms_adapters.can_decoder import CanDecoder
from sms_adapters.can_replay import open_log
from sms_adapters.devices import make_can_decoder, make_decoder
from sms_adapters.raw import ERROR_FRAME, EXTENDED, FD_FRAME, REMOTE_FRAME, CanFrames, Decoder, SerialChunk
from sms_adapters.serial_decoder import LONGEST_LINE
from sms_adapters.sources import open_source
from sms_online.description.bodies import Joint
from sms_online.description.schema import System
from sms_online.description.sources import CanSource, FrameField, SerialField, SerialFrames, SerialLines
from sms_online.errors import InputError

DBC = """VERSION ""

BS_:

BU_: RIG

BO_ 1 A: 8 RIG
 SG_ COUNT : 0|4@1+ (1,0) [0|0] "" RIG
 SG_ ANGLE : 4|12@1+ (1,0) [0|0] "" RIG
 SG_ REAL : 32|32@1- (1,0) [0|0] "" RIG

BO_ 2147483650 B: 3 RIG
 SG_ WORD : 7|24@0- (0.1,2) [0|0] "" RIG

SIG_VALTYPE_ 1 REAL : 1;
"""
CAN = CanSource.model_validate(
    {
        "kind": "can",
        "name": "bus",
        "dbc": "rig.dbc",
        "counters": ["A.COUNT"],
        "signals": {
            "A.ANGLE": {"channel": "q_1", "wrap": 4096},
            "A.REAL": {"channel": "theta_m_1", "minimum": -1e6, "maximum": 1e6},
            "B.WORD": "tau_1",
        },
    }
)
FIELDS = (
    FrameField(type="u8", counter=True),
    FrameField(type="u16", tick=1e-3),
    FrameField(type="f64", channel="q_1", wrap=6.28),
    FrameField(type="f32", channel="tau_1"),
)
FRAMES = SerialFrames(kind="serial", name="s", port="x", format="frames", fields=FIELDS)
LINES = SerialLines(
    kind="serial",
    name="s",
    port="x",
    format="lines",
    fields=(SerialField(counter=True, tick=1e-3, wrap=256), SerialField(channel="q_1", wrap=6.28)),
)
# More than any decoder holds: its description, turns, counts and an unfinished line.
MOST_STATE = 2 * LONGEST_LINE

small = settings(max_examples=150, deadline=None, suppress_health_check=[HealthCheck.function_scoped_fixture])
raw_frame = st.tuples(
    st.sampled_from([1, 0x80000002, 2, 0x7FF, 0xFFFFFFFF]) | st.integers(0, 2**32 - 1),
    st.binary(max_size=64),
    st.integers(0, 7) | st.just(0),
    st.floats(0, 1e9) | st.just(np.nan),
)
number = st.floats().map(lambda x: str(x).encode()) | st.integers(-10, 300).map(lambda x: str(x).encode())
line = st.lists(number, min_size=1, max_size=3).map(b",".join) | st.binary(max_size=40)


def framed(payload: bytes) -> bytes:
    return bytes(cobs.encode(payload + struct.pack("<I", zlib.crc32(payload)))) + b"\0"


piece = (
    st.binary(min_size=15, max_size=15).map(framed)
    | st.binary(max_size=30).map(framed)
    | st.binary(max_size=40)
    | st.just(b"\0")
)
# A line of candump -l, as its documentation and its source have it; at most 64 bytes, 64 letters of an interface.
CANDUMP = re.compile(
    rb"\((\d{1,10})\.(\d{1,9})\) ([!-\xff]{1,64}) ([0-9A-Fa-f]{3}|[0-9A-Fa-f]{8})#"
    rb"(?:#[0-9A-Fa-f])?(?:(R)[0-9A-Fa-f]?|((?:[0-9A-Fa-f]{2}){0,64}))(?: [RT])?\r?"
)
word = st.sampled_from(b"()#. 0123456789abcRT\r\tx".decode()).map(str.encode)
candump_line = st.tuples(
    st.sampled_from([b"(", b"", b"(("]),
    st.sampled_from([b"0", b"1600000000", b"9999999999", b"16000000000", b"x"]),
    st.sampled_from([b".", b"", b".."]),
    st.sampled_from([b"5", b"000001", b"123456789", b"1234567890", b""]),
    st.sampled_from([b") ", b")", b" ", b")  "]),
    st.sampled_from([b"can0", b"vcan0.1", b"a#b", b"", b"c" * 70, b"c\t", b"\xc3\xa9"]),
    st.sampled_from([b" ", b"", b"  "]),
    st.sampled_from([b"123", b"1FFFFFFF", b"2000abcd", b"12", b"1234", b"xyz", b""]),
    st.sampled_from([b"#", b"##1", b"##", b"##x", b"#R", b"#R8", b"#Rx", b""]),
    st.binary(max_size=9).map(lambda x: x.hex().encode())
    | st.sampled_from([b"0", b"00" * 64, b"00" * 65, b"0g", b"0011 R"]),
    st.sampled_from([b"", b" R", b" T", b" X", b"\r", b" R\r", b" "]),
)
# Mostly as they should be: of eleven parts, each is drawn wrong in a few lines only.
RIGHT = (b"(", b"1600000000", b".", b"000001", b") ", b"can0", b" ", b"123", b"#", b"00ff", b"")
log_line = (
    st.tuples(st.integers(0, 10**9), st.integers(0, 2**29), st.binary(max_size=9)).map(
        lambda x: b"(%d.5) can0 %03X#%s" % (x[0], x[1], x[2].hex().encode())
    )
    | st.binary(max_size=60)
    | st.text("()#. 0123456789abcR\t", max_size=40).map(str.encode)
)


def can_decoder(directory: Path) -> CanDecoder:
    (directory / "rig.dbc").write_text(DBC)
    return make_can_decoder(CAN, directory)


def can_frames(drawn: list[tuple[int, bytes, int, float]]) -> CanFrames:
    count = len(drawn)
    data = np.frombuffer(b"".join(row[1].ljust(64, b"\0") for row in drawn), np.uint8).reshape(count, 64)
    return CanFrames(
        np.zeros(count),
        np.array([row[3] for row in drawn], dtype=np.float64),
        np.array([row[0] for row in drawn], dtype=np.uint32),
        np.array([len(row[1]) for row in drawn], dtype=np.uint8),
        data,
        np.array([row[2] for row in drawn], dtype=np.uint8),
    )


def check(decoder: Decoder, chunks: list[bytes]) -> None:
    """Push bytes as they are and see that samples are finite or NaN and that little is kept."""
    for chunk in chunks:
        samples = decoder.push(SerialChunk(0.0, chunk))
        assert not np.isinf(samples.values).any()
        assert np.isfinite(samples.t_device).all()
        assert not np.isnan(samples.values).all(axis=1).any()
        assert len(pickle.dumps(decoder)) < MOST_STATE
    assert min(decoder.counters.values()) >= 0


def read_or_refused(read: Callable[[], object]) -> None:
    """It ends, and what is refused is refused in one line."""
    try:
        read()
    except InputError as error:
        said = str(error)
    else:
        said = ""
    assert "\n" not in said


@small
@given(st.lists(raw_frame, min_size=1, max_size=30))
def test_any_frames(tmp_path: Path, drawn: list[tuple[int, bytes, int, float]]) -> None:
    decoder = can_decoder(tmp_path)
    raw = can_frames(drawn)
    samples = decoder.push(raw)
    assert not np.isinf(samples.values).any()
    unused = (
        "error_frame",
        "remote",
        "unknown_id",
        "wrong_length",
        "repeated_time",
        "repeated_counter",
        "late_counter",
    )
    dropped = sum(decoder.counters[kind] for kind in unused)
    refused = len(raw) - dropped - samples.t_arrival.size  # frames whose every value was
    assert 0 <= refused <= decoder.counters["non_finite"] + decoder.counters["out_of_range"]


@small
@given(st.lists(st.lists(piece, max_size=5).map(b"".join), max_size=8))
def test_any_bytes_as_frames(chunks: list[bytes]) -> None:
    check(make_decoder(FRAMES, None), chunks)


@small
@given(st.lists(st.lists(line, max_size=5).map(b"\n".join) | st.binary(max_size=9), max_size=8))
def test_any_bytes_as_lines(chunks: list[bytes]) -> None:
    check(make_decoder(LINES, None), chunks)
    check(make_decoder(LINES.model_copy(update={"checksum": "xor", "separator": ""}), None), chunks)


@small
@given(st.lists(log_line, max_size=8).map(b"\n".join), st.sampled_from([".log", ".asc", ".trc", ".csv", ".blf"]))
def test_any_file_is_read_or_refused(tmp_path: Path, text: bytes, ending: str) -> None:
    can_decoder(tmp_path)
    system = System(name="rig", joints=(Joint(),), motors=(None,), links=(), sources=(CAN,))
    path = tmp_path / f"run{ending}"
    header = {".csv": b"timestamp,arbitration_id,extended,remote,error,dlc,data\n", ".trc": b";$FILEVERSION=1.1\n"}
    path.write_bytes(header.get(ending, b"") + text + b"\n")
    read_or_refused(lambda: list(open_source(path, system, directory=tmp_path)))


@settings(small, max_examples=250)
@given(candump_line, st.sets(st.integers(0, 10), max_size=3), st.lists(word, max_size=1))
def test_candump_lines_are_those_of_the_grammar(
    tmp_path: Path, parts: tuple[bytes, ...], drawn: set[int], extra: list[bytes]
) -> None:
    line = b"".join([*(parts[k] if k in drawn else RIGHT[k] for k in range(11)), *extra])
    match = CANDUMP.fullmatch(line)
    if match is not None and int(match[1]) * 10**9 >= 2**63 - 10**9:
        match = None  # no whole nanoseconds of 64 bits
    path = tmp_path / "run.log"
    path.write_bytes(line + b"\n" + b"".join(RIGHT).replace(b"16", b"92") + b"\n")
    if match is None and line.rstrip(b"\r"):
        with pytest.raises(InputError, match="line 1"):
            list(open_log(path))
        return
    (logged,) = open_log(path)
    assert len(logged.frames) == 2 - (match is None)
    if match is not None:
        frames, id_ = logged.frames, int(match[4], 16)
        error = len(match[4]) == 8 and bool(id_ & 1 << 29)
        assert frames.id[0] == (id_ & (1 << 29) - 1 | EXTENDED if len(match[4]) == 8 else id_)
        assert frames.flags[0] == error * ERROR_FRAME | bool(match[5]) * REMOTE_FRAME | (b"##" in line) * FD_FRAME
        asked = frames.data[0, : frames.length[0]]
        # A remote frame has no data; its length is that of the frame it asks for.
        data = b"\0" * asked.size if match[5] else bytes.fromhex((match[6] or b"").decode())
        assert bytes(asked) == data
        assert logged.buses[0] == match[3].decode("utf-8", "replace")
        between = 9200000000 * 10**9 + 1000 - int(match[1]) * 10**9 - int(match[2].ljust(9, b"0"))
        assert frames.arrival[1] == float(between) / 1e9


@small
@given(st.binary(max_size=8), st.integers(0, 2000), st.integers(1, 255))
def test_any_damage_to_a_blf(tmp_path: Path, extra: bytes, place: int, change: int) -> None:
    path = tmp_path / "run.blf"
    with can.BLFWriter(path, compression_level=0) as writer:
        for k in range(20):
            writer(can.Message(timestamp=1.6e9 + k, arbitration_id=1, is_extended_id=False, data=bytes([k] * 8)))
    content = bytearray(path.read_bytes())
    content[place % len(content)] ^= change
    path.write_bytes(bytes(content) + extra)
    read_or_refused(lambda: list(open_log(path)))


@pytest.mark.long
def test_a_million_frames_lines_and_pieces(tmp_path: Path) -> None:
    """Random frames of known and unknown messages, and streams in which one in a few pieces is sound; seed 11."""
    rng = np.random.default_rng(11)
    decoder = can_decoder(tmp_path)
    for _ in range(1000):
        n = 1000
        raw = CanFrames(
            np.zeros(n),
            rng.random(n),
            rng.choice(np.array([1, 0x80000002, 3], dtype=np.uint32), n),
            rng.choice(np.array([8, 3, 0, 64], dtype=np.uint8), n, p=[0.6, 0.3, 0.05, 0.05]),
            rng.integers(0, 256, (n, 64), dtype=np.uint8),
            rng.choice(np.array([0, 1, 2, 4], dtype=np.uint8), n, p=[0.9, 0.03, 0.03, 0.04]),
        )
        assert not np.isinf(decoder.push(raw).values).any()
    frames, lines = make_decoder(FRAMES, None), make_decoder(LINES, None)
    for _ in range(2000):
        payloads = [rng.bytes(15) for _ in range(500)]
        sound = [framed(payload) for payload in payloads]
        check(frames, [b"".join(sound), rng.bytes(20_000)])
        text = b"".join(b"%d,%r\n" % (k % 256, value) for k, value in enumerate((rng.random(500) * 6).tolist()))
        check(lines, [text, bytes(rng.choice(np.frombuffer(b"0123456789.,-e\nx\xff", np.uint8), 20_000).tobytes())])
