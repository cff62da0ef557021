"""Base parameters: the combinations of physical parameters that the motion of a system can determine at all.

Found numerically on the system itself: columns of energy and dissipated power at random states, rank by QR with column
pivoting, then independent columns chosen in the order of preference. Source: Gautier, J. Robotic Systems 8 (1991) 485.
"""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np
import scipy.linalg

from sms_online.description.explain import hint, nearest
from sms_online.effects.base import Inputs
from sms_online.errors import InputError
from sms_online.model.model import Model
from sms_online.model.parameters import Parameter
from sms_online.stream import Array

# States per parameter: enough that the rank is that of the columns and not of the sample.
STATES_PER_PARAMETER = 4
# Relative size below which a scaled column's remainder is zero: rounding leaves 1e-14, real combinations above 1e-6.
RANK_TOLERANCE = 1e-9
# Coefficients of combinations within this of zero or of one are that number: they come from a least-squares solve.
COEFFICIENT_ROUNDING = 1e-8
RANDOM_SEED = 1965
# Random elastic strains and deflections of joints: a tenth of the unit keeps links within their physical range.
ELASTIC_AMPLITUDE = 0.1


@dataclass(frozen=True)
class BaseParameters:
    """Identifiable combinations β = π_independent + mixture π_dependent.

    parameters: one a combination, with readable name, symbol and nominal value. independent, dependent, absent: indices
    into the physical parameters; absent ones have no influence on the motion or are declared known.
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
    offset = layout.n_base_positions - layout.n_base_speeds
    for q, theta_m in zip(layout.q, layout.theta_m, strict=True):
        x[:, q + offset] = rng.uniform(-np.pi, np.pi, size=count)
        if theta_m != q:
            x[:, theta_m + offset] = x[:, q + offset] + ELASTIC_AMPLITUDE * x[:, theta_m + offset]
    for elastic in layout.q_f:
        x[:, elastic.start + offset : elastic.stop + offset] *= ELASTIC_AMPLITUDE
    if layout.free and not layout.planar:
        x[:, 3:7] /= np.linalg.norm(x[:, 3:7], axis=1)[:, None]
    return x, rng.uniform(-1.0, 1.0, size=(count, layout.n_v))


def random_inputs(model: Model, count: int, rng: np.random.Generator) -> Inputs:
    """Random torques and internal states for the effects of `count` random states."""
    return Inputs(rng.normal(size=(count, len(model.layout.q))), rng.normal(size=(count, model.n_states)))


def find_base_parameters(model: Model) -> BaseParameters:
    """Base parameters of a system; parameters declared known leave the unknowns. InputError on an unknown name."""
    names = [p.name for p in model.parameters]
    for name in model.system.known:
        if name not in names:
            expected = f"the name of a parameter of this system{hint(nearest(name, names))}"
            raise InputError(model.system.name, f'known."{name}"', "no such parameter", expected)
    known = tuple((names.index(name), value) for name, value in model.system.known.items())
    rng = np.random.default_rng(RANDOM_SEED)
    x, v = random_states(model, STATES_PER_PARAMETER * model.n_pi, rng)
    energy = model.energy_columns(x, v)
    power = model.power_columns(x, v, random_inputs(model, len(x), rng))
    Y = np.concatenate((energy[1:] - energy[0], power))
    scale = np.linalg.norm(Y, axis=0)
    known_indices = {index for index, _ in known}
    largest = float(scale.max())
    absent = tuple(k for k in range(model.n_pi) if scale[k] <= RANK_TOLERANCE * largest or k in known_indices)
    candidates = [k for k in range(model.n_pi) if k not in absent]
    scaled = Y[:, candidates] / scale[candidates]
    pivoted = np.abs(np.diag(scipy.linalg.qr(scaled, mode="r", pivoting=True)[0]))
    rank = int(np.sum(pivoted > RANK_TOLERANCE * pivoted[0]))
    # Without pivoting a column that depends on earlier ones leaves nothing on the diagonal of R.
    remainder = np.abs(np.diag(np.linalg.qr(scaled, mode="r")))
    chosen = sorted(np.argsort(-remainder, kind="stable")[:rank])
    independent = tuple(candidates[k] for k in chosen)
    dependent = tuple(k for k in candidates if k not in independent)
    mixture = np.linalg.lstsq(Y[:, independent] / scale[list(independent)], Y[:, dependent], rcond=None)[0]
    mixture /= scale[list(independent)][:, None]
    mixture[np.abs(mixture) < COEFFICIENT_ROUNDING] = 0.0
    ones = np.abs(np.abs(mixture) - 1.0) < COEFFICIENT_ROUNDING
    mixture[ones] = np.sign(mixture[ones])
    parameters = tuple(
        _combine(
            model.parameters[k], [(mixture[row, column], model.parameters[d]) for column, d in enumerate(dependent)]
        )
        for row, k in enumerate(independent)
    )
    return BaseParameters(model.parameters, parameters, independent, dependent, absent, mixture, known)


def _combine(leading: Parameter, others: list[tuple[float, Parameter]]) -> Parameter:
    """Leading parameter with what is lumped into it: the symbol is the combination, masses say so in the name."""
    lumped = [(c, p) for c, p in others if c != 0.0]
    symbol = leading.symbol + "".join(f"{'+' if c > 0 else '-'}{_factor(abs(c))}{p.symbol}" for c, p in lumped)
    name = leading.name
    if leading.quantity == "mass" and lumped and all(c == 1.0 and p.quantity == "mass" for c, p in lumped):
        name += "_with_" + "_and_".join(p.owner for _, p in lumped)
    nominal = leading.nominal + sum(c * p.nominal for c, p in lumped)
    return replace(leading, name=name, symbol=symbol, nominal=nominal)


def _factor(c: float) -> str:
    return "" if c == 1.0 else f"{c:.4g} "
