"""Windows of the weak form over a whole session, and what any columns of momentum and force are in them."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass

import numpy as np
import scipy.sparse
from scipy.signal import oaconvolve

from sms_online.diagnosis.record import Segment
from sms_online.model.layout import Layout
from sms_online.pipeline.momentum_windows import HOPS, INSTANTS
from sms_online.pipeline.row_noise import common
from sms_online.pipeline.sensing import Sensing
from sms_online.pipeline.smoothing import kernel, smooth, smooth_all
from sms_online.pipeline.weak_form import effective_samples, test_function
from sms_online.stream import Array, Indices


@dataclass(frozen=True)
class SeenMotion:
    """Smoothed motion at the samples that some windows see.

    segment: its number. half_width: of the filter, samples. samples (K,): numbers in the segment. x (K, n_x), v (K,
    n_v), torque (K, joints): n τ.
    """

    segment: int
    half_width: int
    samples: Indices
    x: Array
    v: Array
    torque: Array


# Columns of momentum and force (K, n_v, c) of d/dt(P c) - G c = Q along a motion; no P where there is none.
WeakColumns = Callable[[SeenMotion], tuple[Array | None, Array]]


@dataclass(frozen=True)
class WindowPlaces:
    """Where windows are and how they see the motion.

    segment, start, half_width (W,): number of the segment, first sample in it, M of the filter. width: samples from
    first to last. exponent: of the test function (1 - z²)^exponent. stride: gives for M to take one sample in so many.
    """

    segment: Indices
    start: Indices
    half_width: Indices
    width: int
    exponent: int
    stride: Callable[[int], int]


class WeakWindows:
    """Evaluates columns in the windows of a session: -∫ (φ̇ P + φ G) dt."""

    def __init__(
        self, windows: WindowPlaces, layout: Layout, sensing: Sensing, segments: Sequence[Segment], sample_rate: float
    ) -> None:
        self.windows, self.segments = windows, segments
        self._layout, self._rate = layout, sample_rate
        self._signals = [
            np.concatenate((sensing.coordinates(segment.values), sensing.inputs(segment.values)), axis=1)
            for segment in segments
        ]
        self._motions: dict[bool, list[tuple[SeenMotion, Indices]]] = {}
        self._operators: dict[bool, list[tuple[scipy.sparse.csr_array, scipy.sparse.csr_array]]] = {}

    @property
    def count(self) -> int:
        """Number of windows W."""
        return self.windows.start.size

    def motions(self, dense: bool = False) -> list[tuple[SeenMotion, Indices]]:
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

    def _motion(self, number: int, M: int, dense: bool) -> tuple[SeenMotion, Indices]:
        w, n_x = self.windows, self._layout.n_x
        signals = self._signals[number]
        which = np.flatnonzero((w.segment == number) & (w.half_width == M))
        inside = np.arange(0, w.width + 1, self._step(M, dense))
        seen = np.unique((w.start[which, None] + inside).ravel())
        if dense:
            smoothed, rates = (part[seen - M] for part in smooth_all(signals, M, self._rate))
        else:
            smoothed, rates = smooth(signals, seen, M, self._rate)
        x = smoothed[:, :n_x]
        v = self._layout.speeds(x, rates[:, :n_x])
        return SeenMotion(number, M, seen, x, v, smoothed[:, n_x:]), which

    @property
    def effective_samples(self) -> float:
        """Samples that a window averages over, see `weak_form.effective_samples`."""
        return effective_samples(test_function(self.windows.width, 1.0, self.windows.exponent)[0])

    def columns(self, weak: WeakColumns, dense: bool = False) -> Array:
        """Rows (W, n_v, c).

        dense: from every sample. What is no smooth function of the motion, or turns fast with it (a cogging's phase),
        holds frequencies that a thinned motion folds back into the rows.
        """
        out: Array | None = None
        for (motion, which), operators in zip(self.motions(dense), self._sums(dense), strict=True):
            P, G = weak(motion)
            if out is None:
                out = np.zeros((self.count, *G.shape[1:]))
            for part, operator in zip((G, P), operators, strict=True):
                if part is None:
                    continue
                flat = part.reshape(len(part), -1)
                # A force acts on few of the rows.
                acts = np.flatnonzero(np.any(flat, axis=0))
                out.reshape(self.count, -1)[np.ix_(which, acts)] -= operator @ flat[:, acts]
        assert out is not None
        return out

    def squares(self, squares: Callable[[SeenMotion], Array]) -> Array:
        """Squares (W, INSTANTS, n_v) of the rows' parts by half hops, of a force that is off anew at every sample.

        squares: gives those of what it is off by, (K, n_v).
        """
        parts = np.zeros((self.count, INSTANTS, self._layout.n_v))
        for (motion, which), (by_force, _) in zip(self.motions(dense=True), self._sums(dense=True), strict=True):
            # The last sample, where the test function is zero, is the first of the next half hop.
            seen, weights = (part.reshape(which.size, -1)[:, :-1] for part in (by_force.indices, by_force.data))
            off = squares(motion)
            for row in np.flatnonzero(np.any(off, axis=0)):
                inside = weights**2 * off[seen, row]
                parts[which, :, row] = inside.reshape(which.size, INSTANTS, -1).sum(axis=2)
        return parts

    def shared(self, parts: Array) -> Array:
        """Covariances (W, HOPS, n_v) of each speed's row with its own, then with those of the windows before.

        By a force whose parts in the half hops (W, INSTANTS, n_v) are off by so much.
        """
        out, segment = np.zeros((self.count, HOPS, self._layout.n_v)), self.windows.segment
        for hops in range(min(HOPS, self.count)):
            later = hops + np.flatnonzero(segment[hops:] == segment[: self.count - hops])
            out[later, hops] = common(parts[later], parts[later - hops], hops)
        return out

    def spread(self, slopes: Callable[[SeenMotion], tuple[Array, Array]]) -> Array:
        """Variance of the rows (W, n_v) for white noise of some readings, to first order.

        slopes: gives (S, K, n_v) of a force by the smoothed value of each of S readings, and by its change from sample
        to sample, times the deviation of a sample.
        """
        out = np.zeros((self.count, self._layout.n_v))
        for (motion, which), (by_force, _) in zip(self.motions(dense=True), self._sums(dense=True), strict=True):
            seen = by_force.indices.reshape(which.size, -1)
            weights = by_force.data.reshape(which.size, -1)
            for parts in zip(*slopes(motion), strict=True):
                for row in np.flatnonzero(np.any(parts, axis=(0, 1))):
                    filtered = [
                        oaconvolve(weights * part[seen, row], column[None], axes=1)
                        for part, column in zip(parts, kernel(motion.half_width).T, strict=True)
                    ]
                    out[which, row] += np.sum(np.square(sum(filtered)), axis=1)
        return out

    def _sums(self, dense: bool) -> list[tuple[scipy.sparse.csr_array, scipy.sparse.csr_array]]:
        """For each of `motions`, what makes ∫ φ · dt and ∫ φ̇ · dt of its windows (W', K) of values at its samples."""
        if dense not in self._operators:
            self._operators[dense] = [self._sum(*seen, dense) for seen in self.motions(dense)]
        return self._operators[dense]

    def _sum(
        self, motion: SeenMotion, which: Indices, dense: bool
    ) -> tuple[scipy.sparse.csr_array, scipy.sparse.csr_array]:
        w = self.windows
        step = self._step(int(w.half_width[which[0]]), dense)
        phi, phi_dot, _ = test_function(w.width // step, w.width / self._rate, w.exponent)
        firsts = np.searchsorted(motion.samples, w.start[which])
        columns = (firsts[:, None] + np.arange(phi.size)).ravel()
        rows = np.arange(0, columns.size + 1, phi.size)
        shape = which.size, motion.samples.size
        weights = (np.tile(step / self._rate * values, which.size) for values in (phi, phi_dot))
        by_force, by_momentum = (scipy.sparse.csr_array((each, columns, rows), shape=shape) for each in weights)
        return by_force, by_momentum
