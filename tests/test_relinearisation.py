"""Rows made again about another point, where they then show what those before did not."""

from __future__ import annotations

from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest

import sms_online as sms
from sms_online.description.channels import channels
from sms_online.pipeline.estimator import Estimator
from sms_online.pipeline.relinearisation import Relinearisation


def momentum(events: int, weights: int) -> SimpleNamespace:
    """A balance that has found so many events, and estimates so many parameters."""
    return SimpleNamespace(
        changes=SimpleNamespace(events=[None] * events, shifts=[]),
        lacking=lambda last: False,
        started=True,
        fit=SimpleNamespace(plain=SimpleNamespace(windows=100)),
        weights=np.zeros(weights),
        joint_estimate=None,
        joint=SimpleNamespace(row_variance=lambda fit: 1.0),
    )


def test_an_event_in_rows_made_again_ends_the_steps(monkeypatch: pytest.MonkeyPatch) -> None:
    """Parameters that it adds are none that rows from before it could be weighted with."""
    system = sms.load_system("paper-planar")
    stage = Estimator(system, channels(system), "planar")._relinearisation
    assert stage is not None
    made, forgotten = list[int](), list[bool]()

    def again(self: Relinearisation, weights: np.ndarray[Any, Any], *_: object) -> None:
        made.append(weights.size)
        self.momentum = momentum(events=1, weights=weights.size + 1)  # type: ignore[assignment]

    monkeypatch.setattr(Relinearisation, "_make_rows_again", again)
    stage.momentum = momentum(events=0, weights=5)  # type: ignore[assignment]
    monkeypatch.setattr(stage.linearisation, "looks", lambda windows, last: True)
    monkeypatch.setattr(stage.linearisation, "moves", lambda estimate: True)
    monkeypatch.setattr(stage.linearisation, "forget", lambda: forgotten.append(True))
    stage._look(None, last=False)  # type: ignore[arg-type]
    assert made == [5]
    assert forgotten == [True]
