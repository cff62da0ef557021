"""excite: motions within limits from which parameters are estimated better, written for the file and the controller."""

from __future__ import annotations

import json
import re
from pathlib import Path

import numpy as np
import pytest

import sms_online as sms
from sms_adapters.system_file import load_system
from sms_online.description.parse import parse_system
from sms_sim.ensemble import ensemble
from sms_sim.excitation import Excitation, excite
from sms_sim.motion_limits import Extremes, Limits
from sms_sim.plant import Plant
from sms_sim.references import fourier_reference
from sms_sim.simulate import exact_states, simulate
from sms_tools.cli import main
from sms_tools.verbs.excite import reference_lines, with_trajectory
from tests.axis import AXIS, MOTION

MOVED = (AXIS + MOTION).replace("duration = 6.0", "duration = 3.0")
ONE_SINE = MOVED.replace(", { frequency = 5.0, cosine = 0.3 }", "")
# Its rate never changes its sign: friction is then an offset of the torque.
ONE_WAY = (AXIS + MOTION.partition("joint_1 = [")[0]).replace("duration = 6.0", "duration = 5.0") + (
    "joint_1 = [{ frequency = 0.25, sine = 1.0 }]"
)
ALIKE = ("coulomb_friction@joint_1", "torque_offset@joint_1")
FRICTION = ("coulomb_friction@joint_1:torque=0.05", "stribeck_friction@joint_1:torque=0.05")


@pytest.fixture(scope="module")
def designed() -> Excitation:
    return excite(parse_system(MOVED, "axis.toml"), seed=1, iterations=4)


@pytest.fixture(scope="module")
def one_way() -> Excitation:
    """A motion for two effects that the described one cannot separate."""
    separate = [f"{name}:torque=1" for name in ALIKE]
    return excite(parse_system(ONE_WAY, "axis.toml"), separate=separate, limits=Limits(angle=1.0), iterations=2)


def test_batched_motions_are_the_exact_ones() -> None:
    system = parse_system(MOVED, "axis.toml")
    assert system.trajectory is not None
    exact = exact_states(simulation := simulate(system), np.linspace(0.0, simulation.duration, 151))
    frequency = np.array([2.0, 5.0])
    sine, cosine = np.array([[[1.0], [0.0]]]), np.array([[[0.0], [0.3]]])
    both = ensemble(system, frequency, np.repeat(sine, 2, 0), np.repeat(cosine, 2, 0), simulation.duration, 0.02)
    for k in range(2):
        np.testing.assert_allclose(both.x[k], exact.x, atol=1e-3)
        np.testing.assert_allclose(both.v[k], exact.v, atol=1e-2)
        np.testing.assert_allclose(both.torque[k], exact.torque, atol=0.1)


def test_a_batch_is_what_its_motions_are_alone() -> None:
    system = parse_system(MOVED, "axis.toml")
    sine, frequency = np.array([[[1.0]], [[0.4]]]), np.array([2.0])
    both = ensemble(system, frequency, sine, 0.0 * sine, 1.0, 0.02)
    alone = ensemble(system, frequency, sine[1:], 0.0 * sine[1:], 1.0, 0.02)
    np.testing.assert_allclose(both.x[1], alone.x[0], atol=1e-4)


@pytest.mark.slow
def test_the_worst_bound_is_lower_within_the_described_extremes(designed: Excitation) -> None:
    assert designed.before is not None
    worst = [max(p.percent or 0.0 for p in bounds.parameters.values()) for bounds in (designed.before, designed.after)]
    assert worst[1] < 0.9 * worst[0]
    assert designed.weighed == tuple(designed.after.parameters)
    plant = Plant(parse_system(MOVED, "axis.toml"))
    simulation = simulate(designed.system)
    exact = exact_states(simulation, np.linspace(0.0, simulation.duration, 3001))
    largest = Extremes(plant)(exact.x, exact.v, exact.torque)
    for value, each in zip(largest, designed.reached, strict=True):
        assert each.limit is not None
        assert value <= 1.0005 * each.limit, each.name


