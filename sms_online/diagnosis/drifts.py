"""Parameters that drift, as a hypothesis for what a capture holds: every one of them, by a tracker that learns drifts.

A drift is no force, so it is compared with the effects as a whole: a session with the same description whose judged
tracker learns drifts. Each parameter is tried there, and a body's inertial ones together, from all starts: a ramp must
explain more than chance, more than any step, and more than a ramp of another. Where the session that follows what it
has found leaves no more than noise, and no event, nothing else is missing; a lack of the model leaves more, whatever
ramps it is taken for, and is searched among the effects.
"""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

from sms_online.description.schema import LEARNED, System
from sms_online.diagnosis.evidence import least_squares
from sms_online.diagnosis.weak_rows import WeakRows
from sms_online.pipeline.estimator import Estimator
from sms_online.tables import formatter
from sms_online.tracker_results import Drift
from sms_online.verdict.judged import evaluated
from sms_online.verdict.reasons import FOLLOW
from sms_online.verdict.trust import Reason, Trust

# Instants between which parameters go along lines, and rows for a column at least, to see whether that may be all.
KNOTS, LEAST_ROWS = 4, 2
# Mean square, over the noise's, and share of what parameters that stay leave, beyond which it is not.
MUCH_MORE, LEFT = 10.0, 0.1


def following(system: System) -> System:
    """The system with a judged tracker that learns drifts."""
    return system.model_copy(update={"trackers": (LEARNED,)})


def leaves_unexplained(session: Estimator) -> bool:
    """Whether a session shows more than noise that no change of parameters explains."""
    momentum = session.momentum
    return momentum is not None and session.by_momentum and (momentum.test.alarm is not None or momentum.misfit)


def leaves_more(session: Estimator) -> bool:
    """Whether a session whose parameters stay shows more than noise, a change of parameters, or one that may be."""
    momentum = session.momentum
    if momentum is None or not session.by_momentum:
        return False
    return leaves_unexplained(session) or bool(session.events) or bool(momentum.bank.suspected)


def may_explain(rows: WeakRows) -> bool:
    """Whether drifts may be all that the model lacks: rows of parameters that all go along lines leave hardly more.

    Lines between KNOTS instants follow any drift roughly, so that most of what it leaves is gone. Where they leave much
    of it, no session that learns drifts needs to be run. Rows too few for that say nothing, and drifts may.
    """
    hats = np.maximum(0.0, 1.0 - np.abs(np.linspace(0.0, KNOTS - 1.0, rows.count)[:, None] - np.arange(KNOTS)))
    Y, b = rows.Y / rows.std[..., None], (rows.b / rows.std).ravel()
    lines = (Y[..., None] * hats[:, None, None, :]).reshape(b.size, -1)
    if LEAST_ROWS * lines.shape[1] > b.size:
        return True
    stays, goes = (
        float(np.sum((b - columns @ least_squares(columns, b)) ** 2)) / (b.size - columns.shape[1])
        for columns in (Y.reshape(b.size, -1), lines)
    )
    return goes <= max(MUCH_MORE, LEFT * stays)


def explained_by_drifts(session: Estimator) -> tuple[Drift, ...]:
    """The drifts that a session follows; none where its rows hold more than those and noise."""
    if session.momentum is None or not session.by_momentum or session.events:
        return ()
    (judged, *_) = evaluated(session).trackers
    nis = judged.consistency
    if session.momentum.test.alarm is not None or session.momentum.misfit or nis.nis is None or nis.nis > nis.upper:
        return ()
    return judged.drifts


def sentence(drift: Drift) -> str:
    """A drift in words: parameter, since when, rate and value now."""
    value = formatter(drift.value, drift.value_std)(drift.value)
    return (
        f"{drift.parameter} drifts since {drift.since:.1f} s by {drift.rate:.4g} ± {drift.std:.2g} {drift.unit} per s, "
        f"and is {value} ± {drift.value_std:.2g} {drift.unit} at the end"
    )


def summary_of(drifts: Sequence[Drift]) -> str:
    """What a capture with these drifts holds, in a sentence."""
    each = "; ".join(map(sentence, drifts))
    return f"{each[:1].upper()}{each[1:]}. With that followed the residual is noise."


def trust_with(drifts: Sequence[Drift], after: Trust) -> Trust:
    """The judgement of a capture whose drifts the tracker of the description does not follow.

    after: of the session that follows them.
    """
    names = ", ".join(drift.parameter for drift in drifts)
    more = ", except as listed below" if after.level == "doubt" else ""
    trusted = (
        "" if after.grave or after.level == "not yet" else f"; with one that does the parameters are trusted{more}"
    )
    text = f"the system file's tracker does not follow {names}{trusted}"
    places = tuple(dict.fromkeys(drift.parameter.split(".")[0] for drift in drifts))
    found = Reason(text, after.grave, places, "drifts", then=FOLLOW)
    return Trust("doubt", (found, *(after.grounds if after.level != "trust" else ())), grave=after.grave)
