"""A rigid arm of six axes picks up a payload where rows leave more than noise: data of Pinocchio's."""

from __future__ import annotations

from functools import cache

import numpy as np
import pytest

from sms_online.diagnosis.diagnose import diagnose
from sms_online.pipeline.estimator import Estimator
from sms_online.pipeline.events import Event
from sms_online.stream import Block
from tests.carrying_arm import carrying, described
from tests.saved import resumed

MASS = 2.8  # kg
DECIDED = 2.0  # s of data after a payload is picked up, in which the event is reported
WITHIN = 0.05  # of the mass: its error bars are a third of that, what the description lacks does as much
PIECE = 25  # samples
PAUSE = 5.0  # s


def events_of(estimator: Estimator, blocks: list[Block]) -> list[tuple[float, Event]]:
    """Events of a session with further samples, each with the time of the newest sample when it was reported."""
    found: list[tuple[float, Event]] = []
    before = len(estimator.events)
    for block in blocks:
        for piece in block.pieces(PIECE):
            estimator.push(piece)
            new = estimator.events[before + len(found) :]
            found += [(float(piece.t[-1]), event) for event in new]
    return found


def estimated_mass(estimator: Estimator) -> float:
    """Of the payload, kg."""
    names = [p.name for p in estimator.base.parameters]
    return float(estimator.estimate().pi[names.index("payload.mass")])


@cache
def steady() -> Estimator:
    """A session without payload, with three times the friction that the description lacks; seed 2."""
    capture = carrying(24.0, 2, 0.0, np.inf, lacking=3.0)
    estimator = Estimator(described(), capture.channels, "steady")
    events_of(estimator, list(capture))
    estimator.finish()
    return estimator


@pytest.mark.long
@pytest.mark.parametrize("seed", [1, 2, 3])
def test_a_payload_is_an_event_beside_friction(seed: int) -> None:
    picked_up = 14.0
    capture = carrying(24.0, seed, MASS, picked_up)
    estimator = Estimator(described(), capture.channels, "carrying")
    ((reported, event),) = events_of(estimator, list(capture))
    estimator.finish()
    assert estimator.momentum is not None
    assert estimator.momentum.misfit
    assert event.kind == "payload"
    assert reported - picked_up < DECIDED
    # Within a window.
    assert abs(event.time - picked_up) < 0.4
    mass = event.sizes[event.parameters.index("payload.mass")]
    assert mass == pytest.approx(MASS, rel=WITHIN)
    assert estimated_mass(estimator) == pytest.approx(MASS, rel=WITHIN)


@pytest.mark.long
def test_a_diagnosis_finds_the_payload_beside_friction() -> None:
    """No effect is named for it: the part before it is diagnosed."""
    capture = carrying(40.0, 1, MASS, 20.0)
    (change,) = diagnose(described(), list(capture), "carrying", lambda estimator: None).changes
    assert change.before
    assert change.event.kind == "payload"
    assert change.event.time == pytest.approx(20.0, abs=0.1)
    assert change.event.sizes[0] == pytest.approx(MASS, rel=WITHIN)


@pytest.mark.long
def test_two_runs_tell_the_payload_of_the_second() -> None:
    """As docs/how-to/payloads.md has it: the loaded run goes on behind a pause. Seeds 4 and 5."""
    empty, loaded = carrying(14.0, 4, 0.0, np.inf), carrying(10.0, 5, MASS, 0.0)
    estimator = Estimator(described(), empty.channels, "two runs")
    assert events_of(estimator, list(empty)) == []
    later = empty.t[-1] + PAUSE - loaded.t[0]
    behind = [Block(block.t + later, block.channels, block.values) for block in loaded]
    ((_, event),) = events_of(estimator, behind)
    estimator.finish()
    assert event.kind == "payload"
    assert estimated_mass(estimator) == pytest.approx(MASS, rel=WITHIN)


@pytest.mark.long
def test_friction_that_no_law_fits_is_no_event() -> None:
    estimator = steady()
    assert estimator.momentum is not None
    assert estimator.momentum.misfit
    assert estimator.events == []


@pytest.mark.long
def test_rows_held_back_for_no_event_are_taken_in() -> None:
    """An alarm without a change, raised by hand and saved meanwhile: it is dismissed, and no row is lost."""
    capture = carrying(24.0, 2, 0.0, np.inf, lacking=3.0)
    estimator = Estimator(described(), capture.channels, "false alarm")
    raised = saved = False
    for block in capture:
        for piece in block.pieces(PIECE):
            estimator.push(piece)
            momentum = estimator.momentum
            assert momentum is not None
            detector = momentum.changes.detector
            if piece.t[-1] > 12.0 and not raised:
                detector.state.onset, detector.state.alarm = detector.history[-2].end, detector.history[-1].end
                raised = True
            if momentum.state.held and not saved:
                estimator, saved = resumed(Estimator(described(), capture.channels, "false alarm"), estimator), True
    estimator.finish()
    assert estimator.momentum is not None
    expected = steady().momentum
    assert expected is not None
    assert saved
    assert estimator.events == []
    assert estimator.momentum.changes.detector.alarm is None
    assert estimator.momentum.joint.tracker.estimate().rows == expected.joint.tracker.estimate().rows
