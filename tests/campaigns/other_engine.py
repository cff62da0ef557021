"""Diagnosis of another engine's data: the planar arm in MuJoCo, 21 segments a link, with an effect of the engine's own.

    python -m tests.campaigns.other_engine run RESULTS.jsonl
    python -m tests.campaigns.other_engine summary RESULTS.jsonl

The diagnosis sees 20 s with noise of grade B and a description with other nominal values: with `exact` links, and once
with `linear` ones on the clean capture. Every case is a line of RESULTS.jsonl; a stopped campaign goes on where it was.
Captures are kept in --cache: the engine needs half a minute of a core for each.
"""

from __future__ import annotations

import argparse
import json
from dataclasses import asdict, dataclass
from pathlib import Path
from time import process_time

from sms_adapters.system_file import load_system
from sms_online.description.parse import describe
from sms_online.diagnosis.diagnose import diagnose
from sms_online.diagnosis.posterior import coefficients
from sms_online.diagnosis.search import Search
from sms_online.pipeline.estimator import Estimator
from sms_online.stream import Block
from tests.campaigns.results import Record, absolute, campaign, complete, summed
from tests.campaigns.sessions import SLIGHT, cached, disguised, noisy_session, true_parameters
from tests.engine_mujoco import EngineEffects, mujoco_capture

GRADE, SEED = "B", 3
DURATION = 20.0  # s


@dataclass(frozen=True)
class Case:
    """What the engine adds, the system file that is diagnosed with, and the keys to be found with their coefficient."""

    effects: EngineEffects
    system: str
    found: dict[str, float | None]


CLEAN = "clean"
CASES = {
    CLEAN: Case(EngineEffects(), "paper-planar-exact", {}),
    "coulomb": Case(EngineEffects(coulomb=(0.0, 1.0)), "paper-planar-exact", {"coulomb_friction@joint_2": 1.0}),
    "cubic": Case(EngineEffects(cubic=(300.0, 0.0)), "paper-planar-exact", {"cubic_stiffness@joint_1": 300.0}),
    "tip": Case(EngineEffects(tip_mass=0.5), "paper-planar-exact", {"tip_payload@tip": 0.5}),
    # Every hinge of both links has a damper.
    "damping": Case(
        EngineEffects(link_damping=1e-3),
        "paper-planar-exact",
        {"link_damping@link_1": 1e-3, "link_damping@link_2": 1e-3},
    ),
    "linear": Case(
        EngineEffects(),
        "paper-planar",
        {"geometric_stiffening@link_1": None, "geometric_stiffening@link_2": None},
    ),
}


def captured(effects: EngineEffects, cache: Path) -> Block:
    """What exact sensors read of the engine, from `cache` or else simulated and written there."""
    system = load_system("paper-planar-exact")
    description = json.dumps([describe(system), DURATION, asdict(effects)])
    return cached(cache, description, lambda: mujoco_capture(system, DURATION, effects=effects))


def run(args: argparse.Namespace) -> None:
    """Append the cases that the results lack."""
    captured(EngineEffects(), args.cache / f"{CLEAN}.mujoco.npz")
    complete(args, diagnosed, [({"case": name}, (args.cache, name)) for name in args.cases])


def diagnosed(cache: Path, name: str) -> Record:
    """The diagnosis of a case."""
    case = CASES[name]
    engine = name if case.effects != EngineEffects() else CLEAN
    block = captured(case.effects, cache / f"{engine}.mujoco.npz")
    block = noisy_session(load_system("paper-planar-exact"), block, GRADE, SEED)
    begin = process_time()
    found = diagnose(disguised(load_system(case.system), factor=SLIGHT), [block], "mujoco", lambda _: None)
    return {**_record(case, found), "seconds": process_time() - begin}


def _record(case: Case, found: Search) -> Record:
    """What was found, and how far base parameters are off before and after, %."""
    keys = [finding.candidate.key for finding in found.findings]
    declared = [effect.key for effect in found.after.system.effects]
    reported = {
        finding.candidate.key: {name: value for name, (value, _) in coefficients(found, finding).items()}
        for finding in found.findings
    }
    return {
        "verdict": found.verdict,
        "found": [*keys, *(key for key in declared if key not in keys)],
        "expected": case.found,
        "reported": reported,
        "before": {name: row.whitened for name, row in found.before.test.items()},
        "after": {name: row.whitened for name, row in found.after.test.items()},
        "holdout": found.after.holdout.whitened,
        "off_before": _off(case, found.estimator_before),
        "off_after": _off(case, found.estimator_after),
    }


def _off(case: Case, session: Estimator) -> dict[str, float]:
    """Relative errors of the described system's own base parameters, %."""
    truth = true_parameters(load_system(case.system))
    estimate = dict(zip((p.name for p in session.base.parameters), session.estimate().pi, strict=True))
    names = (p.name for p in session.base.parameters if "@" not in p.name)
    return {name: 100.0 * (estimate[name] / value - 1.0) for name, value in zip(names, truth, strict=False)}


def summary(records: list[Record]) -> str:
    """A line for each case: whether all that was added, and nothing else, was found; rows and parameters."""
    lines = []
    for r in records:
        right = set(r["found"]) == set(r["expected"]) and (r["verdict"] != "clean") == bool(r["expected"])
        worst = [max(r[side].values()) for side in ("before", "after", "holdout")]
        craft = [
            max((abs(off) for name, off in r[side].items() if name.startswith("spacecraft")), default=float("nan"))
            for side in ("off_before", "off_after")
        ]
        lines.append(
            f"{'ok ' if right else 'BAD'} {r['case']:8} {r['verdict']:11} {r['found']} {r['reported']}\n"
            f"    worst row {worst[0]:.2f} → {worst[1]:.2f}, held out {worst[2]:.2f} times noise;"
            f" spacecraft {craft[0]:.3f} → {craft[1]:.4f} % off; {r['seconds']:.0f} s"
        )
    return "\n".join(lines)


if __name__ == "__main__":
    campaign(
        __doc__,
        {"run": run, "summary": summed(summary)},
        cache={"type": absolute, "default": absolute("runs")},
        cases={"nargs": "*", "choices": tuple(CASES), "default": list(CASES)},
    )
