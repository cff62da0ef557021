"""What a results document says beside an estimate: the bound of its session, and the nearest consistent parameters."""

from __future__ import annotations

import numpy as np
import pytest
from numpy.testing import assert_allclose, assert_array_equal

from sms_online.cramer_rao import STEP, MotionRecord, cramer_rao_bound, session_bound
from sms_online.linearised import Motion
from sms_online.pipeline.estimator import Estimator
from sms_online.sensor_set import sensor_set
from sms_online.stream import Array
from sms_online.trackers.interface import Prior
from sms_sim.sensors import GRADES
from sms_sim.simulate import ExactStates, Simulation, exact_states, sampled_blocks
from tests.evaluated import results_document
from tests.simulations import planar

DURATION = 2.0  # s
SEED = 12


@pytest.fixture(scope="module")
def simulation() -> Simulation:
    return planar(DURATION)


@pytest.fixture(scope="module")
def exact(simulation: Simulation) -> ExactStates:
    """At the system's rate."""
    t = np.arange(round(DURATION * simulation.plant.system.sample_rate) + 1) / simulation.plant.system.sample_rate
    return exact_states(simulation, t)


def session(simulation: Simulation, grade: str, prior: Prior | None = None) -> Estimator:
    blocks = list(sampled_blocks(simulation, grade, SEED))
    estimator = Estimator(simulation.plant.system, blocks[0].channels, "simulation")
    if prior is not None:
        estimator.set_prior(prior)
    for block in blocks:
        estimator.push(block)
    estimator.finish()
    return estimator


def record_of(exact: ExactStates, segments: Array) -> MotionRecord:
    """A record of the exact motion, handed over in uneven pieces and in segments that begin at the given samples."""
    record = MotionRecord(1000.0)
    index = np.arange(exact.t.size)
    cuts = np.unique(np.concatenate((segments, [7, 260, 1111]))).astype(int)
    for piece in np.split(index, cuts):
        segment = int(np.searchsorted(segments, piece[0], side="right"))
        record.motion(piece, segment, exact.x[piece], exact.v[piece], exact.torque[piece], np.zeros((piece.size, 0)))
    return record


def test_a_record_holds_the_motion_at_the_bounds_step(exact: ExactStates) -> None:
    (motion,) = record_of(exact, np.empty(0)).motions
    assert_allclose(motion.step, STEP)
    assert_array_equal(motion.x, exact.x[::10])
    assert_array_equal(motion.v, exact.v[::10])


def test_a_gap_begins_a_new_motion_and_scraps_are_left_out(exact: ExactStates) -> None:
    motions = record_of(exact, np.array([1000, 1995])).motions
    assert [motion.t.size for motion in motions] == [100, 100]
    assert_array_equal(motions[1].x[0], exact.x[1000])


def test_a_session_has_the_bound_of_its_motion_and_sensors(simulation: Simulation, exact: ExactStates) -> None:
    estimator, plant = session(simulation, "B"), simulation.plant
    bound = session_bound(estimator, record_of(exact, np.empty(0)))
    assert bound is not None
    grade, channels = GRADES["B"], plant.channels
    sigma = np.full(len(channels), grade.encoder)
    sigma[:2] = grade.torque / 50.0
    sensors = sensor_set(plant.model, channels, sigma, np.full(len(channels), 1000.0))
    motion = Motion(exact.t[::10], exact.x[::10], exact.v[::10])
    expected = cramer_rao_bound(plant.dynamics, estimator.base, [motion], sensors)
    # The session estimates its noise to some percent, and the second stator's inertia to a third.
    assert_allclose(bound, expected, rtol=0.1)
    document = results_document(estimator, 1.0, [], bound=bound)
    assert_array_equal([p["bound"] for p in document["parameters"]], bound)


def test_a_session_without_noise_or_without_motion_has_no_bound(simulation: Simulation, exact: ExactStates) -> None:
    assert session_bound(session(simulation, "0"), record_of(exact, np.empty(0))) is None
    estimator = session(simulation, "B")
    assert session_bound(estimator, MotionRecord(1000.0)) is None
    document = results_document(estimator, 1.0, [])
    assert all(p["bound"] is None for p in document["parameters"])


def test_consistent_estimates_get_no_second_value(simulation: Simulation) -> None:
    document = results_document(session(simulation, "A"), 1.0, [])
    assert document["physical"] == {"distance_std": 0.0, "active": []}
    assert all(p["projected"] is None for p in document["parameters"])
    assert not any("physical consistency" in warning for warning in document["warnings"])


def test_estimates_of_no_real_bodies_come_with_the_nearest_ones(simulation: Simulation) -> None:
    # A prior forces what data would not: a motor of negative mass.
    names = [
        p.name for p in Estimator(simulation.plant.system, simulation.plant.channels, "simulation").base.parameters
    ]
    value, std = np.full((2, len(names)), np.nan)
    k = names.index("motor_2.mass")
    value[k], std[k] = -3.0, 1e-3
    document = results_document(session(simulation, "B", Prior(value, std)), 1.0, [])
    mass = document["parameters"][k]
    assert mass["estimate"] < 0.0
    assert mass["projected"] == pytest.approx(0.0, abs=1e-2 * mass["std"])
    # It pulls the inertia beside it below zero too, so that the way back is longer than that of the mass alone.
    assert "motor_2.mass" in document["physical"]["active"]
    assert document["physical"]["distance_std"] >= 0.999 * -mass["estimate"] / mass["std"]
    assert any("physical consistency" in warning and "motor_2.mass" in warning for warning in document["warnings"])
