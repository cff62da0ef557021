"""The description of a testbed, as frozen and validated records.

A description holds nominal values. They make a simulated truth and, where the person asks for it, priors. Otherwise the
estimator reads them only to start the weights of its rows, where a fit without weights leaves more than noise. SI units
throughout. The paper's symbols are given beside each field.
"""

from __future__ import annotations

from typing import Annotated, Any, Literal

from pydantic import Field, model_validator

from sms_online.description.bodies import FixedJoint, Joint, Link, Motor, RigidBody, Spacecraft, Vector3
from sms_online.description.record import NonNegative, Positive, Record
from sms_online.description.sources import Device, LogSource, Source

Forgetting = Literal["none", "exponential", "window", "directional"]
Over = Literal["rate", "angle", "deflection", "load"]
WrenchComponent = Literal["f_x", "f_y", "f_z", "m_x", "m_y", "m_z"]
Drift = Literal["none", "random_walk", "trend", "learned"]


class Sensor(Record):
    """One sensor.

    channels: the channels that it fills; shell patterns select several.
    rate: samples a second, Hz; none means the system's sample_rate. Fewer than eight of a pose or a marker in a window
    of the momentum balance are too few for it: the smoother then gives the estimate.
    resolution: step of its readings, in the channel's unit.
    noise: 1σ of its white noise per sample, in the channel's unit; 0 means that it is estimated from the samples.
    latency: its delay behind the others, s; it is corrected, but by the smoother.
    hold: whether its readings are commands that act from their stamps on until the next ones, which is corrected too.
    """

    channels: Annotated[tuple[str, ...], Field(min_length=1)]
    rate: Positive | None = None
    resolution: NonNegative = 0.0
    noise: NonNegative = 0.0
    latency: NonNegative = 0.0
    hold: bool = False

    def delay(self, sample_rate: float) -> float:
        """Delay of the mean instant of a reading's action to its stamp, s. sample_rate: of the system, Hz."""
        return self.latency - (0.5 / (self.rate or sample_rate) if self.hold else 0.0)


class Effect(Record):
    """An effect declared from the start and identified with π.

    name: of the effect.
    where: `joint_i`, `link_i`, `base`, `tip`, or a channel or shell pattern of channels.
    coefficients: nominal values by name; the simulator alone uses them, except shape constants, which are fixed.
    over: of a learned curve, the joint's variable that it is over: `rate`, `angle`, `deflection` or `load`.
    knots: of a learned curve, values of that variable between which it is a cubic, ascending, rad/s or rad (m/s or m).
    """

    name: str
    where: str
    coefficients: dict[str, float] = {}
    over: Over | None = None
    knots: tuple[float, ...] = ()

    @property
    def key(self) -> str:
        """name@where, which a system has once."""
        return f"{self.name}@{self.where}"


class Prior(Record):
    """What is known of a parameter beforehand, from weighing a part for instance.

    value: in the parameter's unit.
    std: its standard deviation, in the same unit.
    """

    value: float
    std: Positive


class Fitted(Record):
    """Estimate of a parameter from an earlier session, which is its nominal value from then on.

    value: in the parameter's unit, with the parameters that are lumped into it as described.
    std: its standard deviation, in the same unit; a prior's with `--prior`. Not stated: undetermined.
    """

    value: float
    std: Positive | None = None


class Controller(Record):
    """Joint PD control of the simulator, n τ = K_p (q_d - q) + K_D (q̇_d - q̇).

    stiffness: K_p of each joint, N m/rad (N/m).
    damping: K_D of each joint, N m s/rad (N s/m).
    """

    stiffness: tuple[NonNegative, ...]
    damping: tuple[NonNegative, ...]


class Harmonic(Record):
    """One term of a reference, sine · sin(ω t) + cosine · (cos(ω t) - 1).

    frequency: ω, rad/s.
    sine, cosine: amplitudes, rad (m).
    """

    frequency: Positive
    sine: float = 0.0
    cosine: float = 0.0


class Trajectory(Record):
    """Reference of every joint, a Fourier series; (46) has one term.

    duration: of the motion, s.
    joints: a list of harmonics for each joint; `joint_1`, `joint_2`, … in a system file.
    """

    duration: Positive
    joints: tuple[tuple[Harmonic, ...], ...]


class Wrench(Record):
    """A measured force and moment of the surroundings on a body, in that body's axes: the channels `wrench_k.f_x`, ….

    where: `base`, at the tracked point S, or `link_i`, at its end.
    components: those measured, of f_x, f_y, f_z, m_x, m_y, m_z; others are zero. Not stated: all that the motion has.
    applied: what the simulator applies, a list of harmonics for each component, amplitudes in N and N m.
    """

    where: str
    components: tuple[WrenchComponent, ...] = ()
    applied: dict[WrenchComponent, tuple[Harmonic, ...]] = {}


