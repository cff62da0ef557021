"""Sessions of one rig compared: what the parameters agree on, how far they scatter from run to run, what has changed.

Error bars hold what the calibration leaves unknown, which sessions of one rig share: they scatter by less. On a real
rig they may also scatter by more, for nothing repeats exactly. So a change is judged against the spread from run to
run where there are three sessions or more. Few sessions determine it badly; its variance is moderated by that of the
error bars, in the proportion that all parameters together show. Sources: Smyth, Linear models and empirical Bayes
methods, Stat. Appl. Genet. Mol. Biol. 3 (2004), for the moderated t; Rousseeuw, Least median of squares regression,
JASA 79 (1984), for the shortest half, which is where a majority of sessions agrees whatever the others do.
"""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
from scipy.stats import chi2, norm, t

from sms_online.errors import InputError
from sms_online.stream import Array, Indices, Mask
from sms_online.tables import Tabled, finite, formatter

SCHEMA = "sms-online/comparison/1"
# Chance that a comparison without any change marks one, all its sessions and parameters together.
FALSE_ALARM = 0.01
# Weight of the error bars in the variance from run to run, as so many sessions more.
BAR_SESSIONS = 4
# From so many sessions on there is a spread from run to run.
LEAST_SESSIONS = 3
# Lengths of halves that differ by less than this factor differ by chance.
ABOUT_AS_CLOSE = 2.0
# A reference is zero for all that sessions show where it is below this multiple of what they scatter by.
KNOWN = 3.0
# Standard deviation of the middle half of a Gaussian, of the whole one's.
MIDDLE_HALF = math.sqrt(1.0 - 4.0 * norm.ppf(0.75) * norm.pdf(norm.ppf(0.75)))


@dataclass(frozen=True)
class Change:
    """A session in which a parameter is not what it is in the reference sessions.

    session: its name. size: of the change, in the parameter's unit. deviations: the same in standard deviations of such
    a difference. limit: what these may reach by chance.
    """

    session: str
    size: float
    deviations: float
    limit: float


@dataclass(frozen=True)
class Compared:
    """A parameter, or a number of the calibration, over sessions.

    values, stds (sessions,): NaN where a session does not determine it. reference: mean of the sessions that agree,
    NaN where none determines it. spread: standard deviation from run to run, moderated; None below three sessions.
    changes: in the order of the sessions.
    """

    name: str
    symbol: str
    unit: str
    values: Array
    stds: Array
    reference: float
    spread: float | None
    changes: tuple[Change, ...]

    @property
    def size(self) -> float:
        """What sessions scatter by: the spread, or with two of them the error bars."""
        return self.spread or float(np.nanmedian(self.stds))

    @property
    def relative(self) -> bool:
        """Whether deviations are read in per cent of the reference: where it is known not to be zero."""
        return abs(self.reference) > KNOWN * self.size


@dataclass(frozen=True, repr=False)
class Comparison(Tabled):
    """Sessions of one rig, compared. sessions: their names. parameters, calibration: by name."""

    system: str
    sessions: tuple[str, ...]
    parameters: Mapping[str, Compared]
    calibration: Mapping[str, Compared]

    @property
    def changed(self) -> tuple[str, ...]:
        """Sessions with a significant change."""
        marked = {c.session for each in self.parameters.values() for c in each.changes}
        return tuple(session for session in self.sessions if session in marked)

    @property
    def sentence(self) -> str:
        """What has changed, in a sentence."""
        if not self.changed:
            return f"No significant change in {len(self.sessions)} sessions."
        names = [name for name, each in self.parameters.items() if each.changes]
        return f"Changed in {', '.join(self.changed)}: {', '.join(names)}."

    def rows(self) -> tuple[list[str], list[list[str]]]:
        """Headings, and a row of cells for each parameter that some session determines."""
        headings = ["parameter", "unit", "reference", "spread %", "changed sessions"]
        rows = []
        for each in self.parameters.values():
            if not math.isfinite(each.reference):
                continue
            spread = f"{100.0 * each.spread / abs(each.reference):.2g}" if each.spread and each.relative else ""
            changes = ", ".join(f"{c.session} {change_text(c, each)}" for c in each.changes)
            rows.append([each.name, each.unit, formatter(each.reference, each.size)(each.reference), spread, changes])
        return headings, rows

    def document(self) -> dict[str, Any]:
        """The same as plain lists, dictionaries and numbers."""
        return {
            "schema": SCHEMA,
            "system": self.system,
            "summary": self.sentence,
            "sessions": list(self.sessions),
            "changed": list(self.changed),
            "parameters": [_document(each) for each in self.parameters.values()],
            "calibration": [_document(each) for each in self.calibration.values()],
        }


