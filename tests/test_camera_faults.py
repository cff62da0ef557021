"""Markers that are missing, hidden or swapped: what a simulation makes of them, and what a session does about it."""

from __future__ import annotations

from itertools import pairwise

import numpy as np
import pytest
from numpy.testing import assert_array_equal

from sms_online.description.schema import System
from sms_online.effects.build import build_model
from sms_online.errors import InputError
from sms_online.pipeline.marker_identity import MarkerIdentity
from sms_online.pipeline.sensing import Sensing
from sms_online.stream import Array, Block
from sms_sim.camera_faults import CameraFaults, parse_fault, parsed_faults
from sms_sim.simulate import Simulation, sampled_blocks, simulate
from tests.camera_rig import FAULTS, bound_of, marked_bench, seen_by_cameras
from tests.evaluated import results_document
from tests.sessions_of import normalised, session_of

SWAPPED = "swapped@link_1.marker_1+link_1.marker_2:begin=0.5,over=1"


@pytest.fixture(scope="module")
def system() -> System:
    return marked_bench()


@pytest.fixture(scope="module")
def simulation(system: System) -> Simulation:
    return simulate(system)


@pytest.fixture(scope="module")
def block(simulation: Simulation) -> Block:
    """The whole session."""
    blocks = list(sampled_blocks(simulation, None, 0))
    t, values = (np.concatenate([getattr(each, name) for each in blocks]) for name in ("t", "values"))
    return Block(t, blocks[0].channels, values)


def faulty(block: Block, *faults: str) -> Block:
    return CameraFaults(parsed_faults(faults), block.channels, seed=0)(block)


def seen(block: Block, channel: str) -> Array:
    values = block.values[:, block.channels.index(channel)]
    return np.asarray(values[np.isfinite(values)])


def test_faults_take_what_they_say(block: Block) -> None:
    missing = faulty(block, "missing@link_1.marker_1:share=0.25")
    whole = seen(block, "link_1.marker_1.x").size
    assert abs(seen(missing, "link_1.marker_1.x").size - 0.75 * whole) < 4.0 * np.sqrt(0.25 * 0.75 * whole)
    assert seen(missing, "link_1.marker_2.x").size == whole
    hidden = faulty(block, "hidden@link_1.*:begin=1,over=0.5")
    inside = (block.t >= 1.0) & (block.t < 1.5)
    point = block.channels.index("link_1.marker_2.y")
    assert np.isnan(hidden.values[inside, point]).all()
    assert_array_equal(hidden.values[~inside], block.values[~inside])
    swapped = faulty(block, "swapped@link_1.marker_1+link_1.marker_2:begin=1,over=0.5")
    assert_array_equal(swapped.values[inside, point], block.values[inside, block.channels.index("link_1.marker_1.y")])


@pytest.mark.parametrize(
    "wrong",
    ["missing@link_1.*", "missing@link_1.*:share=2", "hidden@link_1.*:share=0.1", "swapped@a:begin=1,over=1", "lost@b"],
)
def test_a_fault_that_is_none_is_one_clear_line(wrong: str) -> None:
    with pytest.raises(InputError, match="expected missing@MARKERS"):
        parse_fault(wrong)


def test_a_fault_of_an_unknown_marker_names_the_known_ones(block: Block) -> None:
    with pytest.raises(InputError, match=r"no marker 'link_3\.\*'.*link_1\.marker_1, link_1\.marker_2"):
        faulty(block, "hidden@link_3.*:begin=1,over=1")


def relabelled(system: System, block: Block, cuts: list[int]) -> tuple[Array, MarkerIdentity]:
    model = build_model(system)
    sensing = Sensing(model, block.channels, "test")
    order = [block.channels.index(name) for name in sensing.channels]
    identity = MarkerIdentity(model, sensing, sensing.channels)
    parts = [identity.push(block.t[a:b], block.values[a:b][:, order]) for a, b in pairwise([0, *cuts, block.t.size])]
    return np.concatenate(parts)[:, np.argsort(order)], identity


def test_swapped_markers_are_given_back_their_names(system: System, block: Block) -> None:
    swapped = faulty(block, "missing@link_1.*:share=0.1", SWAPPED)
    honest = faulty(block, "missing@link_1.*:share=0.1")
    values, identity = relabelled(system, swapped, [300, 301, 900])
    assert_array_equal(values, honest.values)
    (swap,) = identity.state.swaps
    assert (swap.first, swap.second) == ("link_1.marker_1", "link_1.marker_2")
    assert 0.5 <= swap.begin < 0.53
    assert 1.47 < swap.end <= 1.5


def test_markers_in_their_places_are_left_alone(system: System, block: Block) -> None:
    hidden = faulty(block, "hidden@link_1.*:begin=1,over=0.5")
    values, identity = relabelled(system, hidden, [700])
    assert_array_equal(values, hidden.values)
    assert identity.state.swaps == []


def test_a_session_bridges_a_hidden_link_and_names_a_swap(system: System, block: Block) -> None:
    faults = ("missing@link_1.*:share=0.1", "hidden@link_1.*:begin=1.8,over=0.5", SWAPPED)
    estimator = session_of(system, [faulty(block, *faults)])
    assert estimator.by_smoother
    assert estimator.smoother is not None
    assert estimator.smoother.known.spans == 1
    assert np.all(np.abs(normalised(estimator)) < 4.0)
    named = "link_1.marker_1 and link_1.marker_2 swapped from 0.5"
    assert any(warning.startswith(named) for warning in results_document(estimator, 1.0, [])["warnings"])


@pytest.mark.long
def test_an_arm_is_identified_in_spite_of_faults() -> None:
    system = seen_by_cameras("paper-planar")
    simulation = simulate(system)
    blocks = list(sampled_blocks(simulation, None, 1))
    faults = CameraFaults(parsed_faults(FAULTS), blocks[0].channels, seed=1)
    estimator = session_of(system, [faults(block) for block in blocks])
    assert estimator.by_smoother
    assert estimator.smoother is not None
    assert not estimator.smoother.known.failures
    assert np.all(np.abs(normalised(estimator)) < 4.0)
    # A tenth of the points is missing, and those of a link for a tenth of the time.
    assert np.all(estimator.estimate().std < 1.2 * bound_of(simulation))
    assert [(swap.first, swap.second) for swap in estimator.swaps] == [("link_1.marker_1", "link_1.marker_2")]