class Windows(Record):
    """Full widths of the test functions.

    relative: of the relative residuals, s.
    momentum: of the momentum balance's rows, which are fitted, s.
    """

    relative: Positive = 0.1
    momentum: Positive = 0.4


class Tolerances(Record):
    """How well a testbed is measured out and its sensors are calibrated, 1σ each; 0 means exactly.

    Within them the estimator corrects its description as the samples ask for, and error bars count what they leave
    unknown. A table [tolerances] of a system file states them; what it does not state has the values below.
    `tolerances = "none"` is short for 0 everywhere.

    tracked_point: of S, along each axis of the base, m.
    length: of a link, and of a joint's place along each axis, m.
    axis: direction of a joint's axis and mount, rad.
    gravity: tilt of gravity against what is described, rad; where a plane slopes, its slope too.
    marker_station: place of a marker along its link, m.
    clock: a device's clock against that of the torques, s; where all channels come from one, of encoders, base,
    gauges and markers.
    gauge_low_pass: inverse square of the corner of the low-pass that strain gauges are read through, s²; by default it
    is at 100 Hz.
    encoder_zero: zero of an encoder, rad (m).
    once_per_turn: sine and cosine of an encoder's error once a turn, rad.
    base_angle: zero of the base's measured attitude, rad. The base's frame is the one that is measured: what this zero
    turns adds to the tolerances of the tracked point and of joints on the base.
    marker_zero: zero of a marker's displacement, m.
    marker_zero_angle: zero of a marker's rotation, rad.
    camera_scale: scale of the base's position and the markers' displacements.
    truncation: share of what more elements would change of an `exact` link: 1 of a continuous one, 0 of one that has no
    more degrees of freedom than its elements give it.
    drive_gain: gain of a joint's torque, that of joint 1 where a parameter is known; else of the others against it.
    drive_offset: zero of a joint's torque or force, after the gear, N m (N); not stated: unknown.
    """

    tracked_point: NonNegative = 5e-4
    length: NonNegative = 3e-4
    axis: NonNegative = 5e-4
    gravity: NonNegative = 1e-3
    marker_station: NonNegative = 5e-4
    clock: NonNegative = 5e-5
    gauge_low_pass: NonNegative = 2.5e-6
    encoder_zero: NonNegative = 1e-4
    once_per_turn: NonNegative = 5e-5
    base_angle: NonNegative = 1e-3
    marker_zero: NonNegative = 1e-4
    marker_zero_angle: NonNegative = 1e-3
    camera_scale: NonNegative = 1e-3
    truncation: NonNegative = 1.0
    drive_gain: NonNegative = 0.01
    drive_offset: NonNegative | None = None

    @model_validator(mode="before")
    @classmethod
    def _from_none(cls, given: Any) -> Any:
        return dict.fromkeys(cls.model_fields, 0.0) if given == "none" else given


class TrackerChoice(Record):
    """A tracker of the rows of the momentum balance, or of the smoother.

    Of several `[[tracker]]` tables the first gives the judged estimate.

    kind: `rls`, recursive least squares, or `kalman`, a Kalman filter in which parameters may drift; or another that
    `sms_online/trackers/build.py` lists.
    forgetting: of `rls`: `none`; `exponential`, old rows fade; `directional`, they fade as new rows replace them;
    `window`, rows of the last `memory` s count alike.
    memory: of a forgetting, s: the time in which a row's weight falls by 1/e, or the window's length.
    drift: of `kalman`: for all parameters, or a table from a parameter, or from what owns several (`joint_1`), to its
    drift. `none`; `random_walk`; `trend`, value and rate on knots; `learned`, a trend of those parameters that show
    one.
    std: process noise, a table of the same names: of a random walk in the parameter's unit per √s, of a trend's rate in
    the unit per s per √s.
    share: the same as a share of the parameter's stated value, where `std` does not name it.
    """

    kind: str = "rls"
    forgetting: Forgetting = "none"
    memory: Positive | None = None
    drift: Drift | dict[str, Drift] = "none"
    std: dict[str, Positive] = {}
    share: Positive | None = None

    @property
    def label(self) -> str:
        """Name for people, such as "rls exponential 5 s" or "kalman random walk 0.001"; every choice has its own."""
        if self.kind != "kalman":
            words = [self.kind, *([] if self.forgetting == "none" else [self.forgetting])]
            return " ".join([*words, *([] if self.memory is None else [f"{self.memory:g} s"])])
        drifts = {"*": self.drift} if isinstance(self.drift, str) else self.drift
        noise = ({} if self.share is None else {"*": self.share}) | self.std
        parts = []
        for name in {**drifts, **noise}:
            drift = drifts.get(name, "none").replace("_", " ")
            words = ([] if name == "*" else [name]) + ([] if drift == "none" else [drift])
            parts.append(" ".join([*words, *([f"{noise[name]:g}"] if name in noise else [])]))
        return f"kalman {', '.join(parts)}".strip()

    @property
    def _drifts(self) -> set[Drift]:
        return {self.drift} if isinstance(self.drift, str) else set(self.drift.values())

    @property
    def learns(self) -> bool:
        """Whether it learns drifts of some parameters."""
        return "learned" in self._drifts

    @property
    def trends(self) -> bool:
        """Whether some parameters have rates, stated or learned."""
        return bool(self._drifts & {"trend", "learned"})

    @property
    def still(self) -> bool:
        """Whether it lets no parameter move."""
        return self.kind != "kalman" or self.drift == "none"

    @property
    def static(self) -> bool:
        """Whether it is the session's own least squares, in which every row counts alike."""
        return self == LEAST_SQUARES


