"""Geometry as built: trees, brackets, fixed and passive joints are accepted, and what is impossible is refused."""

from __future__ import annotations

import pytest

from sms_online.description.bodies import FlexibleLink
from sms_online.description.channels import channels
from sms_online.description.parse import parse_system
from sms_online.description.tree import BASE, tree_of
from tests.refused import assert_refused, refusal

# Two arms on a base: joints 1 and 2 with a bracket (link 4) on link 1, joint 3 a passive panel; an arm's U-joint.
TREE = """
name = "tree"

[joint_1]
axis = [0.0, 0.0, 1.0]
transmission = "rigid"
[link_1]
kind = "flexible"
length = 1.0
elements = 2
mass_per_length = 2.0
polar_inertia_per_length = 0.01
flexural_rigidity_z = 100.0
deformations = ["bending_z"]
root_position = [0.1, 0.0, 0.05]
root_rotation = [0.0, 0.2, 0.0]

[joint_2]
parent = "link_4"
axis = [1.0, 0.0, 0.0]
transmission = "rigid"
[link_2]
kind = "cross"

[joint_3]
axis = [0.0, 1.0, 0.0]
transmission = "rigid"
[link_3]
kind = "rigid"
mass = 2.0
inertia = { xx = 0.2, yy = 0.3, zz = 0.3 }
tip = [0.4, 0.0, 0.0]

[joint_4]
kind = "fixed"
parent = "link_1"
mount_position = [0.0, 0.1, 0.0]
[link_4]
kind = "rigid"
mass = 0.5
tip = [0.0, 0.0, 0.1]
"""
PANEL = """
[joint_4]
parent = "base"
mount_position = [0.0, 1.0, 0.0]
passive = true
stiffness = 20.0
[link_4]
kind = "rigid"
mass = 1.0
"""


def changed(old: str, new: str) -> str:
    """The tree's text with one occurrence replaced."""
    assert TREE.count(old) == 1, old
    return TREE.replace(old, new)


def message(text: str) -> str:
    return refusal(text, "arm.toml")


def test_a_tree_is_read_with_brackets_and_a_fixed_joint() -> None:
    system = parse_system(TREE, "arm.toml")
    assert (len(system.joints), len(system.fixed_joints), len(system.links)) == (3, 1, 4)
    tree = tree_of(system)
    assert tree.parents == (BASE, 3, 1, 0)
    assert tree.outwards == (0, 3, 1, 2)
    assert tree.ending == (2,)
    link = system.links[0]
    assert isinstance(link, FlexibleLink)
    assert link.root_rotation == (0.0, 0.2, 0.0)


def test_a_passive_joint_has_neither_drive_nor_motor_side() -> None:
    text = TREE.replace("[joint_4]", "[joint_5]").replace("[link_4]", "[link_5]").replace("link_4", "link_5")
    names = channels(parse_system(text + PANEL, "arm.toml"))
    assert "q_4" in names
    assert not {"tau_4", "force_4", "theta_m_4", "link_4.strain_angle"} & set(names)
    assert {"force_1", "force_2", "force_3"} <= set(names)
    assert "q_5" not in names


@pytest.mark.parametrize(
    ("old", "new", "place", "found", "expected"),
    [
        ("zz = 0.3 }", "zz = 0.6 }", "link_3.inertia", "0.2, 0.3, 0.6 kg m²", "none above the sum of the other two"),
        ("axis = [1.0, 0.0, 0.0]", "axis = [0.0, 0.0, 0.0]", "joint_2.axis", "length 0", "an axis has a direction"),
        ("axis = [1.0, 0.0, 0.0]", "axis = [3.0, 0.0, 4.0]", "joint_2.axis", "length 5", "[0.6, 0.0, 0.8]"),
        ("axis = [0.0, 1.0, 0.0]", "axis = [1.0, 0.0, 0.0]", "link_2.tip", "joint_2 and joint_3 one axis", "joint_3"),
        ('kind = "cross"', 'kind = "rigid"\nmass = 1.0', "link_2.tip", "missing", "where joint_3 is mounted"),
        ('kind = "cross"', 'kind = "cross"\nmass = 1.0', "link_2", "a cross with mass", "kind = 'rigid'"),
        ("[0.4, 0.0, 0.0]\n", "[0.4, 0.0, 0.0]\n[payload]\nmass = -1\n", "payload.mass", "-1", "not less than 0"),
        ('parent = "link_1"', 'parent = "link_3"', "joint_2.parent", "link_2 on link_4 on link_3 on link_2", "a tree"),
        ('parent = "link_1"', 'parent = ["link_1", "base"]', "joint_4.parent", "a closed chain", "one parent"),
        ('parent = "link_1"', 'parent = "link_7"', "joint_4.parent", "'link_7'", "link_1 to link_4"),
        ('parent = "link_1"', 'parent = "left arm"', "joint_4.parent", "'left arm'", "'base' or one of"),
        ('parent = "link_1"\n', "", "joint_4.parent", "missing", "'base' or 'link_i'"),
        ("axis = [1.0, 0.0, 0.0]", 'kind = "fixed"', "joint_2", "before joint_3, which moves", "numbered last"),
        ('kind = "fixed"', 'kind = "fxied"', "joint_4.kind", "'fxied'", "did you mean 'fixed'"),
        ("[joint_4]", "[motor_4]\nmass = 1.0\n[joint_4]", "motor_4", "joint_4, which is fixed", "no such table"),
    ],
)  # fmt: skip
def test_what_no_arm_has_is_refused_in_one_line(old: str, new: str, place: str, found: str, expected: str) -> None:
    assert_refused(changed(old, new), "arm.toml", place, found, expected)


def test_a_gain_on_a_passive_joint_is_refused() -> None:
    passive = changed("[joint_3]\n", "[joint_3]\npassive = true\n")
    controller = "\n[controller]\nstiffness = [1.0, 1.0, 2.0]\ndamping = [1.0, 1.0, 0.0]\n"
    assert "controller.stiffness: 2 of joint_3; expected 0" in message(passive + controller)


def test_a_link_without_length_may_join_axes_that_meet() -> None:
    """As the shoulders and wrists of many arms have it; but it has to say so."""
    stated = changed('kind = "cross"', 'kind = "rigid"\nmass = 1.0\ntip = [0.0, 0.0, 0.0]')
    assert parse_system(stated, "arm.toml").links[1].kind == "rigid"


def test_rounding_of_a_flat_body_s_inertia_is_no_fault() -> None:
    parse_system(changed("zz = 0.3 }", "zz = 0.5001 }"), "arm.toml")