def test_a_motion_that_is_no_better_is_not_given_out(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr("sms_sim.excitation._optimised", lambda problem, *_: np.full(problem.series.size, 1e-3))
    system = parse_system(MOVED, "axis.toml")
    found = excite(system)
    assert found.system == system
    assert set(found.gains().values()) == {1.0}


@pytest.mark.slow
def test_the_seed_decides_the_motion() -> None:
    system = parse_system(MOVED, "axis.toml")
    found = [excite(system, duration=2.0, seed=seed, iterations=1).system for seed in (1, 1, 2)]
    assert found[0] == found[1]
    assert found[0] != found[2]


@pytest.mark.slow
def test_a_stated_limit_holds_in_place_of_the_described_motions() -> None:
    found = excite(parse_system(MOVED, "axis.toml"), limits=Limits(rate=0.8), duration=2.0, iterations=2)
    (rate,) = [each for each in found.reached if each.name == "rate of q_1"]
    assert rate.limit == 0.8
    assert 0.5 < rate.largest <= 0.8
    assert found.system.trajectory is not None
    assert found.system.trajectory.duration == 2.0


@pytest.mark.slow
def test_without_a_described_motion_limits_are_enough() -> None:
    system = parse_system(AXIS + MOTION.partition("[trajectory]")[0], "axis.toml")
    found = excite(system, limits=Limits(angle=0.5), duration=2.0, iterations=1)
    assert found.before is None
    assert next(each.largest for each in found.reached if each.name == "q_1") <= 0.5
    with pytest.raises(sms.InputError, match="both a duration and the largest joint angle"):
        excite(system, limits=Limits(angle=0.5))


@pytest.mark.long
def test_two_effects_are_separated() -> None:
    system = parse_system(ONE_SINE, "axis.toml")
    found = excite(system, separate=FRICTION, iterations=2)
    assert found.weighed == ("coulomb_friction@joint_1.torque", "stribeck_friction@joint_1.torque")
    assert found.before is not None
    worst = [max(bounds.parameters[name].std for name in found.weighed) for bounds in (found.before, found.after)]
    assert worst[1] < 0.6 * worst[0]
    # The file keeps what it described: the effects are hypotheses.
    assert found.system.effects == system.effects


@pytest.mark.long
@pytest.mark.parametrize("present", [0, 1])
def test_what_a_diagnosis_names_together_it_then_names_alone(one_way: Excitation, present: int) -> None:
    acting, other = ALIKE[present], ALIKE[1 - present]
    for system, together in ((parse_system(ONE_WAY, "axis.toml"), True), (one_way.system, False)):
        data = sms.simulate(system, grade="B", seed=1, effects=[f"{acting}:torque=1"])
        (found,) = sms.diagnose(system, data).effects
        named = f"{found.name}@{found.where}"
        assert {named, *found.ambiguous_with} >= set(ALIKE) if together else named == acting
        assert together or other not in found.ambiguous_with


def test_an_effect_to_separate_needs_its_size() -> None:
    with pytest.raises(sms.InputError, match="nominally zero; expected its size"):
        excite(parse_system(MOVED, "axis.toml"), separate=(FRICTION[0], "stribeck_friction@joint_1"))


@pytest.mark.parametrize(
    ("second", "said"),
    [
        ("nonsense@joint_1:x=1", "--separate, nonsense@joint_1:x=1: unknown effect"),
        (FRICTION[0], "again; expected each effect once"),
        ("viscous_friction@joint_1:damping=1", "the system file declares; expected viscous_friction@joint_1 alone"),
    ],
)
def test_what_cannot_be_separated_is_refused(second: str, said: str) -> None:
    with pytest.raises(sms.InputError, match=re.escape(said)):
        excite(parse_system(MOVED, "axis.toml"), separate=(FRICTION[0], second))


def test_a_motion_too_long_to_be_designed_is_refused() -> None:
    with pytest.raises(sms.InputError, match=r"duration: 1e\+09 s; expected a motion of 600 s at most"):
        excite(parse_system(MOVED, "axis.toml"), duration=1e9)


@pytest.mark.parametrize("kind", ["deflection", "base_rotation"])
def test_a_limit_of_what_is_not_there_is_refused(kind: str) -> None:
    with pytest.raises(sms.InputError, match=f"nothing that a limit of the {kind.replace('_', ' ')} holds for"):
        excite(parse_system(MOVED, "axis.toml"), limits=Limits(**{kind: 1.0}))


@pytest.mark.slow
def test_the_verb_writes_file_reference_and_table(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    path, out = tmp_path / "moved.toml", tmp_path / "done"
    path.write_text(MOVED)
    assert main(["excite", "--system", str(path), "--iterations", "1", "--out", str(out)]) == 0
    said = capsys.readouterr().out
    assert "times lower" in said
    assert "link_1.inertia" in said
    system, document = load_system(out / "system.toml"), json.loads((out / "excitation.json").read_text())
    assert system.trajectory is not None
    assert json.loads(json.dumps(document["trajectory"])) == system.trajectory.model_dump(mode="json")
    assert system.model_copy(update={"trajectory": None}) == load_system(path).model_copy(update={"trajectory": None})
    table = np.loadtxt(out / "reference.csv", delimiter=",", skiprows=1)
    q_d, rate = fourier_reference(system.trajectory)(table[:, 0])
    np.testing.assert_array_equal(table[:, 1:], np.column_stack((q_d, rate)))
    assert table.shape[0] == round(system.trajectory.duration * system.sample_rate) + 1


def test_another_trajectory_changes_nothing_else_of_a_file(tmp_path: Path) -> None:
    trajectory = parse_system(MOVED, "axis.toml").trajectory
    assert trajectory is not None
    shipped = with_trajectory("paper-planar", load_system("paper-planar").trajectory or trajectory)
    assert parse_system(shipped, "x.toml") == load_system("paper-planar")
    assert "# (46), for twice the paper's 10 s" in shipped
    path = tmp_path / "axis.toml"
    path.write_text(AXIS + MOTION.partition("[trajectory]")[0])
    assert parse_system(with_trajectory(str(path), trajectory), "axis.toml") == parse_system(MOVED, "axis.toml")
    assert next(reference_lines(trajectory, 10.0)) == "t,q_d_1,q_d_dot_1"
