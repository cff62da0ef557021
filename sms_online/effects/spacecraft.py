"""Forces and torques on a free-floating base: what a testbed adds to floating freely, and what the craft does itself.

Rows of the base are those of S: force on ṙ_S, torque about S on ω_0, both in inertial axes.
"""

from __future__ import annotations

from collections.abc import Mapping

import numpy as np

from sms_online.description.channels import AXES
from sms_online.description.schema import Effect, System
from sms_online.effects.base import Constant, Entry, Force, Ranges, Shape, Site
from sms_online.effects.traits import Traits
from sms_online.model.effect import Inputs
from sms_online.model.layout import Layout
from sms_online.stream import Array


def _axes(site: Site) -> str:
    """Names of the base's linear axes."""
    return "".join(AXES[axis] for axis in site.chain.layout.base_linear)


def _linear_rows(layout: Layout) -> slice:
    return slice(0, len(layout.base_linear))


class ReactionWheel(Force):
    """A constant torque of the base's wheel on the base, body-fixed, N m: `torque`, in space `torque_x` … `torque_z`.

    Limitations: constant; the wheel's own momentum, which turns with the base, is left out.
    """

    entry = Entry(
        "reaction_wheel", "force", "base",
        {"torque": "N m", "torque_x": "N m", "torque_y": "N m", "torque_z": "N m"},
        "long motion in which the base turns and travels far: a force about S then differs from a torque",
        traits=Traits(signed=True),
    )  # fmt: skip

    def __init__(self, site: Site, given: Mapping[str, float]) -> None:
        planar = site.chain.layout.planar
        names = ["torque"] if planar else [f"torque_{axis}" for axis in AXES]
        linear = {name: (name.replace("torque", "T_w"), "N m", given.get(name, 0.0)) for name in names}
        super().__init__(site, given, linear)

    def force(self, layout: Layout, x: Array, v: Array, inputs: Inputs | None) -> Array:
        """T_0 e on ω_0; about z in the plane."""
        f = np.zeros((*v.shape, len(self.parameters)))
        T_0 = layout.base_pose(x)[1]
        rows = slice(len(layout.base_linear), layout.n_base_speeds)
        f[:, rows] = T_0[:, 2:, 2:] if layout.planar else T_0
        return f


class ThrusterLeak(Force):
    """A constant body-fixed force at S, N: `force_x`, `force_y`, in space `force_z`.

    Limitations: a leak elsewhere is this force and a torque.
    """

    entry = Entry(
        "thruster_leak", "force", "base", {"force_x": "N", "force_y": "N", "force_z": "N"},
        "a base that turns by a quarter turn or more: a leak turns with it, a tilted table does not",
        traits=Traits(signed=True),
    )  # fmt: skip

    def __init__(self, site: Site, given: Mapping[str, float]) -> None:
        names = [f"force_{axis}" for axis in _axes(site)]
        linear = {name: (name.replace("force", "F_l"), "N", given.get(name, 0.0)) for name in names}
        super().__init__(site, given, linear)

    def force(self, layout: Layout, x: Array, v: Array, inputs: Inputs | None) -> Array:
        """T_0 e on ṙ_S."""
        f = np.zeros((*v.shape, len(self.parameters)))
        n = len(layout.base_linear)
        f[:, :n] = layout.base_pose(x)[1][:, :n, :n]
        return f


class TableTilt(Constant, Force):
    """Uniform gravity in the plane on every mass, m/s²: `gravity_x`, `gravity_y`, in inertial axes.

    The product of gravity and masses is linear in one of them only: columns are those of 1 m/s² on the masses of the
    model's reference π, so the masses have to be known well, from a fit without this effect or from a scale.
    Limitations: the error of the reference masses is left out.
    """

    entry = Entry(
        "table_tilt", "force", "base", {"gravity_x": "m/s²", "gravity_y": "m/s²"},
        "a base that turns by a quarter turn or more: gravity does not turn with it, a leak does",
        traits=Traits(signed=True, course="smooth", calibrates=("gravity",)),
    )  # fmt: skip
    symbols = ("g_x", "g_y")
    needs_masses = True

    def __init__(self, site: Site, given: Mapping[str, float]) -> None:
        super().__init__(site, given)
        self._weight = site.weight

    def force(self, layout: Layout, x: Array, v: Array, inputs: Inputs | None) -> Array:
        """Weight of the reference masses under 1 m/s² along x and y."""
        return self._weight(x)

    @classmethod
    def declared(cls, system: System, effect: Effect) -> System:
        """The system with more gravity."""
        gravity = np.array(system.gravity)
        gravity[:2] += effect.coefficients["gravity_x"], effect.coefficients["gravity_y"]
        return system.model_copy(update={"gravity": tuple(gravity.tolist())})


class AirDrag(Force):
    """f = -c ṙ_S, c `damping` in N s/m: drag of air or of an air bearing on the base.

    Limitations: linear; drag on the links is left out, and that on the base's turning is `rotational_drag`.
    """

    entry = Entry("air_drag", "force", "base", {"damping": "N s/m"}, "travel of the base at two speeds, and back")
    symbols = ("d_0",)

    def force(self, layout: Layout, x: Array, v: Array, inputs: Inputs | None) -> Array:
        """-ṙ_S."""
        f = np.zeros((*v.shape, 1))
        rows = _linear_rows(layout)
        f[:, rows, 0] = -v[:, rows]
        return f


