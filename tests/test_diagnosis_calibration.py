"""A description that is off within its tolerances lacks no effect; beside a true effect, only that one is named.

Sessions of the planar example of 10 s, noise of grade B (seed 3), nominal values off by up to 1.4 (seed 1).
"""

from __future__ import annotations

from functools import cache

import numpy as np
import pytest

from sms_adapters.system_file import load_system
from sms_online.description.schema import Effect
from sms_online.diagnosis.diagnose import diagnose
from sms_online.diagnosis.document import diagnosis_document
from sms_online.diagnosis.search import Search
from sms_online.stream import Block
from sms_sim.simulate import sampled_blocks, simulate
from tests.campaigns.calibration import Samples, clock, torque_gain, tracked_point
from tests.campaigns.sessions import disguised, noisy_session

DURATION = 10.0


@cache
def exact(friction: float) -> Block:
    effects = (Effect(name="coulomb_friction", where="joint_2", coefficients={"torque": friction}),)
    system = load_system("paper-planar").model_copy(update={"effects": effects if friction else ()})
    simulation = simulate(system, DURATION)
    blocks = list(sampled_blocks(simulation, "0"))
    t, values = (np.concatenate([getattr(block, part) for block in blocks]) for part in ("t", "values"))
    return Block(t, blocks[0].channels, values)


def diagnosed(friction: float, *imperfections: Samples) -> Search:
    system, true = load_system("paper-planar"), exact(friction)
    block = Block(true.t, true.channels, true.values.copy())
    random = np.random.default_rng(1)
    for distort in imperfections:
        distort(system, block, random)
    return diagnose(disguised(system, random), [noisy_session(system, block, "B", 3)], "test", lambda _: None)


def keys(found: Search) -> list[str]:
    return [finding.candidate.key for finding in found.findings]


@pytest.mark.long
def test_what_is_within_its_tolerance_is_no_effect() -> None:
    found = diagnosed(0.0, tracked_point(2e-4), clock(5e-5))
    assert (found.verdict, keys(found)) == ("clean", [])


@pytest.mark.long
def test_a_true_effect_alone_is_named_beside_two_imperfections() -> None:
    found = diagnosed(1.0, tracked_point(2e-4), clock(5e-5))
    assert (found.verdict, keys(found)) == ("named", ["coulomb_friction@joint_2"])
    (torque,) = found.attempt.solution(found.chosen)[found.attempt.tracing.n_model :][:1]
    assert torque == pytest.approx(1.0, abs=0.05)


@pytest.mark.long
def test_what_is_far_beyond_its_tolerance_is_an_effect() -> None:
    """A gain is known to 1 %; the torque of joint 2 is read 4 % wrong, of which joint, the data do not determine."""
    found = diagnosed(0.0, torque_gain(0.04))
    assert (found.verdict, keys(found)) == ("named", ["torque_gain@joint_2"])


@pytest.mark.long
def test_geometry_far_beyond_its_tolerance_is_said_in_words() -> None:
    """The tracked point is 8 mm elsewhere along both axes; no effect of the catalogue says so.

    Its tolerances are 2.1 and 1.1 mm, with what that of the base's angle makes of them.
    """
    found = diagnosed(0.0, tracked_point(8e-3))
    assert (found.verdict, keys(found)) == ("named", [])
    assert {each.part for each in found.calibration} == {"x", "y"}
    assert min(abs(each.estimate) for each in found.calibration) > 6e-3
    document = diagnosis_document(found)
    assert "tracked point" in document["summary"]
    assert document["judgement"]["level"] == "doubt"
