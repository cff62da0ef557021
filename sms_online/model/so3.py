"""Rotations, vectorised over leading axes: exponential, left Jacobian and its rate, logarithm, Euler parameters.

Source: the formulas of Rodrigues and of the left Jacobian as in Barfoot, State Estimation for Robotics, ch. 7.
"""

from __future__ import annotations

import math

import numpy as np

from sms_online.stream import Array

# Terms of the power series in φ² below: full double precision for angles up to π.
SERIES_TERMS = 14


def _series(offset: int) -> list[float]:
    """Coefficients of Σ_k (-φ²)^k / (2k + offset)!: sin φ/φ, (1 - cos φ)/φ², (φ - sin φ)/φ³ for offsets 1, 2, 3."""
    return [(-1) ** k / math.factorial(2 * k + offset) for k in range(SERIES_TERMS)]


def _derivative(offset: int) -> list[float]:
    """Coefficients of the derivative of `_series` with respect to φ²."""
    return [(-1) ** (k + 1) * (k + 1) / math.factorial(2 * k + 2 + offset) for k in range(SERIES_TERMS)]


# What multiplies θ× and (θ×)² in exp(θ×), then in J_l, (SERIES_TERMS, 4); and in the φ²-derivative of J_l.
_FACTORS = np.array([_series(1), _series(2), _series(2), _series(3)]).T
_FACTOR_RATES = np.array([_derivative(2), _derivative(3)]).T

# a @ _SKEW is a× row by row.
_SKEW = np.zeros((3, 9))
_SKEW[2, 1] = _SKEW[0, 5] = _SKEW[1, 6] = -1.0
_SKEW[1, 2] = _SKEW[2, 3] = _SKEW[0, 7] = 1.0


def skew(a: Array) -> Array:
    """Cross-product matrix a× of vectors (..., 3) as (..., 3, 3)."""
    return (a @ _SKEW).reshape(*a.shape[:-1], 3, 3)


def cross(a: Array, b: Array) -> Array:
    """a × b along the last axis, (..., 3); several times faster than numpy.cross on small arrays."""
    a0, a1, a2 = a[..., 0], a[..., 1], a[..., 2]
    b0, b1, b2 = b[..., 0], b[..., 1], b[..., 2]
    return np.stack((a1 * b2 - a2 * b1, a2 * b0 - a0 * b2, a0 * b1 - a1 * b0), axis=-1)


def moment(r: Array, f: Array) -> Array:
    """Σ r × f (..., 3) over the last axis but one of (..., G, 3)."""
    products = r.swapaxes(-1, -2) @ f  # all r_j f_k summed, and of those the antisymmetric part
    return np.asarray(-products.reshape(*products.shape[:-2], 9) @ _SKEW.T)


class RotationVector:
    """Rotations exp(θ×) of rotation vectors θ (..., 3), rad, of at most π."""

    def __init__(self, theta: Array) -> None:
        self.theta = theta
        self._powers = np.ones((*theta.shape[:-1], SERIES_TERMS))
        self._powers[..., 1:] = np.einsum("...i,...i->...", theta, theta)[..., None]
        np.multiply.accumulate(self._powers, axis=-1, out=self._powers)
        # θ× and (θ×)², each as nine numbers: combinations of the two are one small matrix product.
        self._basis = np.empty((*theta.shape[:-1], 2, 9))
        self._basis[..., 0, :] = theta @ _SKEW
        S = self._basis[..., 0, :].reshape(*theta.shape, 3)
        self._basis[..., 1, :] = (S @ S).reshape(*theta.shape[:-1], 9)
        factors = (self._powers @ _FACTORS).reshape(*theta.shape[:-1], 2, 2)
        self._pair = (factors @ self._basis + np.eye(3).ravel()).reshape(*theta.shape[:-1], 2, 3, 3)

    @property
    def matrix(self) -> Array:
        """exp(θ×) (..., 3, 3)."""
        return np.asarray(self._pair[..., 0, :, :])

    @property
    def left_jacobian(self) -> Array:
        """J_l(θ) (..., 3, 3): the angular velocity of exp(θ×) in its fixed frame is J_l θ̇."""
        return np.asarray(self._pair[..., 1, :, :])

    def left_jacobian_rate(self, theta_dot: Array) -> Array:
        """d/dt J_l(θ) (..., 3, 3) for θ̇ (..., 3)."""
        squared_dot = 2.0 * np.einsum("...i,...i->...", self.theta, theta_dot)[..., None]
        factors = np.stack((squared_dot * (self._powers @ _FACTOR_RATES), self._powers @ _FACTORS[:, 2:]), axis=-2)
        S, S_dot = self._basis[..., 0, :].reshape(*self.theta.shape, 3), skew(theta_dot)
        basis_dot = np.stack((S_dot, S_dot @ S + S @ S_dot), axis=-3).reshape(self._basis.shape)
        rate = factors[..., :1, :] @ self._basis + factors[..., 1:, :] @ basis_dot
        return np.asarray(rate.reshape(*self.theta.shape, 3))


def logarithm(R: Array) -> Array:
    """Rotation vector (..., 3), rad, of rotation matrices (..., 3, 3) with angle below π."""
    axis = 0.5 * np.stack(
        (R[..., 2, 1] - R[..., 1, 2], R[..., 0, 2] - R[..., 2, 0], R[..., 1, 0] - R[..., 0, 1]), axis=-1
    )
    sine = np.sqrt(np.einsum("...i,...i->...", axis, axis))
    cosine = 0.5 * (np.trace(R, axis1=-2, axis2=-1) - 1.0)
    angle = np.arctan2(sine, cosine)
    # Below the square root of the rounding unit φ/sin φ = 1 + φ²/6 is 1 exactly.
    ratio = np.where(sine > 1e-8, angle / np.where(sine > 1e-8, sine, 1.0), 1.0)
    return np.asarray(ratio[..., None] * axis)


def turn_basis(axis: Array) -> Array:
    """(3, 9): rotations about a unit axis (3,) are combinations of 1, a×, (a×)² by (1, sin, 1 - cos), see `about`."""
    K = skew(axis)
    return np.stack((np.eye(3), K, K @ K)).reshape(3, 9)


def about(basis: Array, angle: Array) -> Array:
    """Rotations (B, 3, 3) by angles (B,), rad, about the axis of a `turn_basis`."""
    trigonometric = np.ones((angle.size, 3))
    trigonometric[:, 1] = np.sin(angle)
    trigonometric[:, 2] -= np.cos(angle)
    return (trigonometric @ basis).reshape(-1, 3, 3)


def from_euler_parameters(eps: Array, eta: Array) -> Array:
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
