"""The readings of the spans of a session: their noise, what they may be off by, and the model behind them."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

from sms_online.model.base_parameters import BaseParameters
from sms_online.model.dynamics import Dynamics
from sms_online.model.model import Model
from sms_online.model.readings import Readings
from sms_online.physical import PhysicalSet
from sms_online.smoother.nuisances import ReadingNuisances
from sms_online.stream import Array


class SmoothedReadings:
    """What spans of a session are fitted with: its model, the noise of its samples, and what readings may be off by.

    torque_noise: times what samples show of it, of a span before.
    readings: of the samples. sigma (C,): their noise, 1σ a sample. torque (joints,): σ² T_s of n τ, (N m)² s.
    nuisances: of the session's channels, of which sensed (C,) are the readings. An estimate β (n,) holds these m
    nuisances, and then the parameters.
    """

    def __init__(
        self, model: Model, base: BaseParameters, readings: Readings, sigma: Array, torque: Array,
        nuisances: ReadingNuisances, sensed: Sequence[int], torque_noise: float = 1.0,
    ) -> None:  # fmt: skip
        self.torque_noise = torque_noise
        self.model = model
        self.base = base
        self.readings = readings
        self._nuisances, self._sensed = nuisances, list(sensed)
        self.m = len(nuisances.all)
        self.tolerances = np.array([each.tolerance for each in nuisances.all])
        self.sigma = sigma
        # Unit noise of each motor's mean torque to forces, (n_v, joints), N m √s.
        self.motors = model.generalized_force(np.eye(torque.size)).T * np.sqrt(torque)
        self.physical = PhysicalSet(model, base)

    def dynamics(self, beta: Array) -> Dynamics:
        """The equations of motion for β (n,)."""
        return self.model.dynamics(self.base.physical_values(beta[self.m :]))

    def offsets(self, x: Array, v: Array, by_position: Array) -> Array:
        """What one unit of each nuisance adds to the readings along a motion (B, C, m), see `ReadingNuisances`."""
        if not self.m:
            return np.zeros((len(x), len(self._sensed), 0))
        return self._nuisances.columns(x, v, by_position, self.readings(x, v), self._sensed)
