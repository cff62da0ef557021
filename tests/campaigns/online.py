"""Effects that begin in the middle of a session of the planar example: how soon they are noticed and named.

    python -m tests.campaigns.online run RESULTS.jsonl
    python -m tests.campaigns.online steady RESULTS.jsonl --seeds 20
    python -m tests.campaigns.online summary RESULTS.jsonl

Noise of grade B, every case with several seeds; `steady` counts alarms of sessions in which nothing
is missing, at all grades. Effects begin at BEGIN; those of forces by a motion that goes on with them from where it is,
those of channels by samples that are distorted from then on. Every case is a line of RESULTS.jsonl; a stopped campaign
goes on where it was.
"""

from __future__ import annotations

from pathlib import Path
from time import process_time
from typing import Any

import numpy as np

from sms_adapters.system_file import load_system
from sms_online.description.schema import System
from sms_online.diagnosis.online import OnlineDiagnosis
from sms_online.diagnosis.online_search import Immediate
from sms_online.effects.catalogue import ENTRIES, channel_effects, parse_effect
from sms_online.pipeline.estimator import Estimator
from sms_online.stream import Block
from sms_sim.simulate import Simulation, exact_states, simulate
from tests.campaigns.results import append, campaign, read, summed
from tests.campaigns.sessions import disguised, noisy_session
from tests.changed_session import changed_session

SYSTEM = "paper-planar"
BEGIN, END = 8.0, 14.0  # s
# Samples that come at once.
PIECE = 80
CASES = (
    "coulomb_friction@joint_1:torque=2",
    "viscous_friction@joint_2:damping=2",
    "tip_payload@tip:mass=0.5",
    "air_drag@base:damping=60",
    "thruster_leak@base:force_x=1,force_y=0.5",
    "cubic_stiffness@joint_1:stiffness=300",
    "load_friction@joint_2:ratio=0.05",
    "link_damping@link_1:time=0.001",
    "sensor_lag@q_1:corner=40",
    "encoder_offset@theta_m_2:offset=0.01",
)
# What events call an effect.
ALIKE = {"tip_payload@tip": "payload."}

Record = dict[str, Any]


def session(before: Simulation, system: System, text: str) -> Block:
    """Exact samples of a session in which an effect begins."""
    effect = parse_effect(text, system)
    changed = system.model_copy(update={"effects": (*system.effects, effect)})
    if ENTRIES[effect.name].kind != "channel":
        return changed_session(before, changed, BEGIN, END)
    rate = system.sample_rate
    exact = exact_states(before, np.arange(round(END * rate) + 1) / rate)
    plant = before.plant
    values = plant.channel_values(exact.torque, exact.x)
    late = exact.t >= BEGIN
    for distortion in channel_effects(changed):
        for k, channel in enumerate(plant.channels):
            if distortion.acts_on(channel):
                values[late, k] = distortion.distort(values[:, k], rate)[late]
    return Block(exact.t, plant.channels, values)


def watched(system: System, block: Block, adopt: bool) -> tuple[Estimator, OnlineDiagnosis]:
    """The session of a description whose nominal values are not the true ones, with what was found meanwhile."""
    estimator = Estimator(disguised(system), block.channels, "case")
    online = OnlineDiagnosis(estimator, Immediate(), adopt)
    for piece in block.pieces(PIECE):
        estimator.push(piece)
    estimator.finish()
    return estimator, online


def run(results: Path, seeds: int) -> None:
    """Append the cases that `results` lacks."""
    system = load_system(SYSTEM)
    before = simulate(system, END)
    done = {(r["kind"], r["case"], r["seed"]) for r in read(results)}
    for text in CASES:
        missing = [seed for seed in range(seeds) if ("begun", text, seed) not in done]
        exact = session(before, system, text) if missing else None
        for seed in missing:
            assert exact is not None
            start = process_time()
            estimator, online = watched(system, noisy_session(system, exact, "B", seed), adopt=True)
            record = {
                "kind": "begun", "case": text, "seed": seed, "episodes": online.document(),
                "events": [event.kind for event in estimator.events], "seconds": process_time() - start,
            }  # fmt: skip
            append(results, record)


def steady(results: Path, seeds: int) -> None:
    """Append sessions in which nothing is missing."""
    system = load_system(SYSTEM)
    simulation = simulate(system)
    samples = round(simulation.duration * system.sample_rate)
    states = exact_states(simulation, np.arange(samples + 1) / system.sample_rate)
    plant = simulation.plant
    exact = Block(states.t, plant.channels, plant.channel_values(states.torque, states.x))
    done = {(r["case"], r["seed"]) for r in read(results) if r["kind"] == "steady"}
    for seed in range(seeds):
        for grade in ("A", "B", "C"):
            if (grade, seed) not in done:
                estimator, online = watched(system, noisy_session(system, exact, grade, seed), adopt=False)
                assert estimator.momentum is not None
                largest = max(estimator.momentum.test.evidence.values())
                record = {"kind": "steady", "case": grade, "seed": seed, "episodes": online.document(), "sum": largest}
                append(results, record)


def summary(records: list[Record]) -> str:
    """How soon each effect was noticed and named, and how many steady sessions alarmed."""
    lines = []
    for r in (r for r in records if r["kind"] == "begun"):
        key = r["case"].partition(":")[0]
        first = r["episodes"][0] if r["episodes"] else None
        if first is None:
            lines.append(f"BAD {r['case']} seed {r['seed']}: not noticed")
            continue
        named = [f"{effect['name']}@{effect['where']}" for effect in first["effects"]]
        # An event names what jumped: a payload by its own parameters.
        right = named[:1] == [key] or ALIKE.get(key, key) in first["summary"]
        late = first["named"] - BEGIN if first["named"] else np.nan
        lines.append(
            f"{'ok ' if right else 'BAD'} {r['case']} seed {r['seed']}: noticed after {first['noticed'] - BEGIN:.2f}, "
            f"named after {late:.2f} s; {first['summary']}; {len(r['episodes'])} episodes"
        )
    begun = [r["episodes"][0] for r in records if r["kind"] == "begun" and r["episodes"]]
    if begun:
        noticed, late = (np.array([e[part] or np.nan for e in begun]) - BEGIN for part in ("noticed", "named"))
        lines.append(f"noticed within {np.max(noticed):.2f} s, named within {np.nanmax(late):.2f} s of {len(begun)}")
    quiet = [r for r in records if r["kind"] == "steady"]
    if quiet:
        alarms = sum(bool(r["episodes"]) for r in quiet)
        largest = max(r["sum"] for r in quiet)
        lines.append(f"{len(quiet)} steady: {alarms} alarmed; the largest sum is {largest:.2f} of the limit")
    return "\n".join(lines)


if __name__ == "__main__":
    campaign(
        __doc__,
        {
            "run": lambda args: run(args.results, args.seeds),
            "steady": lambda args: steady(args.results, args.seeds),
            "summary": summed(summary),
        },
        seeds={"type": int, "default": 2},
    )
