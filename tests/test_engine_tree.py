"""Arms as they are built against a second engine: brackets at flexible links, and a tree of two arms with a panel."""

from __future__ import annotations

import numpy as np
import pytest

from sms_online.description.parse import parse_system
from sms_online.effects.build import build_model
from sms_sim.simulate import sampled_blocks, simulate
from tests.engine_tree import hanging_end, tree_capture
from tests.exactly_known import exactly_known
from tests.sessions_of import session_of
from tests.test_truncation import HELD, PER_MARKER, hanging, with_elements

# Coarse links, whose static deflections are exact: the motion starts without a jolt and is slow against their modes.
CELLS, STEP = 8, 1.25e-4
FLEXIBLE = """
kind = "flexible"
elements = 2
mass_per_length = 5.0
polar_inertia_per_length = 0.0004
flexural_rigidity_y = 400.0
flexural_rigidity_z = 300.0
torsional_rigidity = 80.0
"""
TORSION = 'deformations = ["torsion", "bending_y", "bending_z"]'
# A straight panel with nothing beside its axis is hardly twisted, so that its torsion is not described.
NO_TORSION = 'deformations = ["bending_y", "bending_z"]'
# Of a part that was weighed before it was built in: beside the links too small to be seen.
WEIGHED = """
"motor_2.stator_inertia_xx" = 0.01
"motor_2.stator_inertia_yy" = 0.011
"motor_2.stator_inertia_zz" = 0.012
"motor_2.stator_inertia_xy" = 0.0
"motor_2.stator_inertia_xz" = 0.0
"motor_2.stator_inertia_yz" = 0.0
"""
BASE = """
[spacecraft]
mass = 60.0
center_of_mass = [-0.4, -0.3, 0.1]
inertia = { xx = 12.0, yy = 14.0, zz = 15.0, xy = 0.5, xz = -0.4, yz = 0.3 }
tracked_point = [-0.5, -0.6, 0.2]
"""
MOTOR = """
mass = 1.5
rotor_inertia = 0.002
stator_inertia = { xx = 0.01, yy = 0.011, zz = 0.012 }
"""
# Of the first two joints, which begins and ends at rest.
MOTION = """
[trajectory]
duration = 8.0
joint_1 = [
    { frequency = 2.0, sine = 0.6 },
    { frequency = 4.0, sine = -0.3 },
    { frequency = 7.0, cosine = 0.05 },
    { frequency = 5.0, cosine = -0.098 },
]
joint_2 = [
    { frequency = 3.0, sine = 0.5 },
    { frequency = 5.0, sine = -0.3 },
    { frequency = 8.0, cosine = 0.045 },
    { frequency = 6.0, cosine = -0.08 },
]
"""
GEAR = """
gear_ratio = 30.0
stiffness = 900.0
damping = 20.0"""
BRACKETS = f"""
name = "brackets"
{BASE}
[known]
"link_1.polar_inertia_per_length" = 0.0004
"link_2.polar_inertia_per_length" = 0.0004{WEIGHED}
[joint_1]
axis = [0.0, 0.0, 1.0]{GEAR}
[motor_1]{MOTOR}
[link_1]{FLEXIBLE}{TORSION}
length = 1.0
root_position = [0.1, 0.05, 0.2]
root_rotation = [0.2, -0.3, 0.4]
[joint_2]
axis = [0.0, 1.0, 0.0]
mount_position = [0.05, 0.1, 0.3]
mount_rotation = [0.3, 0.4, -0.2]{GEAR}
[motor_2]{MOTOR}
[link_2]{FLEXIBLE}{TORSION}
length = 0.9
root_position = [-0.05, 0.1, 0.1]
root_rotation = [0.0, 0.5, 0.1]
[payload]
mass = 3.0
center_of_mass = [0.1, 0.2, -0.15]
inertia = {{ xx = 0.1, yy = 0.12, zz = 0.15, xy = 0.01, xz = -0.01, yz = 0.02 }}
[controller]
stiffness = [200.0, 150.0]
damping = [60.0, 40.0]
{MOTION}"""
TREE = f"""
name = "tree"
{BASE}
[known]
"link_1.polar_inertia_per_length" = 0.0004
"link_3.polar_inertia_per_length" = 0.0004
[joint_1]
axis = [0.0, 0.0, 1.0]{GEAR}
[motor_1]{MOTOR}
[link_1]{FLEXIBLE}{TORSION}
length = 1.0
root_position = [0.1, 0.05, 0.1]
[joint_2]
parent = "base"
mount_position = [-0.2, -0.8, 0.1]
mount_rotation = [0.2, 0.1, -1.2]
axis = [0.0, 1.0, 0.0]
transmission = "rigid"
[link_2]
kind = "rigid"
mass = 4.0
center_of_mass = [0.3, 0.05, 0.02]
inertia = {{ xx = 0.1, yy = 0.3, zz = 0.35 }}
tip = [0.6, 0.0, 0.0]
[joint_3]
parent = "base"
mount_position = [-0.9, 0.2, 0.1]
mount_rotation = [0.0, 0.0, 2.6]
axis = [0.0, 1.0, 0.0]
passive = true
stiffness = 60.0
damping = 1.0
[link_3]{FLEXIBLE}{NO_TORSION}
length = 1.2
[joint_4]
parent = "link_2"
axis = [0.0, 0.0, 1.0]
transmission = "rigid"
[link_4]
kind = "rigid"
mass = 3.0
center_of_mass = [0.2, 0.1, 0.05]
inertia = {{ xx = 0.08, yy = 0.1, zz = 0.12 }}
[joint_5]
kind = "fixed"
parent = "link_1"
mount_position = [0.1, 0.0, 0.05]
mount_rotation = [0.0, 0.4, 0.0]
[link_5]
kind = "rigid"
mass = 2.5
center_of_mass = [0.15, 0.2, -0.1]
inertia = {{ xx = 0.08, yy = 0.1, zz = 0.12, xy = 0.01 }}
[controller]
stiffness = [200.0, 150.0, 0.0, 80.0]
damping = [60.0, 40.0, 0.0, 20.0]
{MOTION}joint_3 = []
joint_4 = [
    {{ frequency = 2.5, sine = 0.8 }},
    {{ frequency = 5.0, sine = -0.4 }},
    {{ frequency = 9.0, cosine = 0.08 }},
    {{ frequency = 6.0, cosine = -0.18 }},
]
"""
SYSTEMS = {name: parse_system(text, name) for name, text in (("brackets", BRACKETS), ("tree", TREE))}
DURATION = 8.0  # s
# Largest relative error of a parameter. A body at the end of a flexible link is separated from the link's own
# mass only within what two markers leave out of its shape: 0.7 % at most was measured, up to four standard deviations.
SHARE, AT_A_FLEXIBLE_END = 1e-3, 1e-2
ENDS = ("payload", "link_5")


