"""From a session to a verdict: what the planar example lacks is named, with its place, size and doubt.

Sessions of 6 s at 1 kHz, noise of grade B (seeds are given), nominal values that are not the true ones.
"""

from __future__ import annotations

from collections.abc import Iterator
from functools import cache
from unittest.mock import patch

import numpy as np
import pytest
from numpy.testing import assert_allclose

from sms_adapters.system_file import load_system
from sms_online.description.parse import describe, parse_system
from sms_online.description.schema import Effect, System
from sms_online.diagnosis.candidates import CandidateColumns
from sms_online.diagnosis.diagnose import diagnose
from sms_online.diagnosis.document import diagnosis_document
from sms_online.diagnosis.posterior import coefficients
from sms_online.diagnosis.search import Search
from sms_online.effects.catalogue import parse_effect
from sms_online.errors import InputError
from sms_online.pipeline.momentum_windows import HOPS
from sms_online.stream import Block
from sms_sim.simulate import sampled_blocks, simulate
from sms_tools.adopted_system import adopted_text
from tests.simulations import planar

DURATION = 6.0
# Far below the noise.
TOLERANCE = 1e-8


def unlike(system: System) -> System:
    """The system with other joints and links than the true ones, so that nothing found can have been read."""
    joints = tuple(joint.model_copy(update={"stiffness": 300.0, "damping": 20.0}) for joint in system.joints)
    links = tuple(link.model_copy(update={"mass_per_length": 10.0}) for link in system.links)
    return system.model_copy(update={"joints": joints, "links": links})


@cache
def block_of(*texts: str) -> Block:
    """A session with injected effects."""
    system = load_system("paper-planar")
    effects = tuple(parse_effect(text, system) for text in texts)
    simulation = simulate(system.model_copy(update={"effects": effects}), DURATION, position_tolerance=TOLERANCE)
    blocks = list(sampled_blocks(simulation, "B", seed=4))
    t, values = (np.concatenate([getattr(block, part) for block in blocks]) for part in ("t", "values"))
    return Block(t, blocks[0].channels, values)


@cache
def diagnosed(*texts: str) -> Search:
    return diagnose(unlike(load_system("paper-planar")), [block_of(*texts)], "test", lambda estimator: None)


def keys(diagnosis: Search) -> list[str]:
    return [finding.candidate.key for finding in diagnosis.findings]


def reported(diagnosis: Search) -> dict[str, float]:
    return {name: value for name, (value, _) in coefficients(diagnosis, diagnosis.findings[0]).items()}


@pytest.mark.long
def test_a_session_that_the_model_explains_is_clean() -> None:
    diagnosis = diagnosed()
    assert (diagnosis.verdict, keys(diagnosis)) == ("clean", [])
    assert not any(row.beyond for row in diagnosis.before.test.values())
    assert diagnosis.after.system == diagnosis.before.system


@pytest.mark.long
@pytest.mark.parametrize(
    ("text", "accuracy"),
    [
        # The sign of a noisy rate at standstill takes some of the friction away.
        ("coulomb_friction@joint_2:torque=1", 0.05),
        ("bearing_coulomb_friction@joint_2:torque=1", 0.05),
        ("bearing_viscous_friction@joint_1:damping=2", 0.01),
        ("cubic_stiffness@joint_1:stiffness=300", 0.01),
        # Without it the base's rows are best explained by an arm of no mass, whose rows have no noise.
        ("air_drag@base:damping=150", 0.01),
        # Its phase turns by 200 rad a radian: faster than the motion that the arm's own columns are taken from.
        ("cogging@joint_1:amplitude=30,phase=1,order=4", 0.02),
        ("torsional_hysteresis@joint_1:torque=5,width=0.02", 0.02),
        ("tip_payload@tip:mass=0.5", 0.02),
        ("sensor_lag@q_1:corner=40", 0.01),
        # Far beyond first order in the delay.
        ("torque_delay@joint_2:time=0.03", 0.01),
        ("torque_delay@joint_*:time=0.006", 0.01),
        ("actuator_delay@joint_1:time=0.01", 0.01),
        ("actuator_delay@joint_*:time=0.004", 0.01),
        # It rings a hundred radians on: a frequency a few percent off would have nothing in common with it.
        ("slosh@base:mass=3,stiffness=867", 0.02),
        ("encoder_offset@theta_m_2:offset=0.01", 0.02),
        ("table_tilt@base:gravity_x=0.003,gravity_y=-0.002", 0.01),
    ],
)
def test_the_missing_effect_is_named_with_its_place_and_size(text: str, accuracy: float) -> None:
    """And nothing else is; what is left is noise."""
    effect = parse_effect(text, load_system("paper-planar"))
    diagnosis = diagnosed(text)
    assert diagnosis.verdict == "named"
    assert keys(diagnosis) == [effect.key]
    found = reported(diagnosis)
    assert {name: found[name] for name in effect.coefficients} == pytest.approx(effect.coefficients, rel=accuracy)
    assert any(row.beyond for row in diagnosis.before.test.values())
    assert not any(row.beyond for row in diagnosis.after.test.values())


@pytest.mark.long
@pytest.mark.parametrize(
    "texts",
    [
        ("viscous_friction@joint_1:damping=2", "cubic_stiffness@joint_2:stiffness=300"),
        # Either leaves more of the link's own rows, and hardly anything of all others.
        ("tip_payload@tip:mass=0.74", "link_mass_damping@link_2:rate=1.98"),
    ],
)
def test_two_effects_are_found_in_turn(texts: tuple[str, ...]) -> None:
    diagnosis = diagnosed(*texts)
    assert diagnosis.verdict == "named"
    assert set(keys(diagnosis)) == {text.partition(":")[0] for text in texts}


