"""From channels to generalized coordinates and joint torques: what a session must measure, and how it is read."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

from sms_online.description.bodies import FlexibleLink
from sms_online.description.channels import point_channels, sensed_channels, strain_channel, wrench_channels
from sms_online.description.explain import hint, nearest
from sms_online.description.schema import System
from sms_online.errors import InputError
from sms_online.model.beam import LinearLink
from sms_online.model.model import Model
from sms_online.model.points import LinkPoints
from sms_online.model.static_shape import PointedShape, SensedShape
from sms_online.state import Stage, State
from sms_online.stream import Array, Block

# Noise of points that state none, m; it weights them against what is known of a link's frame and shape.
USUAL_NOISE = 1e-4
EULER_PARAMETERS = ("eps_x", "eps_y", "eps_z", "eta")


def stated_noise(system: System, channels: Sequence[str]) -> Array:
    """White noise that a description states of channels, 1σ per sample in their own unit (channels,); else NaN."""
    stated = np.full(len(channels), np.nan)
    for sensor in system.sensors:
        for name in sensed_channels(system, sensor):
            if name in channels and sensor.noise > 0.0:
                # Rounding to a resolution r adds r²/12.
                stated[channels.index(name)] = np.hypot(sensor.noise, sensor.resolution / np.sqrt(12.0))
    return stated


# Samples of a sensor in a window of the momentum balance; fewer do not show how it moves there.
LEAST_IN_WINDOW = 8


def stated_period(system: System, channels: Sequence[str]) -> float:
    """Period of the slowest sensor that fills any of the channels, s, as described."""
    read = [sensor for sensor in system.sensors if set(sensed_channels(system, sensor)) & set(channels)]
    return max([1.0 / system.sample_rate, *(1.0 / sensor.rate for sensor in read if sensor.rate is not None)])


def is_slow(period: float, window: float) -> bool:
    """Whether samples of some period, s, are too few for windows of the momentum balance of some length, s.

    Between them the motion is interpolated by polynomials. A window weights its middle half: these must follow there.
    """
    return window < LEAST_IN_WINDOW * period


def not_smoothed(model: Model) -> str:
    """What a system has that the smoother does not use, in words; empty where it has nothing of the kind."""
    if model.system.wrenches:
        return "a measured wrench, which the smoother does not use"
    inner = [effect.key for effect in model.effects if effect.n_states or effect.needs_torque]
    return f"{inner[0]}, whose internal states the smoother does not follow" if inner else ""


class Sensing:
    """Which of a source's channels give each coordinate and torque of a model.

    channels: those it takes, in an order of its own. torque_columns: the torques' among them, drive by drive.
    unused: the source's others. In place of q_i a flexible joint may have the strain of the strip that it represents,
    an angle beyond θ_m_i. A flexible link needs one marker at least, in its own frame or, where nothing is read there,
    in the laboratory's; where it has fewer readings than coordinates, or points, its shape is the static one, and
    `missing` names what is not read.
    Raises InputError, naming the source, when a channel that the model needs is not there.
    """

    def __init__(self, model: Model, available: Sequence[str], source: str) -> None:
        self.model = model
        layout = model.layout
        channels: list[str] = []

        def need(*alternatives: str) -> int:
            for name in alternatives:
                if name in available:
                    if name not in channels:
                        channels.append(name)
                    return channels.index(name)
            expected = f"a column {' or '.join(alternatives)}{hint(nearest(alternatives[0], available))}"
            raise InputError(source, "header", f"no channel {alternatives[0]!r}", expected)

        base = layout.position_names[: layout.n_base_positions]
        self._base = [need(name) for name in base]
        joints = range(1, len(model.system.joints) + 1)
        flexible = [i for i in joints if layout.q[i - 1] != layout.theta_m[i - 1]]
        instead = {i: strain_channel(model.system, i) if i in flexible else f"theta_m_{i}" for i in joints}
        self._q = [need(*filter(None, (f"q_{i}", instead[i]))) for i in joints]
        self._theta_m = [need(f"theta_m_{i}") for i in flexible]
        # Which q are an angle beyond which θ_m, both as numbers in their own lists.
        self._beyond = [
            (i - 1, k) for k, i in enumerate(flexible) if channels[self._q[i - 1]] == strain_channel(model.system, i)
        ]
        self._links: dict[int, tuple[SensedShape, list[int]]] = {}
        self._pointed: dict[int, tuple[PointedShape, list[int]]] = {}
        missing = []
        for i, kinematics in enumerate(model.chain.flexible, start=1):
            if kinematics is None:
                continue
            names = [f"link_{i}.{name}" for name in kinematics.marker_names]
            read = [k for k, name in enumerate(names) if name in available]
            points = point_channels(model.system, i)
            if model.system.links[i - 1].markers or (not read and points[0] in available):
                self._pointed[i - 1] = self._pointed_shape(i - 1), [need(name) for name in points]
                missing.append(f"shape of link_{i} between its markers")
                continue
            if not read:
                read = list(range(len(names)))
            self._links[i - 1] = SensedShape(kinematics, read), [need(names[k]) for k in read]
            missing += [name for k, name in enumerate(names) if k not in read]
        self.missing = tuple(missing)
        driven = [i for i in joints if not model.system.joints[i - 1].passive]
        self.torque_columns = [need(f"tau_{i}", f"force_{i}") for i in driven]
        # n τ out of these columns: tau_i is measured at the motor shaft, before the gear; force_i acts on the joint.
        self._ratio = np.array(
            [
                model.system.joints[i - 1].gear_ratio if channels[column].startswith("tau_") else 1.0
                for i, column in zip(driven, self.torque_columns, strict=True)
            ]
        )
        self._driven = [i - 1 for i in driven]
        self._wrenches = [need(name) for name in wrench_channels(model.system)]
        self.channels = tuple(channels)
        self.unused = tuple(name for name in available if name not in channels)

    @property
    def stated_noise(self) -> Array:
        """Stated white noise of each channel (channels,), 1σ per sample in its own unit; NaN where none is stated."""
        return stated_noise(self.model.system, self.channels)

    @property
    def noise(self) -> Array:
        """Stated white noise, 1σ per sample, of positions and inputs (n_x + inputs,); NaN where none is stated.

        Strain coefficients of exact links mix several markers, and so do static shapes: nothing is stated of them.
        """
        stated = self.stated_noise
        markers = []
        for i, kinematics in enumerate(self.model.chain.flexible):
            if kinematics is None:
                continue
            if i not in self._links:
                markers.append(np.full(kinematics.n_f, np.nan))
                continue
            shape, columns = self._links[i]
            own = isinstance(kinematics, LinearLink) and shape.complete
            markers.append(stated[columns] if own else np.full(kinematics.n_f, np.nan))
        inputs = self.inputs(stated[None])[0]
        q = stated[self._q]
        for joint, motor in self._beyond:
            q[joint] = np.hypot(q[joint], stated[self._theta_m[motor]])
        return np.concatenate((stated[self._base], q, stated[self._theta_m], *markers, inputs))

    @property
    def deciding(self) -> tuple[list[int], Array]:
        """Positions whose noise is a sensor's, and `noise` as the width of a filter is chosen by it.

        Between the samples of a slow sensor noise is interpolated: a filter of many samples averages fewer of them.
        """
        noise, layout = self.noise, self.model.layout
        if not self.missing:
            return list(range(layout.n_x)), noise
        columns = [*self._base, *self._q, *self._theta_m]
        periods = [stated_period(self.model.system, [self.channels[column]]) for column in columns]
        noise[: len(columns)] *= np.sqrt(np.array(periods) * self.model.system.sample_rate)
        return list(range(len(columns))), noise

    @property
    def position_columns(self) -> list[int]:
        """Channels of the position sensors, in the order of the coordinates that they measure, where none is missing.

        There are n_x then, and `displacements` and `coordinate_noise` hold.
        """
        markers = (column for _, columns in self._links.values() for column in columns)
        return [*self._base, *self._q, *self._theta_m, *markers]

    def _pointed_shape(self, i: int) -> PointedShape:
        model = self.model
        link, kinematics = model.system.links[i], model.chain.flexible[i]
        assert isinstance(link, FlexibleLink)
        assert kinematics is not None
        points = LinkPoints(model.system, model.chain, i)
        stated = stated_noise(model.system, points.names)
        sigma = float(np.fmax.reduce(stated, initial=-np.inf))
        axes = [0, 1] if model.layout.planar else [0, 1, 2]
        return PointedShape(link.length, kinematics, points, axes, sigma if sigma > 0.0 else USUAL_NOISE)

    @property
    def usual_shapes(self) -> dict[int, Array]:
        """Covariance (n_f, n_f) of the shapes that each link (from 0) usually takes which cameras see as points."""
        return {i: shape.usual for i, (shape, _) in self._pointed.items()}

    def readings(self, x: Array) -> Array:
        """Readings (K, n_x) of the position sensors at coordinates x (K, n_x): where no marker is missing."""
        out = x.copy()
        for angle, motor in self._beyond_coordinates:
            out[:, angle] -= x[:, motor]
        layout = self.model.layout
        for i, kinematics in enumerate(self.model.chain.flexible):
            if kinematics is not None:
                own = layout.elastic(i)
                out[:, own] = kinematics.markers(self.model.chain.elastic(x, i))
        return out

    def displacements(self, x: Array) -> Array:
        """Displacements (K, n_v, n_x) along the speeds, at x (K, n_x), for one more unit of each sensor's reading."""
        layout = self.model.layout
        K, n_x = x.shape
        by_sensor = np.broadcast_to(np.eye(n_x), (K, n_x, n_x)).copy()
        for angle, motor in self._beyond_coordinates:
            by_sensor[:, angle, motor] = 1.0
        for i, kinematics in enumerate(self.model.chain.flexible):
            if kinematics is not None and not isinstance(kinematics, LinearLink):  # whose markers are its coordinates
                own = layout.elastic(i)
                by_sensor[:, own, own] = np.linalg.inv(kinematics.marker_jacobian(self.model.chain.elastic(x, i)))
        every = np.repeat(x, n_x, axis=0)
        moved = layout.speeds(every, by_sensor.swapaxes(1, 2).reshape(-1, n_x))
        return np.asarray(moved.reshape(K, n_x, -1).swapaxes(1, 2))

    def coordinate_noise(self, sensors: Array) -> Array:
        """1σ of the coordinates (n_x,) for that of the position sensors (n_x,), about the straight arm."""
        layout = self.model.layout
        out = sensors.copy()
        for angle, motor in self._beyond_coordinates:
            out[angle] = np.hypot(out[angle], sensors[motor])
        for i, kinematics in enumerate(self.model.chain.flexible):
            if kinematics is not None:
                own = layout.elastic(i)
                inverse = np.linalg.inv(kinematics.marker_jacobian(np.zeros((1, kinematics.n_f)))[0])
                out[own] = np.sqrt(inverse**2 @ sensors[own] ** 2)
        return out

    @property
    def _beyond_coordinates(self) -> list[tuple[int, int]]:
        """Numbers of the coordinates q_i that are read as an angle beyond θ_m_i, with those of θ_m_i."""
        first = len(self._base)
        return [(first + joint, first + len(self._q) + motor) for joint, motor in self._beyond]

    @property
    def unseen(self) -> list[int]:
        """Positions, as numbers in x, of which a sensor is missing or too slow for windows of the momentum balance."""
        layout = self.model.layout

        def slow(columns: Sequence[int]) -> bool:
            names = [self.channels[column] for column in columns]
            return is_slow(stated_period(self.model.system, names), self.model.system.windows.momentum)

        out = [k for k, column in enumerate([*self._base, *self._q, *self._theta_m]) if slow([column])]
        for i, kinematics in enumerate(self.model.chain.flexible):
            if kinematics is not None:
                seen = i in self._links and self._links[i][0].complete and not slow(self._links[i][1])
                out += [] if seen else range(layout.n_x)[layout.elastic(i)]
        return out

    @property
    def n_rigid(self) -> int:
        """Number of positions of base and joints."""
        return len(self._base) + len(self._q) + len(self._theta_m)

    def rigid(self, values: Array) -> Array:
        """Positions (B, n_rigid) of base and joints, the first of x, of samples (B, channels or more)."""
        q = values[:, self._q]
        for joint, motor in self._beyond:
            q[:, joint] += values[:, self._theta_m[motor]]
        return np.concatenate((values[:, self._base], q, values[:, self._theta_m]), axis=1)

    def coordinates(self, values: Array) -> Array:
        """Positions x (B, n_x) of samples (B, channels)."""
        rigid = self.rigid(values)
        x = np.zeros((len(values), self.model.layout.n_x))
        x[:, : rigid.shape[1]] = rigid
        for i, (shape, columns) in self._links.items():
            self.model.chain.elastic(x, i)[:] = shape.coordinates(values[:, columns])
        # From the base outwards: where a link's frame is follows from the links before it.
        for i in self.model.chain.tree.outwards if self._pointed else ():
            if i in self._pointed:
                pointed, columns = self._pointed[i]
                frame = self.model.chain.configure(x).frames[2 * i + 2]
                elastic = pointed.coordinates(values[:, columns], frame.origin, frame.rotation)
                self.model.chain.elastic(x, i)[:] = elastic
        return x

    @property
    def drives(self) -> dict[int, tuple[str, float]]:
        """Channel of each joint's drive, by the joint's number from 0, and n of the torque after the gear n τ."""
        channels = [self.channels[column] for column in self.torque_columns]
        return dict(zip(self._driven, zip(channels, self._ratio.tolist(), strict=True), strict=True))

    def motion(self, values: Array) -> Array:
        """x and signals side by side (B, n_x + n_signals) of samples (B, channels + n_states)."""
        return np.concatenate((self.coordinates(values), self.signals(values)), axis=1)

    def joint_torque(self, values: Array) -> Array:
        """Torque after the gear n τ (B, joints), N m (N)."""
        return self._by_joint(values[:, self.torque_columns])

    def inputs(self, values: Array) -> Array:
        """n τ and measured wrenches (B, inputs)."""
        return np.concatenate((self.joint_torque(values), values[:, self._wrenches]), axis=1)

    def _by_joint(self, drives: Array) -> Array:
        """n τ (..., joints) of the drives' readings (..., drives)."""
        torque = drives * self._ratio
        if len(self._driven) == len(self.model.system.joints):
            return np.asarray(torque)
        out = np.zeros((*drives.shape[:-1], len(self.model.system.joints)))
        out[..., self._driven] = torque
        return out

    def signals(self, values: Array) -> Array:
        """Measured inputs (B, inputs), and what samples (B, channels + n_states) hold beyond the channels."""
        return np.concatenate((self.inputs(values), values[:, len(self.channels) :]), axis=1)


class AttitudeState(State):
    """What the sign of Euler parameters follows.

    last (4,): Euler parameters of the last sample.
    """

    last: Array


class AttitudeContinuity(Stage):
    """Turns the sign of Euler parameters, which is arbitrary, so that they are continuous from sample to sample."""

    def __init__(self) -> None:
        self.state = AttitudeState(np.zeros(4))

    def continued(self, block: Block) -> Block:
        """The block with continuous Euler parameters; blocks without them pass as they are."""
        if not set(EULER_PARAMETERS) <= set(block.channels):
            return block
        columns = np.array([block.channels.index(name) for name in EULER_PARAMETERS])
        rows = np.flatnonzero(np.isfinite(block.values[:, columns]).all(axis=1))
        if rows.size == 0:
            return block
        attitude = block.values[np.ix_(rows, columns)]
        before = np.concatenate((self.state.last[None], attitude[:-1]))
        flips = np.where(np.einsum("bi,bi->b", attitude, before) < 0.0, -1.0, 1.0)
        values = block.values.copy()
        attitude *= np.cumprod(flips)[:, None]
        values[np.ix_(rows, columns)] = attitude
        self.state.last = attitude[-1]
        return Block(block.t, block.channels, values)
