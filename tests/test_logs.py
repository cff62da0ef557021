"""Logs as labs have them: the numbers of a capture in each format, written by its own library, give the same bits."""

from __future__ import annotations

import json
from pathlib import Path
from typing import Any

import h5py
import numpy as np
import pandas as pd
import pytest
from mcap.reader import make_reader
from rosbags.rosbag2 import StoragePlugin
from scipy.io import savemat

import sms_online as sms
from sms_adapters import log_reader
from sms_adapters.files import size_of
from sms_adapters.sources import open_source
from sms_online.description.parse import parse_system, shipped_text
from sms_online.errors import InputError
from sms_tools.cli import main
from tests.bags import path_of, write_json_mcap, write_ros1, write_ros2
from tests.simulations import planar_capture

BAG, TABLE = "bag", "table"


def described(kind: str, signals: dict[str, str], further: str = "") -> sms.System:
    """The planar example with a source of a kind."""
    lines = [f'[[source]]\nkind = "{kind}"\nname = "rig"', further, "[source.signals]"]
    lines += [f'"{key}" = {value}' for key, value in signals.items()]
    return parse_system(shipped_text("paper-planar") + "\n" + "\n".join(lines), "rig.toml")


@pytest.fixture(scope="module")
def capture() -> sms.Capture:
    """Three seconds of the planar example. Seed 4."""
    return planar_capture(3.0, seed=4)


@pytest.fixture(scope="module")
def bagged(capture: sms.Capture) -> sms.System:
    return described(BAG, {path_of(name, capture.channels): f'"{name}"' for name in capture.channels})


@pytest.fixture(scope="module")
def pi(capture: sms.Capture, tmp_path_factory: pytest.TempPathFactory) -> list[float]:
    """What the capture as CSV is estimated to."""
    path = sms.write_capture(capture, tmp_path_factory.mktemp("csv") / "run.csv")
    values = [p.value for p in sms.estimate(sms.load_system("paper-planar"), path).parameters.values()]
    assert np.isfinite(values).sum() > 8
    return values


def written(capture: sms.Capture, folder: Path, form: str) -> Path:
    if form == "ros 1":
        return write_ros1(capture, folder / "run.bag")
    if form == "mcap with json":
        return write_json_mcap(capture, folder / "run.mcap")
    plugin = StoragePlugin.SQLITE3 if form == "ros 2 in sqlite" else StoragePlugin.MCAP
    bag = write_ros2(capture, folder / "bag", plugin)
    return next(bag.glob("*.mcap")) if form == "mcap with ros 2" else bag


@pytest.mark.parametrize("form", ["ros 1", "ros 2 in sqlite", "ros 2 in mcap", "mcap with ros 2", "mcap with json"])
def test_a_bag_gives_the_bits_of_the_csv(capture: sms.Capture, bagged: sms.System, tmp_path: Path, form: str) -> None:
    path = written(capture, tmp_path, form)
    read = sms.read_capture(path, bagged)
    order = [read.channels.index(name) for name in capture.channels]
    np.testing.assert_array_equal(read.values[:, order], capture.values)
    np.testing.assert_array_equal(read.t, capture.t)
    assert read.warnings == ()


