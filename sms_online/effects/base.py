"""What an effect is: a generalized force, linear in its coefficients; rows, energy column and injection follow from it.

f(x, v, t) = Σ c_j f_j on the right-hand side of the equations of motion, d/dt(P π) - G π = Q + f. Shape constants (a
Stribeck velocity, a gap) enter nonlinearly and are fixed when the effect is built.
"""

from __future__ import annotations

from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import dataclass, field
from typing import ClassVar, Literal

import numpy as np

from sms_online.description.schema import Effect, Over, System
from sms_online.description.tree import index_of
from sms_online.effects.traits import Traits
from sms_online.model.chain import Chain
from sms_online.model.effect import ForceEffect
from sms_online.model.layout import Layout
from sms_online.model.parameters import Parameter
from sms_online.stream import Array

Kind = Literal["force", "inertia", "channel", "kinematics"]
Place = Literal[
    "joint", "driven joint", "flexible joint", "later joint", "joint pair", "weighed joint", "link", "linear link",
    "base", "tip", "angle", "position",
]  # fmt: skip
# Speed below which an axis is at rest, rad/s (m/s): an integrator cannot follow a jump, and encoders resolve no less.
STANDSTILL = 1e-4
# Kinds of events that effects are named after.
CHANGES = ("stiffness", "friction", "offset", "damping")
# Relative step of the differences that carry standard deviations over to reported coefficients.
DIFFERENCE = 1e-6


def beyond_zero(offset: float) -> str:
    """By how much a sensor reads too much or too little, in words."""
    return f"{abs(offset):.3g} too {'much' if offset > 0.0 else 'little'}"


def joints_of(where: str) -> tuple[int, ...]:
    """Indices, from 0, of the joint or the two joints of a place, `joint_i` or `joint_i+joint_j`; none of another."""
    return tuple(index_of(each) for each in where.split("+") if each.startswith("joint_"))


@dataclass(frozen=True)
class Ranges:
    """How far a motion goes where an effect sits, for grids of shape constants.

    speed: largest motor rate, rad/s. swing: from the least to the largest motor angle, rad. deflection: largest joint
    deflection, rad. duration: of the longest part without a gap, s. sample_rate: Hz.
    """

    speed: float
    swing: float
    deflection: float
    duration: float
    sample_rate: float


def shares_of(size: str, *shares: float) -> Callable[[Ranges], tuple[float, ...]]:
    """A grid of shares of a motion's range."""
    return lambda ranges: tuple(share * getattr(ranges, size) for share in shares)


@dataclass(frozen=True)
class Shape:
    """A shape constant: unit, value where none is given, and the values to search for a motion's ranges.

    counted: whether it is a number of periods in a motor's turn, which is one of those in the grid, and of which the
    motion has to go through one.
    """

    unit: str
    default: float
    grid: Callable[[Ranges], tuple[float, ...]]
    counted: bool = False


@dataclass(frozen=True)
class Entry:
    """The catalogue's entry of an effect.

    coefficients: those that may be declared and are reported, name to unit ("": a ratio); on a prismatic joint, m is
    for rad and N for N m. separated_by: the motion that separates it from similar effects. shapes: shape constants.
    further: coefficients that may be declared but are not reported. relative_to: place that coefficients are relative
    to where no parameter is known, so that as much the other way there is the same. said: the finding in words, of its
    place and coefficients. over: variables that a curve of it may be over, with its traits there. forms: of a curve,
    the declarations to try, of one at a place and the values (K,) that its variables go through in a session.
    """

    name: str
    kind: Kind
    at: Place
    coefficients: Mapping[str, str]
    separated_by: str
    shapes: Mapping[str, Shape] = field(default_factory=dict)
    further: Mapping[str, str] = field(default_factory=dict)
    traits: Traits = field(default_factory=Traits)
    relative_to: str = ""
    said: Callable[[str, Mapping[str, float]], str] | None = None
    over: Mapping[Over, Traits] = field(default_factory=dict)
    forms: Callable[[Effect, Mapping[str, Array]], Iterator[Effect]] | None = None

    @property
    def change(self) -> str:
        """Kind of an event in which its coefficients jump, by its place or the last word of its name."""
        if self.at == "tip":
            return "payload"
        word = self.name.rsplit("_", 1)[-1]
        return word if word in CHANGES else "inertia"


@dataclass(frozen=True)
class Site:
    """Where an effect sits.

    index: number of the joint or link, from 1; 0 elsewhere. weight: x (B, n_x) to the generalized forces (B, n_v, 2) of
    1 m/s² of gravity along inertial x and y on every mass. declared: the effect as a system file declares it.
    """

    system: System
    chain: Chain
    declared: Effect
    index: int
    weight: Callable[[Array], Array]

    @property
    def where(self) -> str:
        """Its place."""
        return self.declared.where

    @property
    def prismatic(self) -> bool:
        """Whether the joint slides."""
        return self.system.joints[self.index - 1].kind == "prismatic"

    @property
    def gear_ratio(self) -> float:
        """n of the joint."""
        return self.system.joints[self.index - 1].gear_ratio

    def unit(self, unit: str) -> str:
        """A coefficient's unit at this place."""
        if not self.where.startswith("joint_") or not self.prismatic:
            return unit
        return unit.replace("N m", "N").replace("rad", "m")


