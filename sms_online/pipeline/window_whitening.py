"""Sequential whitening of windows with fixed weights: each row is the innovation given all rows before it.

The nine windows that overlap a row's own predict its error, and the windows before those improve the prediction: the
noise is a moving average whose sum over all windows nearly vanishes, and only its whole past predicts such a one.
A filter that begins anew predicts worse for a second or two. It also takes its rows for independent of those before,
which they are not.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from sms_online.calibration.multiplied_noise import SAMPLES, Shares
from sms_online.pipeline.latency import LatencyColumns, SourceGroup
from sms_online.pipeline.momentum_windows import Window
from sms_online.pipeline.sensor_noise import SensorNoise
from sms_online.pipeline.whitening import Whitener
from sms_online.pipeline.window_noise import PropagatedNoise, WindowNoise
from sms_online.state import Stage, State
from sms_online.stream import Array


@dataclass(frozen=True)
class WhitenedWindow:
    """A window's rows (n_v, width), independent of all before and of each other, errors of unit variance.

    late (n_v, G): columns of the sources' latencies, likewise. calibration (n_v, m), twice: columns of what the
    description may be wrong in, as they came and likewise. multiplied (n_v, ·), twice: a sample of the noise that some
    of these multiply and still hold. noise (n_v, n_v): covariance of the rows as they came, as far as it is noise;
    covariance (n_v, n_v): with what the model lacks.
    """

    rows: Array
    late: Array
    calibration: tuple[Array, Array]
    multiplied: tuple[Array, Array]
    noise: Array
    covariance: Array


class WindowWhiteningState(State):
    """What weights were begun with.

    misfit (n_v,): variance of what the model lacks in each row, over that of the noise. reference (m + n,): nuisances
    and β of the newest estimate, which residuals are of.
    """

    misfit: Array
    reference: Array


class WindowWhitening(Stage):
    """Whitens windows with the noise that parameters β (n,) and sensors give them, and a misfit (n_v,), see `begin`.

    noise: that of the windows. sources: whose latencies are estimated. width: columns of the rows, without those of
    calibration.
    """

    def __init__(self, noise: WindowNoise, width: int, sources: Sequence[SourceGroup] = ()) -> None:
        self.noise = noise
        self.state = WindowWhiteningState(np.zeros(noise.n_v), np.zeros(noise.nuisances))
        self._late = LatencyColumns(sources)
        self._whitener = Whitener(width + len(sources) + noise.nuisances + SAMPLES * len(noise.multiplied))
        self._plain_shares = Shares(noise.multiplied, noise.n_v)
        self._shares = Shares(noise.multiplied, noise.n_v)

    @property
    def misfit(self) -> Array:
        """Variance of what the model lacks in each row (n_v,), over that of the noise."""
        return self.state.misfit

    @property
    def beta(self) -> Array | None:
        """β, None before it has begun."""
        return self.noise.beta

    def begin(self, beta: Array, noise: SensorNoise, misfit: Array, instant: int) -> None:
        """Begin with the window that starts at an instant, as if no window before shared samples with it.

        misfit (n_v,): variance of what the model lacks in each row, over that of the noise.
        """
        self.state.misfit, self.state.reference = misfit, np.append(np.zeros(self.noise.nuisances), beta)
        self.noise.begin(beta, noise, instant)
        self._whitener.begin_segment()
        self._plain_shares.begin()
        self._shares.begin()

    def begin_segment(self) -> None:
        """The next window begins a segment, and shares no samples with those before."""
        self.noise.begin_segment()
        self._whitener.begin_segment()

    def push(self, windows: Sequence[Window], rows: Array, errors: Array) -> list[WhitenedWindow]:
        """The next windows' rows (W, n_v, width); errors (W, n_v): variance of each that nothing propagates."""
        propagated = self.noise.push(windows, errors)
        return [self._whitened(noise, own) for noise, own in zip(propagated, rows, strict=True)]

    def _whitened(self, noise: PropagatedNoise, rows: Array) -> WhitenedWindow:
        """Whiten one window."""
        own = noise.covariances[-1]
        of_noise = own.copy()
        diagonal = np.einsum("ii->i", own)
        diagonal += self.state.misfit * diagonal
        width = rows.shape[1]
        calibrated = width + len(self._late)
        if len(self._late):
            rows = np.concatenate((rows, self._late.of(noise.late)), axis=1)
        samples = noise.multiplied.shape
        rows = np.concatenate((rows, noise.calibration, noise.multiplied.reshape(samples[0], -1)), axis=1)
        white = self._whitener.push(noise.covariances, rows)
        multiplied = calibrated + noise.calibration.shape[1]
        calibration = noise.calibration, white[:, calibrated:multiplied]
        synthetic = noise.multiplied, white[:, multiplied:].reshape(samples)
        kept = synthetic[0][..., 0], synthetic[1][..., 0]
        if len(self.noise.multiplied):
            std = np.sqrt(np.diag(own))[:, None]
            plain, whitened = calibration[0] / std, calibration[1]
            residuals = self._residual(rows / std, plain), self._residual(white, whitened)
            plain, left = self._plain_shares.taken_off(plain, synthetic[0] / std[:, None], residuals[0])
            whitened, white_left = self._shares.taken_off(whitened, synthetic[1], residuals[1])
            calibration, kept = (std * plain, whitened), (std * left, white_left)
        return WhitenedWindow(white[:, :width], white[:, width:calibrated], calibration, kept, of_noise, own)

    def refer(self, joint: Array) -> None:
        """Take the newest estimate of nuisances, beside those that samples are corrected by, and of β (m + n,)."""
        self.state.reference = joint

    def _residual(self, rows: Array, N: Array) -> Array:
        """What rows [Y b …] (n_v, ·) leave with the newest estimate."""
        nuisances, beta = np.split(self.state.reference, [N.shape[1]])
        return np.asarray(rows[:, beta.size] - rows[:, : beta.size] @ beta - N @ nuisances)
