"""Recordings: readable by others, complete after a kill, and the session again when replayed."""

from __future__ import annotations

import os
import signal
import subprocess
import sys
import time
from dataclasses import replace
from pathlib import Path
from types import SimpleNamespace

import can
import numpy as np
import pytest

from sms_adapters import recorder as recorder_module
from sms_adapters.raw import ERROR_FRAME, EXTENDED, FD_FRAME, MOST_BYTES, REMOTE_FRAME, CanFrames, SerialChunk
from sms_adapters.recorded import recorded_at
from sms_adapters.recorder import Recorder, being_recorded
from sms_adapters.recording import Recording
from sms_adapters.session_log import RULES, SESSION, RecordedItems, SessionHeader, header_text, read_header
from sms_adapters.sources import open_source
from sms_online.capture import Capture
from sms_online.errors import InputError
from sms_online.stream import Array
from sms_online.trackers.parse import parse_tracker
from sms_tools.cli import main
from sms_tools.results_file import results_directory
from tests.axis import AXIS, capture_lines
from tests.bus_streams import AxisBus, axis_testbed, merged

EPOCH = 1_700_000_000_123_456
HEADER = SessionHeader(EPOCH, {"drive": "can", "encoder": "serial"}, 0.0, {"numpy": np.__version__})


def some_frames(count: int) -> CanFrames:
    """Frames of every kind, one a millisecond."""
    random = np.random.default_rng(1)
    flags = np.array([0, REMOTE_FRAME, ERROR_FRAME, FD_FRAME], dtype=np.uint8)[np.arange(count) % 4]
    length = np.where(flags == FD_FRAME, 12, 8).astype(np.uint8)
    data = random.integers(0, 256, (count, MOST_BYTES)).astype(np.uint8)
    data[np.arange(MOST_BYTES) >= np.where(flags == REMOTE_FRAME, 0, length)[:, None]] = 0
    id_ = np.where(np.arange(count) % 8 < 4, 0x123, 0x123 | EXTENDED).astype(np.uint32)
    arrival = np.array([1000 * k * 1e-6 for k in range(count)])
    stamp: Array = np.rint(arrival * 1e6 + 17) * 1e-6
    return CanFrames(arrival, stamp, id_, length, data, flags)


def test_a_recording_under_other_rules_says_that_it_differs(tmp_path: Path) -> None:
    system = axis_testbed(tmp_path)

    def warnings(directory: Path) -> str:
        return " ".join(Recording(directory, system, tmp_path).warnings)

    for rules in (RULES, RULES + 1):
        Recorder(tmp_path / f"{rules}", replace(HEADER, rules=rules)).close(1.0)
    assert "another version" not in warnings(tmp_path / f"{RULES}")
    assert "another version" in warnings(tmp_path / f"{RULES + 1}")
    # The first ones had no number.
    session = tmp_path / f"{RULES}" / "session.toml"
    session.write_text(session.read_text().replace(f"rules = {RULES}\n", ""))
    assert "another version" in warnings(tmp_path / f"{RULES}")


def recorded(directory: Path, frames: CanFrames, chunks: list[SerialChunk]) -> None:
    recorder = Recorder(directory, HEADER)
    for k in range(0, len(frames), 7):
        recorder.put("drive", [frames[k : k + 7]], dropped=False)
    recorder.put("encoder", chunks, dropped=False)
    recorder.close(1.0)


def test_a_recording_holds_the_trackers_asked_for(tmp_path: Path) -> None:
    asked = parse_tracker("kalman:drift=learned"), parse_tracker("rls:forgetting=exponential,memory=5")
    for directory, header in (("with", replace(HEADER, trackers=asked)), ("without", HEADER)):
        (tmp_path / directory).mkdir()
        (tmp_path / directory / SESSION).write_text(header_text(header))
        assert (
            recorded_at(tmp_path / directory, Capture.from_arrays(np.zeros(1), {"q_1": np.zeros(1)})).trackers
            == header.trackers
        )


def test_what_was_recorded_is_read_back_to_the_bit(tmp_path: Path) -> None:
    frames = some_frames(3000)
    chunks = [SerialChunk(0.25, b""), SerialChunk(0.25, bytes(range(256))), SerialChunk(123456.789012, b"x")]
    recorded(tmp_path / "run", frames, chunks)
    header, ending = read_header(tmp_path / "run")
    assert header == HEADER
    assert ending == {"duration_s": 1.0, "unrecorded": 0, "warnings": []}
    back = [item for item in RecordedItems(tmp_path / "run", "drive", "can", EPOCH) if isinstance(item, CanFrames)]
    for name in ("arrival", "stamp", "length", "data", "flags"):
        np.testing.assert_array_equal(np.concatenate([getattr(part, name) for part in back]), getattr(frames, name))
    # An error frame's identifier is its class of error; candump knows no length of identifiers there.
    plain = frames.flags != ERROR_FRAME
    np.testing.assert_array_equal(np.concatenate([part.id for part in back])[plain], frames.id[plain])
    assert list(RecordedItems(tmp_path / "run", "encoder", "serial", EPOCH)) == chunks


