"""What a session shows of an effect found, apart from its law: the force over what it depends on, and rows beside it.

Both are drawn for a person to judge the law by. Sources: force: partial residuals, Larsen and McCleary, Technometrics
14 (1972) 781, here of weak-form rows; rows: added-variable plots, Cook and Weisberg, Residuals and Influence in
Regression, 1982, section 2.3.2.
"""

from __future__ import annotations

from dataclasses import dataclass
from itertools import pairwise

import numpy as np

from sms_online.description.schema import Effect
from sms_online.description.tree import index_of
from sms_online.diagnosis.attempt import Attempt
from sms_online.diagnosis.candidate import Candidate
from sms_online.diagnosis.evidence import basis, free_of, gain
from sms_online.diagnosis.search import Search
from sms_online.diagnosis.splines import DEGREE, Variable, design, spline_columns
from sms_online.diagnosis.weak_windows import SeenMotion
from sms_online.effects.base import deflection, position
from sms_online.effects.build import build_model
from sms_online.effects.catalogue import periods
from sms_online.effects.traits import Curve
from sms_online.model.effect import Inputs
from sms_online.stream import Array

# Inner knots of a spline to each side of zero, where friction jumps and axes stick: shares of the time that the motion
# spends between zero and them.
KNOTS = (0.05, 0.25, 0.5, 0.75)
# Points of a curve to each side of zero.
POINTS = 60
# Groups of rows in an added-variable plot; rows with less than this share of the largest expectation say nothing.
BINS = 24
LEAST_EXPECTED = 0.01


@dataclass(frozen=True)
class ForceCurve:
    """Force that the model lacks at one joint, N m (N), over what it depends on.

    where: joint. variable, unit: of `at` (P,). effects: whose law it is. force, std (P,): a spline fitted to the rows
    in the place of the law, with everything else as found; NaN at zero where it may jump. law (P,): of the effects.
    """

    where: str
    variable: str
    unit: str
    force_unit: str
    effects: tuple[Effect, ...]
    at: Array
    force: Array
    std: Array
    law: Array


@dataclass(frozen=True)
class AddedVariable:
    """Rows of an effect, whitened and free of all else that the model holds, in groups of equal expectation.

    expected, left, std (B,): mean of what the effect adds, of what the model without it leaves, and its deviation.
    """

    effect: Effect
    expected: Array
    left: Array
    std: Array


def force_curves(diagnosis: Search) -> list[ForceCurve]:
    """Curves of the effects found that have a variable of their own; those of the same joint and variable share one."""
    attempt = diagnosis.attempt
    groups: dict[tuple[str, Curve, float | None], list[int]] = {}
    for k in diagnosis.chosen:
        candidate = attempt.tracing.candidates[k]
        if candidate.traits.curve is not None:
            key = candidate.effect.where, candidate.traits.curve, periods(candidate.effect)
            groups.setdefault(key, []).append(k)
    return [_curve(diagnosis, where, curve, order, own) for (where, curve, order), own in groups.items()]


def _curve(diagnosis: Search, where: str, curve: Curve, order: float | None, own: list[int]) -> ForceCurve:
    name, jumps = curve.over, curve.over == "motor speed"
    attempt, after = diagnosis.attempt, diagnosis.after
    rows, candidates = attempt.rows, attempt.tracing.candidates
    layout, i = rows.model.layout, index_of(where)
    effects = tuple(candidates[k].effect for k in own)
    direction = np.eye(layout.n_v)[layout.theta_m[i]]
    if curve.between:
        direction[layout.q[i]] = -1.0
    variable = _variable(attempt, i, name, 1.0 if order is None else order)
    # What is left once everything else has been subtracted.
    left = after.residual * attempt.tracing.std
    for k in own:
        left = left + candidates[k].columns @ _coefficients(diagnosis, k)
    values = np.concatenate([variable(motion) for motion, _ in rows.weak.motions()])
    knots, at = _knots(values, jumps)
    white = rows.white(spline_columns(rows, variable, knots, direction, dense=True))
    found = gain(np.empty((len(white), 0)), rows.white(left[..., None])[:, 0], white)
    B = design(at, knots)
    std = np.sqrt(np.einsum("pi,ij,pj->p", B, found.covariance, B))
    force, law = B @ found.coefficients, _law(diagnosis, own, variable, at)
    if jumps:
        for part in (force, std, law):
            part[at == 0.0] = np.nan
    prismatic = rows.model.system.joints[i].kind == "prismatic"
    angle, force_unit = ("m", "N") if prismatic else ("rad", "N m")
    unit = {"motor speed": f"{angle}/s", "deflection": angle, "torque": force_unit}.get(name, "rad")
    return ForceCurve(where, name, unit, force_unit, effects, at, force, std, law)


