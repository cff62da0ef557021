"""Effects on measured channels: offset, eccentricity, lag of positions, delay of torques, taken off where declared.

They are corrections by stated constants, no unknowns of π: their columns are the response of rows to their derivatives.
"""

from __future__ import annotations

from collections.abc import Mapping
from fnmatch import fnmatchcase
from functools import lru_cache
from typing import Protocol

import numpy as np

from sms_online.effects.base import Entry, Ranges, Shape
from sms_online.stream import Array

# A lag is taken back up to so many times its corner, and up to this share of the sample rate; with three times, noise
# grows so far that squares of it bias a fit (links' rows of the planar example leave five times their deviation).
# NOISE_WEIGHT is that of the sum of squared weights against squared relative errors.
PASSBAND, HIGHEST, NOISE_WEIGHT = 1.0, 0.4, 1e-6
# A slow lag is taken back up to this at least, Hz: rows of windows of 0.4 s hear no more, and less would leave a
# channel without the motion that the others show.
LEAST_BAND = 8.0
# Frequencies that are compared: a kernel of the slowest corner resolves 15.
FREQUENCIES = 400
# Samples wait for as long as a torque is late: more than this, s, is no delay of a drive.
LONGEST_DELAY = 1.0
# Fixed-point steps from a reading back to the angle; the error falls by the amplitude (rad) each.
INVERSIONS = 20


class ChannelEffect(Protocol):
    """What stands between a true channel and its samples.

    where: a channel, or a shell pattern of channels. coefficients: as declared, shape constants included.
    """

    name: str
    where: str
    coefficients: Mapping[str, float]

    def acts_on(self, channel: str) -> bool:
        """Whether a channel feels it."""

    def distort(self, samples: Array, sample_rate: float) -> Array:
        """What the sensor makes of exact samples (B,) at `sample_rate`, Hz."""

    def correct(self, samples: Array, sample_rate: float) -> Array:
        """What was before the effect, of samples (B,) at `sample_rate`, Hz: a whole gapless record at a time."""


class _Channel:
    """Place and coefficients."""

    def __init__(self, name: str, where: str, coefficients: Mapping[str, float]) -> None:
        self.name, self.where, self.coefficients = name, where, coefficients

    def acts_on(self, channel: str) -> bool:
        """Whether the channel is, or fits the pattern of, `where`."""
        return fnmatchcase(channel, self.where)


class EncoderOffset(_Channel):
    """A reading of x + c for x, c `offset` in rad (m).

    Limitations: constant; an offset of all that is measured relative to a free base moves nothing.
    """

    entry = Entry(
        "encoder_offset", "channel", "position", {"offset": "rad"},
        "the same motion about other positions of the joint",
    )  # fmt: skip

    def __init__(self, where: str, given: Mapping[str, float]) -> None:
        super().__init__(self.entry.name, where, {"offset": given.get("offset", 0.0)})

    def distort(self, samples: Array, sample_rate: float) -> Array:
        """x + c."""
        return samples + self.coefficients["offset"]

    def correct(self, samples: Array, sample_rate: float) -> Array:
        """Reading - c."""
        return samples - self.coefficients["offset"]


class EncoderEccentricity(_Channel):
    """A reading of x + A sin(x + φ) for the angle x: a disc off its centre. A `amplitude` < 1, φ `phase`, rad.

    Limitations: one period a turn of the angle that the channel gives, which is after the gear.
    """

    entry = Entry(
        "encoder_eccentricity", "channel", "angle", {"amplitude": "rad", "phase": "rad"},
        "whole turns of the joint, or large angles to both sides",
    )  # fmt: skip

    def __init__(self, where: str, given: Mapping[str, float]) -> None:
        stated = {"amplitude": given.get("amplitude", 0.0), "phase": given.get("phase", 0.0)}
        super().__init__(self.entry.name, where, stated)

    def _error(self, angle: Array) -> Array:
        return np.asarray(self.coefficients["amplitude"] * np.sin(angle + self.coefficients["phase"]))

    def distort(self, samples: Array, sample_rate: float) -> Array:
        """x + A sin(x + φ)."""
        return samples + self._error(samples)

    def correct(self, samples: Array, sample_rate: float) -> Array:
        """x, by fixed-point iteration."""
        angle = samples
        for _ in range(INVERSIONS):
            angle = samples - self._error(angle)
        return angle


