"""Blind cases of the diagnosis: sessions of the planar example with an effect that its description lacks.

    python -m tests.campaigns.blind run RESULTS.jsonl --seeds 4
    python -m tests.campaigns.blind struck RESULTS.jsonl --seeds 4
    python -m tests.campaigns.blind pairs RESULTS.jsonl --seeds 20
    python -m tests.campaigns.blind clean RESULTS.jsonl --seeds 100
    python -m tests.campaigns.blind cameras RESULTS.jsonl --seeds 1
    python -m tests.campaigns.blind summary RESULTS.jsonl

Place, size and shape constants of each effect are drawn by the seed: it is worth 2 to 20 % of the rms of the rows that
it acts on, or of their peaks. The diagnosis sees a capture with noise of grade B and a description with other nominal
values; what was drawn is compared afterwards. `struck` diagnoses the cases with the true effect, and those whose
columns are within 10° of it, struck out of the catalogue; in those of `pairs` two effects act at once; in those of
`cameras` forces and payloads act on an arm whose links are seen as points. Simulated
motions are kept, so that another search can be tried on them. Every case is a line of RESULTS.jsonl; a stopped campaign
goes on where it was.
"""

from __future__ import annotations

import argparse
from collections.abc import Iterator
from itertools import product
from pathlib import Path
from time import process_time
from unittest.mock import patch

import numpy as np

import sms_online as sms
from sms_adapters.system_file import load_system
from sms_online.description.schema import Effect, System, Tolerances
from sms_online.diagnosis.candidates import CandidateColumns
from sms_online.diagnosis.diagnose import diagnose
from sms_online.diagnosis.evidence import basis, free_of
from sms_online.diagnosis.posterior import coefficients
from sms_online.diagnosis.search import Search
from sms_online.effects.build import build_model
from sms_online.effects.catalogue import ENTRIES, candidates
from sms_online.effects.spacecraft import TableTilt
from sms_online.evaluation import Evaluation
from sms_online.model.base_parameters import find_base_parameters
from sms_online.pipeline.estimator import Estimator
from sms_online.pipeline.snapshot import statistics_of
from sms_online.stream import Array, Block
from sms_tools.archive.runner import Work
from tests.camera_rig import seen_by_cameras
from tests.campaigns.accuracy import flagged
from tests.campaigns.blind_draws import CLEAN, GRADE, SYSTEM, TOLERANCE, drawn
from tests.campaigns.results import Record, absolute, campaign, complete, summed
from tests.campaigns.sessions import SLIGHT, disguised, exact_session, noisy_session, true_parameters
from tests.sessions_of import session_of

# Effects with a place on the planar example, and one form there.
_POSSIBLE = {effect.name for effect in candidates(load_system(SYSTEM))}
PLANAR = [name for name, entry in ENTRIES.items() if name in _POSSIBLE and entry.forms is None]
# Columns nearer than this, rad, are ambiguous.
SAME_ANGLE = np.deg2rad(10.0)

# Asked of the residual on held-out data, over what noise alone leaves.
MOST_OVER_FLOOR = 1.2
# A session of 20 s that leaves more than this multiple of the predicted noise leaves more than noise.
MOST_IN_A_SESSION = 1.25
# Asked of the median error of every parameter, over that of sessions whose description declares the effect.
MOST_OVER_DECLARED = 1.5


def singles(args: argparse.Namespace, kind: str, work: Work) -> None:
    """Append the cases of one effect that the results lack, seed by seed."""
    drawn(args.cache)
    names = [name for name in args.names if kind == "single" or ENTRIES[name].kind != "kinematics"]
    wanted = product(range(args.seeds), names)
    complete(args, work, [({"kind": kind, "seed": k, "name": name}, (args.cache, name, k)) for k, name in wanted])


def pairs(args: argparse.Namespace) -> None:
    """Append sessions with two effects of different names, one pair for each seed."""
    drawn(args.cache)
    names = [name for name in args.names if ENTRIES[name].kind != "kinematics"]
    complete(args, one_pair, [({"kind": "pair", "seed": k}, (args.cache, names, k)) for k in range(args.seeds)])


