"""What fixed parameters leave of a force of another run, and whether they hold for it."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from sms_online.diagnosis.residuals import RowResidual
from sms_online.row_types import LARGEST_RESIDUAL, NOISE_WHITENED
from sms_online.verdict.reasons import NOISE_RESIDUAL

# Parameters that predict another run within this multiple of what any parameters leave there hold for both.
HOLDS = 1.15
# And this share of a torque beside it is none: gains of torques are known no better.
NEGLIGIBLE = 0.01
# Zeros of two encoders beside a spring are off by no more than so many of their tolerances.
WITHIN = 3.0 * np.sqrt(2.0)


@dataclass(frozen=True)
class Predicted:
    """What fixed parameters leave of a force, as a share: rms over rms.

    left: with everything fixed. least: fitted to this run, what the description itself lacks and noise, of which a fit
    takes some for motion. rows: what is left of the momentum rows over the sensors' noise in them, None where that is
    not known.
    """

    left: float
    least: float
    rows: RowResidual | None = None

    @property
    def ratio(self) -> float:
        """The share that is left over the least possible one."""
        return self.left / self.least if self.least > 0.0 else np.inf

    @property
    def holds(self) -> bool:
        """Whether the parameters hold here: fitting them to this run would gain little, or noise alone."""
        return self._as_fitted(self.left) or (self.rows is not None and not self.rows.beyond)

    @property
    def unexplained(self) -> bool:
        """Whether a large share is left that is not noise."""
        return self.left > NOISE_RESIDUAL and (self.rows is None or self.rows.whitened > NOISE_WHITENED)

    @property
    def shifted(self) -> bool:
        """Whether the parameters hold but for a zero: of torques alone."""
        return False

    def document(self) -> dict[str, float | str | None]:
        """The entry of validation.json."""
        noise = (None, None) if self.rows is None else (self.rows.whitened, self.rows.limit)
        return {"left": self.left, "least": self.least, "whitened": noise[0], "limit": noise[1]}

    def _as_fitted(self, left: float) -> bool:
        return left <= float(np.hypot(NEGLIGIBLE, HOLDS * self.least))


@dataclass(frozen=True)
class PredictedTorque(Predicted):
    """Of a joint's torque or force; a fit to this run is one of parameters and of a zero of each torque.

    zero: what its channel reads too much throughout if the prediction is right, in `unit`; zero_share: its size over
    rms of the torque. turned: what deflections of its spring would be read too large by in its place, rad (m), 0
    without a spring; tolerance: of an encoder's zero. at_rest: share of the run that is left out, see `TorqueCourse`.
    """

    channel: str = ""
    unit: str = "N m"
    zero: float = 0.0
    zero_share: float = 0.0
    turned: float = 0.0
    tolerance: float = 0.0
    at_rest: float = 0.0

    @property
    def holds(self) -> bool:
        """Whether the parameters hold here, with encoders whose zeros are within their tolerances."""
        zeros = 0.0 < abs(self.turned) <= WITHIN * self.tolerance
        return super().holds or (zeros and self._as_fitted(self.beside_zero))

    @property
    def beside_zero(self) -> float:
        """The share that is left beside a zero of the torque, which each run has its own of."""
        return float(np.sqrt(max(0.0, self.left**2 - self.zero_share**2)))

    @property
    def shifted(self) -> bool:
        """Whether the parameters hold but for a zero of the torque."""
        return not self.holds and self._as_fitted(self.beside_zero)

    @property
    def weak(self) -> bool:
        """Whether most of the torque is left, and is noise: other parameters would do as well."""
        return self.left > LARGEST_RESIDUAL and not self.unexplained

    def document(self) -> dict[str, float | str | None]:
        """See `Predicted`."""
        return super().document() | {
            "channel": self.channel,
            "unit": self.unit,
            "zero": self.zero,
            "beside_zero": self.beside_zero,
            "turned": self.turned,
            "at_rest": self.at_rest,
        }
