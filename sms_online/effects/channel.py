"""Effects on measured channels: what they share, offset and eccentricity; taken off where declared.

They are corrections by stated constants, no unknowns of π: their columns are the response of rows to their derivatives.
"""

from __future__ import annotations

from collections.abc import Mapping
from fnmatch import fnmatchcase
from typing import ClassVar, Literal, NamedTuple

import numpy as np

from sms_online.effects.base import Constant, Entry, beyond_zero
from sms_online.effects.harmonic import amplitude_and_phase
from sms_online.effects.traits import Traits
from sms_online.stream import Array

# Fixed-point steps from a reading back to the angle; the error falls by the amplitude (rad) each.
INVERSIONS = 20
# A disc's centre is off by a twentieth of its radius at most.
LARGEST_ECCENTRICITY = 0.05
# A zero further off than a turn is no zero: such a size fits where the offset acts on next to nothing.
LARGEST_OFFSET = 2.0 * np.pi  # rad (m)


class Linear(NamedTuple):
    """A linear coefficient of an effect on channels: name, unit, and what one unit of it adds to a reading.

    adds: of a reading x its one, sine, cosine or rate, or of a torque its rate; with a sign.
    """

    quantity: str
    unit: str
    adds: Literal["one", "sine", "cosine", "rate", "torque rate"]
    sign: float


class ChannelEffect(Constant):
    """How the samples of a channel differ from its true values; without a latency and a filter of its own.

    where: a channel, or a shell pattern of channels. coefficients: as declared, shape constants included. linear: its
    linear coefficients. filtered: whether a simulator passes exact values through `filter`, in place of `distort`.
    """

    linear: ClassVar[tuple[Linear, ...]]
    filtered: ClassVar[bool] = False

    def __init__(self, where: str, given: Mapping[str, float]) -> None:
        self.name, self.where = self.entry.name, where
        self.coefficients = {name: given.get(name, 0.0) for name in self.entry.coefficients}

    @property
    def latency(self) -> float:
        """By how much a simulator samples the exact value earlier, s."""
        return 0.0

    def acts_on(self, channel: str) -> bool:
        """Whether the channel is, or fits the pattern of, `where`."""
        return fnmatchcase(channel, self.where)

    def distort(self, samples: Array, sample_rate: float) -> Array:
        """What the sensor makes of exact samples (B,) at `sample_rate`, Hz."""
        raise NotImplementedError

    def filter(self, sample_rate: float) -> tuple[Array, Array]:
        """Numerator and denominator of the filter that a reading has passed, for exact values at `sample_rate`, Hz."""
        return np.ones(1), np.ones(1)

    def correct(self, samples: Array, sample_rate: float) -> Array:
        """What was before the effect, of samples (B,) at `sample_rate`, Hz: a whole gapless record at a time."""
        raise NotImplementedError


class EncoderOffset(ChannelEffect):
    """A reading of x + c for x, c `offset` in rad (m).

    Limitations: constant; an offset of all that is measured relative to a free base moves nothing.
    """

    entry = Entry(
        "encoder_offset", "channel", "position", {"offset": "rad"},
        "the same motion about other positions of the joint",
        traits=Traits(
            signed=True, most=LARGEST_OFFSET, calibrates=("encoder_zero", "marker_zero", "marker_zero_angle")
        ),
        said=lambda where, given: f"{where} reads {beyond_zero(given['offset'])}: set its zero anew",
    )  # fmt: skip
    linear = (Linear("offset", "rad", "one", -1.0),)

    def distort(self, samples: Array, sample_rate: float) -> Array:
        """x + c."""
        return samples + self.coefficients["offset"]

    def correct(self, samples: Array, sample_rate: float) -> Array:
        """Reading - c."""
        return samples - self.coefficients["offset"]


class EncoderEccentricity(ChannelEffect):
    """A reading of x + A sin(x + φ) for the angle x: a disc off its centre. A `amplitude` < 1, φ `phase`, rad.

    Limitations: one period a turn of the angle that the channel gives, which is after the gear.
    """

    entry = Entry(
        "encoder_eccentricity", "channel", "angle", {"amplitude": "rad", "phase": "rad"},
        "whole turns of the joint, or large angles to both sides",
        traits=Traits(signed=True, most=LARGEST_ECCENTRICITY, calibrates=("once_per_turn",)),
    )  # fmt: skip
    linear = (Linear("sine", "rad", "sine", -1.0), Linear("cosine", "rad", "cosine", -1.0))

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

    @classmethod
    def possible(cls, given: Mapping[str, float], sample_rate: float) -> bool:
        """Whether it is that of a disc."""
        return given["amplitude"] <= LARGEST_ECCENTRICITY

    @classmethod
    def improved(cls, given: Mapping[str, float], increments: Array) -> dict[str, float]:
        """Sine and cosine parts changed."""
        a, phi = given.get("amplitude", 0.0), given.get("phase", 0.0)
        sine, cosine = a * np.cos(phi) + increments[0], a * np.sin(phi) + increments[1]
        return amplitude_and_phase(np.array((sine, cosine)))

    @classmethod
    def deviations(cls, given: Mapping[str, float], covariance: Array) -> dict[str, float]:
        """Deviations of the parts along the phase and across it."""
        sine, cosine = np.cos(given["phase"]), np.sin(given["phase"])
        along, across = np.array([sine, cosine]), np.array([-cosine, sine])
        radial, tangential = (float(np.sqrt(e @ covariance @ e)) for e in (along, across))
        return {"amplitude": radial, "phase": tangential / given["amplitude"]}


class Convolved(ChannelEffect):
    """An effect that weights of the samples on both sides correct."""

    def kernel(self, sample_rate: float) -> Array:
        """Weights (2M + 1,) of the samples about an instant in what was there."""
        raise NotImplementedError

    def correct(self, samples: Array, sample_rate: float) -> Array:
        """What was before the effect; beyond its ends the record goes on as its own point reflection."""
        from scipy.signal import oaconvolve  # here, for it takes half a second that only lags and delays need

        kernel = self.kernel(sample_rate)
        padded = np.pad(samples, kernel.size // 2, mode="reflect", reflect_type="odd")
        return np.asarray(oaconvolve(padded, kernel[::-1], mode="valid"))