class RotationalDrag(Force):
    """f = -c ω_0, c `damping` in N m s/rad: drag of air or of an air bearing on the base's turning.

    Limitations: linear, and in space isotropic.
    """

    entry = Entry("rotational_drag", "force", "base", {"damping": "N m s/rad"}, "turns of the base at two rates")
    symbols = ("d_0r",)

    def force(self, layout: Layout, x: Array, v: Array, inputs: Inputs | None) -> Array:
        """-ω_0."""
        f = np.zeros((*v.shape, 1))
        rows = slice(len(layout.base_linear), layout.n_base_speeds)
        f[:, rows, 0] = -v[:, rows]
        return f


class CableSpring(Force):
    """f = -c (r_S - r_0), c `stiffness` in N/m: a cable that pulls the base back to where it hangs slack.

    r_0: shape constants `rest_x`, `rest_y`, in space `rest_z`, m: where S was at the start; the origin unless stated.
    Limitations: linear and isotropic; its torque about S is left out.
    """

    entry = Entry(
        "cable_spring", "force", "base", {"stiffness": "N/m"}, "travel of the base to both sides, held there",
        {f"rest_{axis}": Shape("m", 0.0, lambda ranges: (0.0,)) for axis in AXES},
    )  # fmt: skip
    symbols = ("c_0",)

    def force(self, layout: Layout, x: Array, v: Array, inputs: Inputs | None) -> Array:
        """-(r_S - r_0)."""
        f = np.zeros((*v.shape, 1))
        rows = _linear_rows(layout)
        f[:, rows, 0] = np.array(list(self.shapes.values())) - x[:, rows]
        return f


# Frequencies of the liquid in small tanks, rad/s: a tenth of a hertz to three, by default half a hertz.
SLOSH_LOWEST, SLOSH_HIGHEST = 2.0 * np.pi * 0.1, 2.0 * np.pi * 3.0
SLOSH_DEFAULT = 2.0 * np.pi * 0.5
# An undamped mass rings on, so T seconds separate a frequency from another that is 2 π / T away. Those tried are this
# share of it apart, or in a long session so many.
SLOSH_APART, SLOSH_MOST = 0.75, 96


def _slosh_frequencies(ranges: Ranges) -> tuple[float, ...]:
    """Frequencies to try in a session, rad/s."""
    apart = SLOSH_APART * 2.0 * np.pi / ranges.duration
    count = min(max(round((SLOSH_HIGHEST - SLOSH_LOWEST) / apart), 2), SLOSH_MOST)
    return tuple(np.linspace(SLOSH_LOWEST, SLOSH_HIGHEST, count).tolist())


class Slosh(Force):
    """A mass on a spring in the base: p̈ = -ω² (p - r_S) on each active axis, and f = c (p - r_S) on ṙ_S, c = m ω².

    c: `stiffness`, N/m; reported with `mass` m, kg. ω: shape constant `frequency`, rad/s, or √(stiffness/mass).
    Internal states p, ṗ (inertial), at first p = r_S and ṗ = 0.
    Source: Abramson, NASA SP-106 (1966), chapter 6 (equivalent mechanical models).
    Limitations: undamped, at S, so what the start stirs up stays; r_S moves with no rotation's arm. Beyond 25 s without
    a gap frequencies are tried so far apart that the right one may be passed over.
    """

    entry = Entry(
        "slosh", "force", "base", {"mass": "kg", "stiffness": "N/m"},
        "motion of the base below and above the liquid's frequency",
        {"frequency": Shape("rad/s", SLOSH_DEFAULT, _slosh_frequencies)},
    )  # fmt: skip

    def __init__(self, site: Site, given: Mapping[str, float]) -> None:
        mass, stiffness = given.get("mass", 0.0), given.get("stiffness", 0.0)
        omega = float(np.sqrt(stiffness / mass)) if mass > 0.0 and stiffness > 0.0 else given["frequency"]
        nominal = stiffness if "stiffness" in given else mass * omega**2
        super().__init__(site, given, {"stiffness": ("c_s", "N/m", nominal)})
        self.shapes = {"frequency": omega}
        self.n_states = 2 * len(site.chain.layout.base_linear)

    def force(self, layout: Layout, x: Array, v: Array, inputs: Inputs | None) -> Array:
        """p - r_S."""
        assert inputs is not None
        f = np.zeros((*v.shape, 1))
        rows = _linear_rows(layout)
        f[:, rows, 0] = inputs.states[:, rows] - x[:, rows]
        return f

    def state_rate(self, layout: Layout, x: Array, v: Array, z: Array) -> Array:
        """ṗ and -ω² (p - r_S)."""
        n = len(layout.base_linear)
        pull = self.shapes["frequency"] ** 2 * (x[:, :n] - z[:, :n])
        return np.concatenate((z[:, n:], pull), axis=1)

    def initial_state(self, layout: Layout, x_0: Array) -> Array:
        """r_S and rest."""
        n = len(layout.base_linear)
        return np.concatenate((x_0[:n], np.zeros(n)))

    def reported(self, values: Array) -> dict[str, float]:
        """m = c / ω² and c."""
        omega = self.shapes["frequency"]
        return {"mass": float(values[0] / omega**2), "stiffness": float(values[0]), "frequency": omega}
