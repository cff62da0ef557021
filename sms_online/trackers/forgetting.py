"""Kinds of forgetting, each with its proof that the covariance cannot wind up.

With plain exponential forgetting the information of a direction that the motion stopped exciting decays to nothing, the
covariance overflows and the first noise that follows throws the estimate off. All kinds here act on the square-root
factor from the left, [R z] ← W [R z], which changes how sure the estimate is, never a determined estimate itself.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Protocol

import numpy as np

from sms_online.stream import Array

# Square-root information below this part of the greatest that a parameter ever had is not forgotten any further. The
# weakest direction of the paper's energy rows has 1e-4 of it (scaled condition number 1.2e4), so this acts only without
# excitation; it lies far above rounding (1e-15), so z keeps meaning, and bounds the std at 1e6 times the best attained.
INFORMATION_FLOOR = 1e-6


class FadingForgetting(Protocol):
    """A forgetting that fades all older rows together, by a factor of information per row."""

    @property
    def factor(self) -> float:
        """Information that is left of a row when the next one has come, between 0 and 1."""

    def row_weights(self, rows: int) -> Array:
        """Square roots (M,) of the weights of M rows that arrive together, as seen after the last of them."""

    def fade(self, factor: Array, peak: Array, block: Array, weight: float) -> Array:
        """Faded factor (n + 1, n + 1) before a block is taken in.

        peak: (n,) greatest column norms of R so far. block: (…, n + 1) the block's rows or factor. weight: information
        that is left of a fully faded direction.
        """


@dataclass(frozen=True)
class _ByFactor:
    factor: float

    def __post_init__(self) -> None:
        if not 0 < self.factor < 1:
            raise ValueError(f"forgetting factor {self.factor:g}; expected between 0 and 1")


@dataclass(frozen=True)
class NoForgetting:
    """Every row counts the same for ever: the batch solution (45), recursively."""


@dataclass(frozen=True)
class SlidingWindow:
    """The last `rows` rows count the same, older ones not at all.

    The window is rounded up to whole blocks, and the rows of the unfinished block come on top. Old blocks leave by
    building the factor anew from those that stay, not by downdating: a downdate subtracts nearly equal numbers and
    loses up to the square of the condition number (Stewart, J. Inst. Maths Applics 23 (1979) 203–213).
    Without excitation the window empties and its parameters become undetermined; nothing grows.
    """

    rows: int

    def __post_init__(self) -> None:
        if self.rows < 1:
            raise ValueError(f"window of {self.rows} rows; expected at least one")


@dataclass(frozen=True)
class Exponential(_ByFactor):
    """Each row counts `factor` times the next one, down to a floor: selective forgetting on the singular values of R.

    In coordinates scaled by the peak column norms, R = U s Vᵀ, a singular value becomes max(√weight·s, min(s, floor)).
    So information is at least the lesser of what there was and floor², and for rows of bounded size at most the
    geometric sum: bounded on both sides whatever the excitation.
    Source: Parkum, Poulsen and Holst, Int. J. Control 55 (1992) 109–128.
    Limitation: a single gross outlier in Y raises the peak, and with it the floor, until reset.
    """

    def row_weights(self, rows: int) -> Array:
        """Geometric within the block as well: exactly row-by-row weighting while the floor is not reached."""
        return np.asarray(self.factor ** (0.5 * np.arange(rows - 1, -1, -1)))

    def fade(self, factor: Array, peak: Array, block: Array, weight: float) -> Array:
        """See FadingForgetting; the block does not matter here."""
        n = peak.size
        root = float(np.sqrt(weight))
        U, s, _ = np.linalg.svd(factor[:n, :n] / peak)
        faded = root * factor
        if root * s[-1] >= INFORMATION_FLOOR:
            return faded
        keep = np.maximum(root, np.minimum(1.0, INFORMATION_FLOOR / np.maximum(s, np.finfo(float).tiny)))
        faded[:n] = keep[:, None] * (U.T @ factor[:n])
        return faded


@dataclass(frozen=True)
class Directional(_ByFactor):
    """Fades by `factor` a row, but only in the directions that the block excites: the rest is kept for ever.

    With V the block's excited directions the information loses (1 − weight) Λ V (Vᵀ Λ V)⁻¹ Vᵀ Λ, which in square-root
    form is R ← (I − (1 − √weight) Q Qᵀ) R with Q an orthonormal basis of R V: no downdate.
    Source: Cao and Schwartz, Automatica 36 (2000) 1725–1731, for one row; Lai and Bernstein, SIFt-RLS,
    arXiv:2404.10844 (2024), for several, with two-sided bounds of the information without persistent excitation.
    """

    def row_weights(self, rows: int) -> Array:
        """Rows of one block count the same: what excites a direction first must not fade before it is counted."""
        return np.ones(rows)

    def fade(self, factor: Array, peak: Array, block: Array, weight: float) -> Array:
        """See FadingForgetting."""
        n = peak.size
        root = float(np.sqrt(weight))
        faded = factor.copy()
        faded[n] *= root
        _, strength, Vt = np.linalg.svd(block[:, :n] / peak, full_matrices=False)
        excited = Vt[strength > INFORMATION_FLOOR]
        if not len(excited):
            return faded
        Q, known, _ = np.linalg.svd((factor[:n, :n] / peak) @ excited.T, full_matrices=False)
        # What is excited now but was never known (below the floor) has nothing to forget.
        Q = Q[:, known > INFORMATION_FLOOR]
        faded[:n] -= (1.0 - root) * (Q @ (Q.T @ factor[:n]))
        return faded


Forgetting = NoForgetting | Exponential | SlidingWindow | Directional
