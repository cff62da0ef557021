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

import argparse
import json
from functools import cache
from itertools import product
from pathlib import Path
from time import process_time

import numpy as np

from sms_adapters.system_file import load_system
from sms_online.description.parse import describe
from sms_online.description.schema import System
from sms_online.diagnosis.online import OnlineDiagnosis
from sms_online.diagnosis.online_search import Immediate
from sms_online.effects.catalogue import ENTRIES, channel_effects, parse_effect
from sms_online.pipeline.estimator import Estimator
from sms_online.stream import Block
from sms_sim.simulate import Simulation, exact_states, simulate
from tests.campaigns.results import Record, campaign, complete, summed
from tests.campaigns.sessions import cached, disguised, exact_session, noisy_session
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


def begun(system: System, text: str) -> Block:
    """Exact samples of a session in which an effect begins."""
    before = unchanged()
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


@cache
def unchanged() -> Simulation:
    """The motion without an effect."""
    return simulate(load_system(SYSTEM), END)


def exact_begun(text: str, folder: Path) -> Block:
    """The same, kept in a folder."""
    system = load_system(SYSTEM)
    description = json.dumps([describe(system), text, BEGIN, END])
    return cached(folder / f"{text.partition(':')[0]}.npz", description, lambda: begun(system, text))


def run(args: argparse.Namespace) -> None:
    """Append the cases that the results lack."""
    folder = args.results.with_suffix("")
    for text in CASES:
        exact_begun(text, folder)
    wanted = product(CASES, range(args.seeds))
    complete(args, one_begun, [({"kind": "begun", "case": t, "seed": seed}, (folder, t, seed)) for t, seed in wanted])


def one_begun(folder: Path, text: str, seed: int) -> Record:
    """What was noticed and named of an effect."""
    system, exact = load_system(SYSTEM), exact_begun(text, folder)
    start = process_time()
    estimator, online = watched(system, noisy_session(system, exact, "B", seed), adopt=True)
    events = [event.kind for event in estimator.events]
    return {"episodes": online.document(), "events": events, "seconds": process_time() - start}


def steady(args: argparse.Namespace) -> None:
    """Append sessions in which nothing is missing."""
    file = args.results.with_suffix("") / "steady.npz"
    exact_session(load_system(SYSTEM), file)
    wanted = product(range(args.seeds), ("A", "B", "C"))
    complete(args, one_steady, [({"kind": "steady", "case": g, "seed": seed}, (file, g, seed)) for seed, g in wanted])


def one_steady(file: Path, grade: str, seed: int) -> Record:
    """Alarms of a session in which nothing is missing."""
    system = load_system(SYSTEM)
    block = noisy_session(system, exact_session(system, file), grade, seed)
    estimator, online = watched(system, block, adopt=False)
    assert estimator.momentum is not None
    return {"episodes": online.document(), "sum": max(estimator.momentum.test.evidence.values())}


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
        {"run": run, "steady": steady, "summary": summed(summary)},
        seeds={"type": int, "default": 2},
    )
