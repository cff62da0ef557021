"""Links with fewer elements than a motion needs: what rows lack, what is corrected, and what is said."""

from __future__ import annotations

import re
from functools import cache

import numpy as np
import pytest

import sms_online as sms
from sms_online.calibration.columns import nuisances
from sms_online.calibration.truncation import Truncation
from sms_online.description.bodies import Inertia, RigidBody
from sms_online.description.parse import parse_system
from sms_online.description.schema import System, Tolerances
from sms_online.effects.build import build_model
from sms_online.model.model import Model
from sms_online.pipeline.momentum_windows import INSTANTS
from sms_online.pipeline.sensing import Sensing
from sms_online.pipeline.snapshot import statistics_of
from sms_online.stream import Array, Block
from sms_online.verdict.judged import JudgedEvaluation
from sms_online.verdict.truncated import truncated
from sms_sim.plant import Plant
from tests.sessions_of import session_of

LINK = """
kind = "flexible"
length = 1.0
mass_per_length = 3.0
polar_inertia_per_length = 0.0004
flexural_rigidity_y = 120.0
flexural_rigidity_z = 80.0
torsional_rigidity = 20.0
deformations = ["torsion", "bending_y", "bending_z"]
"""
# A link that its weight bends in both planes, and so twists.
HELD = f"""
name = "held"
gravity = [0.0, 5.0, -8.0]
[joint_1]
transmission = "rigid"
[link_1]{LINK}"""
PER_MARKER = 5  # readings of one: u_y, u_z, θ_x, θ_y, θ_z


def with_elements(system: System, n: int, **changed: object) -> System:
    """The same system with n elements on its last link."""
    last = system.links[-1].model_copy(update={"elements": n, **changed})
    return system.model_copy(update={"links": (*system.links[:-1], last)})


def truncation_alone(system: System) -> System:
    """The same system, measured out exactly but for what more elements change."""
    return system.model_copy(
        update={"tolerances": Tolerances.model_validate("none").model_copy(update={"truncation": 1.0})}
    )


def hanging(model: Model) -> Array:
    """Positions (1, n_x) at which the link of a model hangs still, its joint at zero, by Newton's method."""
    q, x = model.layout.q_f[0], np.zeros((1, model.layout.n_x))
    still = np.zeros((1, model.layout.n_v))

    def force(elastic: Array) -> Array:
        there = x.copy()
        there[0, q] = elastic
        return np.asarray((model.momentum_columns(there, still)[1] @ model.nominal)[0, q])

    elastic, step = np.zeros(q.stop - q.start), 1e-6
    for _ in range(20):
        slope = np.array([force(elastic + e) - force(elastic - e) for e in step * np.eye(elastic.size)]).T / (2 * step)
        elastic = elastic - np.linalg.solve(slope, force(elastic))
    x[0, q] = elastic
    assert np.abs(force(elastic)).max() < 1e-8
    return x


@pytest.mark.slow
def test_rows_of_a_hanging_link_close_with_the_correction() -> None:
    """Statics of eight elements, read at two markers: what twists and bends the link is left to a hundredth."""
    described = truncation_alone(parse_system(HELD, "held"))
    assert described.links[0].elements == 2
    true, model = build_model(with_elements(described, 8)), build_model(described)
    markers = true.chain.flexible[0].markers(true.chain.elastic(hanging(true), 0))
    x, still = np.zeros((INSTANTS, model.layout.n_x)), np.zeros((INSTANTS, model.layout.n_v))
    read = markers.reshape(8, PER_MARKER)[3::4].reshape(1, -1)
    model.chain.elastic(x, 0)[:] = model.chain.flexible[0].coordinates(read)
    q = model.layout.q_f[0]
    left = (model.momentum_columns(x[:1], still[:1])[1] @ model.nominal)[0, q]
    _, changes = Truncation(model, 0.02).extend(model.nominal, x, still, np.zeros((INSTANTS, model.n_signals)))
    momentum, force = changes[-1, :, q, 0]
    assert np.abs(momentum).max() < 1e-15
    for part in (slice(0, 2), slice(2, None)):
        assert np.abs(left + force)[part].max() < np.abs(left)[part].max() / 100.0


