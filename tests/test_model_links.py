"""Shapes of flexible links: the exact rod against analytic cases, and against the linear link where both must agree."""

from __future__ import annotations

import numpy as np
import pytest
from scipy.interpolate import CubicHermiteSpline
from scipy.linalg import expm
from scipy.spatial.transform import Rotation

from sms_online.description.bodies import FlexibleLink
from sms_online.description.schema import System
from sms_online.effects.build import build_model
from sms_online.model.beam import LinearLink
from sms_online.model.flexible import LinkKinematics
from sms_online.model.rod import ExactRod
from sms_online.stream import Array
from tests.model_systems import difference, paper, planar_link, spatial_link

LENGTH = 1.2
# Rounding over the step of the differences.
DIFFERENCING = 1e-11
# A rod in space meets R' = R κ× at its Gauss points alone: sections that turn by up to 1 rad are good to this.
COLLOCATION = 1e-9
# Rounding of the integration along the rod.
INTEGRATION = 1e-13


def rods() -> dict[str, LinkKinematics]:
    """Links with clamped and free ends, planar and spatial."""
    return {
        "rod, planar": ExactRod(planar_link(kinematics="exact"), free_end=False),
        "rod, planar, free end": ExactRod(planar_link(kinematics="exact"), free_end=True),
        "rod, spatial": ExactRod(spatial_link("exact"), free_end=False),
        "rod, spatial, free end": ExactRod(spatial_link("exact"), free_end=True),
        "linear": LinearLink(spatial_link("linear")),
    }


all_links = pytest.mark.parametrize("link", rods().values(), ids=rods().keys())


def accuracy(link: LinkKinematics) -> float:
    """Of a rate against a difference."""
    return COLLOCATION if isinstance(link, ExactRod) and link.n_f == len(SPATIAL_STRAINS) else DIFFERENCING


def strains(link: LinkKinematics, size: float, seed: int, count: int = 5) -> Array:
    return size * np.random.default_rng(seed).normal(size=(count, link.n_f))


def unstrained(names: tuple[str, ...], **values: float) -> Array:
    """Coordinates (1, n) that are zero but for those named."""
    return np.array([[values.get(name, 0.0) for name in names]])


SPATIAL_STRAINS = tuple(f"{f}_{k}" for f, n in (("twist", 2), ("curvature_y", 4), ("curvature_z", 4)) for k in range(n))


@all_links
def test_coordinates_follow_from_the_markers(link: LinkKinematics) -> None:
    """Markers to coordinates and back: to rounding at tip rotations around half a radian."""
    q_f = strains(link, 0.3, seed=50)
    np.testing.assert_allclose(link.coordinates(link.markers(q_f)), q_f, rtol=0.0, atol=1e-12)
    markers = link.markers(q_f)
    assert markers.shape[1] == len(link.marker_names) == link.n_f
    np.testing.assert_allclose(link.markers(link.coordinates(markers)), markers, rtol=0.0, atol=1e-13)


@all_links
def test_jacobians_are_derivatives_of_the_shape(link: LinkKinematics) -> None:
    """Velocities of points and tip, and the tip's spin, against differences of positions and rotations."""
    q_f, rate = strains(link, 0.1, seed=51), strains(link, 1.0, seed=52)
    atol = accuracy(link)
    shape = link.shape(q_f)

    def change(name: str) -> Array:
        return difference(lambda t: np.asarray(getattr(link.shape(q_f + t * rate), name)))

    np.testing.assert_allclose((shape.J @ rate[:, None, :, None])[..., 0], change("points"), atol=atol)
    np.testing.assert_allclose((shape.tip_J @ rate[..., None])[..., 0], change("tip"), atol=atol)
    W = change("tip_rotation") @ shape.tip_rotation.swapaxes(1, 2)
    spin = np.stack((W[:, 2, 1], W[:, 0, 2], W[:, 1, 0]), axis=1)
    np.testing.assert_allclose((shape.tip_spin @ rate[..., None])[..., 0], spin, atol=atol)
    rates = link.shape_rate(q_f, rate, shape)
    np.testing.assert_allclose(rates.tip, change("tip"), atol=atol)
    np.testing.assert_allclose(rates.tip_angular, spin, atol=atol)
    for name in ("J", "spin", "tip_J", "tip_spin"):
        found = np.broadcast_to(getattr(rates, name), (len(q_f), *getattr(rates, name).shape[1:]))
        np.testing.assert_allclose(found, np.broadcast_to(change(name), found.shape), atol=atol)


