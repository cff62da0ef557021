"""Stretches of the Quanser rig's recording: what is found on one predicts the others, and their parameters agree.

The current was recorded over the last 20 s alone. Before them the torque is the command, which the controller's gains
in the file give exactly; its zero is another one than that of the measured current.
"""

from __future__ import annotations

from itertools import pairwise
from pathlib import Path

import numpy as np
import pytest

import sms_online as sms
from sms_adapters.importers import import_quanser, load_matlab

pytestmark = pytest.mark.long

DATA = Path(__file__).resolve().parents[1].parent / "shared" / "data"
QUANSER = DATA / "quanser_2dsfl" / "lqr_full_10deg.mat"
# Of 20 s each, by their first sample.
EARLIER = (10_000, 30_000)
SAMPLES = 10_000
SYSTEM = "quanser-2dsfl"


@pytest.fixture(scope="module")
def last(tmp_path_factory: pytest.TempPathFactory) -> sms.Capture:
    """The last 20 s, with measured torques."""
    if not QUANSER.exists():
        pytest.skip(f"measured data {QUANSER.name} is not beside the checkout")
    path = tmp_path_factory.mktemp("quanser") / "last.csv"
    import_quanser(QUANSER, path)
    return sms.read_capture(path)


@pytest.fixture(scope="module")
def earlier(last: sms.Capture) -> list[sms.Capture]:
    """Stretches from before, with commanded torques."""
    return [commanded(first) for first in EARLIER]


@pytest.fixture(scope="module")
def zeros(last: sms.Capture) -> list[float]:
    """What the command reads more than the measured torque of each joint, N m, where both are recorded."""
    return [
        float(np.mean(command - last.values[:, last.channels.index(f"tau_{stage}")]))
        for stage, command in enumerate(torques(slice(-SAMPLES, None)), start=1)
    ]


@pytest.fixture(scope="module")
def found(last: sms.Capture, earlier: list[sms.Capture]) -> list[sms.Diagnosis]:
    return [sms.diagnose(SYSTEM, capture) for capture in (last, *earlier)]


def torques(part: slice) -> list[np.ndarray]:
    """Commanded torques of both joints at the motors' shafts, N m."""
    data = load_matlab(QUANSER)
    out = []
    # The labels of stage 2 are swapped in the file.
    for stage, measured, reference in ((1, "stage1_X1_meas", "stage1_X1_ref"), (2, "stage2_X2_sim", "stage2_X2_meas")):
        error = data[reference]["signals"]["values"] - data[measured]["signals"]["values"]
        out.append(data[f"Ktg{stage}"] / data[f"Kg{stage}"] * (error @ data[f"K{stage}"])[part])
    return out


def commanded(first: int) -> sms.Capture:
    data, part = load_matlab(QUANSER), slice(first, first + SAMPLES)
    channels = {}
    for stage, name, torque in zip((1, 2), ("stage1_X1_meas", "stage2_X2_sim"), torques(part), strict=True):
        values = data[name]["signals"]["values"][part]
        channels |= {
            f"tau_{stage}": torque,
            f"theta_m_{stage}": values[:, 0],
            f"link_{stage}.strain_angle": values[:, 1],
        }
    t = data["stage1_X1_meas"]["time"][part]
    return sms.Capture.from_arrays(t - t[0], channels)


def test_what_is_found_predicts_other_stretches(
    found: list[sms.Diagnosis], earlier: list[sms.Capture], zeros: list[float]
) -> None:
    for capture in earlier:
        validation = sms.validate(found[0].system, capture)
        assert validation.verdict == "shifted"
        for joint in validation.joints.values():
            assert joint.beside_zero < 1.1 * joint.least
            assert joint.beside_zero < 0.2
        # Friction of joint 1 that differs by direction is a zero as well.
        assert validation.joints["joint_2"].zero == pytest.approx(zeros[1], rel=0.1)


def test_stretches_agree_within_their_bars(found: list[sms.Diagnosis]) -> None:
    for name in ("joint_1.stiffness", "joint_2.stiffness", "link_1.inertia", "link_2.inertia", "motor_2.rotor_inertia"):
        parameters = [each.after.parameters[name] for each in found]
        assert all(each.determined for each in parameters), name
        for one, other in pairwise(parameters):
            assert one.std is not None
            assert other.std is not None
            assert abs(one.value - other.value) < 3.0 * np.hypot(one.std, other.std), name
    springs = [each.after.parameters["joint_1.stiffness"].value for each in found]
    assert 20.0 < min(springs) < max(springs) < 35.0


def test_two_stretches_with_other_zeros_predict_a_third(
    last: sms.Capture, earlier: list[sms.Capture], zeros: list[float]
) -> None:
    both = sms.diagnose(SYSTEM, [last, earlier[0]], holdout=earlier[1])
    taken_off = {(each["channel"], each["capture"]): each for each in both.document()["torque_zeros"]}
    for joint, zero in enumerate(zeros, start=1):
        for capture in (2, None):
            each = taken_off[f"tau_{joint}", capture]
            assert abs(each["offset"] - zero) < 3.0 * each["std"]
            assert each["std"] < 0.2 * abs(zero)
    assert both.after.held_out["joint_1"].relative < 0.2
    assert both.after.held_out["joint_2"].relative < 0.2
