"""The drawn arm is the measured and modelled one: markers, tip, links, ghost."""

from __future__ import annotations

import numpy as np
import pytest

from sms_adapters.system_file import load_system
from sms_online.description.bodies import FlexibleLink
from sms_online.description.parse import parse_system
from sms_online.effects.build import build_model
from sms_online.model.base_parameters import random_states
from sms_online.model.model import Model
from sms_online.model.so3 import RotationVector
from sms_online.pipeline.sensing import Sensing
from sms_online.stream import Array, Block
from sms_tools.view.readings import Readings, SampleAndHold
from sms_tools.view.scene import STUB, Scene

SEED = 11
RIGID_AXIS = """
name = "axis"
motion = "planar"
sample_rate = 100.0
[joint_1]
kind = "{kind}"
axis = {axis}
transmission = "rigid"
[link_1]
kind = "rigid"
mass = 1.0
{link}
"""
SYSTEMS = ("paper-planar", "paper-planar-exact", "spatial-two-link", "seven-joint", "quanser-2dsfl")


def states(model: Model, count: int = 20) -> Array:
    return random_states(model, count, np.random.default_rng(SEED))[0]


@pytest.mark.parametrize("name", SYSTEMS)
def test_the_drawn_tip_is_the_forward_kinematics(name: str) -> None:
    model = build_model(load_system(name))
    x = states(model)
    drawing = Scene(model).draw(x)
    end = model.chain.configure(x).frames[-1].origin
    np.testing.assert_allclose(drawing.tip, end, rtol=0, atol=1e-12)
    np.testing.assert_allclose(drawing.links[-1][:, -1], end, rtol=0, atol=1e-12)


@pytest.mark.parametrize("name", SYSTEMS)
def test_links_hang_together(name: str) -> None:
    drawing = Scene(build_model(load_system(name))).draw(states(build_model(load_system(name))))
    for i, line in enumerate(drawing.links):
        np.testing.assert_allclose(line[:, 0], drawing.joints[:, i], rtol=0, atol=1e-12)
        if i + 1 < len(drawing.links):
            np.testing.assert_allclose(line[:, -1], drawing.joints[:, i + 1], rtol=0, atol=1e-12)


def rigid_axis(kind: str, link: str) -> Scene:
    axis = "[0.0, 0.0, 1.0]" if kind == "revolute" else "[1.0, 0.0, 0.0]"
    return Scene(build_model(parse_system(RIGID_AXIS.format(kind=kind, axis=axis, link=link), "axis.toml")))


def test_a_rigid_link_without_a_tip_ends_in_its_centre_of_mass() -> None:
    drawing = rigid_axis("revolute", "center_of_mass = [0.2, 0.1, 0.0]").draw(np.array([[0.0], [np.pi / 2.0]]))
    np.testing.assert_allclose(drawing.links[0][:, 0], 0.0, atol=1e-12)
    np.testing.assert_allclose(drawing.links[0][:, -1], [[0.2, 0.1, 0.0], [-0.1, 0.2, 0.0]], atol=1e-12)
    np.testing.assert_array_equal(drawing.tip, drawing.links[0][:, -1])
    np.testing.assert_array_equal(drawing.ghost[:, -1], drawing.tip)


def test_a_link_of_no_stated_point_is_seen_to_turn() -> None:
    scene = rigid_axis("revolute", "")
    tip = scene.draw(np.array([[0.0], [np.pi / 2.0]])).tip
    assert np.linalg.norm(tip, axis=1) == pytest.approx(STUB * scene.reach)
    assert np.dot(*tip) == pytest.approx(0.0, abs=1e-12)


def test_a_slide_is_drawn_from_where_it_is_mounted() -> None:
    (line,) = rigid_axis("prismatic", "").draw(np.array([[0.3]])).links
    np.testing.assert_allclose(line[0, [0, -1]], [[0.0, 0.0, 0.0], [0.3, 0.0, 0.0]], atol=1e-12)


def measured_marker(model: Model, readings: dict[str, float], i: int, j: int) -> Array:
    """Where a marker of a planar arm is, from its readings, written out by hand along the chain."""
    system = model.system
    assert system.spacecraft is not None
    angle = readings["theta_0"]
    turn = RotationVector(np.array((0.0, 0.0, angle))).matrix
    point = np.array((readings["r_S_x"], readings["r_S_y"], 0.0)) - turn @ np.array(system.spacecraft.tracked_point)
    for k, link in enumerate(system.links[:i], start=1):
        assert isinstance(link, FlexibleLink)
        angle += readings[f"q_{k}"]
        turn = RotationVector(np.array((0.0, 0.0, angle))).matrix
        last = j if k == i else link.elements
        marker = f"link_{k}.marker_{last}"
        along = link.length * last / link.elements
        shown = np.array((along + readings.get(f"{marker}.u_x", 0.0), readings[f"{marker}.u_y"], 0.0))
        if k == i:
            return np.asarray(point + turn @ shown)
        point = point + turn @ shown
        angle += readings[f"{marker}.theta_z"]
    raise AssertionError


