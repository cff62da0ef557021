"""Sessions of the planar example that description or sensors are a little wrong of: do the intervals still hold?

    python -m tests.campaigns.calibration run RESULTS.jsonl --seeds 10 [--kinds clean clock …]
    python -m tests.campaigns.calibration summary RESULTS.jsonl

Every session is a line of RESULTS.jsonl; `run` goes on where it was stopped. Signs of what is wrong are drawn anew for
every seed, its size is that of the kind.
"""

from __future__ import annotations

import argparse
from collections.abc import Callable
from dataclasses import dataclass
from functools import cache
from itertools import product
from pathlib import Path
from time import process_time
from typing import Any

import numpy as np
from scipy.interpolate import make_interp_spline
from scipy.signal import lfilter
from scipy.spatial.transform import Rotation

from sms_adapters.system_file import load_system
from sms_online.description.schema import System, Tolerances
from sms_online.effects.build import declaring
from sms_online.effects.catalogue import parse_effect
from sms_online.evaluation import NORMAL_95
from sms_online.pipeline.snapshot import statistics_of
from sms_online.stream import Array, Block
from sms_online.verdict.judged import JudgedEvaluation
from tests.campaigns.results import Record, campaign, complete, summed
from tests.campaigns.sessions import disguised, exact_session, noisy_session, true_parameters
from tests.sessions_of import session_of

SYSTEM = "paper-planar"
GRADE = "B"
TOLERANCES = ("none", "default")
PIECE = 1000  # samples
WITHIN = 3.0  # standard deviations of a nuisance
# What is declared where a kind has friction.
FRICTION = (
    "coulomb_friction@joint_1:torque=8", "viscous_friction@joint_1:damping=5",
    "coulomb_friction@joint_2:torque=4", "viscous_friction@joint_2:damping=3",
)  # fmt: skip
# The true arm where its geometry is another than the described one.
LENGTH, AXIS = 1.2e-4, 5e-4  # m, rad: of link 1, and of joint 2

# Name, place and part of a nuisance.
Key = tuple[str, str, str]
# Distorts samples, and returns the nuisances that they have then.
Samples = Callable[[System, Block, np.random.Generator], dict[Key, float]]


def _columns(block: Block, *beginnings: str) -> list[int]:
    return [k for k, name in enumerate(block.channels) if name.startswith(beginnings)]


def _sign(random: np.random.Generator) -> float:
    return float(random.choice((-1.0, 1.0)))


def tracked_point(by: float) -> Samples:
    """S is elsewhere by so much along both axes of the base, m."""

    def distort(system: System, block: Block, random: np.random.Generator) -> dict[Key, float]:
        theta = block.values[:, block.channels.index("theta_0")]
        along, across = by * _sign(random), by * _sign(random)
        x, y = block.channels.index("r_S_x"), block.channels.index("r_S_y")
        block.values[:, x] += along * np.cos(theta) - across * np.sin(theta)
        block.values[:, y] += along * np.sin(theta) + across * np.cos(theta)
        return {("tracked_point", "base", "x"): along, ("tracked_point", "base", "y"): across}

    return distort


def clock(by: float) -> Samples:
    """The camera, which sees base and markers, is late or early by so much, s."""

    def distort(system: System, block: Block, random: np.random.Generator) -> dict[Key, float]:
        seen = _columns(block, "r_S", "theta_0", "link_")
        late = by * _sign(random)
        block.values[:, seen] = make_interp_spline(block.t, block.values[:, seen], 5)(block.t - late)
        return {("clock", where, ""): late for where in ("base", "markers")}

    return distort


def once_per_turn(by: float) -> Samples:
    """Every encoder is off by so much once a turn, rad."""

    def distort(system: System, block: Block, random: np.random.Generator) -> dict[Key, float]:
        out: dict[Key, float] = {}
        for k in _columns(block, "q_", "theta_m"):
            phase = random.uniform(0.0, 2.0 * np.pi)
            block.values[:, k] += by * np.sin(block.values[:, k] + phase)
            parts = {"sine": np.cos(phase), "cosine": np.sin(phase)}
            out |= {("once_per_turn", block.channels[k], part): by * float(share) for part, share in parts.items()}
        return out

    return distort


def marker_zero(by: float) -> Samples:
    """Every marker's displacement has a zero of so much, m."""

    def distort(system: System, block: Block, random: np.random.Generator) -> dict[Key, float]:
        out: dict[Key, float] = {}
        for k in _columns(block, "link_"):
            if ".u_" in block.channels[k]:
                zero = out["marker_zero", block.channels[k], ""] = by * _sign(random)
                block.values[:, k] += zero
        return out

    return distort


def torque_gain(by: float) -> Samples:
    """The torque of joint 2 is read with another gain."""

    def distort(system: System, block: Block, random: np.random.Generator) -> dict[Key, float]:
        gain = by * _sign(random)
        block.values[:, block.channels.index("tau_2")] *= 1.0 + gain
        return {("drive_gain", "joint_2", "against joint_1"): gain}

    return distort


