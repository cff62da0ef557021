"""`diagnose` of several captures of one rig at once, checked on one that decides nothing."""

from __future__ import annotations

import json
from pathlib import Path

import numpy as np
import pytest

import sms_online as sms
from sms_online.description.parse import parse_system
from sms_online.diagnosis.captures import PAUSE, begins, one_after_another
from sms_online.diagnosis.folds import Folds
from sms_online.stream import Block
from sms_tools.cli import main
from tests.test_compare import ELASTIC_AXIS, STIFFNESS

FRICTION = 0.6


@pytest.fixture(scope="module")
def rig(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A folder with rig.toml, which says nothing of the friction in the captures a, b and d; e is d, shuffled."""
    folder = tmp_path_factory.mktemp("rig")
    (folder / "rig.toml").write_text(ELASTIC_AXIS.format(stiffness=STIFFNESS))
    described = sms.load_system(folder / "rig.toml")
    friction = parse_system(
        f'{ELASTIC_AXIS.format(stiffness=STIFFNESS)}\n[[effect]]\nname = "coulomb_friction"\nwhere = "joint_1"\n'
        f"coefficients = {{ torque = {FRICTION} }}\n",
        "rig.toml",
    )
    for seed, name in enumerate(("a", "b", "d")):
        sms.write_capture(sms.simulate(friction, grade="A", seed=seed), folder / f"{name}.csv")
    d = sms.read_capture(folder / "d.csv", described)
    order = np.random.default_rng(0).permutation(len(d))
    sms.write_capture(sms.Capture(d.t, d.channels, d.values[order]), folder / "e.csv")
    return folder


@pytest.fixture(scope="module")
def found(rig: Path) -> sms.Diagnosis:
    return sms.diagnose(rig / "rig.toml", [rig / "a.csv", rig / "b.csv"], holdout=rig / "d.csv")


@pytest.mark.slow
def test_two_captures_are_searched_at_once(found: sms.Diagnosis) -> None:
    assert [effect.effect for effect in found.effects] == ["coulomb_friction@joint_1"]
    assert found.effects[0].coefficients["torque"].value == pytest.approx(FRICTION, rel=0.02)
    assert found.verdict == "named"


@pytest.mark.slow
def test_the_error_of_the_held_out_capture_falls(found: sms.Diagnosis) -> None:
    before, after = (fit.held_out["joint_1"].relative for fit in (found.before, found.after))
    assert before is not None
    assert after is not None
    assert after < 0.5 * before


@pytest.mark.slow
def test_a_shuffled_held_out_capture_changes_nothing_found(rig: Path, found: sms.Diagnosis) -> None:
    other = sms.diagnose(rig / "rig.toml", [rig / "a.csv", rig / "b.csv"], holdout=rig / "e.csv")
    assert other.effects == found.effects
    assert other.system == found.system
    assert other.after.residuals == found.after.residuals
    assert other.after.held_out != found.after.held_out


@pytest.mark.slow
def test_the_verb_takes_several_captures(rig: Path, tmp_path: Path) -> None:
    captures = [str(rig / f"{name}.csv") for name in ("a", "b")]
    assert main(["diagnose", *captures, "--system", str(rig / "rig.toml"), "--out", str(tmp_path)]) == 0
    document = json.loads((tmp_path / "diagnosis.json").read_text())
    assert [effect["name"] for effect in document["effects"]] == ["coulomb_friction"]
    assert not any("gap" in warning for warning in document["warnings"])


@pytest.mark.slow
def test_captures_of_other_channels_are_refused(rig: Path) -> None:
    b = sms.read_capture(rig / "b.csv")
    fewer = sms.Capture(b.t, b.channels[:-1], b.values[:, :-1], "fewer")
    with pytest.raises(sms.InputError, match="fewer"):
        sms.diagnose(rig / "rig.toml", [sms.read_capture(rig / "a.csv"), fewer])


def _block(t: list[float]) -> Block:
    return Block(np.array(t), ("q_1",), np.zeros((len(t), 1)))


def test_captures_follow_each_other_with_a_pause() -> None:
    runs = [[_block([5.0, 6.0]), _block([7.0])], [_block([5.0, 6.0])], [_block([0.0])]]
    first, second, third = one_after_another(runs)
    assert second[0].t.tolist() == [7.0 + PAUSE, 8.0 + PAUSE]
    assert third[0].t.tolist() == [8.0 + 2.0 * PAUSE]
    assert first == runs[0]
    np.testing.assert_allclose(begins([first, second, third]), [2.0 + 0.5 * PAUSE, 3.0 + 1.5 * PAUSE])


def test_each_capture_is_predicted_from_the_others() -> None:
    capture = np.repeat([0, 1, 2], 40)
    folds = Folds.of(capture, np.arange(120.0), capture=capture)
    assert (folds.parts, folds.count, folds.across) == (3, 10, True)
    for part in range(3):
        np.testing.assert_array_equal(folds.predicted(part), capture == part)
        np.testing.assert_array_equal(folds.fitted(part), capture != part)
