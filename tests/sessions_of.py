"""Whole sessions of given blocks, and how far their estimates are from the truth."""

from __future__ import annotations

from collections.abc import Iterable

import numpy as np

from sms_online.description.schema import System
from sms_online.pipeline.estimator import Estimator
from sms_online.stream import Array, Block


def session_of(system: System, blocks: Iterable[Block]) -> Estimator:
    """A finished session of all blocks."""
    estimator: Estimator | None = None
    for block in blocks:
        estimator = Estimator(system, block.channels, "simulation") if estimator is None else estimator
        estimator.push(block)
    assert estimator is not None
    estimator.finish()
    return estimator


def normalised(estimator: Estimator) -> Array:
    """Errors (n,) in standard deviations."""
    truth = estimator.base.values(estimator.model.nominal)
    return np.asarray((estimator.estimate().pi - truth) / estimator.estimate().std)