def stamps(by: float) -> Samples:
    """Encoders, of one device, are read at random by so much before or after their stamps, s."""

    def distort(system: System, block: Block, random: np.random.Generator) -> dict[Key, float]:
        read = _columns(block, "q_", "theta_m")
        early = by * random.standard_normal(block.t.size)
        block.values[:, read] = make_interp_spline(block.t, block.values[:, read], 5)(block.t - early)
        return {}

    return distort


def _coloured(exact: Block, block: Block, time: float) -> Block:
    """The samples with noise of the same size at the markers that is correlated over a time, s."""
    seen, fade = _columns(block, "link_"), np.exp(-float(np.median(np.diff(block.t))) / time)
    noise = block.values[:, seen] - exact.values[:, seen]
    first = (1.0 - np.sqrt(1.0 - fade**2)) * noise[:1]
    filtered = lfilter([np.sqrt(1.0 - fade**2)], [1.0, -fade], noise, axis=0)
    values = block.values.copy()
    values[:, seen] = exact.values[:, seen] + filtered + first * fade ** np.arange(block.t.size)[:, None]
    return Block(block.t, block.channels, values)


def encoder_zero(by: float) -> Samples:
    """Every encoder has a zero of so much, rad."""

    def distort(system: System, block: Block, random: np.random.Generator) -> dict[Key, float]:
        out: dict[Key, float] = {}
        for k in _columns(block, "q_", "theta_m"):
            zero = out["encoder_zero", block.channels[k], ""] = by * _sign(random)
            block.values[:, k] += zero
        return out

    return distort


@cache
def _described(friction: bool) -> System:
    """The planar example, its joints with declared friction or without."""
    system = load_system(SYSTEM)
    return declaring(system, [parse_effect(effect, system) for effect in FRICTION if friction])


def _geometry(system: System, length: float, axis: float) -> System:
    first, *others = system.links
    joint = system.joints[1]
    mount = (Rotation.from_rotvec(joint.mount_rotation) * Rotation.from_rotvec((0.0, 0.0, axis))).as_rotvec()
    turned = joint.model_copy(update={"mount_rotation": tuple(mount.tolist())})
    longer = first.model_copy(update={"length": first.length + length})  # type: ignore[union-attr]
    joints = (system.joints[0], turned, *system.joints[2:])
    return system.model_copy(update={"links": (longer, *others), "joints": joints})


@dataclass(frozen=True)
class Kind:
    """What befalls the samples, how much longer link 1 is, m, by how much joint 2 is turned, rad; and friction."""

    samples: tuple[Samples, ...] = ()
    length: float = 0.0
    axis: float = 0.0
    friction: bool = False


ALL = (tracked_point(2e-4), clock(5e-5), once_per_turn(2e-5), marker_zero(1e-4), torque_gain(1e-3))
KINDS: dict[str, Kind] = {
    "clean": Kind(),
    "tracked point 0.2 mm": Kind((tracked_point(2e-4),)),
    "tracked point 1 mm": Kind((tracked_point(1e-3),)),
    "tracked point 5 mm": Kind((tracked_point(5e-3),)),
    "length 0.12 mm": Kind(length=LENGTH),
    "axis 0.5 mrad": Kind(axis=AXIS),
    "camera 50 us": Kind((clock(5e-5),)),
    "camera 0.5 ms": Kind((clock(5e-4),)),
    "camera 4 ms": Kind((clock(4e-3),)),
    "once per turn 2e-5": Kind((once_per_turn(2e-5),)),
    "once per turn 1e-4": Kind((once_per_turn(1e-4),)),
    "marker zero 1e-4": Kind((marker_zero(1e-4),)),
    "torque gain 0.1 %": Kind((torque_gain(1e-3),)),
    "all": Kind(ALL, LENGTH, AXIS),
    "stamps 0.1 ms": Kind((stamps(1e-4),)),
    "stamps 0.5 ms": Kind((stamps(5e-4),)),
    "markers 5 ms": Kind(),
    "markers 50 ms": Kind(),
    "friction": Kind(friction=True),
    "friction, encoders": Kind((once_per_turn(2e-5), encoder_zero(1e-4)), friction=True),
    "friction, all": Kind((*ALL, encoder_zero(1e-4)), LENGTH, AXIS, friction=True),
}
# Correlation time, s, of the markers' noise where it is not white.
COLOURS = {"markers 5 ms": 5e-3, "markers 50 ms": 5e-2}


@cache
def _exact(folder: Path, length: float, axis: float, friction: bool) -> Block:
    system = _geometry(_described(friction), length, axis)
    rubbing = "-friction" if friction else ""
    return exact_session(system, folder / f"{SYSTEM}{rubbing}-{length:g}-{axis:g}.npz")


