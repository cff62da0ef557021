"""Rows without a torque, made free of the scale of π to first order.

Such rows are homogeneous in π: they leave r = -Yπ, and least squares lowers that by shrinking π. This matters where
they hold more than noise, and where torques fix the scale so weakly that noise in the columns alone attenuates it. What
counts is r beside the size s(π) of its terms, as in the criterion of the estimate (see `pipeline.criterion`). About π°

    r(π) s(π°) / s(π) = r° - (Y + r° gᵀ) (π - π°) + …,    g = Mπ° / s(π°)²,    s² = πᵀ M π,

which are rows of least squares again, with columns Y + r° gᵀ: π°, along which all of them shrink, is no direction of
theirs any more, and only rows with a torque fix the scale. Solved again and again, each time about the solution before,
they lead to where the criterion is least (Gauss and Newton).
"""

from __future__ import annotations

from collections.abc import Callable, Iterator, Sequence

import numpy as np
from scipy.linalg import solve_triangular

from sms_online.diagnosis.evidence import bounded
from sms_online.stream import Array, Mask

# Fits about the solution before, at most, and halvings of a step that does not lower what is asked for.
FITS, HALVINGS = 16, 6
# What rows determine to less than this share of their columns' size stays near given parameters.
NEAR = 1e-3
# Gain of the sum of logarithms below which a fit is the last.
SAME = 1e-3
# Standard deviations of the scale of π by which noise in the columns may attenuate it.
LARGEST_ATTENUATION = 1.0


class HomogeneousRows:
    """Frees some speeds' rows (W, n_v, n) of a model."""

    def __init__(self, Y: Array, speeds: Sequence[int], inertial: Mask) -> None:
        """inertial (n,): which columns are inertial forces: they may cancel each other, and so count as one."""
        same = np.outer(inertial, inertial) | np.eye(inertial.size, dtype=bool)
        self._Y = Y
        self._metric = {speed: np.where(same, Y[:, speed].T @ Y[:, speed], 0.0) for speed in speeds}

    def squares(self, pi: Array, left: Array, expected: Array) -> Array:
        """Mean squares (n_v,) of what parameters (n,) leave (W, n_v), freed rows as large as expected (n,) has them."""
        out = np.mean(left**2, axis=0)
        for speed, M in self._metric.items():
            size = np.maximum(pi @ M @ pi, np.finfo(np.float64).tiny)
            with np.errstate(over="ignore", invalid="ignore"):  # of a step to parameters without rows
                out[speed] *= (expected @ M @ expected) / size
        return np.asarray(out)

    def about(self, pi: Array, left: Array) -> tuple[Array, Array]:
        """Columns (W, n_v, n) about parameters (n,) that leave (W, n_v), and what is added to the right-hand side."""
        columns, added = self._Y.copy(), np.zeros_like(left)
        for speed, g in self._directions(pi):
            columns[:, speed] += left[:, speed, None] * g
            added[:, speed] = left[:, speed]
        return columns, added

    def solved(self, beside: Array, b: Array, start: Array, near: Array, least: float, positive: Mask) -> Array:
        """Solution (n + c,) of rows b (W, n_v) with columns beside (W, n_v, c), weighted by what each speed leaves.

        start, near (n,): parameters to begin with, and those that rows which determine nothing else stay near. least:
        mean square of what noise alone leaves. positive (n + c,): which unknowns are not negative.
        """
        columns, n = np.concatenate((self._Y, beside), axis=2), self._Y.shape[2]
        first, anchor = np.zeros((2, columns.shape[2]))
        first[:n], anchor[:n] = start, near
        std = np.sqrt(np.maximum(least, np.mean((b - columns @ first) ** 2, axis=0)))
        lengths = NEAR * np.linalg.norm(columns / std[:, None], axis=(0, 1))
        unseen = lengths == 0.0
        first[unseen] = anchor[unseen] = 0.0
        by_speed = np.ascontiguousarray(columns.swapaxes(0, 1))
        grams = by_speed.swapaxes(1, 2) @ by_speed
        known = np.diag(np.where(unseen, 1.0, lengths**2))

        def cost(solution: Array) -> float:
            squares = self.squares(solution[:n], b - columns @ solution, start) / least
            return cost_of(squares, lengths * (solution - anchor), len(b))

        def fit(solution: Array) -> Array:
            left = b - columns @ solution
            squares = np.sum(left**2, axis=0)
            weight = 1.0 / np.maximum(least, squares / len(b))
            downhill = np.einsum("vwc,wv->vc", by_speed, left)
            information = known + np.tensordot(weight, grams, 1)
            slope = weight @ downhill - lengths**2 * (solution - anchor)
            for speed, g in self._directions(solution[:n]):
                along = np.zeros(solution.size)
                along[:n] = g
                cross = np.outer(downhill[speed], along)
                information += weight[speed] * (cross + cross.T + squares[speed] * np.outer(along, along))
                slope += weight[speed] * squares[speed] * along
            size = np.sqrt(np.diag(information))
            root = _root(information / np.outer(size, size)) * size
            aim = root @ solution + solve_triangular(root, slope, trans="T")
            found = solve_triangular(root, aim)
            return bounded(root, aim, positive) if np.any(found[positive] < 0.0) else found

        return converged(fit, first, cost)

    def _directions(self, pi: Array) -> Iterator[tuple[int, Array]]:
        """Freed speeds and their g (n,) at parameters (n,), where these make such rows at all."""
        for speed, M in self._metric.items():
            squares = float(pi @ M @ pi)
            if squares > 0.0:
                yield speed, M @ pi / squares


