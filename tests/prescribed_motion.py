"""A motion of any system as a formula of time: exact positions, speeds and forces without simulation."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from sms_online.model.model import Model
from sms_online.stream import Array
from tests.model_systems import difference

# Amplitudes: elastic coordinates and deflections of joints, rad and m; all others.
ELASTIC, WIDE = 0.02, 0.4
# Frequencies, rad/s.
SLOWEST, FASTEST = 0.5, 2.0
# Imaginary step of derivatives: no difference is formed, so no digits are lost.
STEP = 1e-20


@dataclass(frozen=True)
class Motion:
    """Instants t (B,), positions x (B, n_x), speeds v (B, n_v) and the forces Q (B, n_v) that H v̇ + C = Q asks for."""

    t: Array
    x: Array
    v: Array
    Q: Array


def prescribed(model: Model, samples: int, seed: int) -> Motion:
    """Sines of random phase on every coordinate; joints move forward all the time, so that friction keeps its sign."""
    layout, rng = model.layout, np.random.default_rng(seed)
    offset = layout.offset
    frequency = rng.uniform(SLOWEST, FASTEST, layout.n_x)
    phase = rng.uniform(0.0, 2.0 * np.pi, layout.n_x)
    amplitude = np.full(layout.n_x, WIDE)
    drift = np.zeros(layout.n_x)
    for elastic in layout.q_f:
        amplitude[elastic.start + offset : elastic.stop + offset] = ELASTIC
    for q, theta_m in zip(layout.q, layout.theta_m, strict=True):
        drift[q + offset] = drift[theta_m + offset] = 2.0 * WIDE * FASTEST
        if theta_m != q:
            frequency[theta_m + offset], phase[theta_m + offset] = frequency[q + offset], phase[q + offset]
            amplitude[theta_m + offset] = WIDE + ELASTIC

    def path(t: np.ndarray) -> np.ndarray:
        x = amplitude * np.sin(frequency * t[:, None] + phase) + drift * t[:, None]
        if layout.free and not layout.planar:
            x[:, 6] += 1.0
            x[:, 3:7] /= np.sqrt(np.sum(x[:, 3:7] ** 2, axis=1))[:, None]
        return np.asarray(x)

    def speeds(t: Array) -> Array:
        return layout.speeds(path(t), path(t + 1j * STEP).imag / STEP)

    t = np.arange(samples) / model.system.sample_rate
    x, v = path(t), speeds(t)
    a = difference(lambda step: speeds(t + step))
    H, C = model.dynamics(model.nominal).mass_and_bias(x, v)
    return Motion(t, x, v, np.einsum("bij,bj->bi", H, a) + C)