@pytest.mark.long
def test_an_unknown_effect_is_unexplained_where_it_acts() -> None:
    """Cubic stiffness, struck from the catalogue with what resembles it: it depends on the deflection of its joint."""
    alike = ("cubic_stiffness", "backlash", "encoder_eccentricity", "torsional_hysteresis", "encoder_offset")
    inner = CandidateColumns.effects

    def known(self: CandidateColumns, learned: bool = False) -> Iterator[Effect]:
        return (effect for effect in inner(self, learned) if effect.name not in alike)

    block = block_of("cubic_stiffness@joint_1:stiffness=300")
    with patch.object(CandidateColumns, "effects", known):
        diagnosis = diagnose(unlike(load_system("paper-planar")), [block], "test", lambda estimator: None)
    assert diagnosis.verdict == "unexplained"
    assert diagnosis.unexplained is not None
    assert diagnosis.unexplained.row in ("joint_1", "link_1")
    assert diagnosis.unexplained.variable == "deflection of joint_1"


@pytest.mark.long
def test_the_adopted_system_file_holds_what_was_found() -> None:
    diagnosis = diagnosed("table_tilt@base:gravity_x=0.003,gravity_y=-0.002")
    system = load_system("paper-planar")
    found = diagnosis.after.system
    text = adopted_text("paper-planar", system, system.model_copy(update={"gravity": found.gravity}), {})
    assert_allclose(parse_system(text, "adopted").gravity, found.gravity, rtol=1e-8)
    diagnosis = diagnosed("torsional_hysteresis@joint_1:torque=5,width=0.02")
    adopted = system.model_copy(update={"effects": diagnosis.after.system.effects})
    (effect,) = parse_system(adopted_text("paper-planar", system, adopted, {}), "adopted").effects
    assert (effect.name, effect.where) == ("torsional_hysteresis", "joint_1")
    assert effect.coefficients["width"] == pytest.approx(0.02, rel=0.02)
    value, std = coefficients(diagnosis, diagnosis.findings[0])["width"]
    assert std is not None
    assert abs(value - 0.02) < 3.0 * std < 0.06 * value


@pytest.mark.long
def test_the_document_holds_results_before_and_after() -> None:
    diagnosis = diagnosed("cubic_stiffness@joint_1:stiffness=300")
    document = diagnosis_document(diagnosis, [], None)
    assert document["verdict"] == "named"
    (effect,) = document["effects"]
    assert effect["evidence"]["gain"] > effect["evidence"]["limit"]
    for part in ("fit", "holdout"):
        before, after = (document[side][part]["joint_1"] for side in ("before", "after"))
        assert after["whitened"] < 0.2 * before["whitened"]
        assert after["relative"] < before["relative"]
    stiffness = {p["name"]: p["estimate"] for p in document["after"]["parameters"]}["joint_1.stiffness"]
    assert stiffness == pytest.approx(1000.0, rel=1e-3)
    assert document["candidates"][0]["name"] == "cubic_stiffness"
    assert describe(diagnosis.before.system)["effects"] == []


@pytest.mark.slow
@pytest.mark.parametrize(("samples", "words"), [(500, "too few"), (700, "too few windows")])
def test_a_capture_that_is_too_short_is_refused(samples: int, words: str) -> None:
    block = block_of()
    short = Block(block.t[:samples], block.channels, block.values[:samples])
    with pytest.raises(InputError, match=words):
        diagnose(unlike(load_system("paper-planar")), [short], "short.csv", lambda estimator: None)


@pytest.mark.slow
def test_a_second_of_samples_is_enough_where_dry_friction_acts() -> None:
    """Fewer windows than overlap one: the noise of friction's law is averaged over those that there are."""
    system = load_system("paper-planar")
    friction = Effect(name="coulomb_friction", where="joint_2", coefficients={"torque": 8.0})
    rubbing = system.model_copy(update={"effects": (friction,)})
    blocks = list(sampled_blocks(simulate(rubbing, 1.0, position_tolerance=1e-8), "B", seed=1))
    found = diagnose(unlike(system), blocks, "test", lambda estimator: None)
    assert found.after.residual.shape[0] < 2 * HOPS - 1
    assert found.verdict != "clean"


def test_a_session_without_momentum_rows_is_refused() -> None:
    system = unlike(load_system("paper-planar")).model_copy(update={"balance": "energy"})
    with pytest.raises(InputError, match="no momentum balance"):
        diagnose(system, list(sampled_blocks(planar(1.0), "B", seed=4)), "test", lambda estimator: None)


@pytest.mark.slow
def test_gaps_and_short_stretches_between_them_do_no_harm() -> None:
    """Two gaps of half a second with 40 samples between them: still clean."""
    block = block_of()
    kept = ~((block.t > 2.0) & (block.t < 2.5)) & ~((block.t > 2.54) & (block.t < 3.0))
    parts = Block(block.t[kept], block.channels, block.values[kept])
    diagnosis = diagnose(unlike(load_system("paper-planar")), [parts], "test", lambda estimator: None)
    assert diagnosis.verdict == "clean"


@pytest.mark.long
def test_joints_at_rest_end_the_search_and_are_no_error() -> None:
    """Encoders of joint 2 that are at rest: whatever is said of such a session, it is said."""
    block = block_of()
    values = block.values.copy()
    for channel in ("q_2", "theta_m_2"):
        values[:, block.channels.index(channel)] = 0.1
    stuck = Block(block.t[:3000], block.channels, values[:3000])
    diagnosis = diagnose(unlike(load_system("paper-planar")), [stuck], "test", lambda estimator: None)
    assert diagnosis.verdict == "unexplained"
