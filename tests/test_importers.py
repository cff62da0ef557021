"""Importers: the measured arrays of a published .mat, and only those, in SI units on one clock."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import numpy as np
import pytest
from scipy.io import loadmat, savemat

from sms_adapters.capture import CaptureReader
from sms_adapters.importers import import_emps, import_quanser
from sms_online.errors import InputError
from sms_online.stream import Array

DATA = Path(__file__).parents[2] / "shared" / "data"
EMPS = DATA / "emps" / "DATA_EMPS.mat"
QUANSER = DATA / "quanser_2dsfl" / "lqr_full_10deg.mat"


def read(capture: Path) -> tuple[Array, dict[str, Array]]:
    reader = CaptureReader(capture)
    blocks = list(reader)
    values = np.concatenate([block.values for block in blocks])
    return np.concatenate([block.t for block in blocks]), dict(zip(reader.channels, values.T, strict=True))


def emps() -> dict[str, Any]:
    t = np.arange(50.0) * 1e-3
    return {"t": t, "qm": 0.1 * t, "vir": 1 - t, "gtau": 35.0, "qg": 0 * t}


def quanser() -> dict[str, Any]:
    t = 82.174 + 0.002 * np.arange(40)
    rng = np.random.default_rng(5)
    names = ("data_Im1", "data_Im2", "data_th11", "data_th12", "data_th21", "data_th22")
    tables = {name: np.column_stack([t, rng.normal(size=(40, 2))]) for name in names}
    return {**tables, "Ktg1": 9.0, "Ktg2": 0.9, "Kg1": 100, "Kg2": 50}


def test_emps_is_force_and_measured_position(tmp_path: Path) -> None:
    data = emps()
    savemat(tmp_path / "in.mat", data)
    assert import_emps(tmp_path / "in.mat", tmp_path / "out.csv") == 50
    t, channels = read(tmp_path / "out.csv")
    assert np.array_equal(t, data["t"])
    assert list(channels) == ["force_1", "q_1"]
    assert np.array_equal(channels["force_1"], 35.0 * data["vir"])
    assert np.array_equal(channels["q_1"], data["qm"])


def test_quanser_is_motor_torque_hub_and_strain(tmp_path: Path) -> None:
    data = quanser()
    savemat(tmp_path / "in.mat", data)
    assert import_quanser(tmp_path / "in.mat", tmp_path / "out.csv") == 40
    t, channels = read(tmp_path / "out.csv")
    assert t.tolist() == [round(0.002 * k, 9) for k in range(40)]
    assert list(channels) == ["tau_1", "theta_m_1", "link_1.strain_angle", "tau_2", "theta_m_2", "link_2.strain_angle"]
    for i, (torque_constant, gear) in enumerate(((9.0, 100.0), (0.9, 50.0)), start=1):
        hub, deflection = np.deg2rad(data[f"data_th{i}1"][:, 2]), np.deg2rad(data[f"data_th{i}2"][:, 2])
        np.testing.assert_allclose(gear * channels[f"tau_{i}"], torque_constant * data[f"data_Im{i}"][:, 2], rtol=1e-14)
        np.testing.assert_allclose(channels[f"theta_m_{i}"], hub, rtol=1e-14)
        np.testing.assert_allclose(channels[f"link_{i}.strain_angle"], deflection, rtol=1e-13)


@pytest.mark.parametrize("name", ["t", "qm", "vir", "gtau"])
def test_emps_names_the_missing_variable(tmp_path: Path, name: str) -> None:
    data = emps()
    del data[name]
    savemat(tmp_path / "in.mat", data)
    with pytest.raises(InputError, match=f"no variable '{name}'"):
        import_emps(tmp_path / "in.mat", tmp_path / "out.csv")
    assert not (tmp_path / "out.csv").exists()


@pytest.mark.parametrize(
    ("name", "value", "found"),
    [
        ("data_th21", np.zeros((40, 2)), r"shape \(40, 2\); expected 40 x 3"),
        ("data_Im2", np.zeros((40, 3)), "other times than data_Im1"),
        ("Kg1", np.nan, "NaN or infinity; expected finite numbers"),
        ("Ktg2", "strong", "expected a number"),
    ],
)
def test_quanser_names_the_wrong_variable(tmp_path: Path, name: str, value: object, found: str) -> None:
    savemat(tmp_path / "in.mat", {**quanser(), name: value})
    with pytest.raises(InputError, match=f"variable '{name}'.*{found}"):
        import_quanser(tmp_path / "in.mat", tmp_path / "out.csv")


def test_what_is_no_mat_file_is_refused(tmp_path: Path) -> None:
    with pytest.raises(InputError, match="No such file"):
        import_emps(tmp_path / "absent.mat", tmp_path / "out.csv")
    for content in (b"", b"t,q_1\n" * 100, b"\x89HDF\r\n\x1a\n" + bytes(600)):
        (tmp_path / "in.mat").write_bytes(content)
        with pytest.raises(InputError, match=r"in\.mat"):
            import_quanser(tmp_path / "in.mat", tmp_path / "out.csv")
    savemat(tmp_path / "in.mat", {**emps(), "t": np.zeros(50)})
    with pytest.raises(InputError, match="times that do not increase"):
        import_emps(tmp_path / "in.mat", tmp_path / "out.csv")


@pytest.mark.skipif(not EMPS.is_file(), reason="the EMPS measurements are not at hand (shared/data)")
def test_the_measured_emps(tmp_path: Path) -> None:
    assert import_emps(EMPS, tmp_path / "out.csv") == 24841
    t, channels = read(tmp_path / "out.csv")
    assert np.abs(t - np.arange(24841) * 1e-3).max() < 5e-8
    steps = channels["q_1"] / 5e-8
    assert np.abs(steps - np.round(steps)).max() < 1e-6


@pytest.mark.skipif(not QUANSER.is_file(), reason="the Quanser measurements are not at hand (shared/data)")
def test_the_measured_quanser_agrees_with_its_log_in_radians(tmp_path: Path) -> None:
    assert import_quanser(QUANSER, tmp_path / "out.csv") == 10_000
    t, channels = read(tmp_path / "out.csv")
    assert t[0] == 0
    assert t[-1] == 19.998
    data = loadmat(QUANSER, squeeze_me=True, struct_as_record=False)
    for i, name in ((1, "stage1_X1_meas"), (2, "stage2_X2_sim")):  # the second label is swapped in the file
        logged = data[name].signals.values[-10_000:]
        assert np.abs(channels[f"theta_m_{i}"] - logged[:, 0]).max() < 1e-15
        assert np.abs(channels[f"link_{i}.strain_angle"] - logged[:, 1]).max() < 1e-15
