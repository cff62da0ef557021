"""Logs that are damaged, or not what the system file says: one line each, or a warning that counts what is left out."""

from __future__ import annotations

import json
from pathlib import Path

import numpy as np
import pandas as pd
import pytest
from mcap.writer import Writer

import sms_online as sms
from tests.test_logs import BAG, TABLE, described, refusal


@pytest.mark.parametrize(
    ("text", "said"),
    [
        ("t,a\n0,1\n1,x\n", "line 3, column a: 'x'; expected a number or nothing"),
        ("t,a\n0,1\n1\n", "line 3: 1 cells; expected 2, as in the header"),
        ("t,b\n0,1\n", "no column 'a'; expected one of its columns: t, b"),
        ("t,a,a\n0,1,2\n", "line 1: column 'a' twice; expected it once"),
        ("0,1\n1,1\n", "no header with a column 't', line 1 is '0,1'; expected names with commas, semicolons or tabs"),
        ("t a\n0 1\n", "no header with a column 't', line 1 is 't a'; expected names with commas, semicolons or tabs"),
        ("\x00\r\x9f,\r\n\x80\r,\x00\n", "no header with a column 't'"),
        ("t,a\n0,1\n1\r2,1\n", "line 3"),
        ("t,a\n0,1\n2,1\n1,1\n", "row 3 has the time 1 s, before that of the row above"),
        ("t,a\n1700000000000.5,1\n", "a stamp of 1.7e+12 s; expected seconds, or stamp_unit"),
        ("t,a\n0,\n1,\n", "source rig, a: no number"),
        ("t,a\n", "no rows with a stamp"),
    ],
)
def test_a_malformed_table_is_one_line(tmp_path: Path, text: str, said: str) -> None:
    (tmp_path / "run.csv").write_text(text)
    assert said in refusal(tmp_path / "run.csv", described(TABLE, {"a": '"tau_1"'}))


def whole_stamps(path: Path) -> None:
    if path.suffix == ".csv":
        path.write_text("t,a\n1700000000001,1\n,2\n1700000000003,3\n")
        return
    stamps = pd.array([1700000000001, None, 1700000000003], dtype="Int64")
    dates = pd.to_datetime(stamps.astype("float64"), unit="ms") if path.stem == "dates" else stamps
    pd.DataFrame({"t": dates, "a": [1.0, 2.0, 3.0]}).to_parquet(path)


@pytest.mark.parametrize("name", ["run.csv", "run.parquet", "dates.parquet"])
def test_rows_without_a_whole_stamp_are_left_out(tmp_path: Path, name: str) -> None:
    whole_stamps(tmp_path / name)
    system = described(TABLE, {"a": '"tau_1"'}, 'stamp_unit = "ms"')
    read = sms.read_capture(tmp_path / name, system)
    np.testing.assert_allclose(read.t, [0.0, 0.002], atol=1e-12)
    assert read.values[:, 0].tolist() == [1.0, 3.0]
    assert read.warnings == (f"{name}, source rig: 1 rows skipped, they have no stamp",)


def test_whole_stamps_in_another_unit_are_refused(tmp_path: Path) -> None:
    # Taken as s, their ns overflow.
    (tmp_path / "run.csv").write_text("t,a\n1700000000000000000,1\n1700000000001000000,2\n")
    said = refusal(tmp_path / "run.csv", described(TABLE, {"a": '"tau_1"'}))
    assert 'a stamp of 1.7e+18 s; expected seconds, or stamp_unit = "ms"' in said


def test_a_damaged_table_is_one_line(tmp_path: Path) -> None:
    path, count = tmp_path / "run.parquet", 50_000
    pd.DataFrame({"t": np.arange(count) * 1e-3, "a": np.arange(1.0 * count)}).to_parquet(path)
    content = path.read_bytes()
    path.write_bytes(bytes(6000) + content[6000:])
    assert "expected a Parquet file without damage" in refusal(path, described(TABLE, {"a": '"tau_1"'}))


MAGIC = b"\x89MCAP0\r\n"


@pytest.mark.parametrize(
    ("content", "said"),
    [
        (b"", "no topic"),
        (MAGIC, "no topic"),
        (MAGIC + bytes(200) + MAGIC, "expected a bag without damage"),
        (b"no bag at all", "expected a bag without damage"),
    ],
)
def test_a_damaged_mcap_is_one_line(tmp_path: Path, content: bytes, said: str) -> None:
    (tmp_path / "run.mcap").write_bytes(content)
    assert said in refusal(tmp_path / "run.mcap", described(BAG, {"/base.x": '"r_S_x"'}))


def messages(path: Path, sent: list[tuple[int, dict[str, object]]]) -> Path:
    """An MCAP file of JSON messages of the topic /base: the time of their recording, ns, and what they say."""
    with path.open("wb") as file:
        writer = Writer(file)
        writer.start()
        schema = writer.register_schema("rig", "jsonschema", b'{"type": "object"}')
        channel = writer.register_channel("/base", "json", schema)
        for at, message in sent:
            writer.add_message(channel, at, json.dumps(message).encode(), at)
        writer.finish()
    return path


@pytest.mark.parametrize(
    ("path", "said"),
    [
        ("/base.pose[0]", "pose[0] is no entry of a list; expected numbers"),
        ("/base.x[0]", "x[0] is no entry of a list; expected numbers"),
        ("/base.pose", "pose is no number; expected numbers"),
    ],
)
def test_a_path_into_another_kind_is_one_line(tmp_path: Path, path: str, said: str) -> None:
    bag = messages(tmp_path / "run.mcap", [(0, {"pose": {"x": 1.0}, "x": 2.0})])
    assert said in refusal(bag, described(BAG, {path: '"r_S_x"'}))


def test_a_first_message_without_a_clock_is_left_out(tmp_path: Path) -> None:
    day = 1_700_000_000
    sent = [(day * 1_000_000_000 + k, {"stamp": {"sec": day + k if k else 0, "nsec": 0}, "x": k}) for k in range(5)]
    read = sms.read_capture(
        messages(tmp_path / "run.mcap", [(at + k * 10**9, m) for k, (at, m) in enumerate(sent)]),
        described(BAG, {"/base.x": '"r_S_x"'}, 'stamp = "stamp"'),
    )
    assert read.t.tolist() == [0.0, 1.0, 2.0, 3.0]
    assert read.values[:, 0].tolist() == [1.0, 2.0, 3.0, 4.0]
    assert read.warnings == ("run.mcap, topic /base: 1 samples skipped, their stamps cannot be true",)