def run(args: argparse.Namespace) -> None:
    """Append the sessions that the results lack, seed by seed."""
    folder = args.results.parent
    for kind in args.kinds:
        _exact(folder, KINDS[kind].length, KINDS[kind].axis, KINDS[kind].friction)
    wanted = product(range(args.seeds), args.kinds, args.tolerances)
    tasks = [({"kind": k, "tolerances": t, "seed": seed}, (folder, k, t, seed)) for seed, k, t in wanted]
    complete(args, one_session, tasks)


def one_session(folder: Path, kind: str, tolerances: str, seed: int) -> Record:
    """Estimate, its deviations and judgement."""
    own = KINDS[kind]
    described = _described(own.friction)
    exact = _exact(folder, own.length, own.axis, own.friction)
    block = Block(exact.t, exact.channels, exact.values.copy())
    random = np.random.default_rng(seed)
    true: dict[Key, float] = {}
    for distort in own.samples:
        true |= distort(described, block, random)
    without, block = block, noisy_session(described, block, GRADE, seed)
    if kind in COLOURS:
        block = _coloured(without, block, COLOURS[kind])
    stated = Tolerances() if tolerances == "default" else Tolerances.model_validate(tolerances)
    system = disguised(described, random).model_copy(update={"tolerances": stated})
    start = process_time()
    estimator = session_of(system, block.pieces(PIECE))
    evaluation = JudgedEvaluation(statistics_of(estimator))
    estimate, nuisances = evaluation.estimate, evaluation.statistics.setup.nuisances
    found = zip(nuisances, estimate.nuisances.tolist(), estimate.nuisances_std.tolist(), strict=True)
    said = {(each.name, each.where, each.part) for each in evaluation.calibration if each.certain}
    return {
        "estimate": estimate.pi.tolist(),
        "std": evaluation.std.tolist(),
        "nuisances": [[n.name, n.where, n.part, value, std] for n, value, std in found],
        "true": [[*key, value, key in said] for key, value in true.items()],
        "chi2": estimate.rss / estimate.dof,
        "level": evaluation.trust.level,
        "sentence": evaluation.trust.sentence,
        "reasons": list(evaluation.trust.reasons),
        "seconds": process_time() - start,
    }


def summary(records: list[Record]) -> str:
    """Coverage of the 95 % intervals, root mean square of errors over their bars, and bars, kind by kind.

    said: share of what is wrong that is reported with its size; within: that is within three of its deviations.
    """
    names = ("sessions", "cover", "rms z", "worst z", "bars", "green", "said", "within", "s")
    lines = [f"{'kind':24}{'tolerances':>12}" + "".join(f"{name:>9}" for name in names)]
    for kind in KINDS:
        for tolerances in TOLERANCES:
            own = [r for r in records if (r["kind"], r["tolerances"]) == (kind, tolerances)]
            if own:
                friction = KINDS[kind].friction
                clean = _stds(records, "friction" if friction else "clean", "none")
                lines.append(_line(kind, tolerances, own, true_parameters(_described(friction)), clean))
    return "\n".join(lines)


def _stds(records: list[Record], kind: str, tolerances: str) -> Array:
    own = [r["std"] for r in records if (r["kind"], r["tolerances"]) == (kind, tolerances)]
    return np.median(np.array(own, dtype=float), axis=0)


def _line(kind: str, tolerances: str, own: list[dict[str, Any]], truth: Array, clean: Array) -> str:
    estimate, std = (np.array([r[key] for r in own], dtype=float) for key in ("estimate", "std"))
    z = (estimate - truth) / std
    green = sum(r["level"] == "trust" for r in own)
    bars = float(np.median(np.median(std, axis=0) / clean))
    seconds = float(np.median([r["seconds"] for r in own]))
    numbers = [
        f"{len(own)}", f"{np.mean(np.abs(z) < NORMAL_95):.3f}", f"{np.sqrt(np.mean(z**2)):.2f}",
        f"{np.abs(z).max():.1f}", f"{bars:.2f}", f"{green}", *_calibration(own), f"{seconds:.1f}",
    ]  # fmt: skip
    return f"{kind:24}{tolerances:>12}" + "".join(f"{number:>9}" for number in numbers)


def _calibration(own: list[dict[str, Any]]) -> tuple[str, str]:
    """Shares of what is wrong in some sessions that are said, and within three deviations of the estimate."""
    said, within = [], []
    for record in own if own[0]["nuisances"] else ():  # without tolerances there is nothing to say
        found = {tuple(key): (value, std) for *key, value, std in record["nuisances"]}
        for *key, true, certain in record["true"]:
            value, std = found[tuple(key)]
            said.append(certain)
            within.append(abs(value - true) < WITHIN * std)
    return (f"{np.mean(said):.2f}", f"{np.mean(within):.2f}") if said else ("", "")


if __name__ == "__main__":
    campaign(
        __doc__,
        {"run": run, "summary": summed(summary)},
        seeds={"type": int, "default": 10, "help": "seeds 0, 1, … of each kind, 10 by default"},
        kinds={"nargs": "+", "choices": list(KINDS), "default": list(KINDS)},
        tolerances={"nargs": "+", "choices": TOLERANCES, "default": list(TOLERANCES)},
    )