def test_topics_that_are_read_at_once_wait_for_each_other(
    capture: sms.Capture, bagged: sms.System, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    # A second and more of each topic at once, and much less patience.
    monkeypatch.setattr(log_reader, "PATIENCE", 0.1)
    read = sms.read_capture(written(capture, tmp_path, "ros 2 in mcap"), bagged)
    assert read.warnings == ()
    np.testing.assert_array_equal(read.t, capture.t)


@pytest.mark.slow
def test_a_bag_is_estimated_from_as_the_csv_is(
    capture: sms.Capture, bagged: sms.System, pi: list[float], tmp_path: Path
) -> None:
    path = written(capture, tmp_path, "ros 2 in mcap")
    assert [p.value for p in sms.estimate(bagged, path).parameters.values()] == pi


def test_channels_come_with_scale_unit_gear_and_offset(tmp_path: Path) -> None:
    rig = described(
        TABLE,
        {
            "a": '{ channel = "theta_m_1", unit = "deg", scale = -2, offset = 0.25 }',
            "b": '{ channel = "tau_1", unit = "mN m", gear = 100 }',
            "c": '{ channel = "tau_2", unit = "Nm" }',
            "d": '{ channel = "omega_0_z", unit = "rpm" }',
        },
        'stamp = "clock"\nstamp_unit = "ms"',
    )
    frame = pd.DataFrame({"clock": [0.0, 1.5], "a": [90.0, 45.0], "b": [3e5, 1e5], "c": [1.0, 2.0], "d": [60.0, 30.0]})
    frame.to_csv(tmp_path / "run.csv", index=False)
    capture = sms.read_capture(tmp_path / "run.csv", rig)
    assert capture.t.tolist() == [0.0, 1.5e-3]
    assert capture.channels == ("theta_m_1", "tau_1", "tau_2", "omega_0_z")
    wanted = [[0.25 - np.pi, 3.0, 1.0, 2 * np.pi], [0.25 - np.pi / 2, 1.0, 2.0, np.pi]]
    np.testing.assert_allclose(capture.values, wanted, rtol=1e-15)


def hdf5(path: Path, capture: sms.Capture) -> dict[str, str]:
    """A dataset each, torques as columns of one, in groups. Returns the path of each channel."""
    with h5py.File(path, "w") as file:
        file["motors/t"] = capture.t
        file["motors/torque"] = capture.values[:, :2]
        for k, name in enumerate(capture.channels[2:], start=2):
            file[f"rig/{name}"] = capture.values[:, k]
    return {name: f"motors/torque[{k}]" if k < 2 else f"rig/{name}" for k, name in enumerate(capture.channels)}


def matlab_73(path: Path, capture: sms.Capture) -> dict[str, str]:
    """As MATLAB writes them: transposed, behind a block of its own."""
    with h5py.File(path, "w", userblock_size=512) as file:
        file["motors/t"] = capture.t[None]
        file["torque"] = capture.values[:, :2].T
        for k, name in enumerate(capture.channels[2:], start=2):
            file[f"rig/{name.replace('.', '_')}"] = capture.values[None, :, k]
    rig = {name: f"rig.{name.replace('.', '_')}" for name in capture.channels}
    return {name: f"torque[{k}]" if k < 2 else rig[name] for k, name in enumerate(capture.channels)}


def matlab_7(path: Path, capture: sms.Capture) -> dict[str, str]:
    rig = {f"c{k}": column[:, None] for k, column in enumerate(capture.values.T)}
    savemat(path, {"motors": {"t": capture.t}, "rig": rig, "torque": capture.values[:, :2]}, do_compression=True)
    return {name: f"torque[{k}]" if k < 2 else f"rig.c{k}" for k, name in enumerate(capture.channels)}


def parquet(path: Path, capture: sms.Capture) -> dict[str, str]:
    frame = pd.DataFrame({"motors/t": capture.t} | dict(zip(capture.channels, capture.values.T, strict=True)))
    frame.to_parquet(path, row_group_size=500)
    return {name: name for name in capture.channels}


def german(path: Path, capture: sms.Capture) -> dict[str, str]:
    """Semicolons and decimal commas beneath two lines of a program's own."""
    frame = pd.DataFrame({"motors/t": capture.t} | dict(zip(capture.channels, capture.values.T, strict=True)))
    path.write_text("Messrechner 3\n\n" + frame.to_csv(index=False, sep=";", decimal=","))
    return {name: name for name in capture.channels}


@pytest.mark.slow
@pytest.mark.parametrize(
    ("write", "name"),
    [(hdf5, "run.h5"), (matlab_73, "run.mat"), (matlab_7, "run.mat"), (parquet, "run.parquet"), (german, "run.csv")],
)
def test_a_table_gives_the_bits_of_the_csv(
    capture: sms.Capture, pi: list[float], tmp_path: Path, write: Any, name: str
) -> None:
    paths = write(tmp_path / name, capture)
    rig = described(TABLE, {path: f'"{channel}"' for channel, path in paths.items()}, 'stamp = "motors/t"')
    read = sms.read_capture(tmp_path / name, rig)
    assert read.channels == capture.channels
    np.testing.assert_array_equal(read.t, capture.t)
    np.testing.assert_array_equal(read.values, capture.values)
    assert [p.value for p in sms.estimate(rig, tmp_path / name).parameters.values()] == pi


def test_sources_of_one_file_have_stamps_of_their_own(tmp_path: Path) -> None:
    instants = "stamp = {!r}\nstamp_unit = {!r}"
    with h5py.File(tmp_path / "run.h5", "w") as file:
        file["drive/t"], file["drive/tau"] = np.arange(40_000) * 1e-3, np.arange(40_000.0)
        file["camera/t"], file["camera/x"] = np.arange(100) * 400, np.arange(100.0)
    rig = described(TABLE, {"drive/tau": '"tau_1"'}, instants.format("drive/t", "s"))
    camera = described(TABLE, {"camera/x": '"r_S_x"'}, instants.format("camera/t", "ms") + "\nlatency = 0.0005").sources
    two = rig.model_copy(update={"sources": (*rig.sources, camera[0].model_copy(update={"name": "camera"}))})
    capture = sms.read_capture(tmp_path / "run.h5", two)
    drive, seen = (capture.t[~np.isnan(column)] for column in capture.values.T)
    assert np.array_equal(drive, np.arange(40_000) * 1e-3)
    np.testing.assert_allclose(seen, 0.4 * np.arange(100) - 5e-4, atol=1e-12)
    assert (np.diff(capture.t) > 0).all()


def test_messages_that_overtake_are_put_in_order(capture: sms.Capture, bagged: sms.System, tmp_path: Path) -> None:
    # A camera's pictures are worked on for 0.3 s before their poses are published.
    path = write_json_mcap(capture, tmp_path / "run.mcap", delayed=("/base", 0.3))
    read = sms.read_capture(path, bagged)
    order = [read.channels.index(name) for name in capture.channels]
    np.testing.assert_array_equal(read.values[:, order], capture.values)


@pytest.mark.slow
def test_a_recorders_stamps_serve_where_asked(capture: sms.Capture, bagged: sms.System, tmp_path: Path) -> None:
    path = write_json_mcap(capture, tmp_path / "run.mcap", stamped=False)
    assert np.array_equal(sms.read_capture(path, bagged).t, capture.t)  # there are no others
    path = write_json_mcap(capture, tmp_path / "zero.mcap", stamp=0)
    assert "the same stamp in every message" in refusal(path, bagged)
    recorded = bagged.sources[0].model_copy(update={"stamp": "recorded"})
    assert np.array_equal(sms.read_capture(path, bagged.model_copy(update={"sources": (recorded,)})).t, capture.t)


@pytest.mark.parametrize("share", [0.5, 0.45, 0.4])
def test_an_mcap_without_an_end_is_read_as_far_as_it_goes(
    capture: sms.Capture, bagged: sms.System, tmp_path: Path, share: float
) -> None:
    path = write_json_mcap(capture, tmp_path / "run.mcap")
    path.write_bytes(path.read_bytes()[: int(share * path.stat().st_size)])
    read = sms.read_capture(path, bagged)
    assert read.warnings == ("run.mcap: its end is missing",)
    assert 0.2 * len(capture) < len(read) < 0.8 * len(capture)
    order = [read.channels.index(name) for name in capture.channels]
    np.testing.assert_array_equal(read.values[:, order][:-1], capture.values[: len(read) - 1])


def refusal(path: Path, system: sms.System) -> str:
    with pytest.raises(InputError) as caught:
        sms.read_capture(path, system)
    line = str(caught.value)
    assert line.startswith((str(path), system.name))
    assert "\n" not in line
    return line


@pytest.mark.parametrize(
    ("old", "new", "said"),
    [
        ("/base.pose.position.x", "/bose.pose.position.x", "no topic '/bose'; expected one of its topics: /base, /jo"),
        ("position[elbow]", "positions[elbow]", "no field 'positions'; expected 'header', 'name', 'position'"),
        ("position[elbow]", "position[wrist]", "topic /joint_states, position[wrist]: no number"),
        ("position[elbow]", "position[7]", "topic /joint_states, position[7]: no number"),
        ("position[elbow]", "name[0]", "name[0] is no number; expected numbers, and a time as the stamp"),
        ('"theta_0"', '{ channel = "theta_0", unit = "furlong" }', "'furlong'; expected a unit of what is measured in"),
        ('"theta_0"', '{ channel = "theta_0", unit = "smoot2x" }', "'smoot2x'; expected a unit by pint's names"),
    ],
)  # fmt: skip
def test_what_a_bag_does_not_hold_is_one_line(
    capture: sms.Capture, tmp_path: Path, old: str, new: str, said: str
) -> None:
    signals = {path_of(name, capture.channels): f'"{name}"' for name in capture.channels}
    text = "\n".join(f"{key}\t{value}" for key, value in signals.items()).replace(old, new)
    short = sms.Capture(capture.t[:50], capture.channels, capture.values[:50])
    path = write_ros2(short, tmp_path / "bag")
    assert said in refusal(path, described(BAG, dict(line.split("\t") for line in text.splitlines())))


def test_what_a_table_skips_is_counted(tmp_path: Path) -> None:
    (tmp_path / "run.csv").write_text("t,a,b\n0,1,2\n1,,2\n1,5,5\n,7,7\n2,1e40,2\n3,1,9\n")
    system = described(TABLE, {"a": '"tau_1"', "b": '{ channel = "tau_2", maximum = 8 }'})
    read = sms.read_capture(tmp_path / "run.csv", system)
    np.testing.assert_array_equal(read.values, [[1, 2], [np.nan, 2], [np.nan, 2], [1, np.nan]])
    assert read.warnings == (
        "run.csv, source rig: 1 rows skipped, they have no stamp",
        "run.csv, source rig: 1 samples skipped, their time repeats the one before",
        "run.csv, source rig: 1 of 10 cells empty, NaN or infinite",
        "run.csv, source rig: 2 values skipped, outside the limits of their channel",
    )


@pytest.mark.parametrize("separator", [";", "\t"])
def test_a_decimal_comma_may_come_after_whole_numbers(tmp_path: Path, separator: str) -> None:
    rows = [("t", "a", "Bemerkung"), ("0", "0", "an, aus"), ("0,001", "1,5", ""), ("1", "2", "")]
    (tmp_path / "run.csv").write_text("\n".join(separator.join(row) for row in rows) + "\n")
    read = sms.read_capture(tmp_path / "run.csv", described(TABLE, {"a": '"tau_1"'}))
    np.testing.assert_array_equal(read.t, [0.0, 0.001, 1.0])
    np.testing.assert_array_equal(read.values[:, 0], [0.0, 1.5, 2.0])


def test_a_header_in_another_encoding_is_read(tmp_path: Path) -> None:
    (tmp_path / "run.csv").write_bytes("t,a,Dehnung in µm/m\n0,1,2\n1,3,4\n".encode("cp1252"))
    read = sms.read_capture(tmp_path / "run.csv", described(TABLE, {"a": '"tau_1"'}))
    np.testing.assert_array_equal(read.values[:, 0], [1.0, 3.0])


def test_a_cut_last_line_of_a_table_is_warned_of(tmp_path: Path) -> None:
    (tmp_path / "run.csv").write_text("t,a\n0,1\n1,2\n2,0.0")
    read = sms.read_capture(tmp_path / "run.csv", described(TABLE, {"a": '"tau_1"'}))
    assert read.t.tolist() == [0.0, 1.0]
    assert read.warnings == ("run.csv: 1 line skipped, line 4 is cut (no newline at its end)",)


@pytest.mark.parametrize("form", ["ros 1", "ros 2 in sqlite", "ros 2 in mcap"])
def test_reading_a_bag_ends_near_its_size(capture: sms.Capture, bagged: sms.System, tmp_path: Path, form: str) -> None:
    path, consumed = written(capture, tmp_path, form), list[int]()
    list(open_source(path, bagged, on_bytes=consumed.append))
    assert consumed == sorted(consumed)
    assert 0.7 * size_of(path) < consumed[-1] <= size_of(path)


@pytest.mark.parametrize(("write", "name"), [(hdf5, "run.h5"), (parquet, "run.parquet")])
def test_reading_a_table_ends_at_its_size(capture: sms.Capture, tmp_path: Path, write: Any, name: str) -> None:
    paths, consumed = write(tmp_path / name, capture), list[int]()
    rig = described(TABLE, {path: f'"{channel}"' for channel, path in paths.items()}, 'stamp = "motors/t"')
    list(open_source(tmp_path / name, rig, on_bytes=consumed.append))
    assert consumed[-1] == size_of(tmp_path / name)


def test_a_log_without_a_meaning_of_its_columns_says_so(tmp_path: Path) -> None:
    pd.DataFrame({"t": [0.0], "a": [1.0]}).to_parquet(tmp_path / "run.parquet")
    assert "a [[source]] of kind 'table'" in refusal(tmp_path / "run.parquet", sms.load_system("paper-planar"))


def test_a_part_of_a_log_is_read(capture: sms.Capture, tmp_path: Path) -> None:
    paths = hdf5(tmp_path / "run.h5", capture)
    rig = described(TABLE, {path: f'"{channel}"' for channel, path in paths.items()}, 'stamp = "motors/t"')
    part = sms.read_capture(tmp_path / "run.h5", rig, start=0.5, stop=1.25)
    np.testing.assert_array_equal(part.t, capture.t[(capture.t >= 0.5) & (capture.t < 1.25)])


def test_a_log_is_imported_as_a_capture(capture: sms.Capture, tmp_path: Path) -> None:
    paths = hdf5(tmp_path / "run.h5", capture)
    source = '\n[[source]]\nkind = "table"\nname = "rig"\nstamp = "motors/t"\n[source.signals]\n'
    text = shipped_text("paper-planar") + source + "\n".join(f'"{path}" = "{name}"' for name, path in paths.items())
    (tmp_path / "rig.toml").write_text(text)
    arguments = ["import", "log", str(tmp_path / "run.h5"), "--system", str(tmp_path / "rig.toml")]
    assert main([*arguments, "--capture", str(tmp_path / "run.csv")]) == 0
    # A capture of the same system is one, in spite of its source of columns.
    read = sms.read_capture(tmp_path / "run.csv", tmp_path / "rig.toml")
    np.testing.assert_array_equal(read.values, capture.values)


def test_an_import_of_a_log_asks_for_its_system(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    assert main(["import", "log", str(tmp_path / "run.h5"), "--capture", str(tmp_path / "run.csv")]) == 2
    assert "import log: no --system; expected the system file" in capsys.readouterr().err


def test_a_capture_as_mcap_has_a_schema_and_every_sample(capture: sms.Capture, tmp_path: Path) -> None:
    values = capture.values.copy()
    values[1::2, 3] = np.nan
    holed = sms.Capture(capture.t - 1.5, capture.channels, values)
    path = sms.write_capture(holed, tmp_path / "run.mcap")
    with path.open("rb") as file:
        schema, channel, _ = next(iter(make_reader(file).iter_messages()))
        assert schema is not None
        assert (channel.topic, schema.encoding) == ("/channels", "jsonschema")
        marker = json.loads(schema.data)["properties"]["link_1"]["properties"]["marker_1"]["properties"]
        assert marker["u_y"] == {"type": "number"}
    signals = {f"/channels.{name}": f'"{name}"' for name in capture.channels}
    read = sms.read_capture(path, described(BAG, signals, 'stamp = "t"'))
    np.testing.assert_array_equal(read.t, holed.t)
    np.testing.assert_array_equal(read.values, values)