def test_only_exact_links_with_a_tolerance_have_it() -> None:
    described = parse_system(HELD, "held")
    names = [
        [
            each.where
            for each in nuisances(Sensing(build_model(system), Plant(system).channels, "test"))
            if each.name == "truncation"
        ]
        for system in (
            described,
            with_elements(described, 2, kinematics="linear"),
            described.model_copy(update={"tolerances": Tolerances.model_validate("none")}),
        )
    ]
    assert names == [["link_1"], [], []]


# Three axes askew to each other, and a flexible link with a free end, which bending in both planes twists.
DRIVE = """
gear_ratio = 30.0
stiffness = 900.0
damping = 20.0
"""
MOTOR = """
mass = 1.5
rotor_inertia = 0.002
stator_inertia = { xx = 0.01, yy = 0.011, zz = 0.012 }
"""
RIGID = """
kind = "rigid"
mass = 3.0
center_of_mass = [0.2, 0.05, 0.02]
inertia = { xx = 0.02, yy = 0.1, zz = 0.1 }
tip = [0.4, 0.0, 0.0]
"""
SKEW = f"""
name = "skew"
[spacecraft]
mass = 60.0
center_of_mass = [-0.4, -0.3, 0.1]
inertia = {{ xx = 12.0, yy = 14.0, zz = 15.0, xy = 0.5, xz = -0.4, yz = 0.3 }}
tracked_point = [-0.5, -0.6, 0.2]
[joint_1]
axis = [0.0, 0.0, 1.0]{DRIVE}[motor_1]{MOTOR}[link_1]{RIGID}
[joint_2]
axis = [0.0, 1.0, 0.0]
mount_rotation = [0.3, 0.0, 0.2]{DRIVE}[motor_2]{MOTOR}[link_2]{RIGID}
[joint_3]
axis = [0.6, 0.8, 0.0]
mount_rotation = [0.0, 0.2, -0.3]{DRIVE}[motor_3]{MOTOR}[link_3]{LINK}
[controller]
stiffness = [200.0, 150.0, 100.0]
damping = [60.0, 40.0, 20.0]
[trajectory]
duration = 8.0
joint_1 = [
    {{ frequency = 2.0, sine = 0.6 }},
    {{ frequency = 4.0, sine = -0.3 }},
    {{ frequency = 7.0, cosine = 0.05 }},
    {{ frequency = 5.0, cosine = -0.098 }},
]
joint_2 = [
    {{ frequency = 3.0, sine = 0.5 }},
    {{ frequency = 5.0, sine = -0.3 }},
    {{ frequency = 8.0, cosine = 0.045 }},
    {{ frequency = 6.0, cosine = -0.08 }},
]
joint_3 = [
    {{ frequency = 2.5, sine = 0.5 }},
    {{ frequency = 6.5, sine = -0.192 }},
    {{ frequency = 9.0, cosine = 0.04 }},
    {{ frequency = 7.0, cosine = -0.066 }},
]
"""
TWIST = "link_3.torsional_rigidity"
# It bends and twists the link's end by its inertia, beside the axis too.
PAYLOAD = RigidBody(
    mass=1.0, center_of_mass=(0.05, 0.08, -0.06), inertia=Inertia(xx=0.02, yy=0.03, zz=0.025)
)  # fmt: skip


def skew(payload: bool) -> System:
    """The arm, with a free end or with a payload there."""
    return parse_system(SKEW, "skew").model_copy(update={"payload": PAYLOAD if payload else None})


@cache
def moved(n: int, payload: bool) -> Block:
    """The arm with n elements on its link, 8 s at grade B with seed 1, read at two markers as of two elements."""
    capture = sms.simulate(with_elements(skew(payload), n), seed=1, grade="B")
    kept, names = [], []
    for k, name in enumerate(capture.channels):
        marker = re.fullmatch(r"link_3\.marker_(\d+)\.(.*)", name)
        if marker and int(marker[1]) * 2 % n:
            continue
        kept.append(k)
        names.append(f"link_3.marker_{int(marker[1]) * 2 // n}.{marker[2]}" if marker else name)
    return Block(capture.t, tuple(names), capture.values[:, kept])