class Convolved(_Channel):
    """What weights of the samples on both sides take off."""

    def kernel(self, sample_rate: float) -> Array:
        """Weights (2M + 1,) of the samples about an instant in what was there."""
        raise NotImplementedError

    def correct(self, samples: Array, sample_rate: float) -> Array:
        """What was before the effect; beyond its ends the record goes on as its own point reflection."""
        from scipy.signal import oaconvolve  # here, see `SensorLag.filter`

        kernel = self.kernel(sample_rate)
        padded = np.pad(samples, kernel.size // 2, mode="reflect", reflect_type="odd")
        return np.asarray(oaconvolve(padded, kernel[::-1], mode="valid"))


def _corners(ranges: Ranges) -> tuple[float, ...]:
    """From where hardly anything is left of a motion of some hertz to where hardly anything is lost of it."""
    hertz = (3.0, 5.0, 8.0, 12.0, 20.0, 30.0, 50.0, 80.0, 120.0)
    return tuple(f for f in hertz if f < 0.25 * ranges.sample_rate)


class SensorLag(Convolved):
    """A reading behind a second-order Butterworth low-pass, ÿ = ω² (x - y) - √2 ω ẏ, ω = 2π f, f `corner` in Hz.

    Below the corner that is a delay of √2 / ω.
    Limitations: what lies above the corner, and above LEAST_BAND, is lost in noise.
    """

    entry = Entry(
        "sensor_lag", "channel", "position", {"corner": "Hz"}, "motion at two frequencies, or fast vibration",
        {"corner": Shape("Hz", 30.0, _corners)},
    )  # fmt: skip

    def __init__(self, where: str, given: Mapping[str, float]) -> None:
        super().__init__(self.entry.name, where, {"corner": given["corner"]})

    @property
    def omega(self) -> float:
        """ω, rad/s."""
        return float(2.0 * np.pi * self.coefficients["corner"])

    def filter(self, sample_rate: float) -> tuple[Array, Array]:
        """Numerator and denominator of the low-pass for samples that are joined by straight lines."""
        from scipy.signal import cont2discrete  # here, for it takes half a second that only a lag needs

        omega = self.omega
        low_pass = (np.array([omega**2]), np.array([1.0, np.sqrt(2.0) * omega, omega**2]))
        b, a, _ = cont2discrete(low_pass, 1.0 / sample_rate, method="foh")
        return np.asarray(b[0]), np.asarray(a)

    def distort(self, samples: Array, sample_rate: float) -> Array:
        """The low-pass, from rest at the first sample, of samples joined by straight lines."""
        from scipy.signal import lfilter, lfilter_zi  # here, see `filter`

        b, a = self.filter(sample_rate)
        start = lfilter_zi(b, a) * samples[0]
        return np.asarray(lfilter(b, a, samples, zi=start)[0])

    def kernel(self, sample_rate: float) -> Array:
        """Weights (2M + 1,) of the samples about an instant in what was before the lag there, y + √2 ẏ / ω + ÿ / ω²."""
        return _inverse_low_pass(self.coefficients["corner"], sample_rate)


class TorqueDelay(Convolved):
    """A reading of τ(t - d) for a joint's torque τ(t), d `time` ≥ 0, s; `where` is the joint.

    The simulator samples the exact torque d earlier, as with a sensor's latency.
    Limitations: constant; what a torque does between samples is a cubic.
    """

    entry = Entry("torque_delay", "channel", "joint", {"time": "s"}, "fast reversals of the torque")

    def __init__(self, where: str, given: Mapping[str, float]) -> None:
        super().__init__(self.entry.name, where, {"time": given.get("time", 0.0)})

    def acts_on(self, channel: str) -> bool:
        """Whether the channel is the torque or force of a joint of `where`."""
        kind, _, joint = channel.partition("_")
        return kind in ("tau", "force") and fnmatchcase(f"joint_{joint}", self.where)

    def distort(self, samples: Array, sample_rate: float) -> Array:
        """τ(t - d), the first sample before the record."""
        seconds = np.arange(samples.size) / sample_rate
        return np.asarray(np.interp(seconds - self.coefficients["time"], seconds, samples))

    def kernel(self, sample_rate: float) -> Array:
        """Weights (2M + 1,) of the samples about an instant in the cubic through the four around d later."""
        ahead, part = divmod(self.coefficients["time"] * sample_rate, 1.0)
        M = int(ahead) + 2
        nodes = np.arange(-1, 3)
        weights = np.zeros(2 * M + 1)
        for node in nodes:
            others = nodes[nodes != node]
            weights[M + int(ahead) + node] = np.prod((part - others) / (node - others))
        return weights


@lru_cache(maxsize=16)
def _inverse_low_pass(corner: float, sample_rate: float) -> Array:
    """See `SensorLag.kernel`; for a corner and a sample rate, Hz.

    Least squares against the inverse of the low-pass over the frequencies that are to come back, relative to it, with a
    small weight on noise; exact for parabolas.
    """
    omega = 2.0 * np.pi * corner
    M = max(4, round(sample_rate / corner))
    k = np.arange(-M, M + 1)
    f = np.linspace(0.0, min(max(PASSBAND * corner, LEAST_BAND), HIGHEST * sample_rate), FREQUENCIES)
    s = 1j * f / corner
    inverse = 1.0 + np.sqrt(2.0) * s + s**2
    response = np.exp(2j * np.pi * np.outer(f, k) / sample_rate) / np.abs(inverse)[:, None]
    wanted = inverse / np.abs(inverse)
    A, b = np.concatenate((response.real, response.imag)), np.concatenate((wanted.real, wanted.imag))
    moments = (k / M) ** np.arange(3)[:, None]
    step = sample_rate / (M * omega)
    exact = np.array([1.0, np.sqrt(2.0) * step, 2.0 * step**2])
    gram = A.T @ A + NOISE_WEIGHT * f.size * np.eye(k.size)
    bordered = np.block([[gram, moments.T], [moments, np.zeros((3, 3))]])
    return np.asarray(np.linalg.solve(bordered, np.concatenate((A.T @ b, exact)))[: k.size])
