"""Mistakes of units, signs and wiring, made in sessions of three systems: is the right one named first?

    python -m tests.campaigns.mistakes run RESULTS.jsonl --seeds 5
    python -m tests.campaigns.mistakes run RESULTS.jsonl --seeds 1 --systems paper-planar --names degrees torque_sign
    python -m tests.campaigns.mistakes summary RESULTS.jsonl

Sessions of 8 s with noise of grade B. Channels, joints and sizes are drawn by the seed. The description states each
mass and stiffness up to 20 % wrong, by the seed too, so that nothing can be read from it. `clean` sessions are those
same ones without a mistake. Every case is a line of RESULTS.jsonl; a stopped campaign goes on where it was.
"""

from __future__ import annotations

import argparse
import zlib
from collections.abc import Callable
from itertools import product
from pathlib import Path
from time import process_time
from typing import Any

import numpy as np

from sms_adapters.system_file import load_system
from sms_online.description.parse import describe
from sms_online.description.schema import System
from sms_online.diagnosis.diagnose import diagnose
from sms_online.stream import Array, Block
from tests.campaigns.results import Record, absolute, campaign, complete, summed
from tests.campaigns.sessions import DISGUISED, exact_session, noisy_session

SYSTEMS = ("paper-planar", "paper-planar-table-v", "spatial-two-link")
GRADE = "B"
DURATION = 8.0
# What a data sheet is off by.
STATED = 0.2

Values = dict[str, Array]


def described(system: System, rng: np.random.Generator) -> System:
    """The system with other nominal values."""

    def other(key: str, value: Any) -> Any:
        if isinstance(value, dict):
            # One factor for all moments of inertia of a body: those of some bodies else have no real ones.
            factor = 1.0 + STATED * rng.uniform(-1.0, 1.0)
            if set(value) & {"xx", "yy", "zz"}:
                return {name: factor * part for name, part in value.items()}
            return {name: other(name, part) for name, part in value.items()}
        if isinstance(value, list):
            return [other("", part) for part in value]
        return value * (1.0 + STATED * rng.uniform(-1.0, 1.0)) if key in DISGUISED else value

    return System.model_validate(other("", describe(system)))


def _pick(rng: np.random.Generator, names: list[str]) -> str:
    return names[int(rng.integers(len(names)))]


def _times(values: Values, names: list[str], factor: float) -> None:
    for name in names:
        values[name] *= factor


def torque_sign(values: Values, system: System, rng: np.random.Generator) -> str:
    name = _pick(rng, ["tau_1", "tau_2"])
    _times(values, [name], -1.0)
    return f"torque_sign@{name}"


def angle_sign(values: Values, system: System, rng: np.random.Generator) -> str:
    name = _pick(rng, ["q_1", "q_2", "theta_m_1", "theta_m_2"])
    _times(values, [name], -1.0)
    return f"angle_sign@{name}"


def swapped(values: Values, system: System, rng: np.random.Generator) -> str:
    one, other = [("tau_1", "tau_2"), ("q_1", "q_2"), ("theta_m_1", "theta_m_2")][int(rng.integers(3))]
    values[one], values[other] = values[other], values[one]
    return f"swapped@{one}, {other}"


def degrees(values: Values, system: System, rng: np.random.Generator) -> str:
    name = _pick(rng, ["q_1", "q_2", "theta_m_1", "theta_m_2"])
    _times(values, [name], 180.0 / np.pi)
    return f"degrees@{name}"


def millimetres(values: Values, system: System, rng: np.random.Generator) -> str:
    _times(values, [name for name in values if name.startswith("r_S_")], 1e3)
    return "millimetres@r_S_*"


def torque_unit(values: Values, system: System, rng: np.random.Generator) -> str:
    _times(values, ["tau_1", "tau_2"], 1e3)
    return "torque_unit@tau_1, tau_2"


