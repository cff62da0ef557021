"""The sessions of the net: simulated or made up from fixed seeds, a few seconds each."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from functools import cache, partial
from pathlib import Path
from tempfile import TemporaryDirectory

import numpy as np

from sms_adapters.recorder import Recorder
from sms_adapters.session_log import SessionHeader
from sms_adapters.sources import open_source
from sms_adapters.system_file import load_system, shipped_text
from sms_online.description.parse import parse_system
from sms_online.description.schema import Effect, System
from sms_online.effects.catalogue import parse_effect
from sms_online.stream import Block
from sms_sim.simulate import sampled_blocks, simulate
from tests.axis import DAMPING
from tests.axis_effects import BARE, SYSTEM, axis_block, cogging, nothing
from tests.bus_streams import AxisBus, axis_testbed
from tests.changed_session import changed_session, noisy
from tests.one_link import one_link

TOLERANCE = 1e-8  # m, rad: of the simulations, far below the noise
QUANSER_MOTION = """
[controller]
stiffness = [1.0, 0.05]
damping = [0.3, 0.02]

[trajectory]
duration = 6.0
joint_1 = [{ frequency = 2.0, sine = 0.4 }, { frequency = 5.0, sine = 0.1 }]
joint_2 = [{ frequency = 3.0, sine = 0.4 }]
"""
EPOCH = 1_700_000_000_123_456  # µs, of the recording


@dataclass(frozen=True)
class Session:
    """A session of the net.

    system: as the estimator has it. block: its samples. adopt: go on with what is named. prior: start from nominal
    values. diagnosed: by the diagnosis of a whole capture, too.
    """

    system: System
    block: Block
    adopt: bool = False
    prior: bool = False
    diagnosed: bool = False


def joined(blocks: list[Block]) -> Block:
    """Blocks as one."""
    t, values = (np.concatenate([getattr(block, part) for block in blocks]) for part in ("t", "values"))
    return Block(t, blocks[0].channels, values)


def samples(system: System, seconds: float, seed: int = 1) -> Block:
    """What the sensors of a simulated system record, at grade B."""
    return joined(list(sampled_blocks(simulate(system, seconds, position_tolerance=TOLERANCE), "B", seed)))


@cache
def shipped(name: str, seconds: float, prior: bool = False, diagnosed: bool = False) -> Session:
    """A shipped system along its own trajectory."""
    system = load_system(name)
    return Session(system, samples(system, seconds), prior=prior, diagnosed=diagnosed)


def declaring(name: str, *texts: str) -> System:
    """A shipped system with effects, name@where:coefficient=value,…"""
    system = load_system(name)
    return system.model_copy(update={"effects": tuple(parse_effect(text, system) for text in texts)})


def quanser() -> Session:
    """The rig that is shipped without a controller, moved by one."""
    described = load_system("quanser-2dsfl")
    moved = parse_system(shipped_text("quanser-2dsfl") + QUANSER_MOTION, "quanser-2dsfl")
    return Session(described, samples(moved, 6.0), prior=True)


def gap() -> Session:
    """A third of a second is lost, and cells of two channels are empty for some samples."""
    whole = shipped("paper-planar", 4.0)
    block = whole.block
    values = block.values.copy()
    values[1000:1003, 2] = np.nan
    values[3000:3040, 5] = np.nan
    kept = (block.t < 1.6) | (block.t > 1.93)
    return Session(whole.system, Block(block.t[kept], block.channels, values[kept]))


def change() -> Session:
    """A drag of the base that begins at 3 s, and is added to the model."""
    system = load_system("paper-planar")
    drag = Effect(name="air_drag", where="base", coefficients={"damping": 60.0})
    changed = system.model_copy(update={"effects": (drag,)})
    block = changed_session(simulate(system, 3.0, position_tolerance=TOLERANCE), changed, 3.0, 6.5)
    return Session(system, noisy(system, block, "B", 1), adopt=True)


def effects() -> Session:
    """Three effects declared by name, one with an internal state."""
    true = ("coulomb_friction@joint_2:torque=2", "torsional_hysteresis@joint_1:torque=5,width=0.01")
    stated = ("coulomb_friction@joint_2", "torsional_hysteresis@joint_1:width=0.01")
    block = samples(declaring("paper-planar", *true, "cogging@joint_2:amplitude=2,phase=0.3,order=1"), 3.0)
    return Session(declaring("paper-planar", *stated, "cogging@joint_2:order=1"), block)


def undescribed() -> Session:
    """Friction that the description lacks."""
    system = declaring("paper-planar", "coulomb_friction@joint_2:torque=8")
    return Session(load_system("paper-planar"), samples(system, 5.0), diagnosed=True)


def smoothed() -> Session:
    """A link whose slopes are not measured."""
    system = one_link("linear")
    return Session(system, joined(list(sampled_blocks(simulate(system, position_tolerance=TOLERANCE), None, 0))))


def recording() -> Session:
    """What two devices on clocks of their own sent, recorded and read back."""
    with TemporaryDirectory() as name:
        folder = Path(name)
        system = axis_testbed(folder)
        bus = AxisBus(seconds=8.0, drift=(2e-5, -3e-5), offset=0.3)
        recorder = Recorder(folder / "run", SessionHeader(EPOCH, {"drive": "can", "encoder": "serial"}, 0.0, {}))
        recorder.put("drive", [bus.drive()], dropped=False)
        recorder.put("encoder", list(bus.encoder(system)), dropped=False)
        recorder.close(9.0)
        return Session(system, joined(list(open_source(folder / "run", system, directory=folder))))


SESSIONS: dict[str, Callable[[], Session]] = {
    "paper-planar": partial(shipped, "paper-planar", 4.0),
    "paper-planar-table-v": partial(shipped, "paper-planar-table-v", 3.0),
    "paper-planar-exact": partial(shipped, "paper-planar-exact", 3.0),
    "spatial-two-link": partial(shipped, "spatial-two-link", 3.0),
    "seven-joint": partial(shipped, "seven-joint", 4.0),
    "quanser-2dsfl": quanser,
    "emps": partial(shipped, "emps", 3.5),
    "ak80-pendulum": partial(shipped, "ak80-pendulum", 6.0, prior=True),
    "smoother": smoothed,
    "gap": gap,
    "change": change,
    "effects": effects,
    "undescribed": undescribed,
    "recording": recording,
    "axis-adopted": lambda: Session(SYSTEM, axis_block(cogging, 8.0, 14.0), adopt=True),
    "axis-event": lambda: Session(SYSTEM, axis_block(lambda q, rate: DAMPING * rate, 8.0, 14.0)),
    "axis-undescribed": lambda: Session(BARE, axis_block(nothing, seconds=9.0), diagnosed=True),
}
# Those that a run of the suite has time for.
QUICK = ("gap", "smoother", "recording", "axis-adopted", "axis-event", "axis-undescribed", "quanser-2dsfl")
