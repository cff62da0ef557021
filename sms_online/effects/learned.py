"""A force of one variable at a joint where no law fits: a cubic spline whose coefficients are parameters like others.

What laws say already is no part of the curve. Over the rate it ends at zero with zero slope at the fastest, where
Coulomb and viscous friction say all; over deflection and load it begins so, where the spring's stiffness, and Coulomb
and load friction do; over the angle it is zero where the joint is. It is put together of orthogonal modes. Beyond the
values that a session went through it goes on as it is there, for a polynomial out there is no measurement.
Source of splines: de Boor, A Practical Guide to Splines, 1978; of their modes: Demmler and Reinsch, Numerische
Mathematik 24 (1975) 375.
"""

from __future__ import annotations

from collections.abc import Iterator, Mapping
from dataclasses import replace
from functools import cached_property

import numpy as np
from scipy.interpolate import BSpline
from scipy.linalg import eigh, null_space

from sms_online.description.schema import Effect, Over
from sms_online.effects.base import Entry, Force, Site, deflection, position
from sms_online.effects.friction import sign
from sms_online.effects.traits import Curve, Traits
from sms_online.model.effect import Inputs
from sms_online.model.layout import Layout
from sms_online.stream import Array

DEGREE = 3
# Intervals between knots that are tried; held-out data decide, so that a curve is as smooth as they allow.
INTERVALS = (3, 6, 12)
# Points of the curve from which its modes are made, and its largest force is found.
POINTS = 400
# Share of its range by which noise may bring a motion beyond it.
MARGIN = 0.01
# On measured rigs curves that lowered the residual of held-out blocks by less than this harmed other runs.
LEAST_IMPROVEMENT = 0.20
_TRAITS = Traits(signed=True, learned=True, least_improvement=LEAST_IMPROVEMENT)
# How a curve over each variable acts: with a motor's rate it reverses, and at a standstill is any force up to its own.
TRAITS: Mapping[Over, Traits] = {
    "rate": replace(_TRAITS, course="dry", curve=Curve("motor speed")),
    "angle": replace(_TRAITS, curve=Curve("motor angle")),
    "deflection": replace(_TRAITS, curve=Curve("deflection", between=True)),
    "load": replace(_TRAITS, course="dry"),
}
# Variables of which the curve is even or odd, so that their size decides; of the others it has two sides.
SIZES = ("rate", "load")
# Where a curve's value, or its value and slope, are zero: at its largest knot, or at zero or the knot nearest to it.
FLAT_AT_END = ("rate",)
SLOPED = ("angle",)
# Where a declaration states none.
DEFAULT_OVER: Over = "rate"
DEFAULT_KNOTS = (0.0, 0.5, 1.0)


def forms(effect: Effect, values: Mapping[str, Array]) -> Iterator[Effect]:
    """Declarations to try at a joint for the values (K,) that a session's variables go through.

    They are quantiles; over sizes they are denser towards zero, where friction changes most.
    """
    for over, seen in values.items():
        used = np.sort(np.abs(seen) if over in SIZES else seen)
        if not used[-1] > used[0]:
            continue
        for count in INTERVALS:
            shares = np.linspace(0.0, 1.0, count + 1)
            knots = np.quantile(used, shares**2 if over in SIZES else shares)
            knots[0] = 0.0 if over in SIZES else knots[0]
            # Steps of an encoder may hold several quantiles, with an interval between that no curve is sampled in.
            if np.all(np.diff(knots) > 2.0 * (knots[-1] - knots[0]) / POINTS):
                yield effect.model_copy(update={"over": over, "knots": tuple(knots.tolist())})


