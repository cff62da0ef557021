"""Base parameters: the combinations of physical parameters that the motion of a system can determine at all.

Found numerically on the system itself: columns of energy and dissipated power at random states, orthogonalised in the
order of preference. A column is independent of those before it where its remainder exceeds what the tolerances of the
geometry could make of zero: axes that are parallel, or cross, are so to a fraction of a milliradian at best.
Source of the numerical search: Gautier, J. Robotic Systems 8 (1991) 485.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np

from sms_online.description.explain import hint, nearest
from sms_online.errors import InputError
from sms_online.model.effect import Inputs
from sms_online.model.model import Model
from sms_online.model.parameters import Parameter
from sms_online.model.tolerance import perturbed
from sms_online.stream import Array
from sms_online.threads import one_blas_thread

# States per parameter: enough that the rank is that of the columns and not of the sample.
STATES_PER_PARAMETER = 4
# Relative size below which a scaled column's remainder is zero whatever the tolerances: rounding leaves 1e-14.
RANK_TOLERANCE = 1e-9
# Geometries drawn from the tolerances, and the multiple of the rms remainder they make of a dependent column that an
# independent one exceeds. On every shipped system real combinations exceed ten times that multiple; mounts written to
# four decimals stay below a hundredth of it.
DRAWS = 3
BEYOND_TOLERANCE = 3.0
# Coefficients of combinations within this of zero or of one are that number: they come from a least-squares solve.
COEFFICIENT_ROUNDING = 1e-8
RANDOM_SEED = 1965
# Random elastic strains and deflections of joints: a tenth of the unit keeps links within their physical range.
ELASTIC_AMPLITUDE = 0.1


@dataclass(frozen=True)
class BaseParameters:
    """Identifiable combinations β = π_independent + mixture π_dependent.

    parameters: one a combination, with readable name, symbol and nominal value. independent, dependent, absent: indices
    into the physical parameters; absent ones have no influence on the motion, are declared known, or are the gain of
    measured wrenches.
    """

    physical: tuple[Parameter, ...]
    parameters: tuple[Parameter, ...]
    independent: tuple[int, ...]
    dependent: tuple[int, ...]
    absent: tuple[int, ...]
    mixture: Array  # (n, dependent)
    known: tuple[tuple[int, float], ...]

    @property
    def n(self) -> int:
        """Number of base parameters."""
        return len(self.parameters)

    @property
    def needed(self) -> frozenset[int]:
        """Physical parameters whose columns `columns` and `known_part` need."""
        return frozenset((*self.independent, *(index for index, _ in self.known)))

    def columns(self, Y: Array) -> Array:
        """Columns (..., n) of the base parameters out of the physical parameters' (..., n_pi)."""
        return np.asarray(Y[..., self.independent])

    def known_part(self, Y: Array) -> Array:
        """Y π of the parameters that are declared known, (...)."""
        out = np.zeros(Y.shape[:-1])
        for index, value in self.known:
            out += Y[..., index] * value
        return out

    def values(self, pi: Array) -> Array:
        """β (n,) of physical parameters π (n_pi,)."""
        return np.asarray(pi[list(self.independent)] + self.mixture @ pi[list(self.dependent)])

    def physical_values(self, beta: Array) -> Array:
        """A physical π (n_pi,) with the same dynamics as β (n,): dependent and absent parameters are zero."""
        pi = np.zeros(len(self.physical))
        pi[list(self.independent)] = beta
        for index, value in self.known:
            pi[index] = value
        return pi