def test_python_can_reads_the_frames_with_their_utc(tmp_path: Path) -> None:
    frames = some_frames(40)
    recorded(tmp_path / "run", frames, [])
    with can.LogReader(tmp_path / "run" / "drive.log") as reader:
        messages = list(reader)
    assert len(messages) == 40
    for k, message in enumerate(messages):
        assert message.timestamp == pytest.approx(EPOCH * 1e-6 + k * 1e-3, abs=1e-6)
        if frames.flags[k] in (0, FD_FRAME):
            assert message.data == frames.data[k, : frames.length[k]].tobytes()
            assert message.arbitration_id == int(frames.id[k]) & ~EXTENDED
            assert message.is_extended_id == bool(frames.id[k] & EXTENDED)
        assert message.is_remote_frame == (frames.flags[k] == REMOTE_FRAME)


def test_a_recording_replayed_gives_the_blocks_of_the_session(tmp_path: Path) -> None:
    system = axis_testbed(tmp_path)
    bus = AxisBus(seconds=6.0, drift=(2e-5, -3e-5), offset=0.3)
    drive, encoder = bus.drive(), bus.encoder(system)
    merger, live = merged(system, tmp_path, drive, encoder)
    recorded(tmp_path / "run", drive, encoder)
    source = open_source(tmp_path / "run", system, directory=tmp_path)
    replayed = list(source)
    assert source.channels == merger.channels
    assert source.warnings == merger.warnings
    assert len(replayed) == len(live)
    for a, b in zip(replayed, live, strict=True):
        assert a.t.tobytes() == b.t.tobytes()
        assert a.values.tobytes() == b.values.tobytes()
    # A part counts from the session's start.
    part = np.concatenate([block.t for block in open_source(tmp_path / "run", system, 2.0, 4.5, directory=tmp_path)])
    whole = np.concatenate([block.t for block in live])
    np.testing.assert_array_equal(part, whole[(whole >= 2.0) & (whole < 4.5)])


def test_dropped_items_are_recorded_and_left_out_of_the_replay(tmp_path: Path) -> None:
    frames = some_frames(100)
    recorder = Recorder(tmp_path / "run", HEADER)
    for k in range(0, 100, 10):
        recorder.put("drive", [frames[k : k + 10]], dropped=k in (30, 40, 70))
    recorder.close(0.1)
    assert len((tmp_path / "run" / "drive.log").read_text().splitlines()) == 100
    back = [item.arrival for item in RecordedItems(tmp_path / "run", "drive", "can", EPOCH)]
    kept = np.concatenate((np.arange(30), np.arange(50, 70), np.arange(80, 100)))
    np.testing.assert_array_equal(np.concatenate(back), frames.arrival[kept])


@pytest.mark.realtime
def test_after_a_kill_at_most_a_second_is_missing(tmp_path: Path) -> None:
    program = f"""
import sys, time
import numpy as np
from pathlib import Path
from sms_adapters.raw import SerialChunk
from sms_adapters.recorder import Recorder, being_recorded
from sms_adapters.session_log import SessionHeader
recorder = Recorder(Path({str(tmp_path / "run")!r}), SessionHeader({EPOCH}, {{"encoder": "serial"}}, 0.0, {{}}))
start = time.monotonic()
while True:
    t = round((time.monotonic() - start) * 1e6) * 1e-6
    recorder.put("encoder", [SerialChunk(t, b"abc")], dropped=False)
    print(t, flush=True)
    time.sleep(0.005)
"""
    process = subprocess.Popen([sys.executable, "-c", program], stdout=subprocess.PIPE, text=True)
    assert process.stdout is not None
    while (last := float(process.stdout.readline())) < 1.5:
        pass
    os.kill(process.pid, signal.SIGKILL)
    process.stdout.close()
    process.wait()
    _, ending = read_header(tmp_path / "run")
    assert ending is None
    items = list(RecordedItems(tmp_path / "run", "encoder", "serial", EPOCH))
    assert last - items[-1].arrival < 1.0
    assert all(isinstance(item, SerialChunk) and item.data == b"abc" for item in items)


def test_a_torn_last_line_is_left_out(tmp_path: Path) -> None:
    recorded(tmp_path / "run", some_frames(10), [])
    log = tmp_path / "run" / "drive.log"
    log.write_bytes(log.read_bytes()[:-9])
    items = RecordedItems(tmp_path / "run", "drive", "can", EPOCH)
    assert sum(len(item) for item in items if isinstance(item, CanFrames)) == 9
    assert items.cut


def test_the_replay_of_a_recording_warns_of_a_cut_line(tmp_path: Path) -> None:
    system = axis_testbed(tmp_path)
    bus = AxisBus(seconds=2.0)
    recorder = Recorder(tmp_path / "run", HEADER)
    recorder.put("drive", [bus.drive()], dropped=False)
    recorder.put("encoder", bus.encoder(system), dropped=False)
    recorder.close(2.0)
    recording = Recording(tmp_path / "run", system, tmp_path)
    list(recording)
    assert "cut" not in " ".join(recording.warnings)
    log = tmp_path / "run" / "encoder.serial"
    log.write_bytes(log.read_bytes()[:-1])
    list(recording)
    assert "encoder.serial: the last line is cut (no newline at its end) and left out" in recording.warnings


