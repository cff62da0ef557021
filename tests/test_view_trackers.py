"""Trackers in the view: a curve with its band for each, innovations with theirs, memory."""

from __future__ import annotations

import json
from itertools import product
from pathlib import Path

import numpy as np
import pytest
import rerun as rr

import sms_online as sms
from sms_tools.cli import main
from sms_tools.view.known import BOUNDS
from tests.axis import AXIS, axis_block
from tests.recordings import columns, scalars

WINDOW, RLS = "rls:forgetting=window,memory=2", "rls"
PARAMETERS = ("link_1.inertia", "viscous_friction@joint_1.damping")
LABELS = ("1_rls_window_2_s", "2_rls")


@pytest.fixture(scope="module")
def folder(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A replay of the axis with two trackers."""
    folder = tmp_path_factory.mktemp("trackers")
    (folder / "axis.toml").write_text(AXIS, encoding="utf-8")
    block = axis_block(coulomb=0.0)
    capture = sms.Capture.from_arrays(block.t, dict(zip(block.channels, block.values.T, strict=True)))
    sms.write_capture(capture, folder / "run.csv")
    options = ["--system", str(folder / "axis.toml"), "--out", str(folder), "--rerun", "save"]
    assert main(["replay", str(folder / "run.csv"), *options, "--tracker", WINDOW, "--tracker", RLS]) == 0
    return folder


def drawn(folder: Path, entity: str) -> np.ndarray:
    return scalars(folder / "session.rrd", entity)[1]


@pytest.mark.slow
def test_each_tracker_has_a_curve_with_its_band(folder: Path) -> None:
    document = json.loads((folder / "results.json").read_text(encoding="utf-8"))
    for label, tracker in zip(LABELS, document["trackers"], strict=True):
        inertia = tracker["parameters"][0]
        entity = f"/trackers/{inertia['name']}/{label}"
        assert drawn(folder, f"{entity}/value")[-1] == pytest.approx(inertia["estimate"])
        above, below = drawn(folder, f"{entity}/two_sigma")[-1]
        assert above - below == pytest.approx(2.0 * BOUNDS * inertia["std"])


@pytest.mark.slow
def test_curves_of_one_tracker_have_one_colour(folder: Path) -> None:
    colors: dict[str, set[int]] = {label: set() for label in LABELS}
    for label, name in product(LABELS, PARAMETERS):
        (described, *_) = columns(folder / "session.rrd", f"/trackers/{rr.escape_entity_path_part(name)}/{label}/value")
        colors[label].update(described["SeriesLines:colors"])
    assert [len(each) for each in colors.values()] == [1, 1]
    assert colors[LABELS[0]] != colors[LABELS[1]]


@pytest.mark.slow
def test_health_has_innovations_with_their_band_and_memory(folder: Path) -> None:
    document = json.loads((folder / "results.json").read_text(encoding="utf-8"))
    for label, tracker in zip(LABELS, document["trackers"], strict=True):
        expected = np.log10([tracker["nis"], tracker["nis_lower"], tracker["nis_upper"]])
        np.testing.assert_allclose(drawn(folder, f"/health/innovations/{label}")[-1], expected)
        assert drawn(folder, f"/health/memory/{label}")[-1] == pytest.approx(tracker["memory_s"])
    short, whole = (drawn(folder, f"/health/memory/{label}")[-1] for label in LABELS)
    assert short < 0.5 * whole


@pytest.mark.slow
def test_one_tracker_has_no_curves_of_its_own(folder: Path, tmp_path: Path) -> None:
    options = ["--system", str(folder / "axis.toml"), "--out", str(tmp_path), "--rerun", "save", "-to", "5"]
    assert main(["replay", str(folder / "run.csv"), *options]) == 0
    assert columns(tmp_path / "session.rrd", f"/trackers/{PARAMETERS[0]}/1_kalman_learned/value") == []
    assert drawn(tmp_path, "/health/innovations/1_kalman_learned").shape[1] == 3