class Constant:
    """What becomes a constant of the description where it is found, and no unknown of π.

    Its linear coefficients are first approximations, by which constants are improved while what is left is fitted.
    """

    entry: ClassVar[Entry]

    @classmethod
    def improved(cls, given: Mapping[str, float], increments: Array) -> dict[str, float]:
        """The constants changed by linear coefficients (c,) that are fitted to the corrected samples."""
        changes = zip(cls.entry.coefficients, increments, strict=True)
        return {name: given.get(name, 0.0) + float(change) for name, change in changes}

    @classmethod
    def deviations(cls, given: Mapping[str, float], covariance: Array) -> dict[str, float]:
        """1σ of the constants for the covariance (c, c) of the linear coefficients."""
        return {name: float(std) for name, std in zip(given, np.sqrt(np.diag(covariance)), strict=True)}

    @classmethod
    def possible(cls, given: Mapping[str, float], sample_rate: float) -> bool:
        """Whether constants that were improved are still of this effect, on samples at so many Hz."""
        return True

    @classmethod
    def declared(cls, system: System, effect: Effect) -> System:
        """The system with an effect of these constants."""
        return system.model_copy(update={"effects": (*system.effects, effect)})


def dahl_rate(rate: Array, z: Array, width: float) -> Array:
    """ż = r - |r| z / w (B, 1) of a state z (B, 1) that remembers where a motion of rate r (B,) comes from.

    Source: Dahl, AIAA J. 14 (1976) 1675, with exponent 1.
    """
    r = rate[:, None]
    return np.asarray(r - np.abs(r) * z / width)


class Force(ForceEffect):
    """What most force effects share: no torque, no internal state, coefficients reported as they are.

    symbols: of the entry's coefficients where these are what is linear, with {} for the number of the joint.
    """

    entry: ClassVar[Entry]
    symbols: ClassVar[tuple[str, ...]] = ()
    needs_torque = False
    n_states = 0
    needs_masses = False

    def __init__(
        self, site: Site, given: Mapping[str, float], linear: Mapping[str, tuple[str, str, float]] | None = None
    ) -> None:
        """given: declared coefficients. linear: quantity to symbol, unit and nominal value, unless by `symbols`."""
        if linear is None:
            number = site.where.replace("joint_", "")
            own = zip(self.entry.coefficients.items(), self.symbols, strict=True)
            linear = {name: (symbol.format(number), unit, given.get(name, 0.0)) for (name, unit), symbol in own}
        self.name, self.where, self.index = self.entry.name, site.where, site.index
        traits = self.entry.traits
        self.smooth, self.reversing, self.dry = traits.course == "smooth", traits.reversing, traits.dry
        self.shapes: Mapping[str, float] = {name: given[name] for name in self.entry.shapes if name in given}
        self.relative_to: tuple[str, ...] = ()
        self.parameters = tuple(
            Parameter(f"{self.key}.{quantity}", symbol, site.unit(unit), nominal)
            for quantity, (symbol, unit, nominal) in linear.items()
        )

    def axis(self, layout: Layout) -> int:
        """That of the joint's motor."""
        return layout.theta_m[self.index - 1]


def position(layout: Layout, x: Array, speed: int) -> Array:
    """Position (B,) whose rate is a speed beyond the base's."""
    return np.asarray(x[:, speed + layout.offset])


def deflection(layout: Layout, x: Array, i: int) -> Array:
    """θ_m - q (B,) of the joint with index i."""
    return np.asarray(position(layout, x, layout.theta_m[i]) - position(layout, x, layout.q[i]))


def report(
    effect: ForceEffect, names: Sequence[str], values: Array, covariance: Array
) -> dict[str, tuple[float, float]]:
    """Reported coefficients with their standard deviations (1σ, first order), from an estimate.

    names, values (n,), covariance (n, n): of the estimated parameters. A shape constant has no deviation. Raises
    ValueError where the estimate lacks a parameter that the effect reports.
    """
    wanted = [*(p.name for p in effect.parameters), *effect.relative_to]
    if missing := [name for name in wanted if name not in names]:
        raise ValueError(f"the estimate holds no {missing[0]!r}")
    columns = [list(names).index(name) for name in wanted]
    at, spread = values[columns], covariance[np.ix_(columns, columns)]
    steps = DIFFERENCE * np.maximum(np.abs(at), np.sqrt(np.diag(spread)))
    steps[steps == 0.0] = DIFFERENCE
    reported = effect.reported(at)
    slopes = np.array(
        [
            [
                (plus - minus) / (2.0 * step)
                for plus, minus in zip(
                    effect.reported(at + step * unit).values(),
                    effect.reported(at - step * unit).values(),
                    strict=True,
                )
            ]
            for step, unit in zip(steps, np.eye(at.size), strict=True)
        ]
    )
    variance = np.einsum("ic,ij,jc->c", slopes, spread, slopes)
    return {name: (value, float(np.sqrt(v))) for (name, value), v in zip(reported.items(), variance, strict=True)}
