"""CAN logs of all formats give the same samples; what is damaged is named, what is cut off is warned of."""

from __future__ import annotations

import gzip
from collections.abc import Callable
from pathlib import Path

import can
import numpy as np
import pytest

from sms_adapters.can_replay import CanLogReader
from sms_adapters.capture import CaptureReader
from sms_adapters.sources import open_source
from sms_online.description.bodies import Joint
from sms_online.description.schema import System
from sms_online.description.sources import CanSource
from sms_online.errors import InputError
from sms_online.stream import Array, Source

DBC = """VERSION ""

BS_:

BU_: RIG

BO_ 291 ENCODER: 8 RIG
 SG_ ANGLE : 0|32@1- (1E-06,0) [0|0] "rad" RIG

BO_ 2147483940 DRIVE: 4 RIG
 SG_ TORQUE : 0|32@1- (0.001,0) [0|0] "N m" RIG
"""
T0 = 1_600_000_000.0
COUNT = 40
WRITERS: dict[str, Callable[[Path], can.Listener]] = {
    ".log": can.CanutilsLogWriter,
    ".asc": can.ASCWriter,
    ".blf": can.BLFWriter,
    ".trc": can.TRCWriter,
    ".csv": can.CSVWriter,
    ".mf4": can.MF4Writer,
}


def source(name: str = "bus", **options: object) -> CanSource:
    signals = {"ENCODER.ANGLE": "q_1", "DRIVE.TORQUE": "tau_1"}
    table = {"kind": "can", "name": name, "dbc": "rig.dbc", "signals": signals}
    return CanSource.model_validate(table | options)


def rig(tmp_path: Path, *sources: CanSource) -> System:
    (tmp_path / "rig.dbc").write_text(DBC)
    return System(name="rig", joints=(Joint(),), motors=(None,), links=(), sources=sources or (source(),))


def messages(channels: tuple[int, ...] = (0,)) -> list[can.Message]:
    """Encoder, drive and one unknown message, each millisecond one."""
    found = []
    for k in range(COUNT):
        data = (1000 * k).to_bytes(8, "little") if k % 2 == 0 else (500 - k).to_bytes(4, "little")
        found.append(
            can.Message(
                timestamp=T0 + k * 1e-3,
                arbitration_id=0x77 if k == 5 else 0x123 if k % 2 == 0 else 0x124,
                is_extended_id=k % 2 == 1 and k != 5,
                data=data,
                channel=channels[k % len(channels)],
            )
        )
    return found


def written(tmp_path: Path, ending: str, frames: list[can.Message]) -> Path:
    path = tmp_path / f"run{ending}"
    writer = WRITERS[ending](path)
    for message in frames:
        writer(message)
    writer.stop()
    return path


def read(reader: Source) -> tuple[Array, Array]:
    blocks = list(reader)
    return np.concatenate([block.t for block in blocks]), np.concatenate([block.values for block in blocks])


@pytest.mark.parametrize("ending", list(WRITERS))
def test_every_format_gives_the_same_samples(tmp_path: Path, ending: str) -> None:
    if ending == ".mf4":
        pytest.importorskip("asammdf", reason="the extra mf4 is not installed")
    reader = open_source(written(tmp_path, ending, messages()), rig(tmp_path), directory=tmp_path)
    k = np.delete(np.arange(COUNT), 5)
    for _ in range(2):
        t, values = read(reader)
        # Float seconds at this epoch are good to 0.24 µs.
        assert np.abs(t - k * 1e-3).max() < 1e-6
        expected = np.full((k.size, 2), np.nan)
        expected[k % 2 == 0, 0] = k[k % 2 == 0] * 1000 * 1e-6
        expected[k % 2 == 1, 1] = (500 - k[k % 2 == 1]) * 0.001
        assert np.array_equal(values, expected, equal_nan=True)
        assert reader.warnings == [f"run{ending}: 1 frames skipped, no channel comes from their ids (077)"]


def test_text_is_read_compressed_and_in_parts_with_progress(tmp_path: Path) -> None:
    path = written(tmp_path, ".asc", messages())
    packed = tmp_path / "run.asc.gz"
    packed.write_bytes(gzip.compress(path.read_bytes()))
    consumed: list[int] = []
    t, _ = read(open_source(packed, rig(tmp_path), 0.0095, 0.0195, consumed.append, tmp_path))
    assert t == pytest.approx(np.arange(10, 20) * 1e-3, abs=1e-6)
    assert consumed[-1] == packed.stat().st_size
    binary = written(tmp_path, ".blf", messages())
    read(open_source(binary, rig(tmp_path), on_bytes=consumed.append, directory=tmp_path))
    assert consumed[-1] == binary.stat().st_size


def test_a_capture_is_known_by_its_header(tmp_path: Path) -> None:
    path = tmp_path / "run.csv"
    path.write_text("t,q_1\n0.0,1.0\n")
    assert isinstance(open_source(path, rig(tmp_path)), CaptureReader)
    path = written(tmp_path, ".csv", messages())
    assert isinstance(open_source(path, rig(tmp_path), directory=tmp_path), CanLogReader)