@cache
def evaluated(n: int, tolerance: float, payload: bool) -> JudgedEvaluation:
    """A session of it that is described with two elements and measured out exactly but for a truncation's tolerance."""
    system = skew(payload)
    tolerances = Tolerances.model_validate("none").model_copy(update={"truncation": tolerance})
    estimator = session_of(system.model_copy(update={"tolerances": tolerances}), [moved(n, payload)])
    return JudgedEvaluation(statistics_of(estimator), estimator.estimate())


def error_of(evaluation: JudgedEvaluation, name: str) -> tuple[float, float]:
    """Relative error of a parameter and its error bar, 1σ."""
    k = [p.name for p in evaluation.parameters].index(name)
    true = evaluation.base.values(evaluation.model.nominal)[k]
    return float(evaluation.estimate.pi[k] / true - 1.0), float(evaluation.std[k] / true)


@pytest.mark.long
def test_torsion_is_right_where_more_elements_are_asked_for() -> None:
    """Four elements read at two markers: within one per cent and its interval, and what is corrected is said."""
    evaluation = evaluated(4, 1.0, False)
    error, bar = error_of(evaluation, TWIST)
    assert abs(error) < min(0.01, 1.96 * bar)
    (found,) = truncated(evaluation)
    assert (found.where, found.elements, found.parameter) == ("link_3", 2, TWIST)
    assert any("elements are too few" in warning for warning in evaluation.warnings)


@pytest.mark.long
def test_bodies_are_right_where_a_payload_bends_the_end() -> None:
    """Loads of a bent link act on its shape between markers: without that rigid links are off by six error bars."""
    evaluation = evaluated(4, 1.0, True)
    assert evaluation.trust.level == "trust"
    assert evaluation.determined.all()
    errors = evaluation.estimate.pi - evaluation.base.values(evaluation.model.nominal)
    deviations = np.abs(errors / evaluation.std)
    assert deviations.max() < 5.0
    assert np.mean(deviations < 1.96) > 0.9


@pytest.mark.long
def test_torsion_is_wrong_beside_an_exact_description() -> None:
    """The same without the tolerance: off by more than one per cent, and not trusted."""
    evaluation = evaluated(4, 0.0, False)
    error, _ = error_of(evaluation, TWIST)
    assert error > 0.01
    assert evaluation.trust.level != "trust"


@pytest.mark.long
def test_nothing_is_corrected_where_elements_are_enough() -> None:
    evaluation = evaluated(2, 1.0, False)
    assert truncated(evaluation) == []
    error, bar = error_of(evaluation, TWIST)
    assert abs(error) < 1.96 * bar


@pytest.mark.long
def test_four_elements_read_at_two_markers_need_no_correction() -> None:
    """The smoother estimates the shape between them: within one per cent and its interval."""
    read = moved(4, False)
    names = tuple(re.sub(r"marker_([12])", lambda found: f"marker_{2 * int(found[1])}", name) for name in read.channels)
    system = with_elements(parse_system(SKEW, "skew"), 4)
    exactly = system.model_copy(update={"tolerances": Tolerances.model_validate("none")})
    estimator = session_of(exactly, [Block(read.t, names, read.values)])
    evaluation = JudgedEvaluation(statistics_of(estimator), estimator.estimate())
    assert evaluation.statistics.method == "smoother"
    error, bar = error_of(evaluation, TWIST)
    assert abs(error) < min(0.01, 1.96 * bar)


@pytest.mark.parametrize("share", [-0.2, 1e-6, 0.02])
def test_no_stiffness_that_a_link_has_bends_it_by_what_is_described(share: float) -> None:
    """A poor fit may give a link no stiffness, or a negative one: it would bend by any amount."""
    system = truncation_alone(with_elements(parse_system(HELD, "held"), 2))
    model = build_model(system)
    x = np.repeat(hanging(model), INSTANTS, axis=0)
    still = np.zeros((INSTANTS, model.layout.n_v))
    rigid = np.array(["rigidity" in p.name for p in model.parameters])
    changes = [
        Truncation(model, 0.02).extend(pi, x, still, np.zeros((INSTANTS, model.n_signals)))[1]
        for pi in (model.nominal, np.where(rigid, share * model.nominal, model.nominal))
    ]
    np.testing.assert_allclose(changes[1], changes[0], rtol=0.0, atol=1e-12)
