"""Windows of the weak form over a whole session, and what any columns of momentum and force are in them."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass

import numpy as np
from numpy.lib.stride_tricks import sliding_window_view
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
        self._layout, self._rate = layout, sample_rate
        self._signals = [
            np.concatenate((sensing.coordinates(segment.values), sensing.joint_torque(segment.values)), axis=1)
            for segment in segments
        ]
        self._motions: dict[bool, list[tuple[Motion, NDArray[np.int64]]]] = {}

    @property
    def count(self) -> int:
        """Number of windows W."""
        return self.windows.start.size

    def motions(self, dense: bool = False) -> list[tuple[Motion, NDArray[np.int64]]]:
        """Motion of each segment and filter width, and the numbers of the windows that see it; dense: every sample."""
        if dense not in self._motions:
            self._motions[dense] = [
                self._motion(number, M, dense)
                for number in range(len(self.segments))
                for M in np.unique(self.windows.half_width[self.windows.segment == number]).tolist()
            ]
        return self._motions[dense]

    def _step(self, M: int, dense: bool) -> int:
        return 1 if dense else self.windows.stride(M)

    def _motion(self, number: int, M: int, dense: bool) -> tuple[Motion, NDArray[np.int64]]:
        w, n_x = self.windows, self._layout.n_x
        signals = self._signals[number]
        which = np.flatnonzero((w.segment == number) & (w.half_width == M))
        inside = np.arange(0, w.width + 1, self._step(M, dense))
        seen = np.unique((w.start[which, None] + inside).ravel())
        smoothed, rates = smooth(signals, seen, M, self._rate)
        x = smoothed[:, :n_x]
        v = self._layout.speeds(x, rates[:, :n_x])
        return Motion(number, seen, x, v, smoothed[:, n_x:]), which

    def columns(self, weak: WeakColumns, dense: bool = False) -> Array:
        """Rows (W, n_v, c).

        dense: from every sample. What is no smooth function of the motion, or turns fast with it (a cogging's phase),
        holds frequencies that a thinned motion folds back into the rows.
        """
        w = self.windows
        out: Array | None = None
        for motion, which in self.motions(dense):
            P, G = weak(motion)
            if out is None:
                out = np.zeros((self.count, *G.shape[1:]))
            step = self._step(int(w.half_width[which[0]]), dense)
            phi, phi_dot, _ = test_function(w.width // step, w.width / self._rate, w.exponent)
            firsts = np.searchsorted(motion.samples, w.start[which])
            for part, weights in ((G, phi), (P, phi_dot)):
                if part is None:
                    continue
                flat = part.reshape(len(part), -1)
                # A force acts on few of the rows.
                acts = np.flatnonzero(np.any(flat, axis=0))
                seen = sliding_window_view(flat[:, acts], phi.size, axis=0)
                weighted = np.stack([seen[first] @ weights for first in firsts])
                out.reshape(self.count, -1)[np.ix_(which, acts)] -= step / self._rate * weighted
        assert out is not None
        return out
