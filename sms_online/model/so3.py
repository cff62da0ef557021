"""Rotations, vectorised over leading axes: exponential, left Jacobian and its rate, logarithm, Euler parameters.

Source: the formulas of Rodrigues and of the left Jacobian as in Barfoot, State Estimation for Robotics, ch. 7.
"""

from __future__ import annotations

import math

import numpy as np

from sms_online.stream import Array

# Terms of the power series in φ²: enough for full double precision below SERIES_LIMIT² (rad²).
SERIES_TERMS = 10
SERIES_LIMIT = 1.0


def skew(a: Array) -> Array:
    """Cross-product matrix a× of vectors (..., 3) as (..., 3, 3)."""
    S = np.zeros((*a.shape[:-1], 3, 3))
    S[..., 0, 1] = -a[..., 2]
    S[..., 0, 2] = a[..., 1]
    S[..., 1, 0] = a[..., 2]
    S[..., 1, 2] = -a[..., 0]
    S[..., 2, 0] = -a[..., 1]
    S[..., 2, 1] = a[..., 0]
    return S


def cross(a: Array, b: Array) -> Array:
    """a × b along the last axis, (..., 3); several times faster than numpy.cross on small arrays."""
    a0, a1, a2 = a[..., 0], a[..., 1], a[..., 2]
    b0, b1, b2 = b[..., 0], b[..., 1], b[..., 2]
    return np.stack((a1 * b2 - a2 * b1, a2 * b0 - a0 * b2, a0 * b1 - a1 * b0), axis=-1)


def _series(squared: Array, offset: int) -> Array:
    """Σ_k (-φ²)^k / (2k + offset)!, with φ² = squared."""
    total = np.zeros_like(squared)
    for k in reversed(range(SERIES_TERMS)):
        total = total * -squared + 1.0 / math.factorial(2 * k + offset)
    return total


def _series_derivative(squared: Array, offset: int) -> Array:
    """Derivative of `_series` with respect to φ²."""
    total = np.zeros_like(squared)
    for k in reversed(range(1, SERIES_TERMS)):
        total = total * -squared - k / math.factorial(2 * k + offset)
    return total


def _coefficients(squared: Array) -> tuple[Array, Array, Array]:
    """sin φ/φ, (1 - cos φ)/φ², (φ - sin φ)/φ³ as functions of φ²."""
    if not squared.size or squared.max() < SERIES_LIMIT**2:
        return _series(squared, 1), _series(squared, 2), _series(squared, 3)
    small = squared < SERIES_LIMIT**2
    phi2 = np.where(small, SERIES_LIMIT**2, squared)
    phi = np.sqrt(phi2)
    inner = np.where(small, squared, 0.0)
    sinc = np.where(small, _series(inner, 1), np.sin(phi) / phi)
    versine = np.where(small, _series(inner, 2), (1.0 - np.cos(phi)) / phi2)
    cubic = np.where(small, _series(inner, 3), (phi - np.sin(phi)) / (phi2 * phi))
    return sinc, versine, cubic


def exponential(theta: Array) -> Array:
    """Rotation matrix exp(θ×) of rotation vectors θ (..., 3), rad, as (..., 3, 3)."""
    sinc, versine, _ = _coefficients(np.einsum("...i,...i->...", theta, theta))
    S = skew(theta)
    return np.asarray(np.eye(3) + sinc[..., None, None] * S + versine[..., None, None] * (S @ S))


def left_jacobian(theta: Array) -> Array:
    """J_l(θ) (..., 3, 3): the angular velocity of exp(θ×) in its fixed frame is J_l θ̇."""
    _, versine, cubic = _coefficients(np.einsum("...i,...i->...", theta, theta))
    S = skew(theta)
    return np.asarray(np.eye(3) + versine[..., None, None] * S + cubic[..., None, None] * (S @ S))


def left_jacobian_rate(theta: Array, theta_dot: Array) -> Array:
    """d/dt J_l(θ) (..., 3, 3), by the power series; θ (..., 3) rad is the rotation of an elastic section, below π."""
    squared = np.einsum("...i,...i->...", theta, theta)
    squared_dot = 2.0 * np.einsum("...i,...i->...", theta, theta_dot)
    versine, cubic = _series(squared, 2), _series(squared, 3)
    versine_dot = _series_derivative(squared, 2) * squared_dot
    cubic_dot = _series_derivative(squared, 3) * squared_dot
    S, S_dot = skew(theta), skew(theta_dot)
    return np.asarray(
        versine_dot[..., None, None] * S
        + versine[..., None, None] * S_dot
        + cubic_dot[..., None, None] * (S @ S)
        + cubic[..., None, None] * (S_dot @ S + S @ S_dot)
    )


def logarithm(R: Array) -> Array:
    """Rotation vector (..., 3), rad, of rotation matrices (..., 3, 3) with angle below π."""
    axis = 0.5 * np.stack(
        (R[..., 2, 1] - R[..., 1, 2], R[..., 0, 2] - R[..., 2, 0], R[..., 1, 0] - R[..., 0, 1]), axis=-1
    )
    sine = np.sqrt(np.einsum("...i,...i->...", axis, axis))
    cosine = 0.5 * (np.trace(R, axis1=-2, axis2=-1) - 1.0)
    angle = np.arctan2(sine, cosine)
    # Below the square root of the rounding unit φ/sin φ = 1 + φ²/6 is exact.
    ratio = np.where(sine > 1e-8, angle / np.where(sine > 1e-8, sine, 1.0), 1.0)
    return np.asarray(ratio[..., None] * axis)


def rotation_from_euler_parameters(eps: Array, eta: Array) -> Array:
    """T_0(ε, η) (..., 3, 3), body to inertial, of Euler parameters ε (..., 3), η (...), normalised here."""
    norm2 = np.einsum("...i,...i->...", eps, eps) + eta * eta
    S = skew(eps)
    scale = (2.0 / norm2)[..., None, None]
    return np.asarray(np.eye(3) + scale * (eta[..., None, None] * S + S @ S))


def euler_parameter_rate(eps: Array, eta: Array, omega: Array) -> Array:
    """(ε̇, η̇) (..., 4) for an inertial angular velocity ω (..., 3), rad/s."""
    eps_dot = 0.5 * (eta[..., None] * omega - cross(eps, omega))
    eta_dot = -0.5 * np.einsum("...i,...i->...", eps, omega)
    return np.concatenate((eps_dot, eta_dot[..., None]), axis=-1)


def angular_velocity(eps: Array, eta: Array, rate: Array) -> Array:
    """Inertial ω (..., 3), rad/s, from Euler parameters and their rates (..., 4), whatever the norm of ε, η."""
    norm2 = np.einsum("...i,...i->...", eps, eps) + eta * eta
    eps_dot, eta_dot = rate[..., :3], rate[..., 3]
    vector = eta[..., None] * eps_dot - eta_dot[..., None] * eps + cross(eps, eps_dot)
    return np.asarray(2.0 * vector / norm2[..., None])