@pytest.mark.parametrize("free_end", [False, True])
def test_markers_of_one_field_are_those_of_the_whole_shape(free_end: bool, monkeypatch: pytest.MonkeyPatch) -> None:
    rod = ExactRod(planar_link(kinematics="exact"), free_end)
    q_f = np.random.default_rng(4).uniform(-0.3, 0.3, size=(20, rod.n_f))
    markers, by_q_f = rod.markers(q_f), rod.marker_jacobian(q_f)
    np.testing.assert_allclose(rod.coordinates(markers), q_f, rtol=0, atol=1e-13)
    monkeypatch.setattr(rod, "_one_field", None)
    np.testing.assert_allclose(rod.markers(q_f), markers, rtol=0, atol=1e-14)
    np.testing.assert_allclose(rod.marker_jacobian(q_f), by_q_f, rtol=0, atol=1e-14)


@pytest.mark.parametrize("link", [link for link in rods().values() if isinstance(link, ExactRod)])
def test_sections_turn_with_the_tangent(link: ExactRod) -> None:
    """The spin Jacobian of a section carries its tangent: d tangent/dt = spin × tangent; tangents stay unit vectors."""
    q_f, rate = strains(link, 0.1, seed=53), strains(link, 1.0, seed=54)
    shape = link.shape(q_f)
    turning = difference(lambda t: link.shape(q_f + t * rate).tangent)
    spin = (shape.spin @ rate[:, None, :, None])[..., 0]
    np.testing.assert_allclose(np.cross(spin, shape.tangent), turning, atol=accuracy(link))
    np.testing.assert_allclose(np.linalg.norm(shape.tangent, axis=-1), 1.0, atol=accuracy(link))


@pytest.mark.parametrize("curvature", [0.2, 0.8, -1.2])
def test_constant_curvature_is_a_circular_arc(curvature: float) -> None:
    rod = ExactRod(planar_link(elements=2, kinematics="exact"), free_end=False)
    q_f = np.array([[curvature, 0.0, 0.0, 0.0]])
    angle = curvature * LENGTH
    shape = rod.shape(q_f)
    np.testing.assert_allclose(
        shape.tip[0], [np.sin(angle) / curvature, (1 - np.cos(angle)) / curvature, 0], atol=INTEGRATION
    )
    np.testing.assert_allclose(shape.tip_rotation[0], Rotation.from_rotvec([0, 0, angle]).as_matrix(), atol=INTEGRATION)
    center = np.array([0.0, 1.0 / curvature, 0.0])
    np.testing.assert_allclose(np.linalg.norm(shape.points[0] - center, axis=1), 1.0 / abs(curvature), rtol=INTEGRATION)
    half = 0.5 * angle
    expected = [(1 - np.cos(half)) / curvature, half, (1 - np.cos(angle)) / curvature, angle]
    np.testing.assert_allclose(rod.markers(q_f)[0], expected, atol=INTEGRATION)


def test_constant_twist_and_curvature_is_a_helix() -> None:
    """The pose at the tip is the matrix exponential of the constant strain."""
    rod = ExactRod(spatial_link("exact"), free_end=False)
    kappa = np.array([0.7, -0.4, 0.5])
    shape = rod.shape(unstrained(SPATIAL_STRAINS, twist_0=kappa[0], curvature_y_0=kappa[1], curvature_z_0=kappa[2]))
    generator = np.zeros((4, 4))
    generator[:3, :3] = np.cross(np.eye(3), kappa)
    generator[0, 3] = 1.0
    pose = expm(LENGTH * generator)
    np.testing.assert_allclose(shape.tip_rotation[0], pose[:3, :3], atol=INTEGRATION)
    np.testing.assert_allclose(shape.tip[0], pose[:3, 3], atol=INTEGRATION)


@pytest.mark.parametrize("free_end", [False, True])
def test_rod_in_space_with_one_strain_field_is_the_planar_rod(free_end: bool) -> None:
    """Bending about z alone takes another path through the code (rotations commute) and gives the same shape."""
    in_space = ExactRod(spatial_link("exact"), free_end)
    planar = ExactRod(planar_link(kinematics="exact"), free_end)
    coefficients = np.array([0.5, -0.3, 0.2, 0.1])
    named = {f"curvature_z_{k}": c for k, c in enumerate(coefficients)}
    found, expected = in_space.shape(unstrained(SPATIAL_STRAINS, **named)), planar.shape(coefficients[None])
    for name in ("points", "tangent", "tip", "tip_rotation"):
        np.testing.assert_allclose(getattr(found, name), getattr(expected, name), atol=COLLOCATION)
    bending = slice(len(SPATIAL_STRAINS) - 4, None)
    for name in ("J", "spin", "tip_J", "tip_spin"):
        np.testing.assert_allclose(getattr(found, name)[..., bending], getattr(expected, name), atol=COLLOCATION)


