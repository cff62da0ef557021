"""The testbed in closed loop: the model's equations of motion under its joint controller."""

from __future__ import annotations

from collections.abc import Sequence
from functools import cached_property

import numpy as np

from sms_online.description.channels import drive_channels, sensed_channels, wrench_channels
from sms_online.description.schema import System
from sms_online.effects.build import build_model
from sms_online.model.effect import Inputs
from sms_online.model.readings import Readings, position_channels, readable_channels
from sms_online.stream import Array
from sms_sim.controller import JointPD
from sms_sim.drifting import ParameterDrift
from sms_sim.references import applied_wrenches, fourier_reference


class Plant:
    """A described system with parameter values π and a controller; without one no torque acts, but wrenches do.

    The state y is positions x, speeds v and the internal states z of declared effects in one array, (B, n_y). Euler
    parameters are integrated as plain states: their norm is an invariant of the equations, which the adaptive
    integrator keeps to its own accuracy; only a run of hours at a fixed step needs `normalised`. Declared effects are
    part of the model's dynamics; those on channels are the sensors'. drifts: parameters that change with time. Mass
    that is lost leaves with the velocity of its body, so that (40) holds with the parameters of the instant.
    """

    def __init__(self, system: System, parameters: Array | None = None, drifts: Sequence[ParameterDrift] = ()) -> None:
        self.model = build_model(system, parameters)
        self.system = self.model.system
        self.parameters = self.model.nominal if parameters is None else parameters
        self.dynamics = self.model.dynamics(self.parameters)
        # Equations of motion are linear in π: what a drift adds to them are those of its direction.
        self._drifts = [(drift, self.model.dynamics(drift.direction(self.model, self.parameters))) for drift in drifts]
        self.controller: JointPD | None = None
        if system.controller is not None and system.trajectory is not None:
            self.controller = JointPD(system.controller, fourier_reference(system.trajectory))
        self._wrenches = applied_wrenches(system)
        layout = self.model.layout
        # Columns of a joint's link side and motor side, among the speeds and among the positions.
        self._q_speed, self._motor_speed = list(layout.q), list(layout.theta_m)
        self._q_position = [column + layout.n_x - layout.n_v for column in layout.q]

    @property
    def rest(self) -> Array:
        """State (n_y,) at rest: undeformed, joints at zero, S at the origin, base unturned."""
        layout = self.model.layout
        x = np.zeros(layout.n_x)
        if "eta" in layout.position_names:
            x[layout.position_names.index("eta")] = 1.0
        return self.state(x, np.zeros(layout.n_v))

    def state(self, x: Array, v: Array) -> Array:
        """State (n_y,) at positions x (n_x,) and speeds v (n_v,), from where effects are as if at rest before."""
        return np.concatenate((x, v, self.model.initial_state(x)))

    def normalised(self, y: Array) -> Array:
        """States y (B, n_y) with Euler parameters, where there are any, of norm 1."""
        names = self.model.layout.position_names
        if "eta" not in names:
            return y
        attitude = slice(names.index("eps_x"), names.index("eta") + 1)
        y = y.copy()
        y[:, attitude] /= np.linalg.norm(y[:, attitude], axis=1, keepdims=True)
        return y

    def split(self, y: Array) -> tuple[Array, Array]:
        """Positions x (B, n_x) and speeds v (B, n_v) of states y."""
        layout = self.model.layout
        return y[:, : layout.n_x], y[:, layout.n_x : layout.n_x + layout.n_v]

    def inputs(self, t: Array, y: Array) -> Inputs:
        """What effects need beside positions and speeds at instants t (B,), s, in states y."""
        layout = self.model.layout
        return Inputs(self.torque(t, y), y[:, layout.n_x + layout.n_v :])

    def torque(self, t: Array, y: Array) -> Array:
        """Torque after the gear n τ, N m (N), and components of wrenches (B, inputs), at instants t (B,), s."""
        out = np.zeros((t.size, self.model.n_inputs))
        joints = len(self.system.joints)
        if self.controller is not None:
            x, v = self.split(y)
            out[:, :joints] = self.controller(t, x[:, self._q_position], v[:, self._q_speed])
        if self._wrenches is not None:
            out[:, joints:], _ = self._wrenches(t)
        return out

    @cached_property
    def channels(self) -> tuple[str, ...]:
        """Channels that the exact motion gives: drives, wrenches, then positions of base, joints and markers."""
        return (*drive_channels(self.system), *wrench_channels(self.system), *position_channels(self.model))

    @cached_property
    def further_channels(self) -> tuple[str, ...]:
        """What some described sensor reads beside positions: v_S, ω_0 and a gyro's rates, strain, points."""
        system = self.system
        described = {channel for sensor in system.sensors for channel in sensed_channels(system, sensor)}
        further = (channel for channel in readable_channels(self.model) if channel not in self.channels)
        return tuple(channel for channel in further if channel in described)

    @property
    def recordable(self) -> tuple[str, ...]:
        """Channels that a recording may hold: those of the exact motion, and what is described beside."""
        return (*self.channels, *self.further_channels)

    def further_values(self, x: Array, v: Array) -> Array:
        """Exact values (B, further_channels) at positions x (B, n_x) and speeds v (B, n_v)."""
        return Readings(self.model, self.further_channels)(x, v)

    def channel_values(self, torque: Array, x: Array) -> Array:
        """Exact values (B, channels) at torques and wrenches (B, inputs), see `torque`, and positions x (B, n_x)."""
        drives = drive_channels(self.system)
        joints = [i - 1 for i in drives.values()]
        gears = np.array([self.system.joints[i].gear_ratio for i in joints])
        at_shaft = np.array([channel.startswith("tau_") for channel in drives])
        of_drives = torque[:, joints] / np.where(at_shaft, gears, 1.0)
        positions = self._positions(x, np.zeros((len(x), self.model.layout.n_v)))
        return np.concatenate((of_drives, torque[:, len(self.system.joints) :], positions), axis=1)

    @cached_property
    def _positions(self) -> Readings:
        return Readings(self.model, position_channels(self.model))

    def rate(self, t: Array, y: Array) -> Array:
        """ẏ (B, n_y) from H v̇ + C = Q, (40), and the effects' own laws."""
        x, v = self.split(y)
        inputs = self.inputs(t, y)
        Q = self.model.generalized_force(inputs.torque)
        v_dot = self.dynamics.acceleration(x, v, Q, inputs) if not self._drifts else self._drifting(t, x, v, Q, inputs)
        return np.concatenate(
            (self.model.position_rate(x, v), v_dot, self.model.state_rate(x, v, inputs.states)), axis=1
        )

    def _drifting(self, t: Array, x: Array, v: Array, Q: Array, inputs: Inputs) -> Array:
        """v̇ (B, n_v) with the parameters of t (B,)."""
        H, C = self.dynamics.mass_and_bias(x, v, inputs)
        for drift, direction in self._drifts:
            H_more, C_more = direction.mass_and_bias(x, v, inputs)
            course = drift.course(t)
            H, C = H + course[:, None, None] * H_more, C + course[:, None] * C_more
        return np.asarray(np.linalg.solve(H, (Q - C)[..., None])[..., 0])

    def motor_power(self, t: Array, y: Array) -> Array:
        """Power of each motor n τ θ̇_m (B, joints), W: its integral is the left side of (42)."""
        _, v = self.split(y)
        return np.asarray(self.torque(t, y)[:, : len(self._motor_speed)] * v[:, self._motor_speed])
