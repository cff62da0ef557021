"""Least squares of the energy balance's rows, and the residuals of the joints: what needs rates of every sample."""

from __future__ import annotations

import numpy as np

from sms_online.model.base_parameters import BaseParameters
from sms_online.model.model import Model
from sms_online.pipeline.energy_balance import EnergyBalance, SharedErrors
from sms_online.pipeline.joint_balance import JointBalance, SquaredResidual
from sms_online.pipeline.sensing import Sensing
from sms_online.state import Stage, State
from sms_online.stream import Array, Indices
from sms_online.trackers.interface import Prior, Rows, Tracker
from sms_online.trackers.square_root import session_tracker


class EnergyEstimateState(State):
    """What the energy balance keeps beside its tracker.

    segment: of the last samples. newest_row: time of the last row, s. dropped_rows: those not finite.
    """

    segment: int = -1
    newest_row: float = -np.inf
    dropped_rows: int = 0


class EnergyEstimate(Stage):
    """The estimate by energies, of the system as described.

    tracker: least squares of its rows.
    """

    def __init__(self, model: Model, base: BaseParameters, sample_rate: float) -> None:
        self._n, self._sample_rate = base.n, sample_rate
        self._energy = EnergyBalance(model, base, sample_rate)
        self.tracker: Tracker = session_tracker(base.n, None)
        self.state = EnergyEstimateState()

    def set_prior(self, prior: Prior) -> None:
        """Add what is known of the base parameters beforehand; before the first sample."""
        self.tracker = session_tracker(self._n, prior)

    @property
    def shared(self) -> SharedErrors:
        """What errors that rows share do to the estimate."""
        return self._energy.shared

    def begin_joints(self, model: Model, base: BaseParameters, sensing: Sensing | None, since: int = 0) -> None:
        """Residuals of the joints count from a grid index on, in these parameters.

        sensing: where nuisances are estimated. Samples of before may still be on their way here.
        """
        self._joints, self._since = JointBalance(model, base, self._sample_rate, sensing), since

    @property
    def joint_residuals(self) -> list[SquaredResidual]:
        """Sums behind the relative residual of each joint, since they were begun."""
        return self._joints.state.residuals

    def push(
        self,
        index: Indices,
        segment: int,
        x: Array,
        v: Array,
        signals: Array,
        sigma: Array,
        start_time: float,
    ) -> None:
        """Take the motion of N samples at grid indices: x (N, n_x), v (N, n_v), signals (N, n_signals).

        sigma: deviation of each measured input. start_time: s of grid index 0.
        """
        now = self.state
        if segment != now.segment:
            now.segment = segment
            self._energy.begin_segment()
            self._joints.begin_segment()
        rows = self._energy.push(index, x, v, signals, sigma)
        finite = np.isfinite(rows.Y).all(axis=1) & np.isfinite(rows.b)
        now.dropped_rows += int(np.sum(~finite))
        if finite.any():
            t = start_time + rows.index[finite] / self._sample_rate
            self.tracker.update(Rows(rows.Y[finite], rows.b[finite], np.ones(t.size), t))
            now.newest_row = float(t[-1])
        after = index >= self._since
        self._joints.push(x[after], v[after], signals[after])
