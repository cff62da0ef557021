"""Captures: what is written reads back to the bit, and bad files are distinguished from interrupted ones."""

from __future__ import annotations

import gzip
import math
import tracemalloc
from collections.abc import Iterable
from pathlib import Path

import numpy as np
import pytest

from sms_adapters.capture import BLOCK, LARGEST, CaptureReader, CaptureWriter
from sms_adapters.part import Part
from sms_adapters.sources import open_source
from sms_adapters.truth import read_truth, truth_path, write_truth
from sms_online.description.bodies import Joint
from sms_online.description.schema import System
from sms_online.errors import InputError
from sms_online.stream import Array, Block

SYSTEM = System(name="bench", joints=(Joint(),), motors=(None,), links=())


def write(path: Path, text: str) -> Path:
    path.write_bytes(text.encode())
    return path


def read(reader: CaptureReader) -> tuple[Array, Array]:
    blocks = list(reader)
    return np.concatenate([block.t for block in blocks]), np.concatenate([block.values for block in blocks])


def refusal(path: Path, **options: object) -> str:
    with pytest.raises(InputError) as error:
        list(CaptureReader(path, **options))  # type: ignore[arg-type]
    message = str(error.value)
    assert message.startswith(str(path))
    assert "\n" not in message
    return message


@pytest.fixture
def samples() -> Block:
    """Two chunks of text: doubles of every magnitude that a capture may hold, and gaps. Seed 1."""
    rng = np.random.default_rng(1)
    bits = rng.integers(0, 2**64, size=(40_000, 2), dtype=np.uint64).view(np.float64)
    values = np.where(np.abs(bits) <= LARGEST, bits, np.nan)
    values[:4, 0] = [-0.0, 5e-324, LARGEST, 0.1]
    return Block(np.cumsum(rng.uniform(1e-4, 1e-3, 40_000)), ("q_1", "tau_1"), values)


def test_every_double_of_any_sense_survives_a_capture(tmp_path: Path, samples: Block) -> None:
    path = tmp_path / "run.csv"
    with CaptureWriter(path, samples.channels) as writer:
        for part in (slice(0, 7), slice(7, None)):
            writer.write(Block(samples.t[part], samples.channels, samples.values[part]))
    reader = CaptureReader(path)
    assert reader.channels == samples.channels
    for _ in range(2):  # each iteration starts from the beginning
        t, values = read(reader)
        assert t.tobytes() == samples.t.tobytes()
        gap = np.isnan(samples.values)
        assert np.array_equal(np.isnan(values), gap)
        assert values[~gap].tobytes() == samples.values[~gap].tobytes()


