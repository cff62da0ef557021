"""Channels that come late: a lag of positions, a delay of torques, or of what they do."""

from __future__ import annotations

from collections.abc import Iterable, Mapping
from fnmatch import fnmatchcase
from functools import lru_cache

import numpy as np

from sms_online.description.schema import Effect
from sms_online.effects.base import Entry, Ranges, Shape
from sms_online.effects.channel import Convolved, Linear
from sms_online.effects.traits import Traits
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
# Delay that is looked for at least and at most, s: one that the data make negative is none, and a channel that is later
# than half a window of the planar example is no channel of this session. A drive's delay below a microsecond is none.
SHORTEST_FOUND, LONGEST_FOUND = 1e-5, 0.2
SHORTEST_TORQUE_DELAY = 1e-6
# A drive that holds its command over a sample acts half a sample late: a lag up to that, in samples, is no sensor's.
HELD = 0.5


def delay_of(corner: float) -> float:
    """Delay, s, of a second-order Butterworth low-pass with a corner in Hz, far below it: √2 / ω. Its own inverse."""
    return float(np.sqrt(2.0) / (2.0 * np.pi * corner))


def lag(where: str, corner: float) -> Effect:
    """Declaration of the lag of a channel, or of a pattern of channels, with its corner, Hz."""
    return Effect(name=SensorLag.entry.name, where=where, coefficients={"corner": corner})


def lagging(effects: Iterable[Effect]) -> list[str]:
    """Channels, or patterns of channels, that are declared to lag."""
    return [effect.where for effect in effects if effect.name == SensorLag.entry.name]


def late_keys(joints: Iterable[int], channels: Iterable[str]) -> list[str]:
    """Effects, name@where, by which torques of joints (from 1) and then channels of positions come late."""
    keys = [f"{TorqueDelay.entry.name}@joint_{joint}" for joint in joints]
    return keys + [f"{SensorLag.entry.name}@{channel}" for channel in channels]


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
        traits=Traits(most=LONGEST_FOUND, behind=HELD, calibrates=("clock",)),
    )  # fmt: skip
    linear = (Linear("delay", "s", "rate", 1.0),)
    filtered = True

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

    @classmethod
    def improved(cls, given: Mapping[str, float], increments: Array) -> dict[str, float]:
        """The delay changed."""
        delay = (delay_of(given["corner"]) if "corner" in given else 0.0) + float(increments[0])
        return {"corner": delay_of(min(LONGEST_FOUND, max(SHORTEST_FOUND, delay)))}

    @classmethod
    def deviations(cls, given: Mapping[str, float], covariance: Array) -> dict[str, float]:
        """Deviation of the corner, by way of the delay."""
        std = np.sqrt(np.diag(covariance))
        return {"corner": float(given["corner"] * std[0] / delay_of(given["corner"]))}

    @classmethod
    def possible(cls, given: Mapping[str, float], sample_rate: float) -> bool:
        """Whether the delay is one of a sensor."""
        return cls.entry.traits.plausible(np.array([delay_of(given["corner"])]), sample_rate)


class TorqueDelay(Convolved):
    """A reading of τ(t - d) for a joint's torque τ(t), d `time` ≥ 0, s; `where` is the joint.

    The simulator samples the exact torque d earlier, as with a sensor's latency.
    Limitations: constant; what a torque does between samples is a cubic.
    """

    entry = Entry(
        "torque_delay", "channel", "driven joint", {"time": "s"}, "fast reversals of the torque",
        traits=Traits(least=SHORTEST_TORQUE_DELAY, most=LONGEST_FOUND, calibrates=("clock",)),
    )  # fmt: skip
    linear = (Linear("time", "s", "torque rate", -1.0),)

    @property
    def latency(self) -> float:
        """By how much the reading is later than the torque acts, s."""
        return self.coefficients["time"]

    def acts_on(self, channel: str) -> bool:
        """Whether the channel is the torque or force of a joint of `where`."""
        kind, _, joint = channel.partition("_")
        return kind in ("tau", "force") and fnmatchcase(f"joint_{joint}", self.where)

    def distort(self, samples: Array, sample_rate: float) -> Array:
        """The torque so much earlier; the first or the last sample beyond the record."""
        seconds = np.arange(samples.size) / sample_rate
        return np.asarray(np.interp(seconds - self.latency, seconds, samples))

    def kernel(self, sample_rate: float) -> Array:
        """Weights (2M + 1,) of the samples about an instant in the value so much later."""
        return ahead(self.latency, sample_rate)

    @classmethod
    def improved(cls, given: Mapping[str, float], increments: Array) -> dict[str, float]:
        """The delay changed, to no less than none."""
        return {"time": min(LONGEST_FOUND, max(0.0, given.get("time", 0.0) + float(increments[0])))}

    @classmethod
    def possible(cls, given: Mapping[str, float], sample_rate: float) -> bool:
        """Whether it is the delay of a drive."""
        return cls.entry.traits.plausible(np.array([given["time"]]), sample_rate)


class ActuatorDelay(TorqueDelay):
    """A torque that acts d after its reading, which is τ(t + d): the dead time of a drive. d `time` ≥ 0, s.

    All positions that come late by d look the same. Where a bus is simulated everything else comes late.
    Limitations: those of `TorqueDelay`; up to half a sample it is a command that is held.
    """

    entry = Entry(
        "actuator_delay", "channel", "driven joint", {"time": "s"}, "fast reversals of the torque",
        traits=Traits(most=LONGEST_FOUND, behind=HELD, calibrates=("clock",)),
        said=lambda where, given: (
            f"the torque of {where} acts {1e3 * given['time']:.3g} ms after its reading, or every position is that late"
        ),
    )  # fmt: skip
    linear = (Linear("time", "s", "torque rate", 1.0),)

    @property
    def latency(self) -> float:
        """See `TorqueDelay`: the reading is earlier."""
        return -self.coefficients["time"]


class SensorLatency(Convolved):
    """A reading of x(t - d), d the delay of a sensor in the system file; of commands that are held it is negative.

    Limitations: constant; what a reading does between samples is a cubic.
    """

    def __init__(self, patterns: tuple[str, ...], latency: float) -> None:
        self.name, self.where, self.coefficients = "latency", ", ".join(patterns), {"time": latency}
        self._patterns = patterns

    def acts_on(self, channel: str) -> bool:
        """Whether the sensor fills the channel."""
        return any(fnmatchcase(channel, pattern) for pattern in self._patterns)

    def kernel(self, sample_rate: float) -> Array:
        """Weights (2M + 1,) of the samples about an instant in the value d later."""
        return ahead(self.coefficients["time"], sample_rate)


def ahead(seconds: float, sample_rate: float) -> Array:
    """Weights (2M + 1,) of the samples about an instant in the cubic through the four around so much later.

    Of less than none the instant lies before.
    """
    ahead, part = divmod(seconds * sample_rate, 1.0)
    M = int(abs(ahead)) + 2
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
