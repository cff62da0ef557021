"""What has changed: hypotheses about an event, compared by generalized likelihood ratio.

After an event the rows obey Y β + Z δ = b with δ the jumps of a few parameters: Z holds columns of the model, or some
that it did not have before (a payload, friction). The rows before the event know β. So each hypothesis is a choice of
columns, and its likelihood ratio is what they take off the residual sum of squares.
Source: Willsky and Jones, IEEE Trans. Automatic Control 21 (1976) 108 (generalized likelihood ratio of jumps).
"""

from __future__ import annotations

from collections.abc import Iterable
from dataclasses import dataclass, replace

import numpy as np

from sms_online.description.bodies import RigidBody
from sms_online.description.schema import Effect, System
from sms_online.effects.build import build_model
from sms_online.effects.catalogue import BEGINNING, ENTRIES, places
from sms_online.model.base_parameters import BaseParameters
from sms_online.model.model import Model
from sms_online.model.parameters import Parameter
from sms_online.stream import Array
from sms_online.trackers.factor import solve

# What a further jump must take off the residual sum of squares: 1e-5 of all noise does; and this share of what the
# event has put there, for the rows' own errors of second order.
COST_OF_A_JUMP = 20.0
LEAST_SHARE = 1e-6
# A hypothesis explains the rows when it leaves at most this times their predicted variance, known as it is from a noise
# that is known to 5 %, and so many standard deviations of its scatter.
EXPLAINED = 1.3
SCATTER = 4.0
# Or when it takes off all but this share of what is beyond noise: real friction is never quite its model.
UNEXPLAINED = 0.02
# The runner-up with as many jumps must leave so much more; one that leaves the same is the same hypothesis in other
# words (a payload on a rigid link is a heavier link).
DECISIVE = 10.0
SAME = 1e-3

# Standard deviations from which on a jump is certain, and its rate behind it certainly less.
CERTAIN = 5.0
# A column of which the others leave less than this share cannot jump alone.
FREE = 1e-6

# Kind of an event in which a body is grasped or released.
PAYLOAD = "payload"
# Kinds of events by the ends of the parameter that jumped.
KINDS = {"stiffness": ("stiffness", "rigidity", "rigidity_y", "rigidity_z"), "damping": ("damping",)}


@dataclass(frozen=True)
class Jump:
    """Hypothesis that some parameters jumped.

    kind: of event. columns: in [Y Z], Z after the n columns of Y.
    """

    kind: str
    columns: tuple[int, ...]


@dataclass(frozen=True)
class Explanation:
    """The best of several hypotheses about the rows after an event.

    jump: None where the rows determine no hypothesis. sizes, stds: of each jump (p,). beta (n,): the parameters
    as they were before, from all rows. explained: whether it leaves little but noise. decisive: whether the next best
    leaves clearly more. needed: whether more than noise is left without it; pays: whether it takes as much as a jump
    costs.
    """

    jump: Jump | None
    sizes: Array
    stds: Array
    beta: Array
    explained: bool
    decisive: bool
    needed: bool
    pays: bool

    @property
    def changed(self) -> bool:
        """Whether the rows show that anything has changed."""
        return self.needed or self.pays


def everything(system: System) -> System:
    """The system with a payload, and with every effect that may begin in a session at every joint that can have it."""
    declared = {effect.key for effect in system.effects}
    at = {name: places(system, ENTRIES[name].at) for name in BEGINNING}
    joints = [f"joint_{i}" for i in range(1, len(system.joints) + 1)]
    every = [Effect(name=name, where=where) for where in joints for name in BEGINNING if where in at[name]]
    missing = [effect for effect in every if effect.key not in declared]
    payload = RigidBody() if system.payload is None else system.payload
    return system.model_copy(update={"payload": payload, "effects": (*system.effects, *missing)})


def additional(system: System, model: Model, base: BaseParameters) -> list[str]:
    """Names of the parameters of `model`, of the system with everything, that neither the system nor `base` holds."""
    held = {p.name for p in build_model(system).parameters} | {p.name for p in base.parameters}
    return [p.name for p in model.parameters if p.name not in held]


def restricted(system: System, names: Iterable[str]) -> System:
    """The system with no more than what the parameters `names` need."""
    names = list(names)
    whole = everything(system)
    payload = whole.payload if any(name.startswith("payload.") for name in names) else system.payload
    owners = {name.rsplit(".", 1)[0] for name in names}
    effects = [effect for effect in whole.effects if effect in system.effects or effect.key in owners]
    return system.model_copy(update={"payload": payload, "effects": tuple(effects)})


def extended(base: BaseParameters, model: Model, names: Iterable[str]) -> BaseParameters:
    """`base` as parameters of a larger model, with further parameters `names` of it, which begin at zero, appended."""
    place = {p.name: k for k, p in enumerate(model.parameters)}

    def placed(indices: Iterable[int]) -> tuple[int, ...]:
        return tuple(place[base.physical[k].name] for k in indices)

    fresh = tuple(place[name] for name in names)
    independent, dependent = (*placed(base.independent), *fresh), placed(base.dependent)
    absent = tuple(k for k in range(model.n_pi) if k not in independent and k not in dependent)
    return replace(
        base,
        physical=model.parameters,
        parameters=(*base.parameters, *(model.parameters[k] for k in fresh)),
        independent=independent,
        dependent=dependent,
        absent=absent,
        mixture=np.concatenate((base.mixture, np.zeros((len(fresh), len(dependent))))),
        known=tuple((placed([k])[0], value) for k, value in base.known),
    )


