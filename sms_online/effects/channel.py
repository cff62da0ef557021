"""Effects on measured position channels: offset, eccentricity, lag. A declared one is taken off the samples.

They are corrections by stated constants, no unknowns of π: their columns are differences of whole corrected sessions.
"""

from __future__ import annotations

from collections.abc import Mapping
from fnmatch import fnmatchcase
from typing import Protocol

import numpy as np
import scipy.signal

from sms_online.effects.base import Entry, Ranges, Shape
from sms_online.stream import Array

# Fixed-point steps from a reading back to the angle; the error falls by the amplitude (rad) each.
INVERSIONS = 20
# The lag's filter is integrated at so many times its corner (or the sample rate, whichever is higher), Hz: the
# trapezoidal rule is then off by (2 π/50)² / 12, a thousandth, of the signal's share at the corner.
LAG_OVERSAMPLING = 50.0


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


def _corners(ranges: Ranges) -> tuple[float, ...]:
    """From where hardly anything is left of a motion of some hertz to where hardly anything is lost of it."""
    hertz = (3.0, 5.0, 8.0, 12.0, 20.0, 30.0, 50.0, 80.0, 120.0)
    return tuple(f for f in hertz if f < 0.25 * ranges.sample_rate)


class SensorLag(_Channel):
    """A reading behind a second-order Butterworth low-pass, ÿ = ω² (x - y) - √2 ω ẏ, ω = 2π f, f `corner` in Hz.

    Below the corner that is a delay of √2 / ω. Correcting adds √2 ẏ / ω + ÿ / ω² to the reading.
    Limitations: what lies above the corner is lost in noise.
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

    def filter(self, sample_rate: float) -> Array:
        """Second-order sections of the low-pass for samples that are joined by straight lines (Tustin, prewarped)."""
        sections = scipy.signal.butter(2, self.coefficients["corner"], fs=sample_rate, output="sos")
        return np.asarray(sections, dtype=np.float64)

    def distort(self, samples: Array, sample_rate: float) -> Array:
        """The low-pass from rest at the first sample; `sample_rate` must lie far above the corner."""
        sections = self.filter(sample_rate)
        start = scipy.signal.sosfilt_zi(sections) * samples[0]
        return np.asarray(scipy.signal.sosfilt(sections, samples, zi=start)[0])

    def correct(self, samples: Array, sample_rate: float) -> Array:
        """Reading + √2 ẏ / ω + ÿ / ω², its derivatives from local polynomials over a quarter of the lag's period."""
        values = derivatives(samples, sample_rate, self.coefficients["corner"])
        return np.asarray(values[0] + np.sqrt(2.0) * values[1] / self.omega + values[2] / self.omega**2)


# Degree of the local polynomials that correct a lag, and their full width in periods of its corner.
DEGREE, PERIODS = 4, 0.5


def half_width(sample_rate: float, corner: float) -> int:
    """Half width of the local polynomials, samples: at least what their degree needs."""
    return max(DEGREE, round(0.5 * PERIODS * sample_rate / corner))


def derivatives(samples: Array, sample_rate: float, corner: float) -> list[Array]:
    """Value, first and second derivative of samples (B,), by Savitzky–Golay; the ends from the last whole window."""
    M = half_width(sample_rate, corner)
    return [
        np.asarray(scipy.signal.savgol_filter(samples, 2 * M + 1, DEGREE, deriv=k, delta=1.0 / sample_rate))
        for k in range(3)
    ]
