"""Effects that become constants of the description when they are found, and are no unknowns of π.

Those on channels are taken off the samples. A tilted table is gravity, whose product with the masses is not linear in
both. Their columns are first approximations: constants are improved by fitting what is left when they are taken off.
"""

from __future__ import annotations

from collections.abc import Iterable, Sequence

import numpy as np

from sms_online.description.schema import Effect, System
from sms_online.diagnosis.plausible import plausible
from sms_online.diagnosis.record import Segment
from sms_online.effects.catalogue import ENTRIES, channel_effects
from sms_online.effects.spacecraft import TableTilt
from sms_online.stream import Array

# Delay of a lag at least and at most, s: one that the data make negative is none.
SHORTEST_DELAY, LONGEST_DELAY = 1e-5, 0.2


def is_constant(effect: Effect) -> bool:
    """Whether an effect becomes a constant."""
    return ENTRIES[effect.name].kind == "channel" or effect.name == TableTilt.entry.name


def improved(effect: Effect, increments: Array) -> Effect:
    """An effect with its constants changed by the linear coefficients of what is left when they are taken off."""
    c = effect.coefficients
    match effect.name:
        case "encoder_offset":
            changed = {"offset": c.get("offset", 0.0) + float(increments[0])}
        case "encoder_eccentricity":
            a, phi = c.get("amplitude", 0.0), c.get("phase", 0.0)
            sine, cosine = a * np.cos(phi) + increments[0], a * np.sin(phi) + increments[1]
            changed = {"amplitude": float(np.hypot(sine, cosine)), "phase": float(np.arctan2(cosine, sine))}
        case "sensor_lag":
            delay = (delay_of(c["corner"]) if "corner" in c else 0.0) + float(increments[0])
            changed = {"corner": delay_of(min(LONGEST_DELAY, max(SHORTEST_DELAY, delay)))}
        case "torque_delay":
            changed = {"time": min(LONGEST_DELAY, max(0.0, c.get("time", 0.0) + float(increments[0])))}
        case "table_tilt":
            names = ("gravity_x", "gravity_y")
            changed = {name: c.get(name, 0.0) + float(g) for name, g in zip(names, increments, strict=True)}
        case _:
            raise ValueError(f"{effect.name} has no constants to improve")
    return effect.model_copy(update={"coefficients": changed})


def stands(effect: Effect, sample_rate: float) -> bool:
    """Whether constants that were improved are still of an effect, on samples at so many Hz."""
    c = effect.coefficients
    late = {"sensor_lag": lambda: delay_of(c["corner"]), "torque_delay": lambda: c["time"]}.get(effect.name)
    return late is None or plausible(effect.name, np.array([late()]), sample_rate)


def deviations(effect: Effect, covariance: Array) -> dict[str, float]:
    """1σ of the constants for the covariance (c, c) of the linear coefficients."""
    c, std = effect.coefficients, np.sqrt(np.diag(covariance))
    match effect.name:
        case "encoder_eccentricity":
            sine, cosine = np.cos(c["phase"]), np.sin(c["phase"])
            along, across = np.array([sine, cosine]), np.array([-cosine, sine])
            radial, tangential = (float(np.sqrt(e @ covariance @ e)) for e in (along, across))
            return {"amplitude": radial, "phase": tangential / c["amplitude"]}
        case "sensor_lag":
            return {"corner": float(c["corner"] * std[0] / delay_of(c["corner"]))}
    return {name: float(s) for name, s in zip(c, std, strict=True)}


def delay_of(corner: float) -> float:
    """Delay, s, of a second-order Butterworth low-pass with a corner in Hz, far below it: √2 / ω. Its own inverse."""
    return float(np.sqrt(2.0) / (2.0 * np.pi * corner))


def applied(system: System, constants: Iterable[Effect]) -> System:
    """The system with constants: effects on channels declared, a tilt in its gravity."""
    effects, gravity = list(system.effects), np.array(system.gravity)
    for effect in constants:
        if effect.name == TableTilt.entry.name:
            gravity[:2] += effect.coefficients["gravity_x"], effect.coefficients["gravity_y"]
        else:
            effects.append(effect)
    return system.model_copy(update={"effects": tuple(effects), "gravity": tuple(gravity.tolist())})


def corrected(system: System, channels: Sequence[str], segment: Segment) -> Segment:
    """Samples of the channels without the effects on them that the system declares, the last of which was the first."""
    values = segment.values.copy()
    # A sensor's lag acts on what its disc or its zero has already distorted.
    last_first = channel_effects(system)[::-1]
    for effect in sorted(last_first, key=lambda effect: effect.name != "sensor_lag"):
        for k, channel in enumerate(channels):
            if effect.acts_on(channel):
                values[:, k] = effect.correct(values[:, k], system.sample_rate)
    return Segment(segment.index, values)
