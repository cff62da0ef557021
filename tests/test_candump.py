"""CAN logs: array decoding equals cantools' own, and every frame is either a sample or counted."""

from __future__ import annotations

import gzip
import math
import random
from pathlib import Path

import can
import cantools.database
import numpy as np
import pytest
from cantools.database.can import Database, Message
from numpy.typing import NDArray

from sms_adapters.can_replay import CanLogReader
from sms_adapters.can_signals import decode_signal
from sms_adapters.sources import open_source
from sms_online.description.bodies import Joint
from sms_online.description.schema import System
from sms_online.description.sources import CanSource, Signal
from sms_online.errors import InputError
from sms_online.stream import Array

DATA = Path(__file__).parents[2] / "shared" / "data" / "ak80_pendulum"

# Two messages, one with an extended id: words of both byte orders, signed, across bytes, and an IEEE float.
DBC = """VERSION ""

BS_:

BU_: RIG

BO_ 291 ENCODERS: 8 RIG
 SG_ MOTOR : 7|24@0- (1E-05,0) [0|0] "rad" RIG
 SG_ JOINT : 24|24@1- (2.5E-06,0.125) [0|0] "rad" RIG
 SG_ FLAGS : 51|7@0+ (1,-3) [0|0] "" RIG
 SG_ TICK : 56|5@1+ (3,0) [0|0] "" RIG

BO_ 2147488001 DRIVE: 7 RIG
 SG_ CURRENT : 3|12@0- (0.00061035156,-0.01) [0|0] "A" RIG
 SG_ TORQUE : 21|32@1- (1,0) [0|0] "N m" RIG

BO_ 292 STRAIN: 4 RIG
 SG_ GAUGE : 0|32@1- (1,0) [0|0] "rad" RIG

SIG_VALTYPE_ 292 GAUGE : 1;
"""
ENCODERS, DRIVE = "123", "00001101"
T0 = 1_600_000_000


def wired(signals: dict[str, str]) -> dict[str, Signal]:
    return {name: Signal(channel=channel) for name, channel in signals.items()}


def rig(tmp_path: Path, signals: dict[str, str] | None = None, dbc: str = "rig.dbc") -> System:
    (tmp_path / "rig.dbc").write_text(DBC)
    signals = signals or {"ENCODERS.MOTOR": "theta_m_1", "DRIVE.CURRENT": "tau_1", "ENCODERS.JOINT": "q_1"}
    source = CanSource(kind="can", name="bus", dbc=dbc, signals=wired(signals))
    return System(name="rig", joints=(Joint(),), motors=(None,), links=(), sources=(source,))


def described(dbc: str, name: str) -> Message:
    database = cantools.database.load_string(dbc, "dbc")
    assert isinstance(database, Database)
    return database.get_message_by_name(name)


def decoded(message: Message, signal: str, frames: NDArray[np.uint8]) -> list[object]:
    """cantools' own values, frame by frame."""
    values = [message.decode(bytes(row)) for row in frames]
    return [value[signal] for value in values if isinstance(value, dict)]


def reader(tmp_path: Path, text: str, **options: object) -> CanLogReader:
    path = tmp_path / "run.log"
    path.write_text(text)
    return CanLogReader(path, rig(tmp_path), directory=tmp_path, **options)  # type: ignore[arg-type]


def read(source: CanLogReader) -> tuple[Array, Array]:
    blocks = list(source)
    return np.concatenate([block.t for block in blocks]), np.concatenate([block.values for block in blocks])


def frame(microseconds: int, id_: str, data: str, interface: str = "can0") -> str:
    return f"({T0 + microseconds // 10**6}.{microseconds % 10**6:06d}) {interface} {id_}#{data}\n"


@pytest.mark.parametrize("name", ["ENCODERS", "DRIVE", "STRAIN"])
def test_arrays_decode_as_cantools_does(name: str) -> None:
    """Random frames, seed 2."""
    message = described(DBC, name)
    frames = np.random.default_rng(2).integers(0, 256, (500, message.length), dtype=np.uint8)
    if name == "STRAIN":
        frames[:, 3] &= 0x3F  # below NaN and infinity
    for signal in message.signals:
        assert decode_signal(signal, frames).tolist() == decoded(message, signal.name, frames)