# Least squares of all rows, and the same until a parameter shows a drift.
LEAST_SQUARES, LEARNED = TrackerChoice(), TrackerChoice(kind="kalman", drift="learned")


class System(Record):
    """A whole testbed; joints, motors and links are in the order of their numbers.

    name: of the system.
    title: a line for reports.
    reference: where the values come from.
    motion: `planar` (in the x-y plane) or `spatial`.
    gravity: its vector in inertial axes, m/s².
    sample_rate: of the estimator's grid, and of sensors that state no other, Hz.
    spacecraft: the free-floating base; without it the base is fixed.
    joints: `[joint_1]`, `[joint_2]`, … in a system file.
    motors: `[motor_1]`, …; one without a table has neither mass nor inertia.
    fixed_joints: the last `[joint_i]` of a system file, of kind `fixed`.
    links: `[link_1]`, …, one for each joint, the fixed ones included.
    payload: a rigid body at the tip of the link of the last joint that moves, in that link's tip frame.
    wrenches: `[[wrench]]` tables.
    sensors: `[[sensor]]` tables.
    sources: `[[source]]` tables, the devices of a live session and what the columns or topics of a log mean.
    effects: `[[effect]]` tables.
    known: parameters that are known exactly, name to value in the parameter's unit; they leave the unknowns.
    priors: parameters that are known with a standard deviation, a table `[prior]`.
    fitted: parameters that an earlier session has found, in place of the values that the other tables state.
    controller: of the simulator.
    trajectory: of the simulator.
    windows: widths of the test functions.
    tolerances: of geometry, clocks and calibration.
    trackers: `[tracker]`, or several `[[tracker]]` tables, of which the first gives the judged estimate. Without any it
    is `kalman` with `drift = learned` where all channels that are used have one clock and there is a momentum balance,
    `rls` otherwise.
    balance: which rows are fitted. `both`: the momentum balance, and the energy balance until its weights are known.
    `smoother`: state and parameters together, which links with too few sensors get unless it says `energy`.
    """

    name: str
    title: str = ""
    reference: str = ""
    motion: Literal["planar", "spatial"] = "spatial"
    gravity: Vector3 = (0.0, 0.0, 0.0)
    sample_rate: Positive = 1000.0
    spacecraft: Spacecraft | None = None
    joints: Annotated[tuple[Joint, ...], Field(min_length=1)]
    motors: tuple[Motor | None, ...]
    fixed_joints: tuple[FixedJoint, ...] = ()
    links: tuple[Link, ...]
    payload: RigidBody | None = None
    wrenches: tuple[Wrench, ...] = ()
    sensors: tuple[Sensor, ...] = ()
    sources: tuple[Source, ...] = ()
    effects: tuple[Effect, ...] = ()
    known: dict[str, float] = {}
    priors: dict[str, Prior] = {}
    fitted: dict[str, Fitted] = {}
    controller: Controller | None = None
    trajectory: Trajectory | None = None
    windows: Windows = Windows()
    tolerances: Tolerances = Tolerances()
    trackers: tuple[TrackerChoice, ...] = ()
    balance: Literal["both", "energy", "momentum", "smoother"] = "both"

    @property
    def devices(self) -> tuple[Device, ...]:
        """The sources that a live session listens to."""
        return tuple(source for source in self.sources if not isinstance(source, LogSource))

    @property
    def scale_tolerance(self) -> float | None:
        """1σ of the scale common to all parameters, that of the torques, which no residual shows.

        None where parameters that are known, or have a prior, fix it.
        """
        if not self.known and not self.priors:
            return self.tolerances.drive_gain
        # Whether they do follows from the model, which is made of a description.
        from sms_online.effects.build import scale_is_fixed

        return None if scale_is_fixed(self) else self.tolerances.drive_gain

    @property
    def nominal(self) -> dict[str, float]:
        """Nominal values of the physical parameters by name, SI units; 0 where the description states none."""
        # What parameters there are follows from the model, which is made of a description.
        from sms_online.effects.build import build_model

        return {parameter.name: parameter.nominal for parameter in build_model(self).parameters}
