"""The system description: what stands on the testbed, as frozen and validated records.

A description holds nominal values. They make a simulated truth and, where the person asks for it, priors. Otherwise the
estimator reads them only to start the weights of its rows, where a fit without weights leaves more than noise. SI units
throughout. The paper's symbols are given beside each field.
"""

from __future__ import annotations

from typing import Annotated, Any, Literal

from pydantic import Field, model_validator

from sms_online.description.markers import Marker
from sms_online.description.record import NonNegative, Positive, Record
from sms_online.description.sources import Device, LogSource, Source

Vector3 = tuple[float, float, float]
Deformation = Literal["traction", "torsion", "bending_y", "bending_z"]
Forgetting = Literal["none", "exponential", "window", "directional"]
Over = Literal["rate", "angle", "deflection", "load"]
Drift = Literal["none", "random_walk", "trend", "learned"]


class Inertia(Record):
    """Moments and products of inertia about the centre of mass in body axes.

    xx, yy, zz: moment of inertia about this axis, kg m².
    xy, xz, yz: product of inertia, -∫xy dm and so on, kg m².
    """

    xx: NonNegative = 0.0
    yy: NonNegative = 0.0
    zz: NonNegative = 0.0
    xy: float = 0.0
    xz: float = 0.0
    yz: float = 0.0


class RigidBody(Record):
    """A rigid body in a frame of its own.

    mass: m, kg.
    center_of_mass: its position in the body's frame, m.
    inertia: about the centre of mass, in the body's axes.
    """

    mass: NonNegative = 0.0
    center_of_mass: Vector3 = (0.0, 0.0, 0.0)
    inertia: Inertia = Inertia()


class Spacecraft(RigidBody):
    """The free-floating base. Frame {0} has its origin in joint 1, so center_of_mass is -r_0 of (10).

    tracked_point: position of S from joint 1, ⁰r_Sj1 of (16), m.
    """

    tracked_point: Vector3 = (0.0, 0.0, 0.0)


class Motor(Record):
    """Motor of a joint: stator on the link before it, rotor spinning about the joint's axis, (17).

    mass: m_m of rotor and stator, kg.
    rotor_inertia: I_r about the joint's axis, before the gear, kg m².
    stator_inertia: I_s, with the rotor's transverse inertia in it: of a rotor of revolution only their sum is
    identifiable.
    """

    mass: NonNegative = 0.0
    rotor_inertia: NonNegative = 0.0
    stator_inertia: Inertia = Inertia()


class Mount(Record):
    """Where a joint is mounted.

    name: what it is called elsewhere, in a URDF for instance.
    parent: what it is mounted on, `base` or `link_i`; if not stated the link before, and the base for joint 1.
    mount_position: of the mount frame's origin from the end of the parent, in the end's axes (of `base`: from the
    origin of {0}), m.
    mount_rotation: rotation vector from the end's axes to the mount frame, rad.
    """

    name: str = ""
    parent: str | None = None
    mount_position: Vector3 = (0.0, 0.0, 0.0)
    mount_rotation: Vector3 = (0.0, 0.0, 0.0)


class Joint(Mount):
    """A joint; in brackets the units of a prismatic one.

    kind: whether the joint turns or slides.
    axis: unit vector of the joint's axis in the mount frame.
    passive: without a motor: no torque but that of its own spring and damper, which act between the parent and q.
    gear_ratio: n, turns of the motor to one of the joint (rad/m).
    transmission: `flexible`, a spring and a damper between θ_m and q; or `rigid`, q = θ_m, of a passive joint neither
    spring nor damper.
    stiffness: k of the spring, N m/rad (N/m).
    damping: b of the damper, N m s/rad (N s/m).
    """

    kind: Literal["revolute", "prismatic"] = "revolute"
    axis: Vector3 = (0.0, 0.0, 1.0)
    passive: bool = False
    gear_ratio: Positive = 1.0
    transmission: Literal["flexible", "rigid"] = "flexible"
    stiffness: NonNegative = 0.0
    damping: NonNegative = 0.0


