"""Earlier results as a prior: their estimates hold with their covariance, in this session's own combinations."""

from __future__ import annotations

import json
import tomllib
from pathlib import Path

import numpy as np
import pytest

import sms_online as sms
from sms_online.effects.build import build_model
from sms_online.model.base_parameters import find_base_parameters
from sms_online.priors import base_prior, given_prior
from sms_online.trackers.interface import Prior, joined, prior_factor
from sms_tools.cli import main
from tests.axis import AXIS, DAMPING, INERTIA

SYSTEM = sms.load_system(tomllib.loads(AXIS))


def run(seed: int) -> sms.Capture:
    """8 s of the axis along two sines, with sensors' noise of the seed."""
    t = np.arange(1600) / 200.0
    q = np.sin(2 * t) + 0.3 * np.sin(5 * t)
    rate, acceleration = 2 * np.cos(2 * t) + 1.5 * np.cos(5 * t), -4 * np.sin(2 * t) - 7.5 * np.sin(5 * t)
    noise = np.random.default_rng(seed).standard_normal((2, t.size))
    torque = INERTIA * acceleration + DAMPING * rate
    return sms.Capture.from_arrays(t, {"force_1": torque + 0.05 * noise[0], "q_1": q + 1e-4 * noise[1]})


@pytest.fixture(scope="module")
def first() -> sms.Result:
    return sms.estimate(SYSTEM, run(1))


@pytest.fixture(scope="module")
def folder(first: sms.Result, tmp_path_factory: pytest.TempPathFactory) -> Path:
    path = tmp_path_factory.mktemp("run")
    (path / "results.json").write_text(json.dumps(first.document()))
    return path


def numbers(result: sms.Result) -> list[tuple[float, float]]:
    return [(p.value, p.std) for p in result.parameters.values()]


def test_two_runs_weigh_what_each_knows(first: sms.Result) -> None:
    second, both = sms.estimate(SYSTEM, run(2)), sms.estimate(SYSTEM, run(2), prior=first)
    for name, found in both.parameters.items():
        runs = [each.parameters[name] for each in (first, second)]
        weights = np.array([each.std**-2 for each in runs])
        assert found.std == pytest.approx(weights.sum() ** -0.5, rel=0.05)
        mean = weights @ [each.value for each in runs] / weights.sum()
        assert found.value == pytest.approx(mean, abs=0.3 * found.std)


@pytest.mark.slow
def test_result_file_and_folder_are_the_same_prior(first: sms.Result, folder: Path) -> None:
    expected = numbers(sms.estimate(SYSTEM, run(2), prior=first))
    for given in (folder, str(folder / "results.json"), first.document()):
        assert numbers(sms.estimate(SYSTEM, run(2), prior=given)) == expected


def test_a_restored_session_knows_the_same(first: sms.Result, folder: Path) -> None:
    data = run(2)
    session = sms.Session(SYSTEM, data.channels, prior=folder / "results.json")
    for block in data:
        for piece in block.pieces(800):
            session.update(piece)
            session = sms.Session.restore(session.save())
    session.finish()
    assert numbers(session.result) == numbers(sms.estimate(SYSTEM, data, prior=first))


def test_errors_keep_their_correlation(first: sms.Result) -> None:
    base = find_base_parameters(build_model(SYSTEM))
    prior = base_prior(SYSTEM, base, given_prior(first))
    rows = prior_factor(prior, base.n)
    np.testing.assert_allclose(np.linalg.inv(rows[:, :-1].T @ rows[:, :-1]), first.covariance, rtol=1e-9)
    np.testing.assert_allclose(np.linalg.solve(rows[:, :-1], rows[:, -1]), [p.value for p in first.parameters.values()])
    assert abs(first.covariance[0, 1]) > 0.0


def test_nothing_is_known_of_an_effect_that_is_new(first: sms.Result) -> None:
    friction = sms.load_system(
        tomllib.loads(
            AXIS + '[[effect]]\nname = "coulomb_friction"\nwhere = "joint_1"\ncoefficients = { torque = 0.0 }\n'
        )
    )
    base = find_base_parameters(build_model(friction))
    known = base_prior(friction, base, given_prior(first)).known
    assert [p.name for p, each in zip(base.parameters, known, strict=True) if not each] == [
        "coulomb_friction@joint_1.torque"
    ]