def clock_unit(values: Values, system: System, rng: np.random.Generator) -> str:
    _times(values, ["t"], 1e3)
    return "clock_unit@t"


def joint_torque(values: Values, system: System, rng: np.random.Generator) -> str:
    names = [["tau_1"], ["tau_2"], ["tau_1", "tau_2"]][int(rng.integers(3))]
    _times(values, names, system.joints[0].gear_ratio)
    return f"joint_torque@{', '.join(names)}"


def torque_constant(values: Values, system: System, rng: np.random.Generator) -> str:
    """The shaft's torque is larger or smaller than it should be, as with a wrong gear ratio."""
    joint = int(rng.integers(1, 3))
    _times(values, [f"tau_{joint}"], float(rng.choice([0.4, 0.6, 1.6, 2.0])))
    return f"gear_ratio@joint_{joint}"


def gear_ratio(values: Values, system: System, rng: np.random.Generator) -> str:
    """See `other_gear`."""
    return f"gear_ratio@joint_{int(rng.integers(1, 3))}"


def other_gear(system: System, key: str, rng: np.random.Generator) -> System:
    """The system described with another gear ratio of the joint in the key of a mistake."""
    factor, joints = float(rng.choice([0.4, 0.6, 1.6, 2.0])), list(system.joints)
    joint = joints[i := int(key[-1]) - 1]
    joints[i] = joint.model_copy(update={"gear_ratio": factor * joint.gear_ratio})
    return system.model_copy(update={"joints": tuple(joints)})


def motor_angle(values: Values, system: System, rng: np.random.Generator) -> str:
    joint = int(rng.integers(1, 3))
    _times(values, [f"theta_m_{joint}"], system.joints[joint - 1].gear_ratio)
    return f"motor_angle@theta_m_{joint}"


