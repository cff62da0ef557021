"""Calibration constants that a session determines, in the terms and units of the person at the testbed."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from sms_online.calibration.nuisance import Nuisance
from sms_online.stream import Array

# A nuisance is a result where its deviation is below this share of its tolerance, or, without one and beyond it, below
# this share of its size.
IMPROVED, OF_ITS_SIZE = 0.7, 1.0 / 3.0
# And beyond this many tolerances the description is wrong there: what else bends to it, no error bar says.
BEYOND = 3.0
# It is reported to people from so many of its deviations on.
CERTAIN = 3.0
# What people call it, with a positive size and with a negative one.
WORDS = {
    "clock": ("late", "early"),
    "length": ("longer", "shorter"),
}
NAMES = {
    "tracked_point": "tracked point",
    "axis": "axis",
    "gravity": "tilt of gravity",
    "marker_station": "place along the link",
    "gauge_low_pass": "low-pass",
    "encoder_zero": "zero",
    "once_per_turn": "once per turn",
    "marker_zero": "zero",
    "marker_zero_angle": "zero",
    "camera_scale": "scale",
    "drive_gain": "gain of the torque",
    "drive_offset": "zero of the torque",
}
# Units as people say them: factor from the SI unit, from which size on.
SCALES = {
    "s": (("s", 1.0), ("ms", 1e-3), ("µs", 1e-6)),
    "m": (("m", 1.0), ("mm", 1e-3), ("µm", 1e-6)),
    "rad": (("rad", 1.0), ("mrad", 1e-3), ("µrad", 1e-6)),
    "": (("%", 1e-2),),
}

# An error once per turn of so many tolerances is rarely the encoder's.
RARE = 20.0


@dataclass(frozen=True)
class Calibration:
    """A number of the description that the samples determine better than its tolerance; estimates are corrected by it.

    name: of a tolerance in the system file. where: `base`, `joint_i`, `link_i`, a channel or a device; part: an axis,
    the sine or cosine of an error once per turn, or what a gain is relative to. estimate: by how much the
    description is off, unit; std: its standard deviation; tolerance: that of the system file, None where nothing was
    known.
    """

    name: str
    where: str
    part: str
    unit: str
    estimate: float
    std: float
    tolerance: float | None

    @property
    def beyond(self) -> bool:
        """Whether the description is wrong by more than its tolerance allows."""
        return self.tolerance is not None and abs(self.estimate) > BEYOND * self.tolerance

    @property
    def certain(self) -> bool:
        """Whether it differs from zero by more than chance."""
        return abs(self.estimate) > CERTAIN * self.std

    def __str__(self) -> str:
        if self.name == "gauge_low_pass" and self.estimate > 0.0:
            corner = 1.0 / (2.0 * np.pi * np.sqrt(self.estimate))
            return f"{self.where} behind a low-pass of {_rounded(corner, 0.5 * corner * self.std / self.estimate)} Hz"
        if self.name == "gauge_low_pass":
            return (
                f"{self.where} lead what bends them: low-pass {_rounded(1e6 * self.estimate, 1e6 * self.std)} ms² off"
            )
        if self.name == "truncation":
            share = _rounded(100.0 * self.estimate, 100.0 * self.std)
            return f"{self.where}: {share} % of what refining its elements changes"
        positive, negative = WORDS.get(self.name, ("off", "off"))
        words = positive if self.estimate >= 0.0 else negative
        value = abs(self.estimate) if positive != negative else self.estimate
        scales = SCALES.get(self.unit, ((self.unit, 1.0),))
        unit, factor = next((each for each in scales if max(abs(value), self.std) >= each[1]), scales[-1])
        # A marker that is seen as a point may be off along each axis.
        name = "place" if self.name == "marker_station" and self.part else NAMES.get(self.name, "")
        place = self.where if self.name in WORDS else f"{self.where}: {name}"
        part = f" ({self.part})" if self.part else ""
        return f"{place}{part} {_rounded(value / factor, self.std / factor)} {unit} {words}"

    @property
    def advice(self) -> str:
        """What to do where it is beyond its tolerance."""
        if self.name == "gauge_low_pass" and self.estimate > 0.0:
            return "record them unfiltered, or declare their low-pass as an effect with this corner"
        if self.name == "gauge_low_pass":
            return "no low-pass does so: higher modes of the link do, or friction whose law is another"
        if self.name == "once_per_turn" and self.tolerance and abs(self.estimate) > RARE * self.tolerance:
            return f"check how {self.where} is mounted, for a force may look like it, then run `sms-online diagnose`"
        if self.name == "clock" and self.estimate > 0.0:
            return f"state latency = {self.estimate:.2g} for it, or a larger tolerances.clock"
        if self.name == "truncation":
            return f"describe {self.where} with more elements"
        if self.name == "drive_gain" and self.part:
            return (
                "check torque constants and gear ratios, or weigh one part and state it under [known]: "
                "either joint's may be wrong"
            )
        return f"correct the system file or the sensor, or state a larger tolerances.{self.name}"

    def document(self) -> dict[str, str | float | None]:
        """The entry of results.json."""
        return {
            "name": self.name, "where": self.where, "part": self.part, "estimate": self.estimate, "std": self.std,
            "tolerance": self.tolerance, "unit": self.unit,
        }  # fmt: skip


def _rounded(value: float, std: float) -> str:
    """Both down to the second digit of the deviation."""
    decimals = int(np.clip(1 - np.floor(np.log10(std)), 0, 9)) if std > 0.0 else 3
    return f"{value:.{decimals}f} ± {std:.{decimals}f}"


def held(nuisances: Sequence[Nuisance], calibration: Sequence[Calibration]) -> Array:
    """Values (m,) of nuisances as earlier results have found them, 0 where they have not."""
    known = {(each.name, each.where, each.part): each.estimate for each in calibration}
    return np.array([known.get((each.name, each.where, each.part), 0.0) for each in nuisances])


def found(nuisances: Sequence[Nuisance], values: Array, deviations: Array) -> list[Calibration]:
    """What is estimated better than its tolerance, and each gain; values, deviations (m,): of all.

    The parameters of a joint go with the gain of its torque, and predict that torque with it alone.
    """
    out = []
    for nuisance, value, std in zip(nuisances, values.tolist(), deviations.tolist(), strict=True):
        known = np.isfinite(nuisance.tolerance)
        better = known and (std < IMPROVED * nuisance.tolerance or (nuisance.name == "drive_gain" and std > 0.0))
        if better or ((not known or abs(value) > BEYOND * nuisance.tolerance) and std < OF_ITS_SIZE * abs(value)):
            tolerance = nuisance.tolerance if known else None
            out.append(Calibration(nuisance.name, nuisance.where, nuisance.part, nuisance.unit, value, std, tolerance))
    return out
