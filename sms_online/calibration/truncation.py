"""What a link with few elements leaves out of its shape between its markers: a nuisance for each `exact` link.

A link of more elements has the coordinates E q + w: E q is the shape that the few elements give, w moves no marker, so
that it is N w' about each shape, J N = 0 for the markers' Jacobian J there. The link carries the load F = Ṗ - G,
without springs, with a stiffness K: F + K (E q + w) = 0. Of that

    TᵀF + TᵀK E q = 0    with    Tᵀ = Eᵀ - EᵀKN (NᵀKN)⁻¹ Nᵀ

are the rows of a virtual displacement that is orthogonal in K to what no marker shows. With stiffness as described,
EᵀKE q, they are DᵀF + EᵀKE q = 0 with Dᵀ = EᵀKE (TᵀKE)⁻¹ Tᵀ. So they differ from those that are described, of the load
F₀ of E q alone, by DᵀF - EᵀF₀, which holds loads alone, and no markers' noise times stiffness. In all other rows F - F₀
is what differs. D moves with the link: DᵀṖ is the rate of DᵀP less ḊᵀP.

The shape w itself follows from loads alone as well, w = -N (NᵀKN)⁻¹ Nᵀ (1 - KE (TᵀKE)⁻¹ Tᵀ) F₀: where w follows its
loads without delay. The inertia that it has by its own acceleration is left out in this; it is smaller by the square of
the motion's frequency over those of w. With K as K is, bending and torsion have a part in each other of a bent link.

The nuisance is the share of this difference: 0 where the link has as few degrees of freedom as it is described with, 1
where it is continuous. Elements of `linear` links are those of statics, without a difference.
Source: static condensation, Guyan, AIAA Journal 3 (1965) 380, of the virtual displacement alone.
"""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from functools import cache
from typing import TypeVar

import numpy as np
from scipy.linalg import eigvalsh

from sms_online.calibration.nuisance import Nuisance
from sms_online.description.bodies import FlexibleLink
from sms_online.description.schema import System
from sms_online.model.dynamics import Dynamics
from sms_online.model.model import Model
from sms_online.model.rod import ExactRod
from sms_online.state import Stage, State
from sms_online.stream import Array
from sms_online.trackers.interface import Estimate

# Elements of the finer link for one of the described: with twice as many the first fields are there that are left out.
FINER = 2
# Instants in a difference of fourth order, and those behind an instant that a rate of a rate needs.
STENCIL = 5
BEHIND = STENCIL - 1
# A link that is softer than this share of its description in some shape is of a poor fit, or no link at all: it would
# bend by any amount.
SOFTEST = 0.1
# Step of the differences by the link's motion, s: 1e-8 of a rate is lost to curvature, as much to rounding.
STEP = 1e-4

StateT = TypeVar("StateT", bound=State)


def truncations(system: System) -> Iterator[Nuisance]:
    """One of each `exact` link, where it has a tolerance."""
    tolerance = system.tolerances.truncation
    for i, link in enumerate(system.links, start=1):
        if tolerance > 0.0 and isinstance(link, FlexibleLink) and link.kinematics == "exact":
            yield Nuisance("truncation", f"link_{i}", "", tolerance)


def share_variance(estimate: Estimate, nuisances: Sequence[Nuisance]) -> Array:
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


class FinerLink:
    """A link of more elements, condensed to the coordinates that are described: E, N, D as above.

    coarse: as described, of so many elements. own: which coordinates of the finer link the described one has as well.
    """

    def __init__(self, coarse: ExactRod, elements: int, fine: ExactRod, own: Sequence[int]) -> None:
        self._rod, self._own = fine, list(own)
        self._other = np.setdiff1d(np.arange(fine.n_f), self._own)
        nodal = coarse.n_f // elements
        self._read = np.arange(fine.n_f).reshape(-1, nodal)[FINER - 1 :: FINER].ravel()
        self._E = np.eye(fine.n_f)[:, self._own]

    def condensed(self, q_f: Array, K: Array) -> tuple[Array, Array]:
        """Dᵀ (B, n_f, n_f'), and what makes w of a load (B, n_f', n_f'), about coordinates q_f (B, n_f') as n_f'.

        K (n_f', n_f'): stiffness.
        """
        E = self._E
        readings = self._rod.marker_jacobian(q_f)[:, self._read]
        N = np.zeros((len(q_f), self._rod.n_f, self._other.size))
        N[:, self._other] = np.eye(self._other.size)
        N[:, self._own] = -np.linalg.solve(readings[..., self._own], readings[..., self._other])
        across = N.swapaxes(1, 2)
        own = across @ K @ N
        T = (E - N @ np.linalg.solve(own, across @ K @ E)).swapaxes(1, 2)
        by_load = np.linalg.solve(T @ K @ E, T)
        return E.T @ K @ E @ by_load, -N @ np.linalg.solve(own, across - across @ K @ E @ by_load)