class FixedJoint(Mount):
    """A joint that does not move: link i is rigidly attached to its parent. Numbered after all those that move.

    kind: `fixed`.
    """

    kind: Literal["fixed"]


class RigidLink(RigidBody):
    """A rigid link; frame {i} has its origin in joint i.

    name: what it is called elsewhere, in a URDF for instance.
    kind: `rigid`; or `cross`, without mass and length, between the axes of a universal or spherical joint.
    tip: where the next joint, or the payload, is mounted, m.
    markers: points that cameras see, `[[link_i.markers]]`.
    """

    name: str = ""
    kind: Literal["rigid", "cross"]
    tip: Vector3 = (0.0, 0.0, 0.0)
    markers: tuple[Marker, ...] = ()

    @property
    def points(self) -> tuple[Vector3, ...]:
        """Positions of the markers that cameras see, in the link's frame, m."""
        return tuple(marker.position for marker in self.markers)


class FlexibleLink(Record):
    """A uniform flexible link along the x axis of its frame.

    name: what it is called elsewhere, in a URDF for instance.
    kind: `flexible`.
    root_position: of the link's root from joint i, in the joint's frame, m: a bracket without mass.
    root_rotation: rotation vector from the joint's frame to the link's frame {i}, rad.
    length: L, m.
    elements: number of elements, of equal length; marker j is at the end of element j unless `markers` are stated.
    markers: points that cameras see, `[[link_i.markers]]`.
    mass_per_length: ρA, kg/m.
    polar_inertia_per_length: ρI_p, kg m.
    axial_rigidity: EA, N.
    flexural_rigidity_y, flexural_rigidity_z: EI_y of bending in the x-z plane, EI_z of bending in the x-y plane, N m².
    torsional_rigidity: GI_p, N m².
    deformations: the active ones; bending_z bends in the x-y plane (u_y, θ_z), bending_y in the x-z plane (u_z, θ_y).
    kinematics: `exact` (inextensible, geometrically exact) or `linear` (the paper's).
    tip_rotation: of a `linear` link: exponential of the nodal rotation vector, or `first_order`, (13) and (21) as
    printed.
    """

    name: str = ""
    kind: Literal["flexible"]
    root_position: Vector3 = (0.0, 0.0, 0.0)
    root_rotation: Vector3 = (0.0, 0.0, 0.0)
    length: Positive
    elements: Annotated[int, Field(ge=1)]
    mass_per_length: Positive
    polar_inertia_per_length: NonNegative = 0.0
    axial_rigidity: NonNegative = 0.0
    flexural_rigidity_y: NonNegative = 0.0
    flexural_rigidity_z: NonNegative = 0.0
    torsional_rigidity: NonNegative = 0.0
    deformations: Annotated[tuple[Deformation, ...], Field(min_length=1)]
    kinematics: Literal["linear", "exact"] = "exact"
    tip_rotation: Literal["exponential", "first_order"] = "exponential"
    markers: tuple[Marker, ...] = ()

    @property
    def points(self) -> tuple[Vector3, ...]:
        """Positions of the markers that cameras see, in the frame of the undeformed link, m."""
        ends = ((self.length * j / self.elements, 0.0, 0.0) for j in range(1, self.elements + 1))
        return tuple(marker.position for marker in self.markers) or tuple(ends)


Link = Annotated[RigidLink | FlexibleLink, Field(discriminator="kind")]