def test_a_full_disk_is_named_and_writing_resumes(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    room = [60]
    write = os.write

    def limited(descriptor: int, data: bytes) -> int:
        if room[0] <= 0:
            raise OSError(28, "No space left on device")
        written = write(descriptor, data[: room[0]])
        room[0] -= written
        return written

    monkeypatch.setattr(recorder_module, "os", SimpleNamespace(**{**vars(os), "write": limited}))
    recorder = Recorder(tmp_path / "run", HEADER)
    chunks = [SerialChunk(1000 * k * 1e-6, b"0123456789") for k in range(10)]
    recorder.put("encoder", chunks[:5], dropped=False)
    until(lambda: recorder.problem is not None)
    assert recorder.problem == "No space left on device"
    room[0] = 1 << 20
    recorder.put("encoder", chunks[5:], dropped=False)
    until(lambda: recorder.problem is None)
    recorder.close(1.0)
    assert recorder.unrecorded == 5
    items = list(RecordedItems(tmp_path / "run", "encoder", "serial", EPOCH))
    # The line that the disk took half of is whole.
    assert items == [*chunks[:2], *chunks[5:]]


def test_a_disk_that_does_not_answer_blocks_nobody(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(recorder_module, "MOST_WAITING", 100)
    recorder = Recorder(tmp_path / "run", HEADER)
    monkeypatch.setattr(recorder, "_write_waiting", lambda: time.sleep(0.01))
    for k in range(150):
        recorder.put("encoder", [SerialChunk(k * 1e-3, b"x")], dropped=False)
    assert recorder.unrecorded == 50
    assert recorder.problem == "the disk is too slow"


def test_a_directory_that_holds_a_recording_is_not_written_over(tmp_path: Path) -> None:
    recorded(tmp_path / "run", some_frames(1), [])
    with pytest.raises(InputError, match="a recording that is there already"):
        Recorder(tmp_path / "run", HEADER)


def test_what_is_no_recording_is_refused(tmp_path: Path) -> None:
    system = axis_testbed(tmp_path)
    with pytest.raises(InputError, match="No such file"):
        Recording(tmp_path, system)
    (tmp_path / "session.toml").write_text('schema = "other/1"\n')
    with pytest.raises(InputError, match="expected a document of schema sms-online/recording/1"):
        Recording(tmp_path, system)
    recorder = Recorder(tmp_path / "run", SessionHeader(EPOCH, {"drive": "can"}, 0.0, {}))
    recorder.close(0.0)
    with pytest.raises(InputError, match="expected those of the system: drive, encoder"):
        Recording(tmp_path / "run", system)


def until(condition: object, patience: float = 5.0) -> None:
    """Wait for what another thread does."""
    assert callable(condition)
    end = time.monotonic() + patience
    while not condition():
        assert time.monotonic() < end
        time.sleep(0.01)


def test_nothing_else_goes_into_a_running_sessions_folder(tmp_path: Path) -> None:
    recorder = Recorder(tmp_path / "run", HEADER)
    with pytest.raises(InputError, match="the folder of a session that runs"):
        results_directory(tmp_path / "run")
    recorder.close(1.0)
    assert results_directory(tmp_path / "run") == tmp_path / "run"


@pytest.mark.parametrize("verb", ["replay", "diagnose", "validate", "check", "show"])
def test_no_verb_writes_into_a_running_sessions_folder(
    tmp_path: Path, capsys: pytest.CaptureFixture[str], verb: str
) -> None:
    (tmp_path / "axis.toml").write_text(AXIS)
    (tmp_path / "run.csv").write_text("\n".join(capture_lines()) + "\n")
    recorder = Recorder(tmp_path / "run", HEADER)
    before = sorted((tmp_path / "run").iterdir())
    read = ["--rerun", "save"] if verb == "show" else [str(tmp_path / "run.csv")]
    assert main([verb, *read, "--system", str(tmp_path / "axis.toml"), "--out", str(tmp_path / "run")]) == 2
    assert "the folder of a session that runs" in capsys.readouterr().err
    assert sorted((tmp_path / "run").iterdir()) == before
    recorder.close(1.0)


@pytest.mark.realtime
def test_a_killed_sessions_folder_is_free(tmp_path: Path) -> None:
    program = (
        "import time; from pathlib import Path; from sms_adapters.recorder import Recorder; "
        "from sms_adapters.session_log import SessionHeader; "
        "recorder = Recorder(Path('run'), SessionHeader(0, {}, 0.0, {})); print('recording', flush=True); "
        "time.sleep(60)"
    )
    process = subprocess.Popen([sys.executable, "-c", program], cwd=tmp_path, stdout=subprocess.PIPE, text=True)
    assert process.stdout is not None
    assert process.stdout.readline() == "recording\n"
    assert being_recorded(tmp_path / "run")
    process.kill()
    process.wait()
    assert results_directory(tmp_path / "run") == tmp_path / "run"