def _root(information: Array) -> Array:
    """Upper triangular root of an information matrix (n, n) of unit diagonal, which rounding may leave indefinite."""
    try:
        return np.asarray(np.linalg.cholesky(information).T)
    except np.linalg.LinAlgError:
        share, axes = np.linalg.eigh(information)
        lost = len(share) * np.finfo(np.float64).eps * share[-1]
        return np.asarray(np.linalg.qr(np.sqrt(np.maximum(share, lost))[:, None] * axes.T, mode="r"))


class Scale:
    """Whether anything fixes the scale of π in a session's rows, and which of them count by their size as nothing does.

    expected (n,): parameters behind the weights. at (n,): those that fits begin from and rows are linear about. freed:
    speeds whose rows count by their size. exceeds: whether they do because rows leave more than noise whatever is
    added, and not by attenuation alone.
    """

    def __init__(self, b: Array, expected: Array, inertial: Mask, known: bool) -> None:
        """b (W, n_v): torques of the rows. expected (n,): parameters behind their weights. known: a prior gives it."""
        self.homogeneous = ~np.any(b, axis=0)
        self.unknown = not known and bool(expected.any()) and bool(self.homogeneous.any())
        self.expected, self._inertial = expected, inertial
        self.begin()

    def begin(self) -> None:
        """Nothing is fitted yet."""
        self.freed: list[int] = []
        self.exceeds = False
        self.at = self.expected

    def free(self, exceeds: bool, terms: Array) -> None:
        """Free rows without a torque where rows leave more than noise, or where noise attenuates the scale of π.

        terms (W, n_v): of whitened rows, with the parameters that are expected.
        """
        self.exceeds = exceeds and self.unknown
        free = self.unknown and (exceeds or self._attenuation(terms) > LARGEST_ATTENUATION)
        self.freed = np.flatnonzero(self.homogeneous).tolist() if free else []

    def _attenuation(self, terms: Array) -> float:
        """Shift of the scale of π by noise in the columns, in its standard deviations.

        Rows without a torque have noise of unit variance for terms that are zero: so much of a least-squares fit's
        information on the scale is none.
        """
        noise = float(len(terms) * np.count_nonzero(self.homogeneous))
        return float(noise / np.sqrt(noise + np.sum(terms[:, ~self.homogeneous] ** 2)))

    def fit(self, Y: Array, beside: Array, b: Array, positive: Mask) -> tuple[Array, Array, Array]:
        """Solution (n + c,) of rows b (W, n_v) with columns (W, n_v, n) and beside (W, n_v, c), and what it leaves.

        Each type of rows counts by what it leaves, those without a torque by their size. Mean squares (n_v,), then the
        same with these as large as the parameters behind the weights make them.
        """
        free, n = HomogeneousRows(Y, np.flatnonzero(self.homogeneous).tolist(), self._inertial), Y.shape[2]
        solution = free.solved(beside, b, self.at, self.expected, 1.0, positive)
        left = b - np.concatenate((Y, beside), axis=2) @ solution
        return solution, np.mean(left**2, axis=0), free.squares(solution[:n], left, self.expected)

    def near(self, white: Array) -> tuple[Array, Array]:
        """Rows (n, n) and right-hand side that keep what columns (M, n) hardly determine near what is expected."""
        lengths = NEAR * np.linalg.norm(white, axis=0)
        value = lengths * self.expected
        if self.exceeds:
            return np.diag(lengths), value
        # In proportion to what is expected: torques fix the scale, though weakly.
        along = value / np.linalg.norm(value)
        return (np.eye(value.size) - np.outer(along, along)) * lengths, np.zeros_like(value)

    def linearise(self, white: Array, b: Array, rest: Array, solve: Callable[[Array, Array], Array]) -> None:
        """Solve whitened rows (W, n_v, n) with right-hand side (W, n_v), each time about the solution before.

        rest (W, n_v, c): columns beside them. solve: takes columns and right-hand side about a point, gives the
        solution (n + c,), that of the least cost last.
        """
        free, n, W = HomogeneousRows(white, self.freed, self._inertial), white.shape[2], len(white)
        near, known = self.near(white.reshape(-1, n))

        def left(solution: Array) -> Array:
            return np.asarray(b - white @ solution[:n] - rest @ solution[n:])

        def about(solution: Array) -> Array:
            Y, added = free.about(solution[:n], left(solution))
            return solve(Y, b + added)

        def cost(solution: Array) -> float:
            off = known - near @ solution[:n]
            squares = free.squares(solution[:n], left(solution), self.at)
            # Where rows hold noise alone its variance is known.
            return cost_of(squares, off, W) if self.exceeds else float(squares.sum() + off @ off / W)

        about(converged(about, np.concatenate((self.at, np.zeros(rest.shape[2]))), cost))


def converged(fit: Callable[[Array], Array], start: Array, cost: Callable[[Array], float]) -> Array:
    """Where fits (n + c,) about the solution before lead to, from a start; the cost falls from fit to fit."""
    solution, least = start, cost(start)
    for _ in range(FITS):
        step, before = fit(solution) - solution, least
        for k in range(HALVINGS):
            tried = solution + 0.5**k * step
            if cost(tried) < least:
                solution, least = tried, cost(tried)
                break
        if before - least < SAME:
            break
    return solution


def cost_of(squares: Array, off: Array, windows: int) -> float:
    """Twice the negative log likelihood, over the windows, up to a constant.

    squares (n_v,): what each type of rows leaves, over its variance. off: from what parameters stay near, whitened.
    """
    with np.errstate(over="ignore", invalid="ignore"):  # of a step that is far too long
        found = float(np.sum(np.log(np.maximum(1.0, squares))) + off @ off / windows)
    return found if np.isfinite(found) else np.inf
