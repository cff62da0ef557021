"""Files of motion captures become captures of points, in metres, under the names of the system's markers."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest
from numpy.testing import assert_allclose

from sms_adapters.camera_capture import import_points
from sms_adapters.sources import open_source
from sms_online.description.bodies import Marker
from sms_online.description.schema import System
from sms_online.errors import InputError
from sms_online.stream import Array
from tests.one_link import one_link

# m; the second marker is not seen in the second frame.
POINTS = np.array([[[0.3, 0.1, 0.0], [1.0, 0.2, 0.5]], [[0.31, 0.11, 0], [np.nan] * 3], [[0.32, 0.12, 0], [1, 0, 0]]])
CHANNELS = ("link_1.marker_1.x", "link_1.marker_1.y", "link_1.marker_2.x", "link_1.marker_2.y")

# The header of a Motive export, as its documentation shows it.
MOTIVE = """Format Version,1.23,Take Name,bench,Capture Frame Rate,100.000000,Length Units,Meters

,Type,Marker,Marker,Marker,Marker,Marker,Marker
,Name,arm:elbow,arm:elbow,arm:elbow,arm:tip,arm:tip,arm:tip
,ID,1,1,1,2,2,2
,,Position,Position,Position,Position,Position,Position
Frame,Time (Seconds),X,Y,Z,X,Y,Z
0,0.000000,0.3,0.1,0.0,1.0,0.2,0.5
1,0.010000,0.31,0.11,0.0,,,
2,0.020000,0.32,0.12,0.0,1,0,0
"""
# That of an ASCII export of Nexus.
VICON = """Trajectories
100
,,arm:elbow,,,arm:tip,,
Frame,Sub Frame,X,Y,Z,X,Y,Z
,,mm,mm,mm,mm,mm,mm
1,0,300,100,0,1000,200,500
2,0,310,110,0,,,
3,0,320,120,0,1000,0,0
"""


@pytest.fixture
def system() -> System:
    """A bench of one link with two markers that have names."""
    bench = one_link("linear")
    markers = (Marker(name="elbow", position=(0.3, 0.0, 0.0)), Marker(name="tip", position=(1.0, 0.0, 0.0)))
    link = bench.links[0].model_copy(update={"markers": markers})
    return bench.model_copy(update={"links": (link,), "sensors": ()})


def imported(source: Path, system: System) -> Array:
    capture = source.with_name("points.csv")
    samples, warnings, _ = import_points(source, system, capture)
    assert samples == 3
    assert warnings == []
    (block,) = open_source(capture, system)
    assert block.channels == CHANNELS
    assert_allclose(block.t, [0.0, 0.01, 0.02], atol=1e-9)
    return block.values


@pytest.mark.parametrize("text", [MOTIVE, VICON], ids=["Motive", "Vicon"])
def test_a_csv_export_is_read(text: str, system: System, tmp_path: Path) -> None:
    source = tmp_path / "take.csv"
    source.write_text(text, encoding="utf-8")
    assert_allclose(imported(source, system), POINTS[..., :2].reshape(3, -1), atol=1e-12)


def test_a_c3d_file_is_read(system: System, tmp_path: Path) -> None:
    ezc3d = pytest.importorskip("ezc3d", reason="the extra logs is not installed")
    file = ezc3d.c3d()
    file["parameters"]["POINT"]["RATE"]["value"] = [100.0]
    file["parameters"]["POINT"]["UNITS"]["value"] = ["mm"]
    file["parameters"]["POINT"]["LABELS"]["value"] = ["arm:elbow", "arm:tip"]
    points = np.ones((4, 2, 3))
    points[:3] = 1e3 * POINTS.transpose(2, 1, 0)
    file["data"]["points"] = points
    file.write(str(tmp_path / "take.c3d"))
    # The format keeps single precision.
    assert_allclose(imported(tmp_path / "take.c3d", system), POINTS[..., :2].reshape(3, -1), rtol=1e-6)


@pytest.mark.parametrize(
    ("old", "new", "message"),
    [
        ("Trajectories", "Devices", r"line 1: 'Devices'; expected 'Format Version' \(Motive\)"),
        (",,mm,", ",,inch,", "unit: 'inch'; expected one of m, "),
        ("310", "3l0", "line 7: '3l0'; expected a number"),
        ("arm:elbow,,,arm:tip", "arm:a,,,arm:b", "markers arm:a, arm:b; expected those of one-link: elbow, tip"),
    ],
)
def test_a_file_that_does_not_fit_is_one_clear_line(
    old: str, new: str, message: str, system: System, tmp_path: Path
) -> None:
    source = tmp_path / "take.csv"
    source.write_text(VICON.replace(old, new), encoding="utf-8")
    with pytest.raises(InputError, match=message):
        import_points(source, system, tmp_path / "points.csv")
