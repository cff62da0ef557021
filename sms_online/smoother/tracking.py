"""The trackers that a person has chosen, on the rows of spans: the first is judged, the others are read beside it.

A span's factor is rows Y β = b with independent unit errors, of nuisances and parameters, as windows of the momentum
balance give them.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace

import numpy as np

from sms_online.calibration.nuisance import Nuisance
from sms_online.description.schema import TrackerChoice
from sms_online.errors import InputError
from sms_online.model.parameters import Parameter
from sms_online.pipeline.tracker_bank import Reading
from sms_online.smoother.search import LARGEST_MEAN_SQUARE, SpanFit
from sms_online.state import Stage
from sms_online.stream import Array
from sms_online.trackers.build import Tracked, build_tracker
from sms_online.trackers.information import Information
from sms_online.trackers.interface import Estimate, Prior, Rows, Tracker, joined


class SpanTrackers(Stage):
    """The chosen trackers of a smoother.

    choices: the judged one first. name: of the system. parameters (n,): columns behind those of the m nuisances.
    prior: of the parameters, or None. period: of the spans, s; a longer one counts as one of these.
    InputError where a choice does not fit the parameters.
    """

    def __init__(
        self, choices: Sequence[TrackerChoice], name: str, parameters: Sequence[Parameter],
        nuisances: Sequence[Nuisance], prior: Prior | None, period: float,
    ) -> None:  # fmt: skip
        nothing = np.full(len(parameters), np.nan)
        within = Prior(np.zeros(len(nuisances)), np.array([each.tolerance for each in nuisances]))
        known = joined(within, Prior(nothing, nothing) if prior is None else prior)
        self._nuisances, rows = len(nuisances), len(nuisances) + len(parameters) + 1
        self._rows_per_second = rows / period
        # The rows' deviations are right, prior or not.
        tracked = Tracked(parameters, len(nuisances), known, False, self._rows_per_second, name, rows)
        for choice in choices:
            if choice.trends:
                found, expected = "drifts with a rate, of spans of samples", "rls, or kalman with random_walk"
                raise InputError(name, f"tracker {choice.label}", found, expected)
        self._labels = [choice.label for choice in choices]
        alone = choices[0].static
        self._trackers = [None if choice.static and alone else build_tracker(choice, tracked) for choice in choices]
        # By name, for each is saved as a stage within.
        for k, tracker in enumerate(self._trackers):
            if tracker is not None:
                setattr(self, f"tracker_{k}", tracker)

    @property
    def judged(self) -> Tracker | None:
        """The tracker whose estimate is judged; None where that is the session's own least squares."""
        return self._trackers[0]

    def begin(self, known: Information) -> None:
        """Forget all rows, and go on from what is known of nuisances and parameters behind an event."""
        for tracker in self._trackers:
            if tracker is not None:
                # What is known beforehand of the nuisances is each tracker's own already.
                tracker.begin(known)

    def update(self, fit: SpanFit, t: float) -> None:
        """Take in the rows of a span that is centred at t, s, and how far it is from noise, as one of unit variance."""
        n = len(fit.factor) - 1
        left = np.zeros((1, n + 1))
        left[0, -1] = np.sqrt(fit.mean_square)
        whole = np.concatenate((fit.factor[:n], left))
        rows = Rows(whole[:, :n], whole[:, n], np.ones(n + 1), np.full(n + 1, t))
        for tracker in self._trackers:
            if tracker is not None:
                tracker.update(rows)

    @property
    def any(self) -> bool:
        """Whether there is a tracker beside the session's own least squares."""
        return any(tracker is not None for tracker in self._trackers)

    def readings(self, own: Estimate) -> tuple[Reading, ...]:
        """Each tracker's estimate, in the order of the choice; own: that by the session's own least squares."""
        return tuple(self._reading(k, own) for k in range(len(self._trackers)))

    def _reading(self, k: int, own: Estimate) -> Reading:
        tracker = self._trackers[k]
        if tracker is None:
            return Reading(self._labels[k], own, np.inf)
        estimate = tracker.estimate()
        if estimate.rss > LARGEST_MEAN_SQUARE * estimate.dof > 0.0:
            # Spans contradict each other: parameters move otherwise than the tracker lets them.
            estimate = replace(estimate, covariance_robust=estimate.covariance * estimate.rss / estimate.dof)
        return Reading(
            self._labels[k], estimate.without_nuisances(self._nuisances), estimate.rows / self._rows_per_second
        )

    @property
    def factor(self) -> Array | None:
        """What the judged tracker knows of nuisances and parameters, priors included, as a factor (n + 1, n + 1)."""
        return None if self.judged is None else self.judged.information.factor