def random_states(model: Model, count: int, rng: np.random.Generator) -> tuple[Array, Array]:
    """Random positions x (count, n_x) and speeds v (count, n_v) within a testbed's range."""
    layout = model.layout
    x = rng.uniform(-1.0, 1.0, size=(count, layout.n_x))
    offset = layout.offset
    for q, theta_m in zip(layout.q, layout.theta_m, strict=True):
        x[:, q + offset] = rng.uniform(-np.pi, np.pi, size=count)
        if theta_m != q:
            x[:, theta_m + offset] = x[:, q + offset] + ELASTIC_AMPLITUDE * x[:, theta_m + offset]
    for i in range(len(layout.q_f)):
        x[:, layout.elastic(i)] *= ELASTIC_AMPLITUDE
    if layout.free and not layout.planar:
        x[:, 3:7] /= np.linalg.norm(x[:, 3:7], axis=1)[:, None]
    return x, rng.uniform(-1.0, 1.0, size=(count, layout.n_v))


def random_inputs(model: Model, count: int, rng: np.random.Generator) -> Inputs:
    """Random torques and internal states for the effects of `count` random states."""
    return Inputs(rng.normal(size=(count, model.n_inputs)), rng.normal(size=(count, model.n_states)))


@one_blas_thread()
def find_base_parameters(model: Model) -> BaseParameters:
    """Base parameters of a system; parameters declared known leave the unknowns. InputError on an unknown name."""
    names = [p.name for p in model.parameters]
    for name in model.system.known:
        if name not in names:
            expected = f"the name of a parameter of this system{hint(nearest(name, names))}"
            raise InputError(model.system.name, f'known."{name}"', "no such parameter", expected)
    known = tuple((names.index(name), value) for name, value in model.system.known.items())
    if model.wrenches is not None:
        known += tuple((names.index(p.name), p.nominal) for p in model.wrenches.parameters)
    Y, drawn = _drawn(model)
    scale = np.linalg.norm(Y, axis=0)
    known_indices = {index for index, _ in known}
    largest = float(scale.max())
    absent = tuple(k for k in range(model.n_pi) if scale[k] <= RANK_TOLERANCE * largest or k in known_indices)
    candidates = [k for k in range(model.n_pi) if k not in absent]
    changes = [(other - Y)[:, candidates] / scale[candidates] for other in drawn]
    kept = _independent(Y[:, candidates] / scale[candidates], changes)
    independent = tuple(candidates[k] for k in kept)
    dependent = tuple(k for k in candidates if k not in independent)
    mixture = _snapped(_mixture(Y, independent, dependent, scale), np.full((len(independent), 1), COEFFICIENT_ROUNDING))
    spread = np.sqrt(
        np.mean([(_mixture(other, independent, dependent, scale) - mixture) ** 2 for other in drawn], axis=0)
    )
    tolerance = np.maximum(COEFFICIENT_ROUNDING, BEYOND_TOLERANCE * spread)
    printed = _snapped(mixture, tolerance)
    lumped = [model.parameters[d] for d in dependent]
    parameters = tuple(
        _combine(model.parameters[k], list(zip(exact.tolist(), shown.tolist(), lumped, strict=True)))
        for k, exact, shown in zip(independent, mixture, printed, strict=True)
    )
    return BaseParameters(model.parameters, parameters, independent, dependent, absent, mixture, known)


@one_blas_thread()
def fixes_scale(model: Model) -> bool:
    """Whether values that the system file states, as known or as priors, fix the scale common to all parameters.

    They do where together they act as no other parameters can. The mass of a link that turns about a fixed axis acts as
    its inertia does: whatever it is, that takes up the rest.
    """
    names = [p.name for p in model.parameters]
    stated = {**{name: prior.value for name, prior in model.system.priors.items()}, **model.system.known}
    value = np.array([stated.get(name, 0.0) for name in names])
    if not value.any():
        return False
    Y, drawn = _drawn(model)
    others = [k for k, name in enumerate(names) if name not in stated]

    def beside(columns: Array) -> Array:
        return np.column_stack((columns[:, others], columns @ value))

    all_of = beside(Y)
    size = np.linalg.norm(all_of, axis=0)
    seen = size > RANK_TOLERANCE * float(size.max())
    changes = [((beside(other) - all_of) / np.where(seen, size, 1.0))[:, seen] for other in drawn]
    kept = _independent(all_of[:, seen] / size[seen], changes)
    return bool(seen[-1]) and int(np.count_nonzero(seen)) - 1 in kept