def test_random_layouts_decode_as_cantools_does() -> None:
    """300 signals of 1 to 53 bits anywhere in 8 bytes, in both orders, seed 3."""
    rng = random.Random(3)
    frames = np.random.default_rng(3).integers(0, 256, (20, 8), dtype=np.uint8)
    for _ in range(300):
        length = rng.randint(1, 53)
        first = rng.randint(0, 64 - length)  # in the order's own count of bits
        big = rng.random() < 0.5
        start = 8 * (first // 8) + 7 - first % 8 if big else first
        text = (
            'VERSION ""\n\nBS_:\n\nBU_: R\n\nBO_ 5 M: 8 R\n'
            f' SG_ S : {start}|{length}@{0 if big else 1}{rng.choice("+-")} (0.37,-1.5) [0|0] "" R\n'
        )
        message = described(text, "M")
        assert decode_signal(message.signals[0], frames).tolist() == decoded(message, "S", frames), text


def test_each_frame_gives_its_own_channels(tmp_path: Path) -> None:
    log = frame(0, "7FF", "") + frame(250, ENCODERS, "0003E8" + "900100" + "0000")
    source = reader(tmp_path, log + frame(1000250, DRIVE, "0100" + "0000000000"))
    t, values = read(source)
    assert source.channels == ("theta_m_1", "tau_1", "q_1")
    assert t.tolist() == [0.00025, 1.00025]  # since the first frame of any kind
    current = 256 * 0.00061035156 - 0.01
    assert np.array_equal(
        values, [[1000 * 1e-5, np.nan, 400 * 2.5e-6 + 0.125], [np.nan, current, np.nan]], equal_nan=True
    )
    assert source.warnings == ["run.log: 1 frames skipped, no channel comes from their ids (7FF)"]


def test_times_are_exact_to_the_microsecond(tmp_path: Path) -> None:
    stamps = np.cumsum(np.random.default_rng(4).integers(1, 2000, 5000))
    t, _ = read(reader(tmp_path, "".join(frame(stamp, ENCODERS, "00" * 8) for stamp in stamps.tolist())))
    assert t.tolist() == [(stamp - stamps[0]) * 1000 / 10**9 for stamp in stamps.tolist()]


def test_python_can_and_candump_variants_read_alike(tmp_path: Path) -> None:
    path = tmp_path / "run.log"
    with can.CanutilsLogWriter(path) as writer:
        for k in range(3):
            data = bytes([0, 0, k, 0, 0, 0, 0, 0])
            writer(can.Message(T0 + k, arbitration_id=0x123, is_extended_id=False, data=data, channel="can0"))
    expected = read(CanLogReader(path, rig(tmp_path), directory=tmp_path))
    lines = path.read_text().splitlines()
    lines[1] = lines[1].rsplit(" ", 1)[0].replace("123#", "123##1") + "\r"  # CAN FD, no direction, DOS line end
    path.write_bytes("\n".join([*lines, ""]).encode())
    for got, want in zip(read(CanLogReader(path, rig(tmp_path), directory=tmp_path)), expected, strict=True):
        assert np.array_equal(got, want, equal_nan=True)
    assert expected[1][:, 0].tolist() == [0.0, 1e-5, 2e-5]


def test_gzip_blocks_progress_and_window(tmp_path: Path) -> None:
    text = "".join(frame(1000 * k, ENCODERS, f"{k:06X}0000000000") for k in range(60_000))  # three chunks of text
    path = tmp_path / "run.log.gz"
    path.write_bytes(gzip.compress(text.encode(), compresslevel=1))
    consumed: list[int] = []
    source = open_source(path, rig(tmp_path), 10.0, 50.0, consumed.append, directory=tmp_path)
    for _ in range(2):
        blocks = list(source)
        assert max(block.t.size for block in blocks) <= 16384
        values = np.concatenate([block.values for block in blocks])
        assert np.array_equal(values[:, 0], np.arange(10_000, 50_000) * 1e-5)
    whole = list(open_source(path, rig(tmp_path), on_bytes=consumed.append, directory=tmp_path))
    assert sum(block.t.size for block in whole) == 60_000
    assert consumed[-1] == path.stat().st_size


def test_what_is_skipped_is_counted(tmp_path: Path) -> None:
    good = "00" * 8
    source = reader(
        tmp_path,
        frame(0, ENCODERS, good)
        + frame(0, ENCODERS, good)  # two frames, one stamp
        + frame(1, ENCODERS, good[2:])  # too short
        + frame(2, ENCODERS, "R8")  # asks for data, brings none
        + frame(3, "00000123", good)  # the extended id of the same number
        + frame(3, "20000004", good)  # an error frame of the controller
        + frame(4, ENCODERS, good)
        + frame(5, ENCODERS, good)[:-4],
    )
    t, _ = read(source)
    assert t.tolist() == [0.0, 4e-6]
    assert source.warnings == [
        "run.log: 1 error frames, the bus or its controller reports trouble",
        "run.log: 1 remote frames skipped, they ask for data and hold none",
        "run.log: 1 frames skipped, no channel comes from their ids (00000123)",
        "run.log: 1 frames skipped, their length is not the described one",
        "run.log: 1 frames skipped, their time repeats that of their message's last one",
        "run.log: 1 line skipped, line 8 is cut (no newline at its end)",
    ]


@pytest.mark.parametrize(
    ("line", "found"),
    [
        ("(1600000100.000000) can0 123#00000\n", "line 30003: '(1600000100.000000) can0 123#00000'"),
        ("(1600000100.000000) can0 123#zz\n", "line 30003"),
        ("1600000100.000000 can0 123#00\n", "line 30003"),
        ("(1600000100.000000) can0 1234#00\n", "line 30003"),
        ("gibberish\n", "line 30003: 'gibberish'; expected (seconds) interface id#data"),
        (frame(0, ENCODERS, ""), "line 30003: a time before that of the line above"),
        (frame(10**8, ENCODERS, "00" * 8, "can1"), "ENCODERS on can1 and can0; expected a message on one interface"),
    ],
)
def test_a_bad_line_is_named(tmp_path: Path, line: str, found: str) -> None:
    text = "\n\n" + "".join(frame(1 + k, ENCODERS, "00" * 8) for k in range(30_000)) + line
    with pytest.raises(InputError) as error:
        list(reader(tmp_path, text + frame(2 * 10**8, ENCODERS, "00" * 8)))
    assert found in str(error.value)
    assert "\n" not in str(error.value)


@pytest.mark.parametrize(
    ("signals", "dbc", "found"),
    [
        (
            None,
            "absent.dbc",
            "no file 'absent.dbc'; expected a file beside the system file, or a shipped one: ak80.dbc",
        ),
        (None, "broken.dbc", "a readable DBC"),
        ({"ENCODER.MOTOR": "q_1"}, "rig.dbc", "such as 'ENCODERS.MOTOR'"),
        ({"ENCODERS.MOTR": "q_1"}, "rig.dbc", "such as 'ENCODERS.MOTOR'"),
    ],
)
def test_a_source_that_does_not_fit_its_dbc_is_refused(
    tmp_path: Path, signals: dict[str, str] | None, dbc: str, found: str
) -> None:
    (tmp_path / "broken.dbc").write_text("BO_ what\n")
    path = tmp_path / "run.log"
    path.write_text(frame(0, ENCODERS, "00" * 8))
    with pytest.raises(InputError) as error:
        CanLogReader(path, rig(tmp_path, signals, dbc), directory=tmp_path)
    assert found in str(error.value)
    assert "\n" not in str(error.value)


def test_a_log_without_dbc_or_frames_is_refused(tmp_path: Path) -> None:
    path = tmp_path / "run.log"
    path.write_text(frame(0, "7FF", "00"))
    bare = System(name="bench", joints=(Joint(),), motors=(None,), links=())
    with pytest.raises(InputError, match="a CAN log without a DBC"):
        CanLogReader(path, bare)
    with pytest.raises(InputError, match="no samples; expected frames of ENCODERS, DRIVE"):
        list(CanLogReader(path, rig(tmp_path), directory=tmp_path))
    path.write_text("")
    with pytest.raises(InputError, match="empty file"):
        CanLogReader(path, rig(tmp_path), directory=tmp_path)


@pytest.mark.skipif(not DATA.is_dir(), reason="the AK80 pendulum's measurements are not at hand (shared/data)")
@pytest.mark.parametrize(("run", "count"), [("energy_shaping", 4000), ("gravity_compensation", 30000)])
def test_ak80_words_equal_the_published_numbers(run: str, count: int) -> None:
    signals = {
        f"AK80_REPLY.{name}": channel
        for name, channel in zip(
            ("POSITION", "VELOCITY", "TORQUE", "MOTOR_ID"), ("theta_m_1", "rate", "tau_1", "id"), strict=True
        )
    }
    source = CanSource(kind="can", name="drive", dbc="ak80.dbc", signals=wired(signals))
    system = System(name="ak80", joints=(Joint(),), motors=(None,), links=(), sources=(source,))
    published = np.loadtxt(DATA / f"{run}.csv", delimiter=",", skiprows=1)
    t, values = read(CanLogReader(DATA / f"{run}.log", system))
    assert t.size == len(published) == count
    assert np.all(values[:, 3] == 1)
    assert np.abs(t - published[:, 0]).max() < 0.6e-6  # the log's microseconds
    for column, full_scale in enumerate((95.5, 45.0, 18.0)):
        # The published numbers are raw * range / steps, the DBC's raw * (range / steps): one rounding apart.
        assert np.abs(values[:, column] - published[:, 1 + column]).max() <= math.ulp(full_scale)