def one_pair(folder: Path, names: list[str], seed: int) -> Record:
    """The diagnosis of a session with two effects."""
    draw, rng = drawn(folder), np.random.default_rng([seed, 2])
    effects = tuple(draw.effect(str(name), seed) for name in rng.choice(names, 2, replace=False))
    return {
        "name": "+".join(effect.name for effect in effects),
        "true": {effect.key: effect.coefficients for effect in effects},
        **_summary(diagnose(disguised(draw.system), [draw.session(effects, seed)], "case", lambda _: None)),
    }


def clean(args: argparse.Namespace) -> None:
    """Append clean sessions of all grades."""
    exact_session(load_system(SYSTEM), args.cache / CLEAN)
    wanted = product(range(args.seeds), ("A", "B", "C"))
    complete(args, one_clean, [({"kind": "clean", "name": g, "seed": k}, (args.cache, g, k)) for k, g in wanted])


def one_clean(folder: Path, grade: str, seed: int) -> Record:
    """The diagnosis of a session that nothing is missing in."""
    system = load_system(SYSTEM)
    block = noisy_session(system, exact_session(system, folder / CLEAN), grade, seed)
    return _summary(diagnose(disguised(system, factor=SLIGHT), [block], "case", lambda _: None))


def cameras(args: argparse.Namespace) -> None:
    """Append sessions of an arm that cameras see as points, with one force or payload, seed by seed."""
    drawn(args.cache)
    names = [name for name in args.names if ENTRIES[name].kind in ("force", "inertia")]
    wanted = product(range(args.seeds), names)
    tasks = [({"kind": "cameras", "seed": k, "name": name}, (args.cache, name, k)) for k, name in wanted]
    complete(args, one_by_cameras, tasks)


def one_by_cameras(folder: Path, name: str, seed: int) -> Record:
    """The diagnosis of a session with one effect, of which points and encoders tell; default tolerances."""
    system = seen_by_cameras(SYSTEM).model_copy(update={"tolerances": Tolerances()})
    effect = drawn(folder).effect(name, seed)
    acting = system.model_copy(update={"effects": (effect,)})
    exact = exact_session(acting, folder / f"cameras-{name}-{seed}.npz", TOLERANCE)
    start = process_time()
    found = sms.diagnose(disguised(system), noisy_session(system, exact, None, seed))
    first = found.effects[0] if found.effects else None
    return {
        "where": effect.where,
        "true": effect.coefficients,
        "verdict": found.verdict,
        "found": [each.effect for each in found.effects],
        "alike": [] if first is None else list(first.ambiguous_with),
        "reported": {
            each.effect: {n: (c.value, c.std) for n, c in each.coefficients.items()} for each in found.effects
        },
        "trust": str(found.trust),
        "seconds": process_time() - start,
    }


def _summary(found: Search) -> Record:
    return {"verdict": found.verdict, "found": _keys(found), "holdout": found.after.holdout.whitened}


def _keys(found: Search) -> list[str]:
    exact = [e for e in found.attempt.system.effects if e not in found.described.system.effects]
    return [effect.key for effect in exact] + [finding.candidate.key for finding in found.findings]


def one_single(folder: Path, name: str, seed: int) -> Record:
    """The diagnosis of a session with one effect, and sessions without and with what was found."""
    draw = drawn(folder)
    system, effect = draw.system, draw.effect(name, seed)
    block = draw.session((effect,), seed)
    start = process_time()
    found = diagnose(disguised(system), [block], "case", lambda _: None)
    seconds = process_time() - start
    reported = {
        finding.candidate.key: {name: value for name, (value, _) in coefficients(found, finding).items()}
        for finding in found.findings
    }
    return {
        "where": effect.where,
        "true": effect.coefficients,
        **_summary(found),
        "reported": reported,
        "ambiguous": {finding.candidate.key: list(finding.ambiguous) for finding in found.findings},
        "before": {row: test.whitened for row, test in found.before.test.items()},
        "after": {row: test.whitened for row, test in found.after.test.items()},
        "session": _left(found.estimator_after),
        "errors": _errors(system, found.estimator_after),
        "declared": _declared(system, block, effect),
        "seconds": seconds,
    }


def _declared(system: System, block: Block, effect: Effect) -> dict[str, float]:
    """Errors of the parameters where the effect is declared from the start; of none where it cannot be."""
    if effect.name == TableTilt.entry.name:
        return {}
    declared = session_of(disguised(system.model_copy(update={"effects": (effect,)})), [block])
    return _errors(system, declared)


