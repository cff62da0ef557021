"""Systems that declare effects, and what the sensors see of their motions."""

from __future__ import annotations

import numpy as np

from sms_online.description.parse import parse_system, shipped_text
from sms_online.description.schema import System
from sms_online.effects.catalogue import parse_effect
from sms_online.stream import Array
from sms_sim.simulate import Simulation, sampled_blocks


def declaring(*texts: str, name: str = "paper-planar") -> System:
    """A shipped system with effects given as texts."""
    system = parse_system(shipped_text(name), name)
    return system.model_copy(update={"effects": tuple(parse_effect(text, system) for text in texts)})


def sampled(simulation: Simulation, grade: str = "0") -> tuple[Array, dict[str, Array]]:
    """Times (T,), s, and the samples (T,) of each channel. Seed 1."""
    blocks = list(sampled_blocks(simulation, grade, seed=1))
    values = np.concatenate([block.values for block in blocks])
    return np.concatenate([block.t for block in blocks]), dict(zip(blocks[0].channels, values.T, strict=True))