def test_what_was_not_determined_is_not_known(first: sms.Result) -> None:
    document = first.document()
    document["covariance"][:2] = [None, None]
    base = find_base_parameters(build_model(SYSTEM))
    known = base_prior(SYSTEM, base, given_prior(document)).known
    assert known.tolist() == [False] + [True] * (base.n - 1)


def test_results_without_covariance_are_refused(first: sms.Result) -> None:
    document = {key: value for key, value in first.document().items() if key != "covariance"}
    with pytest.raises(sms.InputError, match="covariance: none"):
        given_prior(document)


def loses(rate: float, seconds: float) -> sms.Capture:
    """The axis, whose inertia falls by a share `rate` a second from 6 s on."""
    t = np.arange(round(200 * seconds)) / 200.0
    q = np.sin(2 * t) + 0.3 * np.sin(5 * t)
    speed = 2 * np.cos(2 * t) + 1.5 * np.cos(5 * t)
    momentum = INERTIA * (1.0 - rate * np.maximum(0.0, t - 6.0)) * speed
    noise = np.random.default_rng(3).standard_normal((2, t.size))
    torque = np.gradient(momentum, t, edge_order=2) + DAMPING * speed
    return sms.Capture.from_arrays(t, {"force_1": torque + 0.01 * noise[0], "q_1": q + 1e-4 * noise[1]})


@pytest.mark.slow
def test_what_drifts_leaves_its_prior_without_a_dispute(first: sms.Result) -> None:
    found = sms.estimate(SYSTEM, loses(0.002, 24.0), prior=first)
    inertia = found.parameters["link_1.inertia"]
    assert inertia.value == pytest.approx(INERTIA * (1.0 - 0.002 * 18.0), abs=4.0 * inertia.std)
    assert [drift.parameter for drift in found.drifts] == ["link_1.inertia"]
    assert found.trust.level == "trust"


@pytest.mark.long
def test_a_prior_counts_once_beside_a_drift() -> None:
    """Nearly all that is known of the damping is the prior's, and so is its deviation."""
    name, std = "viscous_friction@joint_1.damping", 2e-6
    system = sms.load_system(tomllib.loads(f'{AXIS}\n[prior]\n"{name}" = {{ value = {DAMPING}, std = {std} }}\n'))
    data = loses(0.002, 24.0)
    session = sms.Session(system, data.channels)
    for block in data:
        for piece in block.pieces(1000):
            session.update(piece)
            session = sms.Session.restore(session.save())
    session.finish()
    assert session.result.drifts
    momentum = session.estimator.momentum
    assert momentum is not None
    k = len(momentum.nuisances) + [p.name for p in momentum.changes.base.parameters].index(name)
    for known in (momentum.bank.information, momentum.joint.tracker.information, momentum.changes.detector.known):
        assert known.solution().covariance()[k, k] ** 0.5 == pytest.approx(std, rel=0.05)
    assert session.result.parameters[name].std == pytest.approx(std, rel=0.05)
    assert numbers(session.result) == numbers(sms.estimate(system, data))


def test_joined_priors_are_independent() -> None:
    correlation = np.array([[1.0, 0.5], [0.5, 1.0]])
    whole = joined(Prior(np.zeros(1), np.ones(1)), Prior(np.ones(2), np.array([2.0, 3.0]), correlation))
    rows = prior_factor(whole, 3)[:, :-1]
    expected = np.array([[1.0, 0.0, 0.0], [0.0, 4.0, 3.0], [0.0, 3.0, 9.0]])
    np.testing.assert_allclose(np.linalg.inv(rows.T @ rows), expected, atol=1e-12)


def test_a_path_without_results_is_one_line(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    system, capture = tmp_path / "axis.toml", tmp_path / "run.csv"
    system.write_text(AXIS)
    sms.write_capture(run(2), capture)
    assert main(["replay", str(capture), "--system", str(system), "--prior", str(tmp_path / "none.json")]) == 2
    (line,) = capsys.readouterr().err.strip().splitlines()
    assert "none.json" in line
