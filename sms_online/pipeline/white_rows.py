"""Rows of the momentum balance whose errors are independent and of unit variance."""

from __future__ import annotations

from dataclasses import dataclass

from sms_online.pipeline.drift_line import DriftLine
from sms_online.stream import Array


@dataclass(frozen=True)
class WhiteRows:
    """Rows of one window, n_v of them: Y (n_v, m + n + 1), [N Y b], independent, errors of unit variance.

    N holds the columns of what the description may be wrong in, see `calibration`. noisy (2, n_v, m + n + 1): the same
    with synthetic noise added and subtracted, but in N. raw (n_v, m + n + 1): the rows as they were,
    with their own covariance (n_v, n_v), of which noise is the part that the sensors make. end: grid index of the
    window's last sample. late (n_v, G): columns of the sources' latencies, independent like Y. misfit (n_v,): what the
    model lacks in each row, over the variance of its noise, as far as it is in the covariance. weights (n,): β behind
    the covariance. moves: whether the arm does in the window. ramp (n_v, n): columns of the parameters' rates about the
    window's centre, independent like Y; none where nobody asked. multiplied (n_v, ·): a sample of the noise that
    nuisances multiply, independent like Y. drift: the known drift there, of which b is free.
    """

    Y: Array
    noisy: Array
    raw: Array
    covariance: Array
    noise: Array
    end: int
    late: Array
    misfit: Array
    weights: Array
    moves: bool
    ramp: Array
    multiplied: Array
    drift: DriftLine | None = None
