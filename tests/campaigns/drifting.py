"""Parameters that drift: how well trackers follow them, beside sessions in which nothing does.

    python -m tests.campaigns.drifting run RESULTS.jsonl --runs 10
    python -m tests.campaigns.drifting summary RESULTS.jsonl

The planar example, 60 s at grade B, every joint and body as described but for one change. Every session is a line of
RESULTS.jsonl: `run` may be stopped at any time and goes on where it was. Nominal values that the estimator sees are
not the true ones, and nothing but them has tolerances, but in the cases of that name. The judged tracker is `kalman`
with `drift = learned`, least squares of all rows runs beside it. Of `short`, 20 s of a steady arm, only what is found
and the verdict are of interest.
"""

from __future__ import annotations

import argparse
from collections import Counter
from collections.abc import Iterable
from dataclasses import dataclass, replace
from itertools import product
from pathlib import Path
from time import process_time
from typing import Any

import numpy as np

from sms_adapters.system_file import load_system
from sms_online.description.schema import System
from sms_online.effects.build import build_model
from sms_online.effects.catalogue import parse_effect
from sms_online.evaluation import NORMAL_95
from sms_online.model.base_parameters import find_base_parameters
from sms_online.session import Session
from sms_online.stream import Array, Block
from sms_sim.drifting import drifted, parsed
from tests.campaigns.accuracy import flagged
from tests.campaigns.results import Record, campaign, complete, summed
from tests.campaigns.sessions import disguised, exact_session, noisy_session
from tests.exactly_known import exactly_known

SYSTEM = "paper-planar"
GRADE = "B"
DURATION = 60.0  # s
TRACKERS = ("kalman:drift=learned", "rls")
# Nominal values over the true ones: a session may yet be trusted.
DISGUISE = 1.2
# From one look at the estimate to the next, and the first whose errors count, s.
LOOKED, COUNTED = 0.5, 20.0
# Time within which a drift is to be named, s.
NAMED_WITHIN = 15.0
# Asked of the share of 95 % intervals that hold the truth, %: of what drifts, over all of time, and of all else.
HELD, OTHERS_HELD = (90.0, 99.0), 90.0
# Asked of the error of what does not drift, over that of least squares without a drift.
OTHERS_ERROR = 1.3
# Asked of least squares' error where nothing drifts, and of all intervals together, %: without tolerances, and with.
STEADY_ERROR, STEADY_HELD, TOLERANT_HELD = 1.15, (93.0, 97.0), (93.0, 100.0)
STEADY, TOLERANT = "steady", "tolerances"


@dataclass(frozen=True)
class Case:
    """A change of the planar example.

    drifts: as texts; their parameters are those of `moving`. asked: of these parameters' error, root mean square, %.
    scale: what the error is a share of, 0 for the true value of the instant. declared, undeclared: effects that the
    description has, and those that it lacks. tolerant: with the tolerances that a description has by default.
    duration: s.
    """

    drifts: tuple[str, ...] = ()
    moving: tuple[str, ...] = ()
    asked: float = 0.0
    scale: float = 0.0
    declared: tuple[str, ...] = ()
    undeclared: tuple[str, ...] = ()
    tolerant: bool = False
    duration: float = DURATION


CASES = {
    STEADY: Case(),
    TOLERANT: Case(tolerant=True),
    "short": Case(duration=20.0),
    "stiffness": Case(("joint_1.stiffness:share=-0.1,over=60",), ("joint_1.stiffness",), 0.003),
    "rigidity": Case(("link_2.flexural_rigidity:share=-0.005,over=20",), ("link_2.flexural_rigidity",), 0.006),
    "propellant": Case(("spacecraft:share=-0.01,over=60",), ("spacecraft.mass_with_motor_1",), 0.003),
    "friction": Case(
        ("viscous_friction@joint_1.damping:by=5,over=60",),
        ("viscous_friction@joint_1.damping",),
        0.2,
        5.0,
        declared=("viscous_friction@joint_1:damping=0",),
    ),
    "damping": Case(
        ("joint_1.damping:half_life=20", "joint_2.damping:half_life=20"),
        ("joint_1.damping", "joint_2.damping"),
        0.03,
        75.85,
    ),
    "late": Case(("joint_1.stiffness:share=-0.1,over=30,begin=15.3",), ("joint_1.stiffness",), 0.003),
    "step": Case(("joint_2.stiffness:share=-0.05,over=0.001,begin=30",)),
    "small-step": Case(("joint_2.stiffness:share=-0.005,over=0.001,begin=15.3",), duration=30.0),
    "damping-step": Case(("joint_1.damping:share=-0.5,over=0.001,begin=15.3",), duration=30.0),
    "step-then-drift": Case(
        ("joint_2.stiffness:share=-0.05,over=0.001,begin=15.3", "joint_1.stiffness:share=-0.1,over=30,begin=30"),
    ),
    "drift-then-step": Case(
        ("joint_1.stiffness:share=-0.1,over=60", "joint_2.stiffness:share=-0.05,over=0.001,begin=30"),
    ),
    "missing": Case(undeclared=("coulomb_friction@joint_2:torque=1",)),
}
# What drifts, once more with the tolerances of a description.
CASES |= {f"{name}-{TOLERANT}": replace(case, tolerant=True) for name, case in CASES.items() if case.moving}