class FinerInstants(State):
    """A model with finer links at some instants, with E q alone: x (K, n_x), v (K, n_v), signals (K, n_signals).

    momentum, load (K, n_v): P π and G π without springs.
    """

    x: Array
    v: Array
    signals: Array
    momentum: Array
    load: Array


class Condensed(State):
    """A finer link at some instants.

    virtual, turning (K, n_f, n_f'): Dᵀ and Ḋᵀ. shape (K, n_f', n_f'): makes w of a load.
    """

    virtual: Array
    turning: Array
    shape: Array


class TruncationState(State):
    """The last instants, and each link there."""

    instants: FinerInstants
    links: list[Condensed]


class Truncation(Stage):
    """Changes of a model's momentum and force by the nuisances of `truncations`, at the instants of a motion.

    step: from one instant to the next, s.
    """

    def __init__(self, model: Model, step: float) -> None:
        system = model.system
        self._step = step
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
        self._rods = [self._finer_link(model, i) for i in self._links]
        self._dynamics: Dynamics | None = None  # of the last π
        self._stiffness: list[Array] = []  # of each link, by it
        self.begin_segment()

    @property
    def count(self) -> int:
        """Links that have a nuisance."""
        return len(self._links)

    def _finer_link(self, model: Model, i: int) -> FinerLink:
        """Link i (from 0)."""
        coarse, fine = model.chain.flexible[i], self._finer.chain.flexible[i]
        assert isinstance(coarse, ExactRod)
        assert isinstance(fine, ExactRod)
        own = np.array(self._speeds[self._own.q_f[i]]) - self._finer.layout.q_f[i].start
        return FinerLink(coarse, model.system.links[i].elements, fine, own.tolist())  # type: ignore[union-attr]

    def begin_segment(self) -> None:
        """The next instant follows none."""
        layout = self._finer.layout
        widths = (layout.n_x, layout.n_v, self._finer.n_signals, layout.n_v, layout.n_v)
        instants = FinerInstants(*(np.empty((0, width)) for width in widths))
        links = []
        for i in self._links:
            few, many = (q.stop - q.start for q in (self._own.q_f[i], layout.q_f[i]))
            shapes = (few, many), (few, many), (many, many)
            links.append(Condensed(*(np.empty((0, *shape)) for shape in shapes)))
        self.state = TruncationState(instants, links)

    def extend(self, pi: Array, x: Array, v: Array, signals: Array) -> tuple[int, Array]:
        """Take the next instants, with parameters π: how many of those before are now known better.

        And what the nuisances change momentum and force by at these and the next, (instants, 2, n_v, c).
        x (K, n_x), v (K, n_v), signals (K, n_signals): see `Model.inputs`.
        """
        if not self._links:
            return 0, np.zeros((len(x), 2, v.shape[1], 0))
        if self._dynamics is None or not np.array_equal(self._dynamics.pi, pi):
            self._dynamics = self._finer.dynamics(pi)
            self._stiffness = self._plausible(self._dynamics)
        dynamics, now = self._dynamics, self.state
        again = min(BEHIND, len(now.instants.x))
        instants = _joined(now.instants, self._instants(dynamics, x, v, signals))
        links = [_joined(before, self._condensed(c, _last(instants, len(x)))) for c, before in enumerate(now.links)]
        changes = [self._change(dynamics, c, instants, link, again + len(x)) for c, link in enumerate(links)]
        # Rates of rates at those that will be known better need as many before them.
        now.instants, now.links = _last(instants, 2 * BEHIND), [_last(link, 2 * BEHIND) for link in links]
        return again, np.stack(changes, axis=3)

    def _plausible(self, dynamics: Dynamics) -> list[Array]:
        """Stiffness (n_f', n_f') of each link, as described where that of π is none that a link has."""
        described, out = self._finer.dynamics(self._finer.nominal).stiffness, []
        for q in (self._finer.layout.q_f[i] for i in self._links):
            softest = eigvalsh(dynamics.stiffness[q, q], described[q, q])[0]
            out.append((dynamics.stiffness if softest >= SOFTEST else described)[q, q])
        return out

    def _instants(self, dynamics: Dynamics, x: Array, v: Array, signals: Array) -> FinerInstants:
        """With states of the model as described."""
        layout = self._finer.layout
        finer_x, finer_v = np.zeros((len(x), layout.n_x)), np.zeros((len(v), layout.n_v))
        finer_x[:, self._positions], finer_v[:, self._speeds] = x, v
        return FinerInstants(finer_x, finer_v, signals, *self._loads(dynamics, finer_x, finer_v, signals))

    def _condensed(self, c: int, at: FinerInstants) -> Condensed:
        """Link of nuisance c."""
        q, K = self._finer.layout.q_f[self._links[c]], len(at.x)
        here, moved = self._finer.chain.elastic(at.x, self._links[c]), STEP * at.v[:, q]
        about = np.concatenate((here, here + moved, here - moved))
        virtual, shape = self._rods[c].condensed(about, self._stiffness[c])
        return Condensed(virtual[:K], (virtual[K : 2 * K] - virtual[2 * K :]) / (2.0 * STEP), shape[:K])

    def _change(self, dynamics: Dynamics, c: int, instants: FinerInstants, link: Condensed, count: int) -> Array:
        """What nuisance c changes momentum and force by (count, 2, n_v) at the last of some instants."""
        i, at = self._links[c], _last(instants, count)
        finer, own = self._finer.layout.q_f[i], self._own.q_f[i]
        load = (self._rate(instants.momentum) - instants.load)[:, finer, None]
        w = (link.shape @ load)[..., 0]
        x, v = at.x.copy(), at.v.copy()
        self._finer.chain.elastic(x, i)[:] += w[-count:]
        v[:, finer] += self._rate(w)[-count:]
        bent = np.stack(self._loads(dynamics, x, v, at.signals), axis=1)
        before = np.stack((at.momentum, at.load), axis=1)
        out = (bent - before)[:, :, self._speeds]
        by_virtual = bent[:, :, finer] @ link.virtual[-count:].swapaxes(1, 2)
        by_virtual[:, 1] += (link.turning[-count:] @ bent[:, 0, finer, None])[..., 0]
        out[:, :, own] = by_virtual - before[:, :, self._speeds[own]]
        return np.asarray(out)

    def _loads(self, dynamics: Dynamics, x: Array, v: Array, signals: Array) -> tuple[Array, Array]:
        """P π and G π (K, n_v) without springs."""
        momentum, force = dynamics.momentum_and_force(x, v, self._finer.inputs(signals))
        return momentum, force - dynamics.spring_force(x, v)

    def _rate(self, values: Array) -> Array:
        """Rates of values (K, ·) at the instants, by differences of fourth order, one-sided at the ends."""
        if len(values) < STENCIL:
            return np.zeros_like(values)
        numbers = np.arange(len(values))
        first = np.clip(numbers - STENCIL // 2, 0, len(values) - STENCIL)
        around = values[first[:, None] + np.arange(STENCIL)]
        return np.asarray(np.einsum("ks,ksn->kn", _slopes()[numbers - first], around) / self._step)


@cache
def _slopes() -> Array:
    """Weights (STENCIL, STENCIL) of values: row k gives the slope, per step, of a polynomial through all at point k."""
    points, powers = np.arange(float(STENCIL)), np.arange(STENCIL)
    rates = np.where(powers > 0, powers * points[:, None] ** np.maximum(powers - 1, 0), 0.0)
    return np.asarray(rates @ np.linalg.inv(points[:, None] ** powers))


def _joined(before: StateT, after: StateT) -> StateT:
    """Records of instants, one behind the other."""
    names = before.__struct_fields__
    return type(before)(*(np.concatenate((getattr(before, name), getattr(after, name))) for name in names))


def _last(instants: StateT, count: int) -> StateT:
    """The last of a record of instants."""
    return type(instants)(*(getattr(instants, name)[-count:] for name in instants.__struct_fields__))