def test_markers_are_where_they_were_measured(planar_block: Block) -> None:
    model = build_model(load_system("paper-planar"))
    scene = Scene(model)
    rows = slice(0, None, 997)
    values = planar_block.values[rows]
    positions = values[:, [planar_block.channels.index(name) for name in model.layout.position_names]]
    drawing = scene.draw(positions)
    for row, sample in enumerate(values):
        readings = dict(zip(planar_block.channels, sample.tolist(), strict=True))
        for column, (i, j) in enumerate(scene.markers):
            expected = measured_marker(model, readings, i, j)
            np.testing.assert_allclose(drawing.markers[row, column], expected, rtol=0, atol=1e-9)


def test_the_last_marker_of_each_link_is_its_end() -> None:
    model = build_model(load_system("spatial-two-link"))
    scene = Scene(model)
    drawing = scene.draw(states(model))
    for column, (i, j) in enumerate(scene.markers):
        link = model.system.links[i - 1]
        assert isinstance(link, FlexibleLink)
        if j == link.elements:
            np.testing.assert_allclose(drawing.markers[:, column], drawing.links[i - 1][:, -1], rtol=0, atol=1e-12)


@pytest.mark.parametrize("name", ["paper-planar", "paper-planar-exact", "seven-joint"])
def test_without_deflections_the_arm_is_its_ghost(name: str) -> None:
    model = build_model(load_system(name))
    stiff = Scene(model, exaggeration=0.0).draw(states(model))
    np.testing.assert_allclose(stiff.joints, stiff.ghost[:, :-1], rtol=0, atol=1e-12)
    np.testing.assert_allclose(stiff.tip, stiff.ghost[:, -1], rtol=0, atol=1e-12)


def test_exaggeration_multiplies_a_links_deflection() -> None:
    model = build_model(load_system("paper-planar"))
    x = np.zeros((1, model.layout.n_x))
    x[0, model.layout.position_names.index("link_1.marker_1.u_y")] = 0.01
    once, tenfold = (Scene(model, factor).draw(x).markers[0, 0] for factor in (1.0, 10.0))
    straight = Scene(model, 0.0).draw(x).markers[0, 0]
    np.testing.assert_allclose(tenfold - straight, 10.0 * (once - straight), rtol=1e-12)


def test_the_spacecraft_holds_joint_1_and_its_tracked_point() -> None:
    for name in ("paper-planar", "seven-joint"):
        system = load_system(name)
        assert system.spacecraft is not None
        center, half = Scene(build_model(system)).box
        axes = slice(0, 2 if system.motion == "planar" else 3)
        for point in (np.zeros(3), np.array(system.spacecraft.tracked_point)):
            assert np.all(np.abs(point - center)[axes] <= half[axes])


def test_a_channel_keeps_its_last_reading() -> None:
    channels = ("q_2", "tau_1", "q_1")
    held = SampleAndHold(["q_1", "q_2"], channels)
    assert np.isnan(held.last).all()
    first = np.array([[9.0, 0.0, np.nan]])
    np.testing.assert_array_equal(held.push(Block(np.zeros(1), channels, first)), [[np.nan, 9.0]])
    later = np.array([[np.nan, 0.0, 1.0], [2.0, 0.0, np.nan], [np.nan, 0.0, 3.0]])
    np.testing.assert_array_equal(held.push(Block(np.ones(3), channels, later)), [[1.0, 9.0], [1.0, 2.0], [3.0, 2.0]])
    np.testing.assert_array_equal(held.last, [3.0, 2.0])


@pytest.mark.parametrize("size", [1, 7, 400])
def test_pictures_come_at_their_rate_however_samples_are_split(planar_block: Block, size: int) -> None:
    model = build_model(load_system("paper-planar"))
    readings = Readings(Sensing(model, planar_block.channels, "test"), planar_block.channels)
    block = Block(planar_block.t[:2000], planar_block.channels, planar_block.values[:2000])
    t = [readings.push(piece)[0] for piece in block.pieces(size)]
    np.testing.assert_allclose(np.concatenate(t), np.arange(0.0, 1.9999, 0.05), rtol=0, atol=1.1e-3)


def test_nothing_is_drawn_before_every_channel_has_a_reading(planar_block: Block) -> None:
    model = build_model(load_system("paper-planar"))
    values = planar_block.values[:500].copy()
    values[:120, planar_block.channels.index("theta_0")] = np.nan
    readings = Readings(Sensing(model, planar_block.channels, "test"), planar_block.channels)
    t, x = readings.push(Block(planar_block.t[:500], planar_block.channels, values))
    assert t[0] >= 0.12
    assert np.isfinite(x).all()