def encoder(values: Values, system: System, rng: np.random.Generator) -> str:
    """Wrapped, or stuck for the last fifth."""
    name = _pick(rng, ["q_1", "q_2", "theta_m_1", "theta_m_2"])
    column = values[name]
    if rng.integers(2):
        turn = 0.6 * float(np.ptp(column))
        values[name] = np.mod(column, turn)
        return f"wrapped@{name}"
    speed = np.abs(np.convolve(np.diff(column), np.ones(50) / 50.0, "same"))
    half = column.size // 2
    start = half + int(np.argmax(speed[half : half + column.size // 4]))
    column[start:] = column[start]
    return f"stuck@{name}"


def held_command(values: Values, system: System, rng: np.random.Generator) -> str:
    """Both, at 20 Hz."""
    for name in ("tau_1", "tau_2"):
        values[name] = np.repeat(values[name][::50], 50)[: values[name].size]
    return "held_command@tau_1, tau_2"


def zero_offset(values: Values, system: System, rng: np.random.Generator) -> str:
    name = _pick(rng, ["q_1", "q_2", "theta_m_1", "theta_m_2"])
    values[name] += float(rng.choice([-1.0, 1.0]) * rng.uniform(0.01, 0.03))
    return f"encoder_offset@{name}"


def markers(values: Values, system: System, rng: np.random.Generator) -> str:
    link = int(rng.integers(1, 3))
    fields = [name.rpartition(".")[2] for name in values if name.startswith(f"link_{link}.marker_1.")]
    for field in fields:
        one, other = (f"link_{link}.marker_{k}.{field}" for k in (1, 2))
        values[one], values[other] = values[other], values[one]
    return f"swapped@link_{link}.marker_1.*, link_{link}.marker_2.*"


def counts(values: Values, system: System, rng: np.random.Generator) -> str:
    """An encoder of a flexible joint has other counts a turn than its source states."""
    name = f"{rng.choice(['theta_m', 'q'])}_{int(rng.integers(1, 3))}"
    _times(values, [name], float(rng.choice([0.25, 0.5, 2.0, 4.0])))
    return f"counts@{name}"


def gravity(values: Values, system: System, rng: np.random.Generator) -> str:
    """See `falling`."""
    return "gravity@base"


def falling(system: System, rng: np.random.Generator) -> System:
    """The system described with gravity along an axis of the base, of which the samples have none."""
    vector = np.zeros(3)
    vector[int(rng.integers(2 if system.motion == "planar" else 3))] = rng.choice([-9.81, 9.81])
    return system.model_copy(update={"gravity": tuple(vector.tolist())})


def clean(values: Values, system: System, rng: np.random.Generator) -> str:
    return ""


MISTAKES: dict[str, Callable[[Values, System, np.random.Generator], str]] = {
    make.__name__: make
    for make in (
        torque_sign, angle_sign, swapped, degrees, millimetres, torque_unit, clock_unit, joint_torque, torque_constant,
        gear_ratio, motor_angle, encoder, held_command, zero_offset, markers, counts, gravity, clean,
    )
}  # fmt: skip


def session(name: str, cache: Path, seed: int) -> tuple[System, Block]:
    """A system and its session with noise of the seed."""
    system = load_system(name)
    block = noisy_session(system, exact_session(system, cache / f"{name}.npz"), GRADE, seed)
    count = round(DURATION * system.sample_rate)
    return system, Block(block.t[:count], block.channels, block.values[:count])


def case(name: str, cache: Path, seed: int, mistake: str) -> Record:
    """One diagnosis."""
    rng = np.random.default_rng([seed, zlib.crc32(mistake.encode()), zlib.crc32(name.encode())])
    system, block = session(name, cache, seed)
    values = {"t": block.t.copy()} | {
        c: column.copy() for c, column in zip(block.channels, block.values.T, strict=True)
    }
    key = MISTAKES[mistake](values, system, rng)
    wrong = Block(values["t"], block.channels, np.stack([values[c] for c in block.channels], axis=1))
    start = process_time()
    stated = described(system, rng)
    if mistake == gear_ratio.__name__:
        stated = other_gear(stated, key, rng)
    if mistake == gravity.__name__:
        stated = falling(stated, rng)
    found = diagnose(stated, [wrong], "case", lambda _: None)
    keys = [each.key for each in found.mistakes] + [finding.candidate.key for finding in found.findings]
    return {
        "true": key, "found": keys, "verdict": found.verdict,
        "or_else": [each.or_else for each in found.mistakes], "seconds": process_time() - start,
    }  # fmt: skip


def run(args: argparse.Namespace) -> None:
    """Append the cases that the results lack."""
    for system in args.systems:
        session(system, args.cache, 0)
    wanted = product(range(args.seeds), args.systems, args.names)
    tasks = [({"system": s, "seed": k, "name": name}, (s, args.cache, k, name)) for k, s, name in wanted]
    complete(args, case, tasks)


def summary(records: list[Record]) -> str:
    """Cases whose mistake is named first, and clean ones."""
    wrong = [r for r in records if r["found"][:1] != ([r["true"]] if r["true"] else [])]
    lines = [f"{r['system']} {r['seed']}: {r['true'] or 'clean'} → {r['found']}, {r['verdict']}" for r in wrong]
    for kind, some in (
        ("mistakes", [r for r in records if r["true"]]),
        ("clean", [r for r in records if not r["true"]]),
    ):
        lines.append(f"{len(some)} {kind}: {sum(r not in wrong for r in some)} right")
    lines.append(f"seconds: median {np.median([r['seconds'] for r in records]):.1f}")
    return "\n".join(lines)


if __name__ == "__main__":
    campaign(
        __doc__,
        {"run": run, "summary": summed(summary)},
        seeds={"type": int, "default": 5},
        cache={"type": absolute, "default": absolute("runs/mistakes")},
        systems={"nargs": "*", "default": list(SYSTEMS)},
        names={"nargs": "*", "choices": list(MISTAKES), "default": list(MISTAKES)},
    )