def _left(session: Estimator) -> dict[str, float]:
    """What the rows of a session leave, over the noise predicted for them, by kind of row."""
    rows = Evaluation(statistics_of(session)).residuals
    return {name: row.whitened for name, row in rows.items() if row.whitened is not None}


def _errors(system: System, session: Estimator) -> dict[str, float]:
    """Relative errors of the parameters that the system has without effects."""
    names = [p.name for p in find_base_parameters(build_model(system)).parameters]
    truth = dict(zip(names, true_parameters(system), strict=True))
    estimated = zip(session.base.parameters, session.estimate().pi, strict=True)
    return {p.name: float(value / truth[p.name] - 1.0) for p, value in estimated if p.name in truth}


def angle(Q: Array, first: Array, second: Array) -> float:
    """Smallest principal angle, rad, of two candidates' columns (M, ·) beside the model with basis Q."""
    A, B = (basis(free_of(Q, columns)) for columns in (first, second))
    cosine = np.linalg.svd(A.T @ B, compute_uv=False)[0]
    return float(np.arccos(min(1.0, cosine)))


def one_struck(folder: Path, name: str, seed: int) -> Record:
    """The same without the true effect, and without those that say the same."""
    draw = drawn(folder)
    rows, effect = draw.rows, draw.effect(name, seed)
    block = draw.session((effect,), seed)
    Q = basis(rows.white(rows.Y))
    columns = {}
    for each in draw.make.effects():
        columns.setdefault(each.key, []).append(rows.white(draw.make.of(each).columns))
    key = effect.key
    own = columns.get(key, [])
    near = {
        other
        for other, forms in columns.items()
        if other == key
        or any(np.any(mine) and np.any(form) and angle(Q, mine, form) < SAME_ANGLE for mine in own for form in forms)
    }
    inner = CandidateColumns.effects

    def allowed(self: CandidateColumns, learned: bool = False) -> Iterator[Effect]:
        return (effect for effect in inner(self, learned) if effect.key not in near)

    with patch.object(CandidateColumns, "effects", allowed):
        found = diagnose(disguised(draw.system), [block], "case", lambda _: None)
    worst = max(found.before.test, key=lambda row: found.before.test[row].whitened)
    return {
        "where": effect.where,
        "struck": sorted(near),
        **_summary(found),
        "row": None if found.unexplained is None else found.unexplained.row,
        "worst": worst,
        "left": found.left,
        "before": {row: test.whitened for row, test in found.before.test.items()},
        "after": {row: test.whitened for row, test in found.after.test.items()},
    }


def summary(records: list[Record]) -> str:
    """Shares of cases named rightly, inside the ambiguity group, unexplained when struck, in pairs, and clean."""
    lines = []
    singles = [r for r in records if r["kind"] == "single"]
    right = group = 0
    ratios: dict[str, list[float]] = {}
    for r in singles:
        key = f"{r['name']}@{r['where']}"
        first = r["found"][:1] == [key]
        inside = first or any(key in r["ambiguous"].get(found, []) for found in r["found"][:1])
        right, group = right + first, group + inside
        for coefficient, value in r["reported"].get(key, {}).items():
            if r["true"].get(coefficient):
                ratios.setdefault(r["name"], []).append(abs(value / r["true"][coefficient] - 1.0))
        reported = r["reported"].get(key, {})
        lines.append(f"{'ok ' if first else 'grp' if inside else 'BAD'} {key:36} {r['true']} → {r['found']} {reported}")
    if singles:
        n = len(singles)
        lines.append(f"{n} single: right first {100 * right / n:.1f} %, inside the group {100 * group / n:.1f} %")
        medians = {name: round(float(np.median(values)), 4) for name, values in ratios.items()}
        lines.append(f"median relative error of coefficients: {medians}")
        held = [max(r["holdout"].values()) for r in singles]
        within = sum(times <= MOST_OVER_FLOOR for times in held)
        times = f"median {np.median(held):.2f}, worst {max(held):.2f} times predicted noise, {within} of {n} within"
        lines.append(f"held-out residual: {times} {MOST_OVER_FLOOR:g}")
        lines += _in_sessions(singles)
        lines += _over_floor(singles, [r for r in records if r["kind"] == "clean" and r["name"] == GRADE])
        lines.append(f"seconds: median {np.median([r['seconds'] for r in singles]):.1f}")
        lines += _against_declared(singles)
    struck = [r for r in records if r["kind"] == "struck"]
    if struck:
        unexplained = [r for r in struck if r["verdict"] == "unexplained"]
        right_row = sum(r["row"] == r["worst"] for r in unexplained)
        lines.append(f"{len(struck)} struck: unexplained {len(unexplained)}, right row {right_row}")
        lines += [f"   {r['name']}@{r['where']}: {r['verdict']} {r['found']}" for r in struck if r not in unexplained]
    both = [r for r in records if r["kind"] == "pair"]
    if both:
        named = [r for r in both if set(r["true"]) <= set(r["found"])]
        lines.append(f"{len(both)} pairs: both named {len(named)}")
        lines += [f"   {list(r['true'])} → {r['found']}" for r in both if r not in named]
    seen = [r for r in records if r["kind"] == "cameras"]
    if seen:
        first = [r for r in seen if r["found"] and f"{r['name']}@{r['where']}" in (r["found"][0], *r["alike"])]
        lines.append(f"{len(seen)} by cameras: the right one or its group first {len(first)}")
        lines.append(f"   {np.median([r['seconds'] for r in seen]):.0f} s of one core in the median")
        lines += [f"   {r['name']}@{r['where']}: {r['verdict']} {r['found']}" for r in seen if r not in first]
    cleans = [r for r in records if r["kind"] == "clean"]
    if cleans:
        lines.append(f"{len(cleans)} clean: {sum(r['verdict'] != 'clean' for r in cleans)} more than noise")
    return "\n".join(lines)


