"""Jitter of a device's stamps, estimated from the samples themselves.

A sample that is taken δ later than its stamp says is off by its reading's rate times δ. All channels of a device have
the same δ, so what is left of two of them after differencing, as `noise` does it, has the covariance σ_t² r_i r_j, r
the rates. White noise of the sensors has none: only pairs of channels count. That of a unit quaternion has one between
its parts, -σ² q_i q_j / 4 of an angle's noise σ, and over these pairs Σ q_i q_j r_i r_j = -Σ q_i² r_i², as q is normal
to its rate: such noise would pass for jitter.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from sms_online.pipeline.noise import rough_part
from sms_online.state import State
from sms_online.stream import Array, Indices, Mask

# Order of the differences: of a vibration at a tenth of the sample rate they leave a ten-thousandth.
ORDER = 8
# Samples to either side from which a rate is taken: a cubic in so few of them is nearly a line.
RATE_SIDE = 8
# Grid samples over which a rate is taken for synthetic jitter.
RATE_SAMPLES = 16
# A jitter is certain from so many standard deviations of its square on; less than LEAST, s, moves no estimate.
CERTAIN, LEAST = 10.0, 2e-5
# Devices have one clock where their jitters have at least this correlation.
ONE_CLOCK = 0.5
# A channel that leaves less has no noise: a constant.
LEAST_VARIANCE = 1e-60
# What older samples count when newer ones come: an arm at rest shows no jitter.
KEPT = 0.5
# Passes in which noise beside jitter and its weights follow each other.
PASSES = 5


@dataclass(frozen=True)
class Jitter:
    """Stamps of the position sensors (indices) of a device are off by `std`, s, at random, all by the same.

    density: its square times the sample period, s³.
    """

    name: str
    sensors: tuple[int, ...]
    std: float
    density: float


class JitterState(State):
    """Sums (sensors, sensors) over pairs of sensors: of products of what is left and of rates, and of the rates'."""

    product: Array
    rates: Array

    @staticmethod
    def none(sensors: int) -> JitterState:
        """Nothing known of so many sensors."""
        return JitterState(np.zeros((sensors, sensors)), np.zeros((sensors, sensors)))

    def with_sums(self, product: Array, rates: Array, own: Indices) -> JitterState:
        """With sums of some sensors (indices), by which older samples of these count less."""
        pairs = np.ix_(own, own)
        out = JitterState(self.product.copy(), self.rates.copy())
        out.product[pairs] = KEPT * out.product[pairs] + product
        out.rates[pairs] = KEPT * out.rates[pairs] + rates
        return out