def change_text(change: Change, compared: Compared) -> str:
    """Size of a change in per cent of the reference, in its unit where that may be zero."""
    if not compared.relative:
        return f"{change.size:+.2g} {compared.unit}".rstrip()
    return f"{100.0 * change.size / abs(compared.reference):+.2g} %"


def _document(each: Compared) -> dict[str, Any]:
    return {
        "name": each.name,
        "symbol": each.symbol,
        "unit": each.unit,
        "reference": finite(each.reference),
        "spread": each.spread,
        "estimates": [finite(value) for value in each.values.tolist()],
        "stds": [finite(std) for std in each.stds.tolist()],
        "changes": [vars(change) for change in each.changes],
    }


def compare_documents(documents: Mapping[str, Mapping[str, Any]]) -> Comparison:
    """Compare sessions of one rig: results.json of each, by the name of the session, in their order.

    InputError where there are fewer than two, or where they are of different systems.
    """
    sessions = tuple(documents)
    if len(sessions) < 2:
        raise InputError("compare", "", f"{len(sessions)} sessions", "two at least")
    systems = {name: str(document["system"]["name"]) for name, document in documents.items()}
    first = systems[sessions[0]]
    for name, system in systems.items():
        if system != first:
            raise InputError(name, "system", repr(system), f"{first!r}, that of {sessions[0]}")
    parameters = _tables(sessions, [_parameters(document) for document in documents.values()])
    calibration = _tables(sessions, [_calibration(document) for document in documents.values()])
    return Comparison(first, sessions, parameters, calibration)


# Name, symbol, unit, estimate and standard deviation.
_Number = tuple[str, str, str, float, float]


def _parameters(document: Mapping[str, Any]) -> list[_Number]:
    return [
        (p["name"], p["symbol"], p["unit"], p["estimate"], p["std"])
        if p["identifiable"]
        else (p["name"], p["symbol"], p["unit"], math.nan, math.nan)
        for p in document["parameters"]
    ]


def _calibration(document: Mapping[str, Any]) -> list[_Number]:
    return [
        (" ".join(filter(None, (c["name"], c["where"], c["part"]))), "", c["unit"], c["estimate"], c["std"])
        for c in document.get("calibration", [])
    ]


def _tables(sessions: Sequence[str], numbers: Sequence[Sequence[_Number]]) -> dict[str, Compared]:
    """Each number over the sessions, by name, in the order in which they come first."""
    known = {name: (symbol, unit) for session in numbers for name, symbol, unit, *_ in session}
    values, stds = np.full((2, len(known), len(sessions)), np.nan)
    places = {name: k for k, name in enumerate(known)}
    for i, session in enumerate(numbers):
        for name, _, _, value, std in session:
            values[places[name], i], stds[places[name], i] = value, std
    judged = judge_changes(values, stds)
    out = {}
    for k, (name, (symbol, unit)) in enumerate(known.items()):
        off = np.flatnonzero(judged.changed[k]).tolist()
        changes = tuple(
            Change(
                sessions[i],
                float(values[k, i] - judged.reference[k]),
                float(judged.deviations[k, i]),
                float(judged.limit[k]),
            )
            for i in off
        )
        spread = finite(float(judged.spread[k]))
        own = (values[k], stds[k], float(judged.reference[k]), spread, changes)
        out[name] = Compared(name, symbol, unit, *own)
    return out


