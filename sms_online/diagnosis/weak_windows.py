"""Windows of the weak form over a whole session, and what any columns of momentum and force are in them."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from sms_online.diagnosis.record import Segment
from sms_online.model.layout import Layout
from sms_online.pipeline.sensing import Sensing
from sms_online.pipeline.smoothing import smooth
from sms_online.pipeline.weak_form import test_function
from sms_online.stream import Array


@dataclass(frozen=True)
class Motion:
    """Smoothed motion at the samples that some windows see.

    segment: its number. samples (K,): numbers in the segment. x (K, n_x), v (K, n_v), torque (K, joints): n τ.
    """

    segment: int
    samples: NDArray[np.int64]
    x: Array
    v: Array
    torque: Array


# Columns of momentum and force (K, n_v, c) of d/dt(P c) - G c = Q along a motion; no P where there is none.
WeakColumns = Callable[[Motion], tuple[Array | None, Array]]


@dataclass(frozen=True)
class Windows:
    """Where windows are and how they see the motion.

    segment, start, half_width (W,): number of the segment, first sample in it, M of the filter. width: samples from
    first to last. exponent: of the test function (1 - z²)^exponent. stride: gives for M to take one sample in so many.
    """

    segment: NDArray[np.int64]
    start: NDArray[np.int64]
    half_width: NDArray[np.int64]
    width: int
    exponent: int
    stride: Callable[[int], int]


class WeakWindows:
    """Evaluates columns in the windows of a session: -∫ (φ̇ P + φ G) dt."""

    def __init__(
        self, windows: Windows, layout: Layout, sensing: Sensing, segments: Sequence[Segment], sample_rate: float
    ) -> None:
        self.windows, self.segments = windows, segments
        self._layout, self._sensing, self._rate = layout, sensing, sample_rate
        self._motions: list[tuple[Motion, NDArray[np.int64]]] | None = None

    @property
    def count(self) -> int:
        """Number of windows W."""
        return self.windows.start.size

    def motions(self) -> list[tuple[Motion, NDArray[np.int64]]]:
        """Motion of each segment and filter width, and the numbers of the windows that see it."""
        if self._motions is None:
            self._motions = [
                self._motion(number, M)
                for number in range(len(self.segments))
                for M in np.unique(self.windows.half_width[self.windows.segment == number]).tolist()
            ]
        return self._motions

    def _motion(self, number: int, M: int) -> tuple[Motion, NDArray[np.int64]]:
        w, n_x, samples = self.windows, self._layout.n_x, self.segments[number].values
        signals = np.concatenate((self._sensing.coordinates(samples), self._sensing.joint_torque(samples)), axis=1)
        which = np.flatnonzero((w.segment == number) & (w.half_width == M))
        inside = np.arange(0, w.width + 1, w.stride(M))
        seen = np.unique((w.start[which, None] + inside).ravel())
        smoothed, rates = smooth(signals, seen, M, self._rate)
        x = smoothed[:, :n_x]
        v = self._layout.speeds(x, rates[:, :n_x])
        return Motion(number, seen, x, v, smoothed[:, n_x:]), which

    def columns(self, weak: WeakColumns) -> Array:
        """Rows (W, n_v, c)."""
        w = self.windows
        out: Array | None = None
        for motion, which in self.motions():
            P, G = weak(motion)
            if out is None:
                out = np.zeros((self.count, *G.shape[1:]))
            step = w.stride(int(w.half_width[which[0]]))
            phi, phi_dot, _ = test_function(w.width // step, w.width / self._rate, w.exponent)
            firsts = np.searchsorted(motion.samples, w.start[which])
            flat = np.concatenate([part.reshape(len(G), -1) for part in (G, P) if part is not None], axis=1)
            size = G[0].size
            for k, first in zip(which, firsts, strict=True):
                seen = flat[first : first + phi.size]
                weighted = phi @ seen[:, :size] if P is None else phi @ seen[:, :size] + phi_dot @ seen[:, size:]
                out[k] = (-step / self._rate * weighted).reshape(out.shape[1:])
        assert out is not None
        return out
