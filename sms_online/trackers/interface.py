"""What goes into a tracker (rows), what comes out (an estimate), and what every tracker can do."""

from __future__ import annotations

from abc import ABC, abstractmethod
from dataclasses import dataclass, field, replace

import numpy as np
from scipy.linalg import block_diag, cholesky, solve_triangular

from sms_online.state import Stage
from sms_online.stream import Array
from sms_online.trackers.factor import triangular_factor
from sms_online.trackers.information import Information


@dataclass(frozen=True)
class Rows:
    """M rows of a balance, Y π = b, in order of time.

    Y: (M, n). b: (M,). std: (M,) standard deviation of each row's error, in the unit of b. t: (M,) seconds.
    ramp: (M, n) what is added to b by parameters that change by one in a second, zero at t; None for nothing.
    Raises ValueError naming the first row that is not finite or whose std is not positive, or shapes that do not fit.
    """

    Y: Array
    b: Array
    std: Array
    t: Array
    ramp: Array | None = None

    def __post_init__(self) -> None:
        if self.Y.ndim != 2 or not self.b.shape == self.std.shape == self.t.shape == self.Y.shape[:1]:
            raise ValueError(
                f"rows do not fit: Y {self.Y.shape}, b {self.b.shape}, std {self.std.shape}, t {self.t.shape}"
            )
        for name, values in (("Y", self.Y), ("b", self.b), ("std", self.std), ("t", self.t)):
            finite = np.isfinite(values)
            if not finite.all():
                raise ValueError(f"row {np.argwhere(~finite)[0, 0]}: {name} is not finite")
        if not (self.std > 0).all():
            row = int(np.argmin(self.std > 0))
            raise ValueError(f"row {row}: std is {self.std[row]:g}; expected a positive number")

    def whitened(self, n: int) -> Array:
        """[Y b] / std of n parameters, (M, n + 1); ValueError where the width differs or the quotient overflows."""
        if self.Y.shape[1] != n:
            raise ValueError(f"row 0: {self.Y.shape[1]} columns; expected {n}")
        with np.errstate(over="ignore"):
            out: Array = np.column_stack((self.Y, self.b)) / self.std[:, None]
        finite = np.isfinite(out).all(axis=1)
        if not finite.all():
            raise ValueError(f"row {int(np.argmin(finite))}: overflows when divided by its std")
        return out


@dataclass(frozen=True)
class Prior:
    """What is known of the parameters beforehand, value ± std each.

    value, std: (n,). A std of NaN says that nothing is known of that parameter; its value is then ignored. correlation
    (n, n): of their errors, ignored likewise; None where these are independent.
    """

    value: Array
    std: Array
    correlation: Array | None = None

    def __post_init__(self) -> None:
        if self.value.shape != self.std.shape or self.value.ndim != 1:
            raise ValueError(f"prior values {self.value.shape} do not fit their std {self.std.shape}")
        known = self.known
        wrong = known & ~(np.isfinite(self.value) & np.isfinite(self.std) & (self.std > 0))
        if wrong.any():
            j = int(np.argmax(wrong))
            raise ValueError(f"prior {j}: {self.value[j]:g} ± {self.std[j]:g}; expected finite and a positive std")

    @property
    def known(self) -> np.ndarray[tuple[int], np.dtype[np.bool_]]:
        """(n,) where something is known."""
        return ~np.isnan(self.std)


def prior_factor(prior: Prior | None, n: int) -> Array:
    """The known priors as information rows (k, n + 1): π_j / std_j = value_j / std_j, errors decorrelated."""
    if prior is None:
        return np.zeros((0, n + 1))
    if prior.std.size != n:
        raise ValueError(f"prior of {prior.std.size} parameters; expected {n}")
    known = np.flatnonzero(prior.known)
    rows = np.zeros((known.size, n + 1))
    rows[np.arange(known.size), known] = 1.0 / prior.std[known]
    rows[:, n] = prior.value[known] / prior.std[known]
    if prior.correlation is None:
        return rows
    return np.asarray(solve_triangular(cholesky(prior.correlation[np.ix_(known, known)], lower=True), rows, lower=True))


