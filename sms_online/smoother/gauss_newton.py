"""Gauss-Newton on the parameters and states of one span: a step with white forces of a level, loose or none.

Source: Bell, SIAM J. Optimization 4 (1994) 626, for the iterated smoother as Gauss-Newton.
"""

from __future__ import annotations

from contextlib import suppress
from dataclasses import replace

import numpy as np

from sms_online.linearised import Motion, linearise
from sms_online.model.dynamics import Dynamics
from sms_online.smoother.collocation import defects, momenta_and_forces, transitions
from sms_online.smoother.filter import FixedIntervalSmoother
from sms_online.smoother.readings import SmoothedReadings
from sms_online.smoother.span import Ending, Innovations, Span, interpolated
from sms_online.stream import Array
from sms_online.trackers.factor import Solution, solve, triangular_factor

# Step of the collocation on the way, s.
ROUGH_STEP = 0.01
# Time within which forces of a level change, s: white forces of share r have the density (r F)² times this. None is to
# change a speed within it by more than this multiple of r times the usual speed: light coordinates would run away.
CORRELATION = 0.1
MOST_SPEED = 3.0
# No coordinate's usual force or speed is taken to be smaller than this share of the largest.
LEAST_USUAL = 0.02
# Free to move are positions of the first state by this, rad, m or 1/m, and its speeds by the usual ones. Not further:
# stiff modes, which no sample sees, decay slowly in the collocation, and are not to ring.
FREE_POSITION = 10.0
# Derivatives by displacements are computed that often as a rule, s; or at every node, where the motion is fast or
# begins far from the samples.
DERIVATIVES_INTERVAL, EVERY_NODE = 0.04, 0.0
# Directions of β with less information than this share of the best one's, in units of the columns' sizes, are left
# as they are: derivatives are good to 1e-8.
RANK_TOLERANCE = 1e-8
# A step of the search is halved so often, where β is no mechanism's after it.
MOST_HALVINGS = 6
# Deviation of β from where it is held, as a share of it, or in its unit where it is small.
HELD = 1e-9
# Mass matrices are checked that often along the motion, s.
MASS_INTERVAL = 0.1
# Steps that swing about the answer are shortened to this share of their length at least.
LEAST_RELAXATION = 0.125


class DivergedError(ArithmeticError):
    """The search found no parameters and states that agree with the samples."""


# What a search that runs away ends in.
NO_NUMBERS = (np.linalg.LinAlgError, ArithmeticError)