def test_each_source_takes_the_frames_of_its_interface(tmp_path: Path) -> None:
    """One message on two buses: two drives of one make."""
    frames = [message for message in messages() if message.arbitration_id == 0x123]
    for k, message in enumerate(frames):
        message.channel = k % 2
    path = written(tmp_path, ".blf", frames)
    with pytest.raises(InputError, match="ENCODER on 1 and 0; expected a message on one interface"):
        list(CanLogReader(path, rig(tmp_path), directory=tmp_path))
    left = source("left", channel="0", signals={"ENCODER.ANGLE": "q_1"})
    right = source("right", channel="1", signals={"ENCODER.ANGLE": "theta_m_1"})
    reader = CanLogReader(path, rig(tmp_path, left, right), directory=tmp_path)
    t, values = read(reader)
    assert reader.channels == ("q_1", "theta_m_1")
    assert (np.diff(t) > 0).all()
    angle = np.arange(0, COUNT, 2) * 1000 * 1e-6
    assert values[::2, 0].tolist() == angle[::2].tolist()
    assert values[1::2, 1].tolist() == angle[1::2].tolist()
    assert np.isnan(values).sum() == len(frames)


@pytest.mark.parametrize("ending", [".asc", ".trc", ".csv"])
def test_a_cut_last_line_is_left_out_and_warned_of(tmp_path: Path, ending: str) -> None:
    frames = messages()
    path = written(tmp_path, ending, frames)
    text = path.read_bytes()
    whole = [line for line in text.splitlines(keepends=True) if not line.startswith((b"End", b"//"))]
    path.write_bytes(b"".join(whole)[:-4])
    reader = open_source(path, rig(tmp_path), directory=tmp_path)
    assert read(reader)[0].size == COUNT - 2  # the unknown one, and the last
    assert reader.warnings[-1].endswith("is cut (no newline at its end)")


def test_a_cut_blf_is_read_as_far_as_it_goes_and_warned_of(tmp_path: Path) -> None:
    path = written(tmp_path, ".blf", messages())
    whole = path.read_bytes()
    path.write_bytes(whole[:-150])
    reader = open_source(path, rig(tmp_path), directory=tmp_path)
    assert 0 < read(reader)[0].size < COUNT - 1
    assert reader.warnings[-1] == f"run.blf: its end is missing, {len(whole) - 150} bytes of {len(whole)} are there"


def test_a_blf_with_an_object_of_no_size_comes_to_an_end(tmp_path: Path) -> None:
    path = tmp_path / "run.blf"
    writer = can.BLFWriter(path, compression_level=0)
    writer(messages()[0])
    writer.stop()
    content = path.read_bytes()
    size = content.rindex(b"LOBJ") + 8
    path.write_bytes(content[:size] + bytes(4) + content[size + 4 :])
    with pytest.raises(InputError, match="more frames than it has room for"):
        list(open_source(path, rig(tmp_path), directory=tmp_path))


@pytest.mark.parametrize(
    ("ending", "old", "new", "found"),
    [
        (".csv", "0x123,0", "0x123", "line 2"),
        (".csv", "0x123", "0x1230000000", "identifier 1230000000"),
        (".csv", "0x123", "-0x123", "identifier -123"),
        (".trc", " 0123 ", " 01x3 ", "line "),
        (".asc", "timestamps absolute", "timestamps relative", "header: timestamps relative; expected"),
        (".csv", "1600000000.001", "1500000000.001", "frame 2: a time before that of the frame above"),
        (".csv", "1600000000.001", "nan", "frame 2: identifier 124 at nan s"),
    ],
)
def test_a_bad_line_is_named(tmp_path: Path, ending: str, old: str, new: str, found: str) -> None:
    path = written(tmp_path, ending, messages())
    text = path.read_text()
    assert old in text
    path.write_text(text.replace(old, new, 1))
    with pytest.raises(InputError) as caught:
        list(open_source(path, rig(tmp_path), directory=tmp_path))
    assert found in str(caught.value)
    assert "\n" not in str(caught.value)


@pytest.mark.parametrize("ending", [".blf", ".mf4", ".asc", ".trc"])
@pytest.mark.parametrize("content", [b"", b"LOGG", b"\xff" * 200, b"nothing of the kind\n" * 20])
def test_another_file_is_refused(tmp_path: Path, ending: str, content: bytes) -> None:
    path = tmp_path / f"run{ending}"
    path.write_bytes(content)
    with pytest.raises(InputError) as caught:
        list(open_source(path, rig(tmp_path), directory=tmp_path))
    assert "\n" not in str(caught.value)


def test_an_ending_that_no_reader_knows_is_refused(tmp_path: Path) -> None:
    with pytest.raises(InputError, match=r"a name ending in \.csv, \.log, \.asc"):
        open_source(tmp_path / "run.blf.gz", rig(tmp_path))