def test_gzip_reads_the_same(tmp_path: Path, samples: Block) -> None:
    plain = tmp_path / "run.csv"
    with CaptureWriter(plain, samples.channels) as writer:
        writer.write(samples)
    packed = tmp_path / "run.csv.gz"
    packed.write_bytes(gzip.compress(plain.read_bytes(), compresslevel=1))
    assert np.array_equal(read(CaptureReader(packed))[1], read(CaptureReader(plain))[1], equal_nan=True)
    # A copy that broke off: the samples that can be unpacked, and a word about it.
    packed.write_bytes(packed.read_bytes()[: packed.stat().st_size // 2])
    reader = CaptureReader(packed)
    t, _ = read(reader)
    assert 10_000 < t.size < 30_000
    assert t.tobytes() == samples.t[: t.size].tobytes()
    assert any("is cut" in warning for warning in reader.warnings)
    packed.write_bytes(plain.read_bytes())
    assert "compression" in refusal(packed)


def test_blocks_are_bounded_and_progress_ends_at_the_file_size(tmp_path: Path, samples: Block) -> None:
    path = tmp_path / "run.csv"
    with CaptureWriter(path, samples.channels) as writer:
        writer.write(samples)
    consumed: list[int] = []
    blocks = list(CaptureReader(path, on_bytes=consumed.append))
    assert max(block.t.size for block in blocks) <= BLOCK
    assert sum(block.t.size for block in blocks) == samples.t.size
    assert consumed == sorted(consumed)
    assert consumed[-1] == path.stat().st_size


def test_memory_does_not_grow_with_the_file(tmp_path: Path) -> None:
    path = tmp_path / "run.csv"
    row = ",".join(["0.12345678901234567"] * 9)

    def peak(count: int) -> int:
        lines = (f"{k / 1000},{row}\n" for k in range(count))
        write(path, "t," + ",".join(f"q_{i}" for i in range(9)) + "\n" + "".join(lines))
        tracemalloc.start()  # sees Python and NumPy; Arrow's own buffers hold one chunk
        assert sum(block.t.size for block in CaptureReader(path)) == count
        _, most = tracemalloc.get_traced_memory()
        tracemalloc.stop()
        return most

    # 4 MB and 16 MB of text.
    assert peak(80_000) < 1.05 * peak(20_000)


def test_start_and_stop_count_from_the_first_sample(tmp_path: Path) -> None:
    path = write(tmp_path / "run.csv", "t,q_1\n" + "".join(f"{100 + k},{k}\n" for k in range(10)))
    t, values = read(Part(CaptureReader(path), "run.csv", 2.0, 5.0))
    assert t.tolist() == [102, 103, 104]
    assert values[:, 0].tolist() == [2, 3, 4]
    with pytest.raises(InputError, match="no samples from 20 s"):
        list(Part(CaptureReader(path), "run.csv", 20.0, None))


def test_empty_and_nan_cells_are_gaps_counted_per_channel(tmp_path: Path) -> None:
    reader = CaptureReader(write(tmp_path / "run.csv", "t,q_1,q_2,q_3\n0,,1,1\n1,nan,NaN,2\n\n2,5,6,7\n"))
    _, values = read(reader)
    assert np.array_equal(values, np.array([[np.nan, 1, 1], [np.nan, np.nan, 2], [5, 6, 7]]), equal_nan=True)
    # With one sample nobody knows how often; with two, 2 s apart, none is missing between.
    assert reader.warnings == ["run.csv: 2 of 3 cells empty or NaN in q_1, the longest hole from 0 s on"]


@pytest.mark.parametrize(
    ("lost", "warnings"),
    [
        ([], []),
        ([4], ["run.csv: 251 of 300 cells empty or NaN in q_2, the longest hole from 0.31 s on"]),
        (range(49, 50), []),  # devices do not end together
        (range(30, 50), ["run.csv: 270 of 300 cells empty or NaN in q_2, the longest hole from 2.91 s on"]),
        (range(20), ["run.csv: 270 of 300 cells empty or NaN in q_2, the longest hole from 0 s on"]),
        (range(50), ["run.csv: 300 of 300 cells empty or NaN in q_2"]),
    ],
    ids=["none", "one", "the last", "many last", "many first", "all"],
)
def test_cells_between_the_samples_of_a_slower_channel_lack_nothing(
    tmp_path: Path, lost: Iterable[int], warnings: list[str]
) -> None:
    """Five seconds of q_1 fifty times a second, and of q_2 ten times, between them."""
    rows = [f"{k / 50:.2f},1," for k in range(250)]
    rows += [f"{k / 10 + 0.01:.2f},,{'' if k in lost else 1}" for k in range(50)]
    text = "\n".join(sorted(rows, key=lambda row: float(row.split(",")[0])))
    reader = CaptureReader(write(tmp_path / "run.csv", f"t,q_1,q_2\n{text}\n"))
    read(reader)
    assert reader.warnings == warnings


@pytest.mark.parametrize("cut", ["3", "3,", "3,1", "3,1.", "3,1e-", "3,1.5"])
def test_a_cut_last_line_is_skipped_and_named(tmp_path: Path, cut: str) -> None:
    reader = CaptureReader(write(tmp_path / "run.csv", f"t,q_1\n1,1\n2,1\n{cut}"))
    t, _ = read(reader)
    assert t.tolist() == [1, 2]
    assert reader.warnings == ["run.csv: 1 line skipped, line 4 is cut (no newline at its end)"]


def test_a_repeated_time_keeps_the_first_sample(tmp_path: Path) -> None:
    reader = CaptureReader(write(tmp_path / "run.csv", "t,q_1\n1,1\n1,2\n1,3\n2,4\n"))
    t, values = read(reader)
    assert t.tolist() == [1, 2]
    assert values[:, 0].tolist() == [1, 4]
    assert reader.warnings == ["run.csv: 2 samples skipped, their time repeats the one before"]


@pytest.mark.parametrize("ending", ["\n", "\r\n"])
@pytest.mark.parametrize(
    ("line", "found"),
    [
        ("3.5,1", "line 20003: 2 cells; expected 3"),
        ("3.5,1,2,3", "line 20003: 4 cells; expected 3"),
        ("3.5,1,abc", "line 20003, column q_2: 'abc'"),
        ("3.5,1,0x10", "line 20003, column q_2: '0x10'"),
        ("3.5,1,inf", "line 20003, column q_2: 'inf'"),
        ("3.5,-1e999,1", "line 20003, column q_1: '-1e999'"),
        ("3.5,1 2,1", "line 20003, column q_1: '1 2'"),
        (",1,1", "line 20003: no time"),
        ("nan,1,1", "line 20003: no time"),
        ("-1,1,1", "line 20003: time -1 s, before"),
    ],
)
def test_a_malformed_line_is_named(tmp_path: Path, line: str, found: str, ending: str) -> None:
    # In the second chunk of text, after a blank line, which holds no sample but counts as a line.
    lines = ["t,q_1,q_2", *(f"{k * 1e-4:.17f},0.12345678901234567,0.12345678901234567" for k in range(20_000))]
    lines[10:10] = [""]
    text = ending.join([*lines, line, "5000,1,1", "5001,1,1", ""])
    assert len(text) > 2**20
    assert found in refusal(write(tmp_path / "run.csv", text))


def test_the_samples_before_a_malformed_chunk_are_out_already(tmp_path: Path) -> None:
    rows = "".join(f"{k},0.12345678901234567\n" for k in range(100_000))
    path = write(tmp_path / "run.csv", f"t,q_1\n{rows}oops\n{rows}")
    count = 0
    blocks = iter(CaptureReader(path))
    while count < 50_000:
        count += next(blocks).t.size
    with pytest.raises(InputError, match=r"line 100002: 1 cells"):
        list(blocks)


@pytest.mark.parametrize(
    ("text", "found"),
    [
        ("", "an empty file"),
        ("0,1\n1,2\n", "no header"),
        ("q_1,q_2\n0,1\n", "first column 'q_1'"),
        ("t\n0\n", "no channel"),
        ("t,q_1,q_1\n0,1,1\n", "'q_1' twice"),
        ("t,t\n0,1\n", "'t' twice"),
        ("t,q_1,\n0,1,2\n", "column 3: a column without a name"),
        ("t,q_1\n", "no samples"),
        ("t,q_1\n0,1", "no samples"),
        ("\xff\xfe", "first column"),
        ("t,q_1\n" + "1" * 3_000_000, "line 2: 1048576 bytes without an end"),
    ],
)
def test_a_file_that_is_no_capture_is_refused(tmp_path: Path, text: str, found: str) -> None:
    assert found in refusal(write(tmp_path / "run.csv", text))


def test_files_that_cannot_be_read_are_refused(tmp_path: Path) -> None:
    assert "No such file" in refusal(tmp_path / "absent.csv")
    (tmp_path / "folder.csv").mkdir()
    assert "directory" in refusal(tmp_path / "folder.csv")
    (tmp_path / "words.csv").write_bytes(b"\xff\xfet,\x00")
    assert "not text" in refusal(tmp_path / "words.csv")


def test_an_unknown_channel_is_refused_with_the_nearest_name(tmp_path: Path) -> None:
    path = write(tmp_path / "run.csv", "t,q_1,thetam_1\n0,1,1\n")
    assert "'thetam_1'; expected a channel of this system, such as 'theta_m_1'" in refusal(
        path, known=("q_1", "theta_m_1", "tau_1")
    )


def test_nothing_half_written_remains(tmp_path: Path) -> None:
    def interrupted() -> None:
        with CaptureWriter(tmp_path / "run.csv", ("q_1",)) as writer:
            writer.write(Block(np.zeros(1), ("q_1",), np.zeros((1, 1))))
            raise KeyboardInterrupt

    with pytest.raises(KeyboardInterrupt):
        interrupted()
    assert list(tmp_path.iterdir()) == []
    with pytest.raises(InputError, match=r"ending in \.csv"):
        CaptureWriter(tmp_path / "run.txt", ("q_1",))
    with pytest.raises(InputError, match="No such file"):
        CaptureWriter(tmp_path / "absent" / "run.csv", ("q_1",))


def test_the_name_chooses_the_reader(tmp_path: Path) -> None:
    path = write(tmp_path / "run.csv", "t,q_1\n0,1\n")
    assert isinstance(open_source(path, SYSTEM), CaptureReader)
    with pytest.raises(InputError, match=r"ending in \.csv, \.log, \.asc"):
        open_source(tmp_path / "run.xyz", SYSTEM)


def test_truth_survives_and_its_absence_is_no_error(tmp_path: Path) -> None:
    capture = tmp_path / "run.csv"
    assert read_truth(capture) is None
    write_truth(capture, {"joint_1.stiffness": 0.1 + 0.2}, {"grade": "A", "seed": 3})
    assert read_truth(capture) == {
        "schema": "sms-online/truth/1",
        "parameters": {"joint_1.stiffness": 0.1 + 0.2},
        "grade": "A",
        "seed": 3,
    }
    assert [path.name for path in tmp_path.iterdir()] == ["run.csv.truth.json"]
    with pytest.raises(ValueError, match="not JSON compliant"):
        write_truth(capture, {"joint_1.stiffness": math.nan}, {})


@pytest.mark.parametrize(
    "text", ["{", "[]", '{"schema": "other"}', '{"schema": "sms-online/truth/1", "parameters": 3}']
)
def test_a_broken_truth_is_refused(tmp_path: Path, text: str) -> None:
    write(truth_path(tmp_path / "run.csv"), text)
    with pytest.raises(InputError, match=r"run\.csv\.truth\.json"):
        read_truth(tmp_path / "run.csv")