def joined(*priors: Prior) -> Prior:
    """Independent priors of some parameters and of those that come after them, as one."""
    value, std = (np.concatenate([getattr(prior, name) for prior in priors]) for name in ("value", "std"))
    if all(prior.correlation is None for prior in priors):
        return Prior(value, std)
    blocks = [np.eye(prior.std.size) if prior.correlation is None else prior.correlation for prior in priors]
    return Prior(value, std, block_diag(*blocks))


@dataclass(frozen=True)
class Estimate:
    """π as far as the rows determine it.

    pi: (n,); where not determined, the minimum-norm solution in units of the columns' sizes: no number to trust.
    covariance: (n, n) from the stated std of the rows. covariance_robust: the same from the residuals themselves, valid
    for autocorrelated errors; None where it is not defined (see `robust`). A parameter that is not determined has an
    infinite variance and zeros beside it. determined: (n,) bool. condition_number: of the column-scaled information
    factor, inf where its rank is not full. rows: number of rows, less where old ones count less.
    rss: residual sum of squares of the whitened rows, priors included. dof: its degrees of freedom. scale: what the
    rows' stated std were multiplied with to weight them against a prior; None where they were taken as stated.
    nuisances, nuisances_std (m,): what was estimated beside π, see `without_nuisances`; nuisances_robust (m,): likewise
    from the residuals, None where it is not defined; crossed (m, n): its covariance with π.
    """

    pi: Array
    covariance: Array
    covariance_robust: Array | None
    determined: np.ndarray[tuple[int], np.dtype[np.bool_]]
    condition_number: float
    rows: float
    rss: float
    dof: float
    scale: float | None = None
    nuisances: Array = field(default_factory=lambda: np.empty(0))
    nuisances_std: Array = field(default_factory=lambda: np.empty(0))
    nuisances_robust: Array | None = None
    crossed: Array | None = None

    def without_nuisances(self, m: int) -> Estimate:
        """The marginal estimate of π, from one of m nuisances and then π."""
        if m == 0:
            return self
        robust = self.covariance_robust
        return replace(
            self,
            pi=self.pi[m:],
            covariance=self.covariance[m:, m:],
            covariance_robust=None if robust is None else robust[m:, m:],
            determined=self.determined[m:],
            nuisances=self.pi[:m],
            nuisances_std=self.std[:m],
            # Clusters that leave nothing of a nuisance round to either side of zero.
            nuisances_robust=None if robust is None else np.sqrt(np.maximum(np.diag(robust)[:m], 0.0)),
            crossed=self.covariance[:m, m:],
        )

    @property
    def joint(self) -> Array:
        """Nuisances, then π."""
        return np.concatenate((self.nuisances, self.pi))

    @property
    def std(self) -> Array:
        """(n,) standard deviations from the stated noise, inf where not determined."""
        return np.sqrt(np.diag(self.covariance))


class Tracker(Stage, ABC):
    """A recursive estimator of π. The result depends on the rows alone, never on how they were split into calls.

    What its rows have changed lies in a `State`, whose arrays are replaced, never written: with it a session is saved.
    """

    @abstractmethod
    def update(self, rows: Rows) -> None:
        """Take in rows; ValueError where their width is not n."""

    @abstractmethod
    def estimate(self) -> Estimate:
        """The estimate from all rows taken in so far; leaves the state as it is."""

    @abstractmethod
    def begin(self, known: Information) -> None:
        """Forget all rows, and go on from given information about π; priors stay. ValueError where it is not of n."""

    @property
    def information(self) -> Information:
        """Information of rows and priors about π, for others to go on from; by default what the estimate holds."""
        estimate = self.estimate()
        known = np.flatnonzero(estimate.determined)
        root = np.linalg.inv(np.linalg.cholesky(estimate.covariance[np.ix_(known, known)]))
        rows = np.zeros((known.size + 1, estimate.pi.size + 1))
        rows[:-1, known], rows[:-1, -1] = root, root @ estimate.pi[known]
        rows[-1, -1] = np.sqrt(estimate.rss)
        return Information(triangular_factor(rows), int(estimate.rows))


def checked(known: Information, n: int) -> Information:
    """The same; ValueError where it is not of n parameters."""
    if known.n != n:
        raise ValueError(f"information of {known.n} parameters; expected {n}")
    return known