class Sensor(Record):
    """One sensor.

    channels: the channels that it fills; shell patterns select several.
    rate: samples a second, Hz; none means the system's sample_rate. Fewer than eight of a pose or a marker in a window
    of the momentum balance are too few for it: the smoother then gives the estimate, on a planar or fixed base.
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


class Prior(Record):
    """What is known of a parameter beforehand, from weighing a part for instance.

    value: in the parameter's unit.
    std: its standard deviation, in the same unit.
    """

    value: float
    std: Positive


class Fitted(Record):
    """What an earlier session has found of a parameter: its nominal value from then on.

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
    gravity: direction of gravity, rad.
    marker_station: place of a marker along its link, m.
    clock: a device's clock against that of the torques, s; where all channels come from one, of encoders, base,
    gauges and markers.
    encoder_zero: zero of an encoder, rad (m).
    once_per_turn: sine and cosine of an encoder's error once a turn, rad.
    base_angle: zero of the base's measured attitude, rad.
    marker_zero: zero of a marker's displacement, m.
    marker_zero_angle: zero of a marker's rotation, rad.
    camera_scale: scale of the base's position and the markers' displacements.
    drive_gain: gain of a joint's torque, that of joint 1 where a parameter is known; else of the others against it.
    drive_offset: zero of a joint's torque or force, after the gear, N m (N); not stated: unknown.
    """

    tracked_point: NonNegative = 5e-4
    length: NonNegative = 3e-4
    axis: NonNegative = 5e-4
    gravity: NonNegative = 1e-3
    marker_station: NonNegative = 5e-4
    clock: NonNegative = 5e-5
    encoder_zero: NonNegative = 1e-4
    once_per_turn: NonNegative = 5e-5
    base_angle: NonNegative = 1e-3
    marker_zero: NonNegative = 1e-4
    marker_zero_angle: NonNegative = 1e-3
    camera_scale: NonNegative = 1e-3
    drive_gain: NonNegative = 0.01
    drive_offset: NonNegative | None = None

    @model_validator(mode="before")
    @classmethod
    def _from_none(cls, given: Any) -> Any:
        return dict.fromkeys(cls.model_fields, 0.0) if given == "none" else given


class TrackerChoice(Record):
    """A tracker of the momentum balance's rows. Of several `[[tracker]]` tables the first gives the judged estimate.

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
        """Name for people, such as "rls", "rls exponential 5 s" or "kalman learned"."""
        if self.kind == "rls":
            return "rls" if self.memory is None else f"rls {self.forgetting} {self.memory:g} s"
        if self.kind != "kalman":
            return self.kind if self.memory is None else f"{self.kind} {self.memory:g} s"
        if isinstance(self.drift, str):
            return "kalman" if self.drift == "none" else f"kalman {self.drift.replace('_', ' ')}"
        return f"kalman {', '.join(f'{name} {drift}' for name, drift in self.drift.items())}".replace("_", " ")

    @property
    def learns(self) -> bool:
        """Whether it learns drifts of some parameters."""
        return "learned" in ([self.drift] if isinstance(self.drift, str) else self.drift.values())

    @property
    def static(self) -> bool:
        """Whether it is the session's own least squares, in which every row counts alike."""
        return self == TrackerChoice()


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
    trackers: `[tracker]`, or several `[[tracker]]` tables, of which the first gives the judged estimate.
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
    trackers: Annotated[tuple[TrackerChoice, ...], Field(min_length=1)] = (TrackerChoice(),)
    balance: Literal["both", "energy", "momentum", "smoother"] = "both"

    @property
    def devices(self) -> tuple[Device, ...]:
        """The sources that a live session listens to."""
        return tuple(source for source in self.sources if not isinstance(source, LogSource))

    @property
    def scale_tolerance(self) -> float | None:
        """1σ of the factor that all parameters have in common: that of the torques, which no residual shows.

        None where a parameter that is known, or has a prior, fixes it.
        """
        stated = [*self.known.values(), *(prior.value for prior in self.priors.values())]
        return None if any(stated) else self.tolerances.drive_gain

    @property
    def nominal(self) -> dict[str, float]:
        """Nominal values of the physical parameters by name, SI units; 0 where the description states none."""
        # What parameters there are follows from the model, which is made of a description.
        from sms_online.effects.build import build_model

        return {parameter.name: parameter.nominal for parameter in build_model(self).parameters}
