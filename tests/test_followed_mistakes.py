"""Units that are others where points are too far from any motion to be reconstructed."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace

import numpy as np
import pytest

import sms_online as sms
from sms_online.diagnosis.captures import undone
from sms_online.diagnosis.followed_mistakes import TRIED, find_followed
from sms_online.effects.catalogue import parse_effect
from sms_online.errors import InputError
from sms_online.stream import Block
from tests.camera_rig import marked_bench

BENCH = marked_bench()
CHANNELS = ("tau_1", "q_1", "theta_m_1", "link_1.marker_1.x", "link_1.marker_1.y")
# What a motion of the bench keeps to.
LARGEST = np.array([2.0, 0.5, 0.5, 0.5, 0.5])
# Torques are small at first, and their unit hardly matters then.
T = np.arange(0.0, 6.0, 0.01)
VALUES = LARGEST * np.minimum(T / 4.0, 1.0)[:, None] * np.sin(3.0 * T)[:, None]


def wrong(factors: dict[str, float]) -> list[Block]:
    """A capture some of whose channels are in other units."""
    return [Block(T, CHANNELS, VALUES * [factors.get(name, 1.0) for name in CHANNELS])]


class Follower:
    """Follows what the bench can do. tried: seconds of each attempt."""

    def __init__(self) -> None:
        self.tried: list[float] = []

    def __call__(self, blocks: Sequence[Block]) -> list[Block]:
        (block,) = blocks
        self.tried.append(float(np.ptp(block.t)))
        size = np.abs(block.values).max(axis=0)
        if np.any(size > 1.5 * LARGEST) or np.any(size < 0.5 * LARGEST):
            raise InputError("capture", "", "no motion", "a motion")
        return [block]


@pytest.mark.parametrize(
    ("factors", "key"),
    [
        ({"tau_1": 1e3}, "torque_unit@tau_1"),
        ({"q_1": 180.0 / np.pi}, "degrees@q_1"),
        ({"q_1": 180.0 / np.pi, "theta_m_1": 180.0 / np.pi}, "degrees@all angles"),
        ({"link_1.marker_1.x": 1e3, "link_1.marker_1.y": 1e3}, "millimetres@all lengths"),
    ],
)
def test_the_unit_with_which_a_motion_follows_is_named(factors: dict[str, float], key: str) -> None:
    follower, capture = Follower(), wrong(factors)
    followed = find_followed(BENCH, capture, follower)
    assert followed is not None
    found, (as_followed,) = followed
    assert [mistake.key for mistake in found.mistakes] == [key]
    (corrected,) = undone(capture, found)
    np.testing.assert_allclose(corrected.values, VALUES, rtol=1e-12)
    np.testing.assert_array_equal(as_followed.values, corrected.values)
    # Some seconds with large torques first, then all.
    assert max(follower.tried[:-1]) <= TRIED
    assert follower.tried[-1] > 5.0


def test_samples_that_no_unit_explains_have_no_mistake() -> None:
    assert find_followed(BENCH, wrong({"tau_1": 1e3, "q_1": 40.0}), Follower()) is None


@pytest.mark.long
def test_torques_in_millinewton_metres_are_named_beside_points() -> None:
    """No motion follows them as they are; friction of 2 N m beside them is named as well."""
    acting = BENCH.model_copy(update={"effects": (parse_effect("coulomb_friction@joint_1:torque=2", BENCH),)})
    capture = sms.simulate(acting, 10.0, seed=3)
    values = capture.values.copy()
    values[:, capture.channels.index("tau_1")] *= 1e3
    found = sms.diagnose(BENCH, replace(capture, values=values))
    assert [mistake.key for mistake in found.mistakes] == ["torque_unit@tau_1"]
    assert [each.effect for each in found.effects] == ["coulomb_friction@joint_1"]
    assert found.effects[0].coefficients["torque"].value == pytest.approx(2.0, rel=0.1)
    assert found.trust.grave