@dataclass(frozen=True)
class Judged:
    """reference, spread, limit (n,); changed, deviations (n, N) of n numbers in N sessions."""

    reference: Array
    spread: Array
    limit: Array
    changed: Mask
    deviations: Array


def judge_changes(values: Array, stds: Array) -> Judged:
    """Which of n numbers differ in which of N sessions from what the majority agrees on.

    values, stds (n, N): estimates and their error bars, NaN where there is none.
    """
    (n, N), known = values.shape, np.isfinite(values) & np.isfinite(stds)
    alpha = FALSE_ALARM / max(1, int(np.count_nonzero(known)))
    agreeing = np.zeros((n, N), dtype=np.bool_)
    for own, row in zip(agreeing, np.where(known, values, np.nan), strict=True):
        own[_shortest_half(row)] = True
    # The shortest half scatters by less than all that agree.
    selection = np.full(n, MIDDLE_HALF)
    while True:
        judged = _against(values, stds, known, agreeing, selection, alpha)
        grown = known & ~judged.changed
        # Who agrees once stays, so that this ends.
        grown |= agreeing
        if (grown == agreeing).all():
            return judged
        selection = np.where((grown == agreeing).all(axis=1), selection, 1.0)
        agreeing = grown


def _shortest_half(values: Array) -> Indices:
    """The half of the known values, rounded up, that lies closest together.

    Where the other half lies about as close and is earlier, it is that: the reference is the rig before a change.
    """
    order = np.argsort(values, kind="stable")[: np.count_nonzero(np.isfinite(values))]
    half = (order.size + 1) // 2
    if not half:
        return order
    lengths = values[order[half - 1 :]] - values[order[: order.size - half + 1]]
    shortest, other = order[lengths.argmin() :][:half], order[(0 if lengths.argmin() else -half) :][:half]
    as_close = np.ptp(values[other]) <= ABOUT_AS_CLOSE * lengths.min() and not set(other) & set(shortest)
    return other if as_close and other.sum() < shortest.sum() else shortest


def _against(
    values: Array,
    stds: Array,
    known: Mask,
    agreeing: Mask,
    selection: Array,
    alpha: float,
) -> Judged:
    """All sessions against the mean of those that agree."""
    count = agreeing.sum(axis=1)
    some = np.maximum(count, 1)
    reference = np.where(count > 0, np.where(agreeing, values, 0.0).sum(axis=1) / some, np.nan)
    bar = np.where(agreeing, stds**2, 0.0).sum(axis=1) / some
    if values.shape[1] < LEAST_SESSIONS:
        variance, freedom, spread = bar, np.full(count.shape, np.inf), np.full(count.shape, np.nan)
    else:
        own = np.maximum(count - 1, 0)
        squares = np.where(agreeing, (values - reference[:, None]) ** 2, 0.0).sum(axis=1) / selection**2
        ratio = squares[own > 0] / (bar * chi2.median(np.maximum(own, 1)))[own > 0]
        common = float(np.median(ratio)) if ratio.size else 1.0
        freedom = own + BAR_SESSIONS
        variance = (squares + BAR_SESSIONS * common * bar) / freedom
        spread = np.sqrt(variance)
    with np.errstate(invalid="ignore", divide="ignore"):
        # A session of wider error bars than those that agree scatters by as much more.
        single = variance[:, None] * np.maximum(1.0, stds**2 / bar[:, None])
        deviations = (values - reference[:, None]) / np.sqrt(single + (variance / some)[:, None])
        limit = np.asarray(t.ppf(1.0 - 0.5 * alpha, freedom))
        changed = known & ~agreeing & (np.abs(deviations) > limit[:, None])
    return Judged(reference, spread, limit, changed, deviations)