def described(case: Case) -> System:
    """The system as the estimator is to know it, but for its nominal values."""
    system = load_system(SYSTEM)
    return system.model_copy(update={"effects": tuple(parse_effect(text, system) for text in case.declared)})


def true_course(case: Case, t: Array) -> Array:
    """True base parameters (T, n) at instants t (T,), s."""
    model = build_model(described(case))
    base = find_base_parameters(model)
    return np.array([base.values(pi) for pi in drifted(model, model.nominal, parsed(case.drifts), t)])


def run(args: argparse.Namespace) -> None:
    """Append the sessions that the results lack, seed by seed."""
    caches = {name: args.results.with_suffix(f".{name}.npz") for name in args.cases}
    for name, cache in caches.items():
        sampled(name, cache, 0)
    wanted = product(range(args.runs), caches.items())
    tasks = [({"case": name, "seed": seed}, (name, cache, seed)) for seed, (name, cache) in wanted]
    complete(args, one_session, tasks)


def sampled(name: str, cache: Path, seed: int) -> Block:
    """The samples of a case with noise of the seed."""
    case = CASES[name]
    system = described(case)
    undeclared = (parse_effect(text, system) for text in case.undeclared)
    whole = system.model_copy(update={"effects": (*system.effects, *undeclared)})
    exact = exact_session(whole, cache, duration=case.duration, drifts=parsed(case.drifts))
    return noisy_session(whole, exact, GRADE, seed)


def one_session(name: str, cache: Path, seed: int) -> Record:
    """What the judged tracker said on the way, and what was found; of seed 0 also what least squares alone says."""
    case, block, alone = CASES[name], sampled(name, cache, seed), seed == 0
    start = process_time()
    system = disguised(described(case), factor=DISGUISE)
    system = system if case.tolerant else exactly_known(system)
    session = Session(system, block.channels, tracker=TRACKERS)
    samples = round(LOOKED * session.estimator.system.sample_rate)
    looks: dict[str, list[Any]] = {key: [] for key in ("t", "estimate", "std", "beside")}
    named: dict[str, float] = {}
    known: dict[float, float] = {}
    for piece in block.pieces(samples):
        session.update(piece)
        for event in session.estimator.events:
            known.setdefault(event.time, float(piece.t[-1]))
        found = session.evaluation()
        if not found.trackers:
            continue
        judged, beside = found.trackers
        looks["t"].append(float(piece.t[-1]))
        looks["estimate"].append([each.value for each in judged.parameters.values()])
        looks["std"].append([each.std for each in judged.parameters.values()])
        looks["beside"].append([each.value for each in beside.parameters.values()])
        for drift in judged.drifts:
            named.setdefault(drift.parameter, float(piece.t[-1]))
    session.finish()
    result, taken = session.result, process_time() - start
    static = Session(system, block.channels, tracker="rls")
    if alone:
        static.update(block)
        static.finish()
    return {
        **looks,
        "names": list(result.parameters),
        "named": named,
        "events": [event.kind for event in result.events],
        "known_after": [known[event.time] - event.time for event in result.events if event.time in known],
        "verdict": result.trust.sentence,
        "static_verdict": static.result.trust.sentence if alone else None,
        "episodes": [episode["effects"] for episode in result.diagnosis],
        "nis": [tracker.consistency.nis for tracker in result.trackers],
        "seconds": taken,
    }


def summary(records: list[Record]) -> str:
    """What the sessions show beside what is asked; an exclamation mark where it is not reached."""
    by_case = {name: [record for record in records if record["case"] == name] for name in CASES}
    steady = _errors(CASES[STEADY], by_case[STEADY])[:3] if by_case[STEADY] else None
    return "\n\n".join(_summary(name, chosen, steady) for name, chosen in by_case.items() if chosen)