def _variable(attempt: Attempt, i: int, name: str, order: float) -> Variable:
    """A variable of joint i (from 0); order: periods of a phase in a motor turn."""
    model = attempt.rows.model
    layout, gear = model.layout, model.system.joints[i].gear_ratio
    motor = layout.theta_m[i]

    def values(motion: SeenMotion) -> Array:
        match name:
            case "motor speed":
                return motion.v[:, motor]
            case "deflection":
                return deflection(layout, motion.x, i)
            case "motor angle":
                return position(layout, motion.x, motor)
            case "torque":
                return motion.torque[:, i]
        return np.mod(order * gear * position(layout, motion.x, motor), 2.0 * np.pi)

    return values


def _knots(values: Array, jumps: bool) -> tuple[Array, Array]:
    """Knots of a spline over values, which may jump at zero, and points (P,) to draw it at."""
    low, high = float(values.min()), float(values.max())
    ends = [low, 0.0, high] if low < 0.0 < high else [low, high]
    knots, points = [np.full(DEGREE, low)], []
    for start, end in pairwise(ends):
        inside = values[(values >= start) & (values <= end)]
        shares = np.array(KNOTS) if start >= 0.0 else 1.0 - np.array(KNOTS[::-1])
        starts = np.full(DEGREE + 1 if jumps and start == 0.0 else 1, start)
        knots += [starts, np.quantile(inside, shares)]
        points.append(np.linspace(start, end, POINTS))
    return np.concatenate([*knots, np.full(DEGREE + 1, high)]), np.unique(np.concatenate(points))


def _law(diagnosis: Search, own: list[int], variable: Variable, at: Array) -> Array:
    """Force (P,) of the effects at values of their variable, from where the session came nearest to them."""
    attempt = diagnosis.attempt
    layout = attempt.rows.model.layout
    # A search that was ended has no session with what it found.
    forces = {(force.name, force.where): force for force in build_model(diagnosis.after.system).effects}
    values, law = [], []
    for motion, _ in attempt.rows.weak.motions():
        total = np.zeros(len(motion.x))
        for k in own:
            effect = attempt.tracing.candidates[k].effect
            force = forces[effect.name, effect.where]
            inputs = Inputs(motion.torque, np.zeros((len(motion.x), 0)))
            columns = force.force(layout, motion.x, motion.v, inputs)
            speed = layout.theta_m[index_of(effect.where)]
            total += columns[:, speed] @ _coefficients(diagnosis, k)
        values.append(variable(motion))
        law.append(total)
    seen, first = np.unique(np.concatenate(values), return_index=True)
    return np.interp(at, seen, np.concatenate(law)[first])


def _coefficients(diagnosis: Search, k: int) -> Array:
    """Coefficients (c,) of one of the candidates chosen."""
    attempt = diagnosis.attempt
    before = [*attempt.fixed, *(attempt.tracing.candidates[j] for j in diagnosis.chosen[: diagnosis.chosen.index(k)])]
    start = attempt.rows.base.n + sum(len(candidate.parameters) for candidate in before)
    return diagnosis.after.solution[start : start + len(attempt.tracing.candidates[k].parameters)]


def added_variables(diagnosis: Search) -> list[AddedVariable]:
    """Rows of the effects found that have no curve, where they are more than a combination of the model's own."""
    attempt, described = diagnosis.attempt, diagnosis.described
    chosen = [attempt.tracing.candidates[k] for k in diagnosis.chosen]
    out = []
    for finding in diagnosis.findings:
        candidate = finding.candidate
        if candidate.constant:
            # It has been taken off the samples of the last attempt.
            own = described.make.of(candidate.effect.model_copy(update={"coefficients": {}}))
            out.append(_added_variable(described, [described.make.of(each.effect) for each in chosen], own))
        elif candidate.traits.curve is None:
            others = [*attempt.fixed, *(other for other in chosen if other is not candidate)]
            out.append(_added_variable(attempt, others, candidate))
    return [added for added in out if added.expected.size]


def _added_variable(attempt: Attempt, others: list[Candidate], own: Candidate) -> AddedVariable:
    rows = attempt.rows
    Q = basis(rows.white(np.concatenate([rows.Y, *(other.columns for other in others)], axis=2)))
    r = free_of(Q, rows.white(rows.b[..., None]))[:, 0]
    columns = rows.white(own.columns)
    expected = free_of(Q, columns) @ gain(Q, r, columns).coefficients
    acts = np.flatnonzero(np.abs(expected) > LEAST_EXPECTED * np.abs(expected).max(initial=0.0))
    order = acts[np.argsort(expected[acts], kind="stable")]
    groups = [group for group in np.array_split(order, BINS) if group.size > 1]
    left = [r[group] for group in groups]
    return AddedVariable(
        effect=own.effect,
        expected=np.array([expected[group].mean() for group in groups]),
        left=np.array([each.mean() for each in left]),
        std=np.array([each.std(ddof=1) / np.sqrt(each.size) for each in left]),
    )
