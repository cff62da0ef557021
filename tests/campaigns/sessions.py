"""Sessions of a campaign: a system simulated once, with new sensor noise for every run."""

from __future__ import annotations

import json
from collections.abc import Callable, Sequence
from pathlib import Path
from typing import Any

import numpy as np

from sms_adapters.files import write_text, writing
from sms_online.description.parse import describe
from sms_online.description.schema import System
from sms_online.effects.build import build_model
from sms_online.model.base_parameters import find_base_parameters
from sms_online.stream import Array, Block
from sms_sim.drifting import ParameterDrift
from sms_sim.sensors import Sensors
from sms_sim.simulate import POSITION_TOLERANCE, sampled_blocks, simulate

# Nominal values that an estimator gets to see are these keys of the description times this: any number would do.
DISGUISED = (
    *("mass", "mass_per_length", "polar_inertia_per_length", "rotor_inertia", "xx", "yy", "zz", "xy", "xz", "yz"),
    *("stiffness", "damping", "axial_rigidity", "torsional_rigidity", "flexural_rigidity_y", "flexural_rigidity_z"),
)
DISGUISE = 2.0
# So far a rig may be from its description and be called clean: beyond 1.5 the diagnosis names the common factor.
SLIGHT = 1.2
ROUGH = (1 / 1.4, 1.4)


def exact_session(
    system: System,
    cache: Path,
    position_tolerance: float = POSITION_TOLERANCE,
    duration: float | None = None,
    drifts: Sequence[ParameterDrift] = (),
) -> Block:
    """Exact samples of the system's own trajectory, read from `cache` or else simulated and written there.

    duration: s, the trajectory's own by default. drifts: of its parameters.
    """
    description = json.dumps(describe(system))
    if duration is not None or drifts:
        description += json.dumps([duration, *(drift.document() for drift in drifts)])

    def make() -> Block:
        blocks = list(sampled_blocks(simulate(system, duration, None, None, position_tolerance, drifts=drifts), "0"))
        t, values = (np.concatenate([getattr(block, name) for block in blocks]) for name in ("t", "values"))
        return Block(t, blocks[0].channels, values)

    return cached(cache, description, make)


def cached(cache: Path, description: str, make: Callable[[], Block]) -> Block:
    """Samples of what is described, read from `cache` or else made and written there."""
    if cache.exists():
        with np.load(cache) as saved:
            if str(saved["system"]) == description:
                return Block(saved["t"], tuple(saved["channels"].tolist()), saved["values"])
    block = make()
    with writing(cache) as part, part.open("wb") as file:
        channels = np.array(block.channels)
        np.savez(file, system=np.array(description), t=block.t, channels=channels, values=block.values)
    return block


def cached_bound(cache: Path, make: Callable[[], Array]) -> Array:
    """A Cramér–Rao bound (n,), read from `cache` or else made and written there."""
    if not cache.exists():
        write_text(cache, json.dumps(make().tolist()))
    return np.array(json.loads(cache.read_text(encoding="utf-8")))


def noisy_session(system: System, exact: Block, grade: str | None, seed: int) -> Block:
    """The samples that `simulate --grade --seed` writes; of the described sensors without a grade."""
    sensors = Sensors(system, exact.channels, grade, seed)
    return Block(exact.t, exact.channels, sensors.read(0, exact.values))


def true_parameters(system: System) -> Array:
    """Base parameters (n,) of the nominal values, in the order in which they are estimated."""
    model = build_model(system)
    return find_base_parameters(model).values(model.nominal)


def disguised(system: System, random: np.random.Generator | None = None, factor: float = DISGUISE) -> System:
    """The system with nominal values that are not the true ones, so that no estimator can have read them.

    factor: of every value; beyond 1.5 the verdict is doubt, for so far a rig is not from its description. random: draws
    a factor of 1.4 at most for each value instead.
    """

    def other(key: str, value: Any) -> Any:
        if isinstance(value, dict):
            return {name: other(name, part) for name, part in value.items()}
        if isinstance(value, list):
            return [other("", part) for part in value]
        own = factor if random is None else random.uniform(*ROUGH)
        return own * value if key in DISGUISED else value

    return System.model_validate(other("", describe(system)))
