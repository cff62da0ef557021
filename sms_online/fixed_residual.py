"""What fixed parameters leave of a session's momentum rows, compared with what the sensors' noise alone leaves."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

from sms_online.calibration.found import Calibration, held
from sms_online.description.schema import System
from sms_online.diagnosis.constants import corrected
from sms_online.diagnosis.followed import least_samples
from sms_online.diagnosis.record import SampleRecord, bounded, excerpts
from sms_online.diagnosis.residuals import ResidualTest, RowResidual, rms
from sms_online.diagnosis.rows import SessionRows
from sms_online.model.parameters import ELASTIC
from sms_online.pipeline.estimator import Estimator
from sms_online.pipeline.relinearisation import NOISE_RENEWED, PASS_BAND
from sms_online.pipeline.sensing import is_slow, stated_period
from sms_online.pipeline.sensor_noise import NoiseEstimate, SensorNoise
from sms_online.predicted import Predicted
from sms_online.stream import Array, Block


class FixedResidual:
    """Keeps a session's samples, and estimates their noise on the way.

    channels: of the blocks to come.
    """

    def __init__(self, session: Estimator, system: System, channels: Sequence[str]) -> None:
        self._session, self._system = session, system
        sensing = session.sensing
        self._columns = [channels.index(name) for name in sensing.channels]
        self._record = SampleRecord(system.sample_rate)
        session.observers.append(self._record)
        self._estimate = NoiseEstimate(sensing, system.sample_rate, PASS_BAND / system.windows.momentum)
        self._noise: SensorNoise | None = None
        self._renewed = -np.inf

    @staticmethod
    def known(session: Estimator, system: System) -> bool:
        """Whether a system's rows are known: all coordinates are measured, and fast enough for the windows."""
        sensing = session.sensing
        positions = tuple(sensing.channels[k] for k in sensing.position_columns)
        return not sensing.missing and not is_slow(stated_period(system, positions), system.windows.momentum)

    def push(self, block: Block) -> None:
        """Take the block that the session has just taken."""
        self._estimate.push(block.t, block.values[:, self._columns])
        # How slow a noise is follows from what the samples of many seconds say.
        if block.t.size and block.t[-1] >= self._renewed + NOISE_RENEWED and self._estimate.ready:
            self._renewed = float(block.t[-1])
            self._noise = self._estimate.noise(self._session.periods, self._system)

    def of(
        self, beta: Array, calibration: Sequence[Calibration]
    ) -> tuple[dict[str, RowResidual], dict[str, Predicted]]:
        """What parameters β (n,) leave by row type, and by spring and flexible link.

        Both are empty where there are too few samples, or noise has no effect; springs and links whose stiffness is no
        parameter are left out. calibration: what the description is off by.
        """
        session, noise, sensing = self._session, self._noise, self._session.sensing
        length, most = bounded(self._system)
        whole = [corrected(self._system, sensing.channels, each) for each in self._record.segments()]
        least = least_samples(self._system)
        segments = [part for part in excerpts(whole, length, most) if part.index.size > least]
        if noise is None or noise.exact or not segments:
            return {}, {}
        try:
            rows = SessionRows(session.model, session.base, sensing, noise, segments, beta)
        except np.linalg.LinAlgError:
            # Readings that no shape of the links gives.
            return {}, {}
        known = held(rows.calibrated.nuisances, calibration)
        residual = (rows.Y @ beta + rows.calibrated.columns @ known - rows.b) / rows.std
        return ResidualTest(rows).of(residual), _elastic(rows, beta, residual)


def _elastic(rows: SessionRows, beta: Array, residual: Array) -> dict[str, Predicted]:
    """What is left of elastic forces, root mean squares of rows in units of their noise.

    The least is with the place's own stiffness or rigidities fitted to the run.
    """
    layout = rows.model.layout
    joints = enumerate(zip(layout.q, layout.theta_m, strict=True), start=1)
    springs = {f"joint_{i}": [q] for i, (q, theta_m) in joints if q != theta_m}
    shapes = enumerate(layout.q_f, start=1)
    links = {f"link_{i}": list(range(q_f.start, q_f.stop)) for i, q_f in shapes if q_f.stop > q_f.start}
    places = springs | links
    if not places:
        return {}
    tested, out = ResidualTest(rows, places).of(residual), {}
    for place, speeds in places.items():
        own = [
            k
            for k, each in enumerate(rows.base.parameters)
            if each.name.startswith(f"{place}.") and each.name.endswith(ELASTIC)
        ]
        columns = (rows.Y[:, speeds][..., own] / rows.std[:, speeds, None]).reshape(-1, len(own))
        force, left = columns @ beta[own], residual[:, speeds].ravel()
        if np.any(force):
            fitted = left - columns @ np.linalg.lstsq(columns, left, rcond=None)[0]
            out[place] = Predicted(rms(left) / rms(force), rms(fitted) / rms(force), tested[place])
    return out