class LearnedForce(Force):
    """f = Σ c_j m_j(u) with modes m_j of a cubic spline over the rate, angle or deflection of a joint, or its load.

    Over the motor's `rate` θ̇_m and `angle` θ_m it acts on θ_m; over the `deflection` δ = θ_m - q along δ. Over the
    `load` |δ| it is a friction: times sign(θ̇_m). Over the rate it is odd. c_j: N m, sizes of the modes.
    Limitations: one variable; no memory; says nothing of values that no session has shown.
    """

    entry = Entry(
        "learned_force", "force", "joint", {"peak": "N m"}, "the same values of its variable in other motions",
        traits=_TRAITS, over=TRAITS, forms=forms,
    )  # fmt: skip

    def __init__(self, site: Site, given: Mapping[str, float]) -> None:
        self.over = site.declared.over or DEFAULT_OVER
        self.knots = np.array(site.declared.knots or DEFAULT_KNOTS)
        self.unit = "N" if site.prismatic else "N m"
        count = self._modes.shape[1]
        linear = {f"mode_{k}": (f"l_{site.index},{k}", "N m", 0.0) for k in range(1, count + 1)}
        super().__init__(site, given, linear)
        traits = TRAITS[self.over]
        self.reversing, self.dry = traits.reversing, traits.dry

    @cached_property
    def _spline(self) -> BSpline:
        """All B-splines at once, coefficients of unit size."""
        knots = np.concatenate((np.full(DEGREE, self.knots[0]), self.knots, np.full(DEGREE, self.knots[-1])))
        return BSpline(knots, np.eye(self.knots.size + DEGREE - 1), DEGREE)

    @cached_property
    def _modes(self) -> Array:
        """Coefficients (B-splines, modes) of curves that no law explains, of unit rms, the smoothest first."""
        u = np.linspace(self.knots[0], self.knots[-1], POINTS)
        B, bending = self._spline(u), self._spline.derivative(2)(u)
        end = self.knots[-1] if self.over in FLAT_AT_END else np.clip(0.0, self.knots[0], self.knots[-1])
        zero = [self._spline(end)] + ([] if self.over in SLOPED else [self._spline.derivative()(end)])
        inside = null_space(np.array(zero))
        gram, roughness = (inside.T @ (part.T @ part) @ inside / POINTS for part in (B, bending))
        return np.asarray(inside @ eigh(roughness, gram)[1])

    def curve(self, u: Array) -> Array:
        """Modes (B, modes) at values (B,) of the variable, those beyond the knots put on the nearest end."""
        inside = np.clip(u, self.knots[0], self.knots[-1])
        return np.asarray(self._spline(inside) @ self._modes)

    def variable(self, layout: Layout, x: Array, v: Array) -> Array:
        """What the curve is over, (B,)."""
        motor = layout.theta_m[self.index - 1]
        if self.over == "rate":
            return np.abs(v[:, motor])
        if self.over == "angle":
            return position(layout, x, motor)
        bent = deflection(layout, x, self.index - 1)
        return np.abs(bent) if self.over == "load" else bent

    def force(self, layout: Layout, x: Array, v: Array, inputs: Inputs | None) -> Array:
        """The modes, with the sign of a friction where it is one."""
        motor, link = layout.theta_m[self.index - 1], layout.q[self.index - 1]
        along = self.curve(self.variable(layout, x, v))
        if self.over in SIZES:
            along = -sign(v[:, motor])[:, None] * along
        f = np.zeros((*v.shape, along.shape[1]))
        f[:, motor] = along
        if self.over == "deflection":
            f[:, link] = -along
        return f

    def beyond(self, layout: Layout, x: Array, v: Array) -> str:
        """Where a motion goes beyond the values that the curve was seen at, in a sentence; empty where it does not."""
        u = self.variable(layout, x, v)
        margin = MARGIN * (self.knots[-1] - self.knots[0])
        outside = float(np.mean((u < self.knots[0] - margin) | (u > self.knots[-1] + margin)))
        if not outside:
            return ""
        seen = f"{self.knots[0]:.3g} to {self.knots[-1]:.3g}"
        reached = f"{u.min():.3g} to {u.max():.3g}"
        return (
            f"{self.key} was seen over a {self.over} of {seen} alone, and here it is {reached}: "
            f"held constant beyond, {100.0 * outside:.2g} % of the time"
        )

    def reported(self, values: Array) -> dict[str, float]:
        """The largest force of the curve."""
        return {"peak": float(np.abs(self.curve(np.linspace(self.knots[0], self.knots[-1], POINTS)) @ values).max())}