def _drawn(model: Model) -> tuple[Array, list[Array]]:
    """Columns (rows, n_pi) at random states, and the same of geometries drawn from the tolerances."""
    rng = np.random.default_rng(RANDOM_SEED)
    x, v = random_states(model, STATES_PER_PARAMETER * model.n_pi, rng)
    inputs = random_inputs(model, len(x), rng)
    drawn = [_columns(model.of_geometry(perturbed(model.system, rng)), x, v, inputs) for _ in range(DRAWS)]
    return _columns(model, x, v, inputs), drawn


def _columns(model: Model, x: Array, v: Array, inputs: Inputs) -> Array:
    """Columns (rows, n_pi) of differences of energy, then of dissipated power, at states x, v."""
    energy = model.energy_columns(x, v)
    return np.concatenate((energy[1:] - energy[0], model.power_columns(x, v, inputs)))


def _independent(columns: Array, changes: Sequence[Array]) -> list[int]:
    """Numbers of the columns (rows, c), of unit length, that are independent of those kept before them.

    changes: of the columns, each by a geometry drawn from its tolerances. A column that depends on others leaves of
    them what its own change leaves of theirs; an independent one leaves more than BEYOND_TOLERANCE times that.
    """
    kept: list[int] = []
    Q = np.empty((len(columns), 0))

    def remainder(column: Array) -> Array:
        once = column - Q @ (Q.T @ column)
        return np.asarray(once - Q @ (Q.T @ once))

    for k, column in enumerate(columns.T):
        rest = remainder(column)
        length = float(np.linalg.norm(rest))
        if length <= RANK_TOLERANCE:
            continue
        mixture = np.linalg.lstsq(columns[:, kept], column, rcond=None)[0] if kept else np.empty(0)
        made = [np.sum(remainder(change[:, k] - change[:, kept] @ mixture) ** 2) for change in changes]
        if length > BEYOND_TOLERANCE * np.sqrt(np.mean(made)):
            kept.append(k)
            Q = np.column_stack((Q, rest / length))
    return kept


def _mixture(Y: Array, independent: Sequence[int], dependent: Sequence[int], scale: Array) -> Array:
    """Coefficients (n, dependent) of the dependent columns of Y in the independent ones, by least squares.

    scale (n_pi,): sizes of the columns.
    """
    size = scale[list(independent)]
    return np.asarray(np.linalg.lstsq(Y[:, independent] / size, Y[:, dependent], rcond=None)[0] / size[:, None])


def _snapped(mixture: Array, tolerance: Array) -> Array:
    """Coefficients with those within a tolerance of 0, 1 or -1 set to that number."""
    out = np.where(np.abs(mixture) < tolerance, 0.0, mixture)
    return np.where(np.abs(np.abs(out) - 1.0) < tolerance, np.sign(out), out)


def _combine(leading: Parameter, others: list[tuple[float, float, Parameter]]) -> Parameter:
    """Leading parameter with what is lumped into it, each with its coefficient and that as people read it.

    The symbol is the combination; masses say so in the name.
    """
    lumped = [(c, p) for _, c, p in others if c != 0.0]
    symbol = leading.symbol + "".join(f"{'+' if c > 0 else '-'}{_factor(abs(c))}{p.symbol}" for c, p in lumped)
    name = leading.name
    if leading.quantity == "mass" and lumped and all(c == 1.0 and p.quantity == "mass" for c, p in lumped):
        name += "_with_" + "_and_".join(p.owner for _, p in lumped)
    nominal = leading.nominal + sum(c * p.nominal for c, _, p in others if c != 0.0)
    return replace(leading, name=name, symbol=symbol, nominal=nominal)


def _factor(c: float) -> str:
    return "" if c == 1.0 else f"{c:.5g} "
