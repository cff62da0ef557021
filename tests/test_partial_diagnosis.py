"""A diagnosis that is interrupted says what it has found by then."""

from __future__ import annotations

import tomllib

import pytest

import sms_online as sms
from tests.axis import AXIS, axis_block

FRICTION = 0.05


@pytest.mark.slow
def test_an_interrupted_search_reports_what_it_found() -> None:
    block = axis_block(coulomb=FRICTION)
    values = dict(zip(block.channels, block.values.T, strict=True))
    said: list[str] = []

    def stop() -> bool:
        return any(text.startswith("found so far") for text in said)

    found = sms.diagnose(
        sms.load_system(tomllib.loads(AXIS)),
        sms.Capture.from_arrays(block.t, values),
        progress=lambda what, share: said.append(what),
        stop=stop,
    )
    assert found.summary.startswith("Partial, the search was interrupted.")
    assert found.document()["partial"]
    (effect,) = found.effects
    assert effect.effect == "coulomb_friction@joint_1"
    # As a person reads it, from the model with it although no session of that model was run.
    assert effect.coefficients["torque"].value == pytest.approx(FRICTION, rel=0.05)
    assert effect.coefficients["torque"].unit == "N m"
    assert "coulomb_friction" in [each.name for each in found.system.effects]
    assert not any(text.startswith("fitting the model with") for text in said)