def hypotheses(parameters: tuple[Parameter, ...]) -> list[Jump]:
    """One parameter each, then natural groups: a payload's body, a joint's spring and damper, its friction.

    Of hypotheses that say the same the first counts: rather a payload than a heavier link.
    """
    names = [p.name for p in parameters]
    out = [Jump(kind_of([name]), (k,)) for k, name in enumerate(names)]
    out.sort(key=lambda jump: jump.kind != PAYLOAD)
    groups: dict[str, list[int]] = {}
    for k, name in enumerate(names):
        owner = name.rsplit(".", 1)[0]
        if "@" in name:
            owner = "friction@" + owner.split("@")[1]
        if owner == "payload" or owner.startswith(("joint_", "friction@")):
            groups.setdefault(owner, []).append(k)
    out += [Jump(kind_of([names[k] for k in columns]), tuple(columns)) for columns in groups.values() if columns[1:]]
    return out


def kind_of(names: list[str]) -> str:
    """Kind of an event in which these parameters jumped."""
    name = names[0]
    if name.startswith("payload."):
        return PAYLOAD
    if "@" in name:
        return ENTRIES[name.split("@")[0]].change
    return next((kind for kind, ends in KINDS.items() if name.endswith(ends)), "inertia")


def explain(factor: Array, rows: Array, jumps: list[Jump], alike: float = 1.0) -> Explanation:
    """The best of the hypotheses `jumps`.

    factor (n + 1, n + 1): information of the rows before the event. rows (M, n + m + 1): [Y Z b] after it, whitened.
    alike: so many rows have one error in common, and count as one.
    """
    n, M = len(factor) - 1, len(rows)
    before = np.concatenate((factor[:n, :n], rows[:, :n]))
    jumped = np.concatenate((np.zeros((n, rows.shape[1] - 1)), rows[:, :-1]))
    b = np.concatenate((factor[:n, -1], rows[:, -1]))
    norm = np.linalg.norm(before, axis=0)
    Q = np.linalg.qr(before / np.where(norm > 0.0, norm, 1.0))[0]
    # What is left of the columns once β is free: parameters that nothing is known of leave no jump to be seen.
    free = jumped - Q @ (Q.T @ jumped)
    size, left = np.linalg.norm(jumped, axis=0), np.linalg.norm(free, axis=0)
    seen = left > FREE * size
    residual = b - Q @ (Q.T @ b)
    scaled = free / np.where(seen, left, 1.0)
    ranked = []
    for jump in jumps:
        columns = list(jump.columns)
        if seen[columns].all():
            delta = np.linalg.lstsq(scaled[:, columns], residual, rcond=None)[0]
            rest = residual - scaled[:, columns] @ delta
            ranked.append((float(rest @ rest), jump))
    without = float(residual @ residual)
    cost = alike * COST_OF_A_JUMP + LEAST_SHARE * without
    ranked.sort(key=lambda entry: round((entry[0] + cost * len(entry[1].columns)) / SAME))
    if not ranked:
        return Explanation(None, np.empty(0), np.empty(0), solve(factor).pi, False, True, True, False)
    rss, best = ranked[0]
    others = [other - rss for other, jump in ranked[1:] if len(jump.columns) == len(best.columns)]
    decisive = all(more > alike * DECISIVE or more < SAME for more in others)
    columns = list(best.columns)
    fitted = solve(np.column_stack((before, jumped[:, columns], b)))
    std = np.sqrt(alike) * np.linalg.norm(fitted.root, axis=1)
    freedom = M - len(columns)
    beyond_noise = max(rss - freedom, 0.0) / max(without - M, 1.0)
    explained = rss <= _most_of_noise(freedom) or beyond_noise <= UNEXPLAINED
    needed, pays = without > _most_of_noise(M), without - rss > cost * len(columns)
    return Explanation(best, fitted.pi[n:], std[n:], fitted.pi[:n], explained, decisive, needed, pays)


def goes_on(factor: Array, rows: Array, ramps: Array, explanation: Explanation, alike: float = 1.0) -> float:
    """Share of its size by which what jumped may go on in 1 s, that of the parameter which may do so most.

    Infinite where no jump is certain. factor, rows, alike: see `explain`. ramps (M, p): what each parameter that jumped
    adds to the rows if it goes on by 1 in 1 s.
    """
    assert explanation.jump is not None
    n, columns = len(factor) - 1, list(explanation.jump.columns)
    before = np.concatenate((factor[:n, :n], np.zeros((n, len(columns) + 1)), factor[:n, -1:]), axis=1)
    shares = []
    for ramp, size, std in zip(ramps.T, explanation.sizes.tolist(), explanation.stds.tolist(), strict=True):
        if abs(size) > CERTAIN * std:
            after = np.column_stack((rows[:, :n], rows[:, columns], ramp, rows[:, -1]))
            fitted = solve(np.concatenate((before, after)))
            deviation = np.sqrt(alike) * float(np.linalg.norm(fitted.root[-1]))
            shares.append((abs(float(fitted.pi[-1])) + CERTAIN * deviation) / abs(size))
    return max(shares, default=np.inf)


def _most_of_noise(freedom: int) -> float:
    return float(EXPLAINED * (freedom + SCATTER * np.sqrt(2.0 * freedom)))