def test_strains_vanish_at_a_free_end() -> None:
    """Natural boundary condition of a last link: no curvature at the tip."""
    rod = ExactRod(planar_link(kinematics="exact"), free_end=True)
    shape = rod.shape(strains(rod, 0.5, seed=55))
    slope = np.arctan2(shape.tangent[..., 1], shape.tangent[..., 0])
    tip = np.arctan2(shape.tip_rotation[:, 1, 0], shape.tip_rotation[:, 0, 0])
    nodes = 0.5 * LENGTH * (np.polynomial.legendre.leggauss(slope.shape[1])[0] + 1.0)
    polynomial = np.polynomial.Polynomial.fit
    for b in range(len(tip)):
        theta = polynomial(np.append(nodes, LENGTH), np.append(slope[b], tip[b]), 5)
        np.testing.assert_allclose(theta.deriv()(LENGTH), 0.0, atol=1e-10)
        np.testing.assert_allclose(theta(nodes), slope[b], atol=1e-12)


def matched(amplitude: float) -> tuple[LinearLink, ExactRod, Array, Array]:
    """One element: the same markers on a linear link and on a rod; while small, both shapes are the same cubic."""
    linear = LinearLink(planar_link(elements=1))
    rod = ExactRod(planar_link(elements=1, kinematics="exact"), free_end=False)
    q_f = amplitude * np.array([[0.5, -0.3]])
    return linear, rod, rod.markers(q_f), q_f


def test_rod_and_linear_link_agree_to_second_order() -> None:
    """The same markers: along the link they differ by the shortening ½ ∫ θ² ds, across it by the amplitude cubed."""
    across, along = [], []
    for amplitude in (0.2, 0.1):
        linear, rod, markers, q_f = matched(amplitude)
        bent, straight = rod.shape(q_f), linear.shape(markers)
        s = np.linspace(0.0, LENGTH, 2001)
        slope = amplitude * (0.5 * s - 0.3 * (s**2 / LENGTH - s))  # of κ = 0.5 - 0.3 (2 s/L - 1)
        along.append((bent.tip - straight.tip)[0, 0])
        assert along[-1] == pytest.approx(-0.5 * np.trapezoid(slope**2, s), rel=amplitude**2)
        np.testing.assert_allclose(bent.tip[0, 1:], straight.tip[0, 1:], atol=INTEGRATION)
        np.testing.assert_allclose(bent.tip_rotation, straight.tip_rotation, atol=INTEGRATION)
        arc = 0.5 * LENGTH * (np.polynomial.legendre.leggauss(bent.points.shape[1])[0] + 1.0)
        cubic = CubicHermiteSpline([0.0, LENGTH], [0.0, markers[0, 0]], [0.0, markers[0, 1]])
        across.append(np.abs(bent.points[0, :, 1] - cubic(arc)).max())
    assert along[0] / along[1] == pytest.approx(4.0, rel=0.02)
    assert across[0] / across[1] == pytest.approx(8.0, rel=0.02)


def test_rod_and_linear_link_agree_at_small_amplitude() -> None:
    """Strain energy ½ EI q_fᵀ S q_f of one element in either's coordinates: equal but for the amplitude squared."""
    for amplitude in (0.1, 0.01):
        linear, rod, markers, q_f = matched(amplitude)
        S_linear, S_rod = linear.stiffness["flexural_rigidity_z"], rod.stiffness["flexural_rigidity_z"]
        np.testing.assert_allclose(markers @ S_linear @ markers.T, q_f @ S_rod @ q_f.T, rtol=amplitude**2)


def two_links(tip_rotation: str) -> System:
    link: FlexibleLink = planar_link().model_copy(update={"tip_rotation": tip_rotation})
    return paper().model_copy(update={"links": (link, link)})


@pytest.mark.parametrize(("angle", "expected"), [(0.1, 0.005), (0.3, 0.045)])
def test_first_order_tip_rotation_stretches_what_it_carries(angle: float, expected: float) -> None:
    """(13) as printed: the next link's end is off by 1 - cos θ of its length, 4.5 % at 0.3 rad."""
    ends = []
    for tip_rotation in ("exponential", "first_order"):
        model = build_model(two_links(tip_rotation))
        x = np.zeros((1, model.layout.n_x))
        x[0, model.layout.position_names.index("link_1.marker_2.theta_z")] = angle
        ends.append(model.chain.configure(x).frames[-1].origin[0])
    off = np.linalg.norm(ends[1] - ends[0]) / LENGTH
    assert off == pytest.approx(expected, rel=0.02)
    assert off == pytest.approx(np.hypot(1.0 - np.cos(angle), angle - np.sin(angle)), rel=1e-9)
