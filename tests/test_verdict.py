"""What a diagnosis may say: verdicts of made-up residuals, links that stiffen, axes that stand still."""

from __future__ import annotations

from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest

from sms_adapters.system_file import load_system
from sms_online.description.schema import Effect, System
from sms_online.diagnosis import diagnose
from sms_online.diagnosis.residuals import RowResidual
from sms_online.diagnosis.standstill import Standstill
from sms_online.diagnosis.weak_windows import Motion


def _finding(name: str) -> Any:
    return SimpleNamespace(candidate=SimpleNamespace(effect=Effect(name=name, where="joint_1")))


@pytest.mark.parametrize(
    ("found", "left", "times_noise", "verdict"),
    [
        ([], 0.0, 1.0, "clean"),
        ([], 1.0, 4.0, "unexplained"),
        (["cogging"], 0.0, 1.0, "named"),
        (["cogging"], 0.2, 4.0, "unexplained"),
        # The right effect leaves hardly more than noise; one that is near it leaves a share that noise is not.
        (["cogging"], 0.005, 1.6, "named"),
        (["cogging"], 0.005, 14.0, "unexplained"),
        # No law is exact, and that of dry friction least.
        (["cogging"], 1e-6, 14.0, "named"),
        (["cogging"], 5e-4, 14.0, "unexplained"),
        (["coulomb_friction"], 5e-4, 14.0, "named"),
    ],
)
def test_the_verdict_follows_from_what_is_left(found: list[str], left: float, times_noise: float, verdict: str) -> None:
    rows = {"joint_1": RowResidual(times_noise, 1.2), "base": RowResidual(1.0, 1.2)}
    assert diagnose._verdict(bool(found), left, rows, [_finding(name) for name in found]) == verdict


@pytest.mark.parametrize(
    ("excess", "exact"),
    [
        # What is left with these links exact, of a system with two straight ones.
        ({"": 1e6, "link_1": 10.0, "link_2": 9e5, "link_1 link_2": 2e5}, "link_1"),
        ({"": 1e6, "link_1": 10.0, "link_2": 9e5, "link_1 link_2": 5.0}, "link_1"),
        ({"": 1e6, "link_1": 5e4, "link_2": 9e5, "link_1 link_2": 5.0}, "link_1 link_2"),
        ({"": 1e6, "link_1": 9.5e5, "link_2": 1.2e6, "link_1 link_2": 9.9e5}, None),
        # Readings that no exact link gives.
        ({"": 1e6, "link_1": 9.5e5, "link_2": None, "link_1 link_2": None}, None),
    ],
)
def test_links_stiffen_that_take_something_away(
    monkeypatch: pytest.MonkeyPatch, excess: dict[str, float | None], exact: str | None
) -> None:
    class Attempted:
        def __init__(self, case: Any, system: System, *_: Any) -> None:
            self.links = " ".join(effect.where for effect in system.effects)
            self.left = excess[self.links]
            if self.left is None:
                raise np.linalg.LinAlgError

        def excess(self, chosen: Any) -> float | None:
            return self.left

    monkeypatch.setattr(diagnose, "Attempt", Attempted)
    attempt: Any = SimpleNamespace(system=load_system("paper-planar"))
    case: Any = None
    found: Any = diagnose._stiffened(case, attempt, np.zeros(1), [])
    assert (None if found is None else found.links) == exact


def test_an_axis_stands_still_where_its_rate_is_noise_for_longer_than_a_reversal() -> None:
    """A rate that reverses at 0.5 s and rests from 1 to 1.3 s, noise of 1 mrad/s, seed 5."""
    t = np.arange(2000) / 1000.0
    rate = np.where(t < 1.0, np.sin(2.0 * np.pi * t), np.where(t < 1.3, 0.0, 1.0))

    def windows(noise: float) -> Any:
        v = (rate + noise * np.random.default_rng(5).standard_normal(t.size))[:, None]
        motion = Motion(0, np.arange(t.size), v, v, v)
        return SimpleNamespace(motions=lambda dense: [(motion, np.arange(1))])

    rows: Any = SimpleNamespace(weak=windows(0.0), model=SimpleNamespace(system=SimpleNamespace(sample_rate=1000.0)))
    held = Standstill(rows, windows(1e-3), 0)
    assert held.slow == pytest.approx(4e-3, rel=0.1)
    (motion, _), *_ = rows.weak.motions(True)
    assert t[held.at(motion)][[0, -1]] == pytest.approx([1.0, 1.3], abs=2e-3)
    assert held.at(motion).sum() == pytest.approx(300, abs=2)