class GaussNewton:
    """β and the motion of a span as the steps so far have left them, and what the last step was made of.

    reach (n,): how far a step takes parameters that loose equations do not determine, as a standard deviation; 0 where
    that is not known. before: see `fit.SpanSmoother`. interval: from one computed derivative by displacements to the
    next, s; between them they are interpolated, and only steer the search. kept: parameters stay where they are while
    equations are loose, as they do in a span that goes on from another. step: of the collocation, as it is asked for,
    s; refined: β and motion when that was changed last.
    """

    def __init__(
        self, smoother: SmoothedReadings, span: Span, beta: Array, known: Array, reach: Array | None = None,
        before: Ending | None = None, interval: float = DERIVATIVES_INTERVAL, kept: bool = False,
    ) -> None:  # fmt: skip
        self._before, self._interval, self._kept = before, interval, kept or before is not None
        self.reach = np.zeros(beta.size) if reach is None else reach
        self._smoother, self._span, self._known = smoother, span, known
        self._model, self._base = smoother.model, smoother.base
        self.iterations = 0
        # Whether nuisances stay where they are, and with them the parameters that are kept.
        self._held = False
        # Whether all of β does.
        self._fixed = False
        self.beta = beta
        self.std, self.factor = np.full(beta.size, np.inf), np.zeros((beta.size + 1, beta.size + 1))
        self.mean_square = np.inf
        self._asked, self._relaxation, self._torque_noise = np.zeros(beta.size), 1.0, smoother.torque_noise
        t = span.nodes(ROUGH_STEP)
        self.motion = Motion(t, *span.guess(t))
        self.step, self.refined = ROUGH_STEP, (beta, self.motion)
        _, force = momenta_and_forces(smoother.dynamics(beta), self.motion.x, self.motion.v)
        self._usual_force, self._usual_speed = _usual(force), _usual(self.motion.v)
        if not self._has_mass(beta):
            raise DivergedError("the first fit's mass matrix is not positive definite")
        self._use_nodes()

    def _use_nodes(self) -> None:
        t = self.motion.t
        self._innovations = Innovations(self._span, t, self._smoother.readings, self._smoother.sigma)
        impulse = self._span.impulse
        of_motors = self._model.generalized_force
        middle = 0.5 * (t[1:] + t[:-1])
        self._impulse, self._impulse_m = of_motors(impulse(t)), of_motors(impulse(middle))

    def refine(self, step: float) -> None:
        """Put the motion on nodes at no more than `step`, s."""
        t = self._span.nodes(step)
        old = self.motion
        if t.size != old.t.size:
            self.motion = Motion(t, interpolated(old.t, old.x, t), interpolated(old.t, old.v, t))
            self._use_nodes()
        self.step, self.refined = step, (self.beta, self.motion)

    def hold(self, beta: Array) -> None:
        """Go on with β (n,), or with what is near it and a mechanism's, and leave it there."""
        self.beta, self._fixed = self._with_mass(beta), True
        unit = HELD * np.maximum(np.abs(self.beta), 1.0)
        self._known = np.column_stack((np.diag(1.0 / unit), self.beta / unit))

    def advance(self, level: float, tame: bool = True) -> None:
        """One step of Gauss-Newton with white forces of a level, which `tame` ones bound by what they do to speeds."""
        motion, base = self.motion, self._base
        dynamics = self._smoother.dynamics(self.beta)
        differences = self._innovations(motion.x, motion.v)
        lacking = defects(dynamics, motion, self._impulse, self._impulse_m)
        kalman = FixedIntervalSmoother(*self._first_state(dynamics))
        every = max(1, round(self._interval / motion.step))
        nodes = every * max(1, 512 // every)
        drive, joints = self._drive(dynamics, level, tame), self._smoother.motors.shape[1]
        n_v, m = self._model.layout.n_v, self._smoother.m
        rows, speeds = [], []
        for start in range(0, len(motion.t), nodes):
            piece = slice(start, start + nodes)  # and one more, which ends the last step
            wide = slice(start, start + nodes + 1)
            linear = linearise(dynamics, base, self._smoother.readings, motion.x[wide], motion.v[wide], every)
            weights = self._innovations.weights[piece, :, None]
            steps = transitions(linear, motion.step, drive, joints, lacking[piece])
            steps = replace(steps, B=_beside(m, steps.B))
            count = len(weights)
            speeds.append((linear.V[:count], _beside(m, linear.E[:count, :n_v, joints:])))
            offsets = weights * self._smoother.offsets(motion.x[piece], motion.v[piece], linear.C[:count, :, :n_v])
            left, C = differences[piece] - offsets @ self.beta[:m], weights * linear.C[:count]
            by_beta = np.concatenate((offsets, weights * linear.D[:count]), axis=2)
            if self._held:
                # On the way nuisances are noise: freed with forces, they would take whatever these leave.
                share = 1.0 / np.sqrt(1.0 + np.sum((offsets * self._smoother.tolerances) ** 2, axis=2))
                left, C, by_beta = left * share, C * share[..., None], by_beta * share[..., None]
                by_beta[..., :m] = 0.0
            rows.append(kalman.push(left, C, by_beta, steps))
        innovations = np.concatenate(rows)
        Y = -innovations[:, 1:]
        self.rows = len(Y)
        self.factor = triangular_factor(np.column_stack((Y, innovations[:, 0] + Y @ self.beta)))
        delta, solution = self._step(level)
        if self._held and self._kept:
            # From a motion that is roughly guessed a step would take what is known of the parameters far away.
            delta = np.zeros_like(delta)
        self._relax(delta)
        beta = self._admissible(self.beta + self._relaxation * delta, solution, level > 0.0 and not self._fixed)
        self._asked, delta = delta, beta - self.beta
        self.mean_square = float(np.mean((innovations[:, 0] - Y @ delta) ** 2))
        self.std = np.sqrt(np.diag(solution.covariance()))
        s = kalman.smooth(delta)
        # The motion is moved by its speeds, not by its momenta: of light coordinates momenta give the speeds badly.
        moved = [
            by_s @ s[k : k + len(by_s), :, None] + by_beta @ delta[:, None]
            for k, (by_s, by_beta) in zip(range(0, len(s), nodes), speeds, strict=True)
        ]
        v = motion.v + np.concatenate(moved)[..., 0]
        self.motion = Motion(motion.t, self._model.layout.displaced(motion.x, s[:, :n_v]), v)
        self.beta = beta
        self.ending = Ending(self.motion.x[-1], v[-1], beta, kalman.root, kalman.mean[:, 1:])
        self.iterations += 1

    def _relax(self, delta: Array) -> None:
        """Shorten steps that go back on the last one, δβ (n,), and lengthen them again where they go on."""
        along = (self.factor[:-1, :-1] @ delta) @ (self.factor[:-1, :-1] @ self._asked)
        self._relaxation = (
            max(LEAST_RELAXATION, 0.5 * self._relaxation) if along < 0.0 else min(1.0, 2.0 * self._relaxation)
        )

    def _first_state(self, dynamics: Dynamics) -> tuple[Array, Array]:
        """Root (2 n_v, 2 n_v) and mean (2 n_v, 1 + n) of how far the first state is from the motion's.

        As the span before leaves it, or free to move.
        """
        n_v, x, mass = self._model.layout.n_v, self.motion.x[:1], dynamics.mass_matrix(self.motion.x[:1])[0]
        mean, before = np.zeros((2 * n_v, 1 + self.beta.size)), self._before
        if before is None:
            root = np.diag(np.concatenate((np.full(n_v, FREE_POSITION), self._usual_speed)))
            root[n_v:, n_v:] @= mass
            return root, mean
        momentum = self._smoother.dynamics(before.beta).mass_matrix(before.x[None])[0] @ before.v
        mean[:n_v, 0] = self._model.layout.speeds(x, before.x - x)[0]
        mean[n_v:, 0] = momentum - mass @ self.motion.v[0]
        mean[:, 0] += before.by_beta @ (self.beta - before.beta)
        mean[:, 1:] = before.by_beta
        return before.root, mean

    def _drive(self, dynamics: Dynamics, level: float, tame: bool) -> Array:
        """What unit noise adds to the state in a step, (2 n_v, noises)."""
        noise = self._torque_noise * self._smoother.motors
        if level:
            forces = self._tame_forces(dynamics) if tame else np.diag(self._usual_force)
            noise = np.concatenate((noise, level * np.sqrt(CORRELATION) * forces), axis=1)
        return np.concatenate((np.zeros_like(noise), np.sqrt(self.motion.step) * noise))

    def _tame_forces(self, dynamics: Dynamics) -> Array:
        """Root (n_v, n_v) of the covariance of forces that are as usual and change speeds by no more than is usual."""
        H = dynamics.mass_matrix(self._sparse_motion()).mean(axis=0)
        # Inverse variances of the two limits add up; as roots, since light coordinates make H ill conditioned.
        of_forces = np.diag(1.0 / self._usual_force)
        of_speeds = CORRELATION / MOST_SPEED * np.linalg.inv(H) / self._usual_speed[:, None]
        return np.asarray(np.linalg.inv(np.linalg.qr(np.concatenate((of_forces, of_speeds)), mode="r")))

    def _step(self, level: float) -> tuple[Array, Solution]:
        """δβ (n,) of least squares, and the solution behind it; while equations are loose, within its reach."""
        n = self.beta.size
        within = np.flatnonzero(self.reach) if level else np.arange(0)
        damping = np.zeros((within.size, n + 1))
        damping[np.arange(within.size), within] = 1.0 / self.reach[within]
        damping[:, n] = damping[:, :n] @ self.beta
        problem = triangular_factor(self._known, self.factor, damping)
        problem[:, n] -= problem[:, :n] @ self.beta
        size = np.linalg.norm(problem[:, :n], axis=0)
        size[size == 0.0] = 1.0
        return np.linalg.lstsq(problem[:, :n] / size, problem[:, n], rcond=RANK_TOLERANCE)[0] / size, solve(problem)

    def _admissible(self, beta: Array, solution: Solution, loose: bool) -> Array:
        """β; or the nearest consistent one while equations are loose, or as much of the step as leaves a mechanism.

        Mass matrices are linear in β, so those that are positive definite make a convex set, which the search is in.
        """
        if loose:
            with suppress(ArithmeticError):  # the projection is a help, no more
                m = self._smoother.m
                found = self._smoother.physical.project(beta[m:], solution.covariance()[m:, m:])
                beta = np.concatenate((beta[:m], found.beta))
        return self._with_mass(beta)

    def _with_mass(self, beta: Array) -> Array:
        """β (n,), or as much of the step there as leaves a mechanism."""
        for _ in range(MOST_HALVINGS):
            if self._has_mass(beta):
                return beta
            beta = 0.5 * (self.beta + beta)
        raise DivergedError("a mass matrix is not positive definite")

    def _has_mass(self, beta: Array) -> bool:
        masses = self._smoother.dynamics(beta).mass_matrix(self._sparse_motion())
        return bool(np.linalg.eigvalsh(masses).min() > 0.0)

    def _sparse_motion(self) -> Array:
        """Positions (B, n_x) every now and then."""
        return self.motion.x[:: max(1, round(MASS_INTERVAL / self.motion.step))]


def _beside(m: int, columns: Array) -> Array:
    """Columns (..., n) of parameters, behind m of nuisances, which the motion does not depend on."""
    return np.concatenate((np.zeros((*columns.shape[:-1], m)), columns), axis=-1)


def _usual(samples: Array) -> Array:
    """rms of each column of samples (B, n_v), and no less than a share of the largest."""
    rms = np.sqrt(np.mean(samples**2, axis=0))
    return np.asarray(np.maximum(rms, LEAST_USUAL * rms.max()))
