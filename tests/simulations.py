"""Simulated motions that several tests use: each is integrated once a run, by the worker that needs it first."""

from __future__ import annotations

import fcntl
import json
import pickle
from dataclasses import replace
from functools import cache
from hashlib import sha256
from pathlib import Path

import numpy as np

from sms_adapters.system_file import load_system
from sms_online.capture import Capture
from sms_online.description.parse import describe
from sms_online.description.schema import System
from sms_sim.capture import Simulated
from sms_sim.plant import Plant
from sms_sim.simulate import POSITION_TOLERANCE, Simulation, simulate

# What the workers of a run share; without workers motions are kept in memory alone.
folder: Path | None = None
_known: dict[str, Simulation] = {}


def simulated(
    system: System, duration: float | None = None, position_tolerance: float = POSITION_TOLERANCE
) -> Simulation:
    """What `simulate` gives, once a run for the same arguments."""
    key = sha256(json.dumps([describe(system), duration, position_tolerance]).encode()).hexdigest()
    if key not in _known:
        _known[key] = _shared(key, system, duration, position_tolerance)
    return _known[key]


def _shared(key: str, system: System, duration: float | None, position_tolerance: float) -> Simulation:
    if folder is None:
        return simulate(system, duration, position_tolerance=position_tolerance)
    file = folder / key
    with (folder / f"{key}.lock").open("w") as lock:
        fcntl.flock(lock, fcntl.LOCK_EX)
        if file.exists():
            return Simulation(Plant(system), pickle.loads(file.read_bytes()))
        simulation = simulate(system, duration, position_tolerance=position_tolerance)
        file.write_bytes(pickle.dumps(simulation.solution))
        return simulation


@cache
def planar(seconds: float = 10.0) -> Simulation:
    """The paper's example (Table III) along (46)."""
    whole = simulated(load_system("paper-planar"), max(10.0, seconds))
    return whole if seconds == whole.duration else until(whole, seconds)


def planar_capture(seconds: float, grade: str = "B", seed: int = 0) -> Capture:
    """The first seconds of the paper's example as `sms.simulate` records them."""
    session = Simulated.of(load_system("paper-planar"), duration=seconds, grade=grade, seed=seed)
    return session.capture(planar(seconds))


def until(whole: Simulation, seconds: float) -> Simulation:
    """The first seconds of a motion, which need no simulation of their own."""
    solution, last = whole.solution, int(np.searchsorted(whole.solution.t, seconds))
    # The polynomials of the last step, on a part of it.
    t = np.append(solution.t[:last], seconds)
    cut = replace(solution, t=t, y=np.append(solution.y[:last], solution(t[-1:]), axis=0))
    stages = solution(cut.stage_times[-1])
    return Simulation(whole.plant, replace(cut, stages=np.append(solution.stages[: last - 1], stages[None], axis=0)))
