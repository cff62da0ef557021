"""The system description: what stands on the testbed, as frozen and validated records.

A description holds nominal values. They make a simulated truth and, where the person asks for it, priors. Otherwise the
estimator reads them only to start the weights of its rows, where a fit without weights leaves more than noise. SI units
throughout. The paper's symbols are given beside each field.
"""

from __future__ import annotations

from typing import Annotated, Any, Literal

from pydantic import BaseModel, ConfigDict, Field, model_validator

Vector3 = tuple[float, float, float]
Positive = Annotated[float, Field(gt=0)]
NonNegative = Annotated[float, Field(ge=0)]
Deformation = Literal["traction", "torsion", "bending_y", "bending_z"]


class Record(BaseModel):
    """A frozen record: unknown keys, infinities and NaN are errors."""

    model_config = ConfigDict(frozen=True, extra="forbid", allow_inf_nan=False)


class Inertia(Record):
    """Moments and products of inertia about the centre of mass in body axes, kg m² (products: -∫xy dm)."""

    xx: NonNegative = 0.0
    yy: NonNegative = 0.0
    zz: NonNegative = 0.0
    xy: float = 0.0
    xz: float = 0.0
    yz: float = 0.0


class RigidBody(Record):
    """Mass (kg), centre of mass in the body's frame (m), inertia about it (kg m²)."""

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

    mass: m_m, kg, rotor and stator. rotor_inertia: axial I_r before the gear, kg m². stator_inertia: I_s, kg m², with
    the rotor's transverse inertia in it (for a rotor of revolution the two cannot be told apart).
    """

    mass: NonNegative = 0.0
    rotor_inertia: NonNegative = 0.0
    stator_inertia: Inertia = Inertia()


class Joint(Record):
    """A joint: its mount is turned by the rotation vector `mount_rotation` (rad) from the end of the link before.

    axis: unit vector in the mount frame. gear_ratio: n (rad/m on a prismatic joint). transmission `rigid`: q = θ_m.
    stiffness: k, N m/rad (N/m). damping: b, N m s/rad (N s/m).
    """

    kind: Literal["revolute", "prismatic"] = "revolute"
    axis: Vector3 = (0.0, 0.0, 1.0)
    mount_rotation: Vector3 = (0.0, 0.0, 0.0)
    gear_ratio: Positive = 1.0
    transmission: Literal["flexible", "rigid"] = "flexible"
    stiffness: NonNegative = 0.0
    damping: NonNegative = 0.0


class RigidLink(RigidBody):
    """A rigid link; frame {i} has its origin in joint i. tip: where the next joint sits, m."""

    kind: Literal["rigid"]
    tip: Vector3 = (0.0, 0.0, 0.0)


class FlexibleLink(Record):
    """A uniform flexible link along the x axis of its frame, with a marker at the end of each of its elements.

    length: L, m. mass_per_length: ρA, kg/m. polar_inertia_per_length: ρI_p, kg m. axial_rigidity: EA, N.
    flexural_rigidity_y, _z: EI_y, EI_z, N m². torsional_rigidity: GI_p, N m².
    deformations: the active ones; bending_z bends in the x-y plane (u_y, θ_z; EI_z), bending_y in the x-z plane.
    kinematics: `exact` (inextensible, geometrically exact) or `linear` (the paper's). tip_rotation, for `linear`:
    exponential of the nodal rotation vector, or `first_order` as (13), (21) are printed.
    """

    kind: Literal["flexible"]
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


Link = Annotated[RigidLink | FlexibleLink, Field(discriminator="kind")]


class Sensor(Record):
    """One sensor: channels it fills (shell patterns allowed), rate Hz, latency s, resolution and noise in their unit.

    Noise is 1σ, white per sample. No rate means the system's sample_rate.
    """

    channels: Annotated[tuple[str, ...], Field(min_length=1)]
    rate: Positive | None = None
    resolution: NonNegative = 0.0
    noise: NonNegative = 0.0
    latency: NonNegative = 0.0


class Signal(Record):
    """Where a number of a device goes: channel value = scale number + offset, in the channel's unit.

    A negative scale turns the sign. minimum, maximum: of the channel value before unwrapping; what lies outside cannot
    be true and is dropped. wrap: an encoder counts modulo this, in the number's own unit; its turns are then counted,
    the first sample lying in turn 0. In a system file a mere channel name is short for { channel = name }.
    """

    channel: str
    scale: float = 1.0
    offset: float = 0.0
    minimum: float | None = None
    maximum: float | None = None
    wrap: Positive | None = None

    @model_validator(mode="before")
    @classmethod
    def _from_name(cls, given: Any) -> Any:
        return {"channel": given} if isinstance(given, str) else given


class SourceRecord(Record):
    """A device: its name in messages and recordings; latency: constant delay from the instant to the stamp, s."""

    name: str
    latency: NonNegative = 0.0


class CanBus(SourceRecord):
    """A CAN bus by the names of python-can: interface, channel, bitrate in bit/s, further options of the interface."""

    interface: str = "socketcan"
    channel: str = "can0"
    bitrate: Annotated[int, Field(gt=0)] | None = None
    options: dict[str, bool | int | float | str] = {}


class CanSource(CanBus):
    """Messages of a DBC: a file beside the system file, or a shipped one; signals: `MESSAGE.SIGNAL` to channel.

    counters: the signals, at most one a message, in which a sender counts its frames.
    """

    kind: Literal["can"]
    dbc: str
    signals: dict[str, Signal]
    counters: tuple[str, ...] = ()


class CanopenSource(CanBus):
    """Process data of CANopen nodes, as their EDS maps them; nodes: node id to EDS, a file beside the system file.

    signals: `NODE.INDEX` or `NODE.INDEX:SUBINDEX`, the index in hexadecimal as in the EDS, to channel: "1.6064" is the
    position of the drive that is node 1.
    """

    kind: Literal["canopen"]
    nodes: dict[str, str]
    signals: dict[str, Signal]


class SerialField(Record):
    """One number of a serial frame or line: a channel, the device's time, a counter of frames, or nothing of interest.

    channel … wrap: see Signal. tick: s a count, for the device's time, or for a counter of frames that are taken at a
    constant rate. wrap: of tick or counter, where it starts again from 0; a word of a binary frame does so at its
    width without saying.
    """

    channel: str | None = None
    scale: float = 1.0
    offset: float = 0.0
    minimum: float | None = None
    maximum: float | None = None
    wrap: Positive | None = None
    tick: Positive | None = None
    counter: bool = False


class FrameField(SerialField):
    """A word of a binary frame, little-endian: its type is u (unsigned), i (signed) or f (IEEE float) and its bits."""

    type: Literal["u8", "i8", "u16", "i16", "u32", "i32", "u64", "i64", "f32", "f64"]


class SerialPort(SourceRecord):
    """A serial port by the names of pyserial, a URL such as socket://host:port included; baudrate in bit/s."""

    kind: Literal["serial"]
    port: str
    baudrate: Annotated[int, Field(gt=0)] = 115200


class SerialFrames(SerialPort):
    """Binary frames: the words of `fields` without padding, then their CRC-32, COBS-encoded, a zero byte at the end.

    The CRC-32 is that of Ethernet and zlib, little-endian. Source: Cheshire and Baker, IEEE/ACM Trans. Networking 7
    (1999) 159.
    """

    format: Literal["frames"]
    fields: Annotated[tuple[FrameField, ...], Field(min_length=1)]


class SerialLines(SerialPort):
    """Lines of decimal numbers in ASCII, `separator` between them ("" for blanks).

    checksum: `xor` expects * and two hexadecimal digits at the end, the exclusive or of the bytes before, without a
    leading $, as NMEA 0183 has it.
    """

    format: Literal["lines"]
    fields: Annotated[tuple[SerialField, ...], Field(min_length=1)]
    separator: str = ","
    checksum: Literal["none", "xor"] = "none"


SerialSource = Annotated[SerialFrames | SerialLines, Field(discriminator="format")]
Source = Annotated[CanSource | CanopenSource | SerialSource, Field(discriminator="kind")]


class Effect(Record):
    """An effect declared from the start and identified with π; its nominal coefficients serve the simulator alone."""

    name: str
    where: str
    coefficients: dict[str, float] = {}


class Prior(Record):
    """A weighed part: value ± std in the parameter's unit."""

    value: float
    std: Positive


class Controller(Record):
    """Joint PD of the simulator, n τ = K_p (q_d - q) + K_D (q̇_d - q̇): gains per joint, N m/rad and N m s/rad."""

    stiffness: tuple[NonNegative, ...]
    damping: tuple[NonNegative, ...]


class Harmonic(Record):
    """One term of a reference, sine sin(ω t) + cosine (cos(ω t) - 1): amplitudes rad (m), frequency ω rad/s."""

    frequency: Positive
    sine: float = 0.0
    cosine: float = 0.0


class Trajectory(Record):
    """Reference of every joint: a Fourier series, (46) with one term; duration s."""

    duration: Positive
    joints: tuple[tuple[Harmonic, ...], ...]


class Windows(Record):
    """Full widths of test functions, s. relative: of relative residuals. momentum: of the rows that are fitted."""

    relative: Positive = 0.1
    momentum: Positive = 0.4


class System(Record):
    """A whole testbed. No spacecraft means a fixed base. joints, motors, links are in order from the base outwards.

    balance: which rows are fitted; `both` is the momentum balance, and the energy balance until its weights are known.
    `smoother` is the smoother that knows the dynamics, which links with too few sensors get unless it says `energy`.
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
    links: tuple[Link, ...]
    payload: RigidBody | None = None
    sensors: tuple[Sensor, ...] = ()
    sources: tuple[Source, ...] = ()
    effects: tuple[Effect, ...] = ()
    known: dict[str, float] = {}
    priors: dict[str, Prior] = {}
    controller: Controller | None = None
    trajectory: Trajectory | None = None
    windows: Windows = Windows()
    balance: Literal["both", "energy", "momentum", "smoother"] = "both"