@pytest.mark.long
@pytest.mark.parametrize("name", SYSTEMS)
def test_every_parameter_is_that_of_the_second_engine(name: str) -> None:
    """Noise-free; the engine shares no equation with the model, its links are chains of rigid segments."""
    system = SYSTEMS[name]
    capture = tree_capture(system, DURATION, CELLS, STEP)
    estimator = session_of(exactly_known(system), [capture])
    assert estimator.by_momentum
    base, estimate = estimator.base, estimator.estimate()
    truth = base.values(estimator.model.nominal)
    assert estimate.determined.all()
    for p, value, true in zip(base.parameters, estimate.pi, truth, strict=True):
        limit = AT_A_FLEXIBLE_END if p.owner in ENDS else SHARE
        assert abs(value - true) < limit * abs(true), (p.name, value, true)


@pytest.mark.parametrize("name", SYSTEMS)
def test_the_simulator_moves_as_the_second_engine(name: str) -> None:
    """From rest for 0.3 s; what differs are the modes of links that have so few segments and markers."""
    system, duration = SYSTEMS[name], 0.3
    engine = tree_capture(system, duration, CELLS, STEP)
    blocks = list(sampled_blocks(simulate(system, duration)))
    ours = np.concatenate([block.values for block in blocks])
    for channel, column in zip(engine.channels, engine.values.T, strict=True):
        if channel.startswith(("tau", "force")):
            continue
        other = ours[:, blocks[0].channels.index(channel)]
        size = 1.0 if channel in ("eta",) else max(float(np.ptp(column)), 1e-3)
        assert np.abs(other - column).max() < (5e-3 if channel.startswith("link") else 3e-4) * size, channel


@pytest.mark.slow
def test_a_finer_chain_twists_as_the_exact_rod() -> None:
    """A link that hangs bent in both planes: a chain bends right with few cells, but twists too much.

    The elements of the rod are so many that more change nothing.
    """
    system = parse_system(HELD, "held")
    rod = build_model(with_elements(system, 8))
    end = rod.chain.flexible[0].markers(rod.chain.elastic(hanging(rod), 0))[0, -PER_MARKER:]
    off = {cells: hanging_end(system, cells) / end - 1.0 for cells in (12, 24, 48)}
    twist = {cells: float(each[2]) for cells, each in off.items()}
    bending = np.delete([*off.values()], 2, axis=1)
    assert np.abs(bending).max() < 1e-4
    assert 0.05 < twist[12] < 0.08
    assert twist[24] < 0.25 * twist[12]
    assert twist[48] < 0.25 * twist[24] < 0.003
