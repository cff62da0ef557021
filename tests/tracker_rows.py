"""Trackers of every kind, and rows for them."""

from __future__ import annotations

from collections.abc import Callable
from functools import partial

import numpy as np

from sms_online.stream import Array
from sms_online.trackers import (
    Directional,
    Exponential,
    Forgetting,
    KalmanTracker,
    NoForgetting,
    Prior,
    RecursiveLeastSquares,
    Rows,
    SlidingWindow,
    Tracker,
)
from tests.guide import fading

ALL_FORGETTING: tuple[Forgetting, ...] = (NoForgetting(), Exponential(0.999), SlidingWindow(1000), Directional(0.999))
N = 6
PI_TRUE = np.array([2.0, -1.0, 0.5, 3.0, -0.25, 1.5])


def kalman(process_std: float = 0.01, initial_std: float = 10.0) -> KalmanTracker:
    return KalmanTracker(N, np.full(N, process_std), Prior(np.zeros(N), np.full(N, initial_std)))


TRACKERS: dict[str, Callable[[], Tracker]] = {
    **{type(kind).__name__: partial(RecursiveLeastSquares, N, kind) for kind in ALL_FORGETTING},
    "KalmanTracker": kalman,
    "the guide's": partial(fading, N, 10.0),
}


def rows_of(Y: Array, b: Array, std: float | Array = 1.0) -> Rows:
    return Rows(Y, b, std * np.ones(b.size), 1e-3 * np.arange(b.size, dtype=np.float64))


def exciting_rows(seed: int, count: int, pi: Array = PI_TRUE, noise: float = 0.1) -> Rows:
    rng = np.random.default_rng(seed)
    Y = rng.normal(size=(count, pi.size))
    return rows_of(Y, Y @ pi + noise * rng.normal(size=count), noise)


def ill_conditioned_rows(seed: int, count: int, n: int, condition: float) -> tuple[Rows, Array]:
    """Rows of a given scaled condition number, in columns whose units differ by twelve decades."""
    rng = np.random.default_rng(seed)
    U, _ = np.linalg.qr(rng.normal(size=(count, n)))
    V, _ = np.linalg.qr(rng.normal(size=(n, n)))
    unit = 10.0 ** np.linspace(-6, 6, n)
    Y = np.sqrt(count) * (U * np.geomspace(1, 1 / condition, n)) @ V.T * unit
    pi = rng.normal(size=n) / unit
    std = rng.uniform(0.5, 2.0, size=count) * 1e-6
    return rows_of(Y, Y @ pi + std * rng.normal(size=count), std), pi
