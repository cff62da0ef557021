"""Rows of the samples behind a change, whitened among themselves, and what explains them.

Whitened rows of the session hold parameters of before the change for a second and a half, or two. So rows are made
again of the samples behind it alone.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, replace
from functools import partial

import numpy as np

from sms_online.calibration.columns import CalibrationColumns
from sms_online.calibration.nuisance import Nuisance, prior_rows
from sms_online.description.schema import System
from sms_online.model.base_parameters import BaseParameters
from sms_online.model.model import Model
from sms_online.pipeline.drift_line import DriftLine
from sms_online.pipeline.event_hypotheses import Explanation, Jump, explain, goes_on, hypotheses
from sms_online.pipeline.events import Seen
from sms_online.pipeline.momentum_balance import MomentumBalance
from sms_online.pipeline.momentum_fit import MomentumFit
from sms_online.pipeline.momentum_windows import COPIES, OVERLAP
from sms_online.pipeline.sensing import Sensing
from sms_online.pipeline.sensor_noise import SensorNoise
from sms_online.pipeline.synchronise import GridSamples
from sms_online.pipeline.white_rows import WhiteRows
from sms_online.pipeline.window_noise import WindowNoise
from sms_online.stream import Array

# What was known goes on behind shifts of clocks by less than LARGEST_SHIFT, s. A clock that begins anew on a late host
# may be off by more, up to LARGEST_STEP: then nothing is known afterwards, for rows are linear in less.
LARGEST_SHIFT, LARGEST_STEP = 1e-3, 5e-3
# Kind of that hypothesis.
CLOCK = "clock"
# Times that the rows after an event are whitened, each with the jumps found before.
PASSES = 2
# A jump is a step where its parameters then go on by less than this share of the rate that would have brought them
# there since it began. A drift may have begun so long before the alarm, s: its first part hides in the noise.
LARGEST_PROGRESS, HIDDEN = 0.2, 2.0


@dataclass(frozen=True)
class AfterChange:
    """Samples behind a change, as the best of the steps explains them.

    goes_on: whether what jumped may drift. rows: of these samples, with the columns of what may begin behind those of
    the parameters of now.
    """

    explanation: Explanation
    goes_on: bool
    rows: list[WhiteRows]


@dataclass(frozen=True)
class EventRows:
    """Makes rows behind a change, and compares what may explain them.

    clocks: nuisances that are those of wandering ones. point: gives the nuisances (m,) that samples are corrected by.
    follows: whether parameters move in the judged estimate; learns: whether a change may be the beginning of a drift.
    drift: gives that which is known, in the window that ends at a grid index, counted from the instant that what is
    known of the parameters before the change holds for.
    """

    system: System
    sensing: Sensing
    nuisances: tuple[Nuisance, ...]
    clocks: tuple[int, ...]
    point: Callable[[], Array]
    follows: bool
    learns: bool
    drift: Callable[[int], DriftLine | None]

    def explain(
        self, model: Model, base: BaseParameters, before: Seen, samples: GridSamples, between: tuple[int, int],
        noise: SensorNoise,
    ) -> AfterChange:  # fmt: skip
        """The best explanation of samples behind a change by a step.

        model, base: with every parameter that may jump, those of now first. before: the last window before the change.
        between: grid indices that it lies between.
        """
        m = len(self.nuisances)
        n = len(before.known.factor) - 1 - m
        jumps = [replace(jump, columns=tuple(m + k for k in jump.columns)) for jump in hypotheses(base.parameters)]
        system, values = self.system, samples.values
        balance = MomentumBalance(model, base, system.sample_rate, system.windows.momentum, moments=self.follows)
        windows, instants = balance.push(
            samples.index, [self.sensing.motion(values)] * COPIES, noise.coordinates, noise.lateness
        )  # fmt: skip
        weights = np.zeros(base.n)
        weights[:n] = before.known.solution().pi[m:]
        # What the rows before left decides, where it is more than noise.
        factor = before.known.factor
        left = max(1.0, abs(factor[-1, -1]) / np.sqrt(max(1, before.known.rows - m - n)))
        # Rows are not whitened of what the model lacks, which those of windows that overlap have in common.
        alike = OVERLAP if before.misfit.any() else 1.0

        def new_noise() -> WindowNoise:
            calibration = CalibrationColumns(model, self.sensing, balance.span) if m else None
            return WindowNoise(model, base, balance, self.sensing.displacements, calibration=calibration)

        def drift(end: int) -> DriftLine | None:
            line = self.drift(end)
            return None if line is None else line.padded(base.n)

        for _ in range(PASSES):
            prior = prior_rows(self.nuisances, base.n)
            known = partial(np.append, np.zeros(m), weights)
            fit = MomentumFit(
                model, base, balance, new_noise, known, prior, self.point, drift=drift
            )  # fmt: skip
            fit.go_on(weights, noise, before.misfit)
            white = fit.push(windows, instants, noise)
            rows = np.concatenate([each.Y for each in white])
            explanation = explain(factor / left, rows / left, jumps, alike)
            clocks = self._of_clocks(factor / left, rows / left, alike)
            if clocks is not None:
                return AfterChange(clocks, False, white)
            weights = np.zeros(base.n)
            weights[:n] = explanation.beta[m:]
            if explanation.jump is not None:
                weights[[k - m for k in explanation.jump.columns]] += explanation.sizes
        if explanation.jump is None or not self.learns:
            return AfterChange(explanation, self.learns, white)
        onset, alarm = between
        after = [each.end / system.sample_rate - 0.5 * balance.span - alarm / system.sample_rate for each in white]
        ramp = np.concatenate([t * each.Y[:, m:-1] + each.ramp for t, each in zip(after, white, strict=True)])
        ramps = ramp[:, [k - m for k in explanation.jump.columns]]
        share = goes_on(factor / left, rows / left, ramps / left, explanation, alike)
        progress = share * max((alarm - onset) / system.sample_rate, HIDDEN)
        return AfterChange(explanation, progress > LARGEST_PROGRESS, white)

    def _of_clocks(self, factor: Array, rows: Array, alike: float) -> Explanation | None:
        """What shifts of clocks alone leave of the rows, where that is little but noise; see `explain`."""
        each = [Jump(CLOCK, (k,)) for k in self.clocks]
        found = explain(factor, rows, [*each, Jump(CLOCK, self.clocks)] if each[1:] else each, alike)
        small = bool((np.abs(found.sizes) < LARGEST_STEP).all())
        return replace(found, decisive=True) if found.explained and small else None