def _errors(case: Case, records: list[Record]) -> tuple[Array, Array, Array, list[str]]:
    """Errors of the judged tracker and of the one beside it, %, whether intervals hold, each (S, T, n); and names."""
    t = np.array(records[0]["t"])
    counted = t >= COUNTED
    truth = true_course(case, t[counted])
    estimate, std, beside = (np.array([r[key] for r in records])[:, counted] for key in ("estimate", "std", "beside"))
    names, scale = records[0]["names"], np.abs(truth)
    if case.scale:
        scale[:, [names.index(each) for each in case.moving]] = case.scale
    held = (np.abs(estimate - truth) < NORMAL_95 * std).astype(np.float64)
    return 100.0 * (estimate - truth) / scale, 100.0 * (beside - truth) / scale, held, names


def _summary(name: str, records: list[Record], steady: tuple[Array, Array, Array] | None) -> str:
    case = CASES[name]
    named, events = [r["named"] for r in records], [kind for r in records for kind in r["events"]]
    after = max((each for r in records for each in r["known_after"]), default=None)
    late = "" if after is None else f", known after {after:.1f} s at most"
    effects = [effect["name"] for r in records for episode in r["episodes"] for effect in episode]
    lines = [
        f"{name}, {len(records)} sessions, {np.median([r['seconds'] for r in records]):.1f} s of one core each",
        f"  drifts named: {_counts(name for each in named for name in each)}; events: {_counts(events)}{late}",
        f"  effects found: {_counts(effects)}",
        f"  verdicts: {_counts(r['verdict'] for r in records)}",
        f"  verdicts with rls alone: {_counts(r['static_verdict'] for r in records if r['static_verdict'])}",
        f"  normalised innovations squared {np.mean([r['nis'][0] for r in records]):.3f}, "
        f"beside {np.mean([r['nis'][1] for r in records]):.3f}",
    ]
    if name not in (STEADY, TOLERANT, *(key for key, each in CASES.items() if each.moving)):
        return "\n".join(lines)
    error, beside, held, names = _errors(case, records)
    rms, rms_beside = (np.sqrt(np.mean(each**2, axis=(0, 1))) for each in (error, beside))
    moving = [names.index(each) for each in case.moving]
    lines.append(f"  {'parameter':34}{'rms %':>11}{'asked':>9}{'held %':>9}{'rls rms %':>12}{'named after s':>15}")
    for k in moving:
        after = [each[names[k]] for each in named if names[k] in each]
        share = 100.0 * float(held[:, :, k].mean())
        lines.append(
            f"  {names[k]:34}{flagged(float(rms[k]), rms[k] > case.asked, '.5f'):>11}{case.asked:9g}"
            f"{flagged(share, not HELD[0] <= share <= HELD[1], '.1f'):>9}{rms_beside[k]:12.5f}"
            f"{flagged(max(after, default=np.inf), len(after) < len(records) or max(after) > NAMED_WITHIN, '.1f'):>15}"
        )
    burning = name.startswith("propellant")
    others = [k for k, each in enumerate(names) if k not in moving and not (burning and "space" in each)]
    share = 100.0 * float(held[:, :, others].mean())
    if steady is None:
        return "\n".join(lines)
    least = np.sqrt(np.mean(steady[1] ** 2, axis=(0, 1)))[[_index(names[k]) for k in others]]
    ratio = float(np.mean(rms[others] / least))
    limit = np.inf if case.tolerant else {STEADY: STEADY_ERROR}.get(name, OTHERS_ERROR)
    low, high = TOLERANT_HELD if case.tolerant else {STEADY: STEADY_HELD}.get(name, (OTHERS_HELD, 100.0))
    lines.append(
        f"  all others: error {flagged(ratio, ratio > limit, '.2f')} of steady least squares' ({limit:g} asked), "
        f"intervals hold {flagged(share, not low <= share <= high, '.1f')} % ({low:g} … {high:g} asked)"
    )
    return "\n".join(lines)


def _index(name: str) -> int:
    """Place of a parameter among those of the steady arm."""
    return [p.name for p in find_base_parameters(build_model(load_system(SYSTEM))).parameters].index(name)


def _counts(names: Iterable[str]) -> str:
    return ", ".join(f"{name} × {count}" for name, count in Counter(names).items()) or "none"


if __name__ == "__main__":
    campaign(
        __doc__,
        {"run": run, "summary": summed(summary)},
        runs={"type": int, "default": 10, "help": "seeds 0, 1, … of each case, 10 by default"},
        cases={"nargs": "+", "choices": list(CASES), "default": list(CASES)},
    )