def left_and_rates(samples: Array, times: Array) -> tuple[Array, Array]:
    """What differencing leaves of samples (B, C) at times (B,), s, in units of one sample's noise, and the rates."""
    left = rough_part(samples, times, ORDER)
    cut = max(0, RATE_SIDE - ORDER // 2)
    left = left[cut : len(left) - cut]
    offsets = np.arange(-RATE_SIDE, RATE_SIDE + 1)
    middle = np.arange(ORDER // 2 + cut, ORDER // 2 + cut + len(left))
    around = middle[:, None] + offsets
    apart = times[around] - times[around].mean(axis=1, keepdims=True)
    slopes = apart / np.sum(apart**2, axis=1, keepdims=True)
    return left, np.einsum("kt,ktc->kc", slopes, samples[around])


def pair_sums(left: Array, rates: Array, quaternion: Mask) -> tuple[Array, Array]:
    """Sums (C, C) over samples: of products of what is left with those of the rates, and of the squares of the latter.

    quaternion (C,): which channels are its parts, whose pairs do not count. Both sums are over the variance of what is
    left: the second is the information on a jitter's square. Products of rates count from their mean: what channels
    have in common at all rates is no jitter. Zero on the diagonal.
    """
    variance = np.mean(left**2, axis=0)
    weight = np.divide(1.0, variance, out=np.zeros_like(variance), where=variance > LEAST_VARIANCE)
    scale = np.outer(weight, weight)
    mean = rates.T @ rates / len(rates)
    product = (left * rates).T @ (left * rates) - mean * (left.T @ left)
    information = (rates**2).T @ rates**2 - len(rates) * mean**2
    off = np.where(np.outer(quaternion, quaternion), 0.0, 1.0 - np.eye(len(variance)))
    return off * scale * product, off * scale * np.maximum(information, 0.0)


def jitters(now: JitterState, devices: Sequence[tuple[str, Sequence[int]]], periods: Array) -> tuple[Jitter, ...]:
    """Jitters that are certain, by device; those of one clock together. periods (sensors,): of samples, s."""
    out = []
    for name, sensors in _of_one_clock(now, devices):
        square, std = _square(now, sensors, sensors)
        if square > max(CERTAIN * std, LEAST**2):
            period = float(np.max(periods[sensors]))
            out.append(Jitter(name, tuple(sensors), float(np.sqrt(square)), square * period))
    return tuple(out)


def _of_one_clock(now: JitterState, devices: Sequence[tuple[str, Sequence[int]]]) -> list[tuple[str, list[int]]]:
    """Devices, those together whose stamps are off by the same."""
    out: list[tuple[str, list[int]]] = []
    for name, sensors in devices:
        own = list(sensors)
        for k, (other, members) in enumerate(out):
            square, std = _square(now, own, members)
            alone = [_square(now, each, each)[0] for each in (own, members)]
            if square > CERTAIN * std and square > ONE_CLOCK * float(np.sqrt(max(0.0, alone[0]) * max(0.0, alone[1]))):
                out[k] = (f"{other} and {name}", members + own)
                break
        else:
            out.append((name, own))
    return out


def _square(now: JitterState, some: Sequence[int], others: Sequence[int]) -> tuple[float, float]:
    """Square of the jitter that some sensors and others share, and its standard deviation, s²; inf without pairs."""
    pairs = np.ix_(some, others)
    # Pairs within one device are there twice.
    twice = 2.0 if list(some) == list(others) else 1.0
    information = float(now.rates[pairs].sum()) / twice
    if information <= 0.0:
        return 0.0, np.inf
    return float(now.product[pairs].sum()) / twice / information, 1.0 / float(np.sqrt(information))


def noise_beside(left: Array, rates: Array, jitter: float) -> float:
    """1σ of a channel's noise (B,) beside a jitter, s, of its stamps at rates (B,)."""
    of_jitter = (jitter * rates) ** 2
    least = np.finfo(np.float64).tiny
    variance = max(float(np.mean(left**2)), least)
    for _ in range(PASSES):
        expected = variance + of_jitter
        weight = (expected.min() / expected) ** 2
        variance = max(float(np.sum(weight * (left**2 - of_jitter)) / np.sum(weight)), least)
    return float(np.sqrt(variance))


def by_sensor(found: Sequence[Jitter], sensors: int, sample_rate: float) -> Array:
    """1σ of a grid sample's lateness (sensors,), s, of white noise of the jitters' densities."""
    out = np.zeros(sensors)
    for jitter in found:
        out[list(jitter.sensors)] = np.sqrt(jitter.density * sample_rate)
    return out


def synthetic(
    found: Sequence[Jitter], readings: Array, before: Array, sample_rate: float, random: np.random.Generator
) -> Array:
    """What jitters may make of readings (B, sensors) on a grid, with those before (·, sensors), for their rates."""
    both = np.concatenate((before, readings))
    own = np.arange(len(before), len(both))
    earlier = np.maximum(own - RATE_SAMPLES, 0)
    rates = (both[own] - both[earlier]) * (sample_rate / np.maximum(own - earlier, 1))[:, None]
    late = np.zeros_like(rates)
    for jitter in found:
        common = random.standard_normal((len(readings), 1))
        late[:, list(jitter.sensors)] = np.sqrt(jitter.density * sample_rate) * common
    return np.asarray(rates * late)
