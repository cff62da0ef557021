"""Bodies, motors, joints and links of an arm, as frozen and validated records. The paper's symbols are in brackets."""

from __future__ import annotations

from typing import Annotated, Literal

from pydantic import Field

from sms_online.description.record import NonNegative, Positive, Record

Vector3 = tuple[float, float, float]
Deformation = Literal["traction", "torsion", "bending_y", "bending_z"]


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


class Marker(Record):
    """A marker that cameras see as a point.

    name: what it is called elsewhere, in a file of a motion capture for instance.
    position: in the frame {i} of the undeformed link, m. On a flexible link x is its station along the link, y and z
    are its offset from the neutral axis, which turns with the section there.
    """

    name: str = ""
    position: Vector3


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
    name: of its rigid body in a file of a motion capture, with S as its origin and the axes of {0}.
    """

    tracked_point: Vector3 = (0.0, 0.0, 0.0)
    name: str = ""


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
    There may be more than are read. What an `exact` link with too few lacks is estimated, see `Tolerances.truncation`.
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
    elements: Annotated[int, Field(ge=1)] = 2
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
