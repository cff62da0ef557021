"""What a link with few elements leaves out of its shape between its markers: a nuisance for each `exact` link.

A link of more elements has the coordinates E q + N w: E q is the shape that the few elements give, N w moves no marker.
It carries the load F = Ṗ - G, without springs, with a stiffness K. Where w follows its loads without delay,

    NᵀF + NᵀK (E q + N w) = 0,    so that    TᵀF + TᵀK E q = 0    with    Tᵀ = Eᵀ - EᵀKN (NᵀKN)⁻¹ Nᵀ

to first order: the rows of q are those of a virtual displacement that is orthogonal in K to what no marker shows. With
stiffness as described, EᵀKE q, they are DᵀF + EᵀKE q = 0 with Dᵀ = EᵀKE (TᵀKE)⁻¹ Tᵀ. So they differ from those that
are described by (Dᵀ - Eᵀ) F, which holds loads alone, and no markers' noise times stiffness. At rest each strain field
has markers of its own, and rigidities cancel. The nuisance is the share of this difference: 0 where the link has as few
degrees of freedom as it is described with, 1 where it is continuous. The inertia of N w is left out: it is smaller by
the square of the motion's frequency over those of w. Elements of `linear` links are those of statics, without a
difference.
Source: static condensation, Guyan, AIAA Journal 3 (1965) 380, of the virtual displacement alone.
"""

from __future__ import annotations

from collections.abc import Iterator, Sequence

import numpy as np
from scipy.linalg import null_space

from sms_online.calibration.nuisance import Nuisance
from sms_online.description.bodies import FlexibleLink
from sms_online.description.schema import System
from sms_online.model.dynamics import Dynamics
from sms_online.model.model import Model
from sms_online.model.rod import ExactRod
from sms_online.stream import Array
from sms_online.trackers.interface import Estimate

# Elements of the finer link for one of the described: with twice as many the first fields are there that are left out.
FINER = 2


def truncations(system: System) -> Iterator[Nuisance]:
    """One of each `exact` link, where it has a tolerance."""
    tolerance = system.tolerances.truncation
    for i, link in enumerate(system.links, start=1):
        if tolerance > 0.0 and isinstance(link, FlexibleLink) and link.kinematics == "exact":
            yield Nuisance("truncation", f"link_{i}", "", tolerance)


def left(estimate: Estimate, nuisances: Sequence[Nuisance]) -> Array:
    """Variance (n,) of π for what the shares may be off by beside their standard deviations.

    Noise in their columns draws shares together: of 0 they come out larger, of 1 smaller, and no link has one between.
    So each may be off by as much as it is from the nearer of both.
    """
    out = np.zeros(estimate.pi.size)
    if estimate.crossed is None or estimate.nuisances.size != len(nuisances):
        return out
    for k, nuisance in enumerate(nuisances):
        if nuisance.name == "truncation" and estimate.nuisances_std[k] > 0.0:
            share = abs(float(estimate.nuisances[k]))
            out += (estimate.crossed[k] / estimate.nuisances_std[k] ** 2 * min(share, abs(1.0 - share))) ** 2
    return out


class Truncation:
    """Changes of a model's momentum and force by the nuisances of `truncations`."""

    def __init__(self, model: Model) -> None:
        system = model.system
        self._links = [int(each.where.removeprefix("link_")) - 1 for each in truncations(system)]
        links = tuple(
            link.model_copy(update={"elements": FINER * link.elements}) if i in self._links else link  # type: ignore[union-attr]
            for i, link in enumerate(system.links)
        )
        self._own = model.layout
        self._finer = model.of_geometry(system.model_copy(update={"links": links})) if self._links else model
        layout = self._finer.layout
        self._positions = [layout.position_names.index(name) for name in self._own.position_names]
        self._speeds = [layout.speed_names.index(name) for name in self._own.speed_names]
        self._corrections = [self._correction(model, i) for i in self._links]
        self._dynamics: Dynamics | None = None  # of the last π

    def _correction(self, model: Model, i: int) -> Array:
        """Dᵀ - Eᵀ (n_f, finer n_f) of link i (from 0)."""
        coarse, fine = model.chain.flexible[i], self._finer.chain.flexible[i]
        assert isinstance(coarse, ExactRod)
        assert isinstance(fine, ExactRod)
        q, finer = self._own.q_f[i], self._finer.layout.q_f[i]
        E = np.zeros((fine.n_f, coarse.n_f))
        E[np.array(self._speeds[q]) - finer.start, np.arange(coarse.n_f)] = 1.0
        per_marker = coarse.n_f // model.system.links[i].elements  # type: ignore[union-attr]
        read = np.arange(fine.n_f).reshape(-1, per_marker)[FINER - 1 :: FINER].ravel()
        N = null_space(fine.marker_jacobian(np.zeros((1, fine.n_f)))[0, read])
        K = np.sum(list(fine.stiffness.values()), axis=0)
        T = E - N @ np.linalg.solve(N.T @ K @ N, N.T @ K @ E)
        return np.asarray(E.T @ K @ E @ np.linalg.solve(T.T @ K @ E, T.T) - E.T)

    def at(self, pi: Array, x: Array, v: Array, signals: Array) -> Array:
        """What they change momentum and force by (2, K, n_v, c), with parameters π.

        x (K, n_x), v (K, n_v), signals (K, n_signals): see `Model.inputs`.
        """
        out = np.zeros((2, *v.shape, len(self._links)))
        if not self._links:
            return out
        model = self._finer
        if self._dynamics is None or not np.array_equal(self._dynamics.pi, pi):
            self._dynamics = model.dynamics(pi)
        finer_x, finer_v = np.zeros((len(x), model.layout.n_x)), np.zeros((len(v), model.layout.n_v))
        finer_x[:, self._positions], finer_v[:, self._speeds] = x, v
        momentum, force = self._dynamics.momentum_and_force(finer_x, finer_v, model.inputs(signals))
        load = force - self._dynamics.spring_force(finer_x, finer_v)
        for c, (i, correction) in enumerate(zip(self._links, self._corrections, strict=True)):
            for change, part in zip(out, (momentum, load), strict=True):
                change[:, self._own.q_f[i], c] = part[:, model.layout.q_f[i]] @ correction.T
        return out
