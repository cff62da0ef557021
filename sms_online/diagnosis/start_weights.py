"""Weights that the rows of a diagnosis begin with: the noise of most rows goes with the parameters."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

from sms_online.diagnosis.candidate import Candidate
from sms_online.diagnosis.evidence import least_squares, together
from sms_online.diagnosis.residuals import ResidualTest
from sms_online.diagnosis.rows import SessionRows
from sms_online.diagnosis.scale_free import NEAR
from sms_online.pipeline.description import LOOSE, described
from sms_online.stream import Array
from sms_online.trackers.interface import Prior

# Times that all candidates are fitted together for the first weights of the rows: without weights, then with those.
STARTS = 2
# Rows for a column at least, for all candidates to be fitted together.
LEAST_ROWS = 4
# Parameters with which a coordinate's rows without a torque are smaller than this share of what the described values
# make of them, or as much larger, give no weights: rows that hold more than noise have drawn them there.
SHRUNK = 0.1
# Weights are the same where the size of the rows' terms changes by less than this share.
SAME_WEIGHTS = 0.1


def first_weights(
    rows: SessionRows, candidates: Sequence[Candidate], prior: Prior | None, estimated: Array | None
) -> None:
    """Whiten the rows with parameters that explain them: of the session, of the model alone, or of a joint fit.

    estimated (n,): of the session of this model, if there are any: noise has attenuated them less than a first fit.
    candidates: the model is fitted with them where neither leaves no more than noise.
    Weights of a model that lacks a large force are no start: most rows are homogeneous in π, and where it cannot
    explain them it shrinks π, with π their noise, and with that their weight grows without end. Beside all candidates
    π shrinks as well where rows are noisy, and what is noise exceeds the noise of that π.
    """
    if estimated is not None:
        rows.reweight(estimated)
        if _at_noise(rows):
            return
    _weigh(rows, rows.Y, prior)
    if _at_noise(rows):
        return
    columns = np.concatenate([rows.Y, *(candidate.columns for candidate in candidates)], axis=2)
    if candidates and LEAST_ROWS * columns.shape[2] <= rows.b.size:
        _weigh(rows, columns, prior)


def _at_noise(rows: SessionRows) -> bool:
    """Whether the parameters that rows are whitened with leave no more than noise, beside what is calibrated."""
    left, calibrated = (rows.b - rows.Y @ rows.beta) / rows.std, rows.calibrated
    if calibrated.count:
        columns = (calibrated.columns / rows.std[..., None]).reshape(left.size, -1)
        known = calibrated.information(np.zeros(calibrated.count, dtype=np.bool_))
        both = np.concatenate((columns, known))
        nuisances = least_squares(both, np.concatenate((left.ravel(), np.zeros(calibrated.count))))
        left = left - (columns @ nuisances).reshape(left.shape)
    return not any(row.beyond for row in ResidualTest(rows).of(left).values())


def _weigh(rows: SessionRows, columns: Array, prior: Prior | None) -> None:
    """Whiten the rows with parameters of a fit of columns to them, or with the described ones where these cannot be.

    Parameters that the prior keeps would hide that the rows have drawn the others to zero.
    """
    value, size = described(rows.model, rows.base)
    std = np.ones_like(rows.b)
    for _ in range(STARTS):
        alone, beta = _beside_candidates(columns / std[..., None], rows.b / std, prior, value, size)
        rows.reweight(beta)
        std = rows.std
    if not (_likely(rows, alone) and _likely(rows, beta)):
        rows.reweight(value)


def _beside_candidates(columns: Array, b: Array, prior: Prior | None, value: Array, size: Array) -> tuple[Array, Array]:
    """Parameters (n,) of a joint fit of columns (W, n_v, n + c) to b (W, n_v), by the rows alone and as weights.

    A candidate may act as a parameter does: friction by direction as viscous friction. Their coefficients then cancel
    each other at any size, but noise is propagated by the parameters alone. So weights have the loose prior of those of
    a session (`pipeline.description`): value (n,), of deviation size, beside rows that are uncertain by what the fit
    leaves. What has no size, as an effect that is described without coefficients, stays near its value where the rows
    hardly determine it.
    """
    n = value.size
    R = np.asarray(np.linalg.qr(np.column_stack((columns.reshape(b.size, -1), b.ravel())), mode="r"))
    left = abs(float(R[-1, -1])) / np.sqrt(b.size)
    loose = np.divide(left, LOOSE * size, out=np.zeros(n), where=size > 0.0)
    lengths = np.hypot(loose, NEAR * np.linalg.norm(R[:, :n], axis=0))
    known = np.zeros((n, R.shape[1]))
    known[:, :n], known[:, -1] = np.diag(lengths), lengths * value
    alone, beta = (together(each[:, None, :-1], each[:, -1:], prior)[:n] for each in (R, np.concatenate((R, known))))
    return alone, beta


def same_weights(rows: SessionRows, beta: Array) -> bool:
    """Whether beta (n,) would give the rows the weights that they have: noise goes with the size of their terms."""
    now, then = _sizes(rows, rows.beta), _sizes(rows, beta)
    return bool(np.all(np.abs(then - now) <= SAME_WEIGHTS * now))


def reweight(rows: SessionRows, beta: Array) -> None:
    """Whiten the rows with parameters beta (n,), or with the described ones where these cannot be."""
    rows.reweight(beta if _likely(rows, beta) else rows.base.values(rows.model.nominal))


def _likely(rows: SessionRows, beta: Array) -> bool:
    """Whether rows without a torque have not drawn parameters beta (n,) to another scale."""
    sizes, expected = (
        _sizes(rows, each)[~np.any(rows.b, axis=0)] for each in (beta, rows.base.values(rows.model.nominal))
    )
    return bool(np.all((expected == 0.0) | ((sizes >= SHRUNK * expected) & (SHRUNK * sizes <= expected))))


def _sizes(rows: SessionRows, beta: Array) -> Array:
    """Size (n_v,) of the terms of each speed's rows with parameters beta (n,)."""
    return np.asarray(np.linalg.norm(rows.Y * beta, axis=(0, 2)))