def _in_sessions(singles: list[Record]) -> list[str]:
    """What sessions leave that declare what was found, and which of them more than noise."""
    left = {f"{r['name']} {r['seed']}": max(r["session"].values()) for r in singles}
    more = {name: round(worst, 2) for name, worst in left.items() if worst > MOST_IN_A_SESSION}
    times = f"median {np.median(list(left.values())):.2f}, worst {max(left.values()):.2f} times predicted noise"
    return [f"residual of a session that declares what was found: {times}, above {MOST_IN_A_SESSION:g}: {more}"]


def _over_floor(singles: list[Record], cleans: list[Record]) -> list[str]:
    """Held-out residuals beside those of clean sessions with the same noise: what its few windows happen to hold."""
    floor = {r["seed"]: r["holdout"] for r in cleans if "holdout" in r}
    over = [
        max(value / floor[r["seed"]][row] for row, value in r["holdout"].items()) for r in singles if r["seed"] in floor
    ]
    if not over:
        return []
    within = sum(share <= MOST_OVER_FLOOR for share in over)
    times = f"median {np.median(over):.2f}, worst {max(over):.2f}, {within} of {len(over)} within {MOST_OVER_FLOOR:g}"
    return [f"held-out residual over that of a clean session with the same noise: {times}"]


def _against_declared(singles: list[Record]) -> list[str]:
    """For each effect, the parameter whose median error is worst beside that of sessions that declare the effect."""
    lines = ["median error of a parameter over that with the effect declared from the start, the worst parameter:"]
    for name in dict.fromkeys(r["name"] for r in singles):
        cases = [r for r in singles if r["name"] == name]
        if name == TableTilt.entry.name:
            lines.append(f"   {name:24} – (it cannot be declared)")
            continue
        ratios = {}
        for parameter in set.intersection(*(r["errors"].keys() & r["declared"].keys() for r in cases)):
            after, declared = (np.median([abs(r[way][parameter]) for r in cases]) for way in ("errors", "declared"))
            ratios[parameter] = after / max(declared, float(np.finfo(np.float64).eps))
        worst = max(ratios, key=lambda parameter: ratios[parameter])
        lines.append(f"   {name:24} {flagged(ratios[worst], ratios[worst] > MOST_OVER_DECLARED, '.2f')} ({worst})")
    return lines


if __name__ == "__main__":
    campaign(
        __doc__,
        {
            "run": lambda args: singles(args, "single", one_single),
            "struck": lambda args: singles(args, "struck", one_struck),
            "pairs": pairs,
            "clean": clean,
            "cameras": cameras,
            "summary": summed(summary),
        },
        seeds={"type": int, "default": 4},
        cache={"type": absolute, "default": absolute("runs/blind")},
        names={"nargs": "*", "default": PLANAR},
    )
