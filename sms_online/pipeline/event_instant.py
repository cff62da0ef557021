"""When a change happened: the instant at which the windows across it are explained best."""

from __future__ import annotations

from collections.abc import Iterable

import numpy as np
import scipy.linalg

from sms_online.model.model import Model
from sms_online.pipeline.events import Seen
from sms_online.pipeline.momentum_windows import EXPONENT, INSTANTS
from sms_online.pipeline.smoothing import smooth
from sms_online.pipeline.weak_form import test_function
from sms_online.stream import Array, Indices

# Half width of the filter, samples: that of a motion with a jolt in it.
HALF_WIDTH = 20
# Instants a half hop that are compared; a parabola finds the best between them, through so many on either side: single
# ones scatter, since windows differ by what their few filtered samples around the event do.
STEPS_A_HALF_HOP = 5
NEIGHBOURS = 4


def event_instant(
    model: Model,
    jump: Array,
    beta: Array,
    windows: Iterable[Seen],
    index: Indices,
    x: Array,
    signals: Array,
    between: tuple[int, int],
    half_hop: int,
    sample_rate: float,
) -> float | None:
    """Grid index (with a fraction) at which parameters jumped; None where the samples do not reach far enough.

    jump (n_pi,): by how much. beta (n,): parameters before, of the windows' rows. windows: with those across the event.
    index (B,), x (B, n_x), signals (B, n_signals): consecutive samples. between: grid indices that the event
    lies between.

    From the instant t_e on the equations of motion hold J = d/dt(P jump) - G jump more than before. Times φ and by
    parts, -∫ (φ̇ P + φ G) dt jump - φ(t_e) P(t_e) jump, both from t_e on: what is picked up in motion brings its
    momentum along.
    """
    width = INSTANTS * half_hop
    step = max(s for s in range(1, half_hop // STEPS_A_HALF_HOP + 1) if half_hop % s == 0) if half_hop > 4 else 1
    across = [seen for seen in windows if seen.end > between[0] and seen.end - width < between[1]]
    if not across:
        return None
    last = min(int(index[-1]) - HALF_WIDTH, across[-1].end)
    first = max(int(index[0]) + HALF_WIDTH, between[0])
    first += (across[0].end - first) % step
    at = np.arange(first, last + 1, step)
    candidates = np.flatnonzero(at <= between[1])
    across = [seen for seen in across if seen.end <= last]
    if candidates.size < 3 or not across:
        return None
    n_x = x.shape[1]
    smoothed, rates = smooth(np.concatenate((x, signals), axis=1), at - int(index[0]), HALF_WIDTH, sample_rate)
    values, inputs = smoothed[:, :n_x], model.inputs(smoothed[:, n_x:])
    P, G = model.momentum_columns(values, model.layout.speeds(values, rates[:, :n_x]), inputs=inputs)
    momentum, force = P @ jump, G @ jump
    phi, phi_dot, _ = test_function(width // step, width / sample_rate, EXPONENT)
    misfit = np.zeros(candidates.size)
    for seen in across:
        inside = (at >= seen.end - width) & (at <= seen.end)
        place = (at[inside] - (seen.end - width)) // step
        integrand = np.zeros_like(momentum)
        integrand[inside] = phi_dot[place, None] * momentum[inside] + phi[place, None] * force[inside]
        carried = np.zeros_like(momentum)
        carried[inside] = phi[place, None] * momentum[inside]
        rest = np.cumsum(integrand[::-1], axis=0)[::-1] - 0.5 * integrand
        rows = -rest[candidates] * (step / sample_rate) - carried[candidates]
        residual = seen.raw[:, -1] - seen.raw[:, :-1] @ beta
        L = np.linalg.cholesky(seen.covariance)
        white = scipy.linalg.solve_triangular(L, (residual - rows).T, lower=True, check_finite=False)
        misfit += np.sum(white**2, axis=0)
    return float(at[candidates[0]] + step * _lowest(misfit))


def _lowest(values: Array) -> float:
    """Place of the minimum of equidistant values, by the parabola that fits the least and its neighbours best."""
    k = int(np.argmin(values))
    if k in (0, values.size - 1):
        return float(k)
    near = np.arange(max(0, k - NEIGHBOURS), min(values.size, k + NEIGHBOURS + 1))
    curvature, slope, _ = np.polyfit(near - k, values[near], 2)
    # A minimum at the edge may have a neighbour as low.
    return float(np.clip(k - 0.5 * slope / curvature, near[0], near[-1])) if curvature > 0.0 else float(k)
