"""The system description: what is accepted, what is refused and in which words, and the systems that are shipped."""

from __future__ import annotations

import json
from fnmatch import fnmatchcase
from pathlib import Path

import numpy as np
import pytest

from sms_adapters.system_file import load_system
from sms_online.description.bodies import FlexibleLink, RigidLink
from sms_online.description.channels import channels, drive_channel, sensed_channels
from sms_online.description.parse import describe, parse_system, shipped_systems, shipped_text
from sms_online.description.schema import System
from sms_online.errors import InputError
from tests.axis import AXIS
from tests.refused import assert_refused, refusal

PLANAR = """
name = "bench"
motion = "planar"

[spacecraft]
mass = 400
inertia = { zz = 65.0 }

[joint_1]
gear_ratio = 50.0
stiffness = 1000.0

[motor_1]
mass = 3.0
rotor_inertia = 0.0075

[link_1]
kind = "flexible"
length = 1.2
elements = 2
mass_per_length = 31.42
flexural_rigidity_z = 1768.8
deformations = ["bending_z"]

[joint_2]
transmission = "rigid"
gear_ratio = 50.0

[link_2]
kind = "rigid"
mass = 2.0
tip = [0.5, 0.0, 0.0]

[payload]
mass = 1.0

[[sensor]]
channels = ["tau_*", "q_*"]
rate = 1000.0

[[source]]
kind = "can"
name = "drives"
dbc = "bench.dbc"
signals = { "DRIVE.ANGLE" = "q_1" }

[[effect]]
name = "viscous_friction"
where = "joint_1"
coefficients = { damping = 1.0 }

[known]
"motor_1.mass" = 3.0

[prior]
"link_2.mass" = { value = 2.0, std = 0.1 }

[controller]
stiffness = [500.0, 500.0]
damping = [100.0, 100.0]

[trajectory]
duration = 10.0
joint_1 = [{ frequency = 1.5, sine = 1.3 }]
joint_2 = [{ frequency = 1.5, sine = 1.0 }, { frequency = 2.5, cosine = 0.1 }]

[windows]
relative = 0.2
"""

VISCOUS_FRICTION = '[[effect]]\nname = "viscous_friction"\nwhere = "joint_1"\n'


def changed(old: str, new: str, text: str = PLANAR) -> str:
    assert text.count(old) >= 1, old
    return text.replace(old, new, 1)


def message(text: str) -> str:
    return refusal(text, "bench.toml")


def test_a_file_becomes_a_description_with_its_defaults() -> None:
    system = parse_system(PLANAR, "bench.toml")
    assert system.spacecraft is not None
    assert system.spacecraft.mass == 400.0
    assert [joint.transmission for joint in system.joints] == ["flexible", "rigid"]
    assert system.motors[0] is not None
    assert system.motors[1] is None
    first, second = system.links
    assert isinstance(first, FlexibleLink)
    assert first.kinematics == "exact"
    assert isinstance(second, RigidLink)
    assert system.known == {"motor_1.mass": 3.0}
    assert system.priors["link_2.mass"].std == 0.1
    assert system.trajectory is not None
    assert [len(series) for series in system.trajectory.joints] == [1, 2]
    assert system.windows.relative == 0.2
    assert system.sample_rate == 1000.0


def test_a_file_may_ask_for_one_balance() -> None:
    from_text = parse_system(f'balance = "energy"\n{AXIS}', "axis.toml")
    assert (from_text.balance, parse_system(AXIS, "axis.toml").balance) == ("energy", "both")


def test_a_description_survives_its_own_json() -> None:
    system = parse_system(PLANAR, "bench.toml")
    text = json.dumps(describe(system))
    assert System.model_validate_json(text) == system
    assert '"kinematics": "exact"' in text  # defaults are resolved


@pytest.mark.parametrize(
    ("old", "new", "place", "found", "expected"),
    [
        # keys
        ("length = 1.2", "lenght = 1.2", "link_1.lenght", "unknown key 'lenght'", "did you mean 'length'?"),
        ("[spacecraft]", "[spacecarft]", "spacecarft", "unknown key", "did you mean 'spacecraft'?"),
        ("[joint_2]", "[jiont_2]", "jiont_2", "unknown key", "did you mean 'joint_2'?"),
        ("zz = 65.0", "zzz = 65.0", "spacecraft.inertia.zzz", "unknown key", "'zz'"),
        ("rate = 1000.0", "raet = 1000.0", "sensor 1.raet", "unknown key", "did you mean 'rate'?"),
        ("joint_1 = [", "joint_3 = [", "trajectory.joint_3", "unknown key", "'joint_1'"),
        ("sine = 1.0", "sin = 1.0", "trajectory.joint_2[1].sin", "unknown key", "did you mean 'sine'?"),
        ("std = 0.1", "sdt = 0.1", "prior.link_2.mass.sdt", "unknown key", "did you mean 'std'?"),
        ("relative = 0.2", "realtive = 0.2", "windows.realtive", "unknown key", "did you mean 'relative'?"),
        ("dbc =", "dcb =", "source 1.dcb", "unknown key", "did you mean 'dbc'?"),
        ("coefficients =", "coefficient =", "effect 1.coefficient", "unknown key", "did you mean 'coefficients'?"),
        ("rotor_inertia", "rotor_inetria", "motor_1.rotor_inetria", "unknown key", "did you mean 'rotor_inertia'?"),
        # values
        ('name = "bench"', "", "name", "missing", "a value"),
        ('name = "bench"', 'name = ""', "name", "an empty text", "a name"),
        ("length = 1.2", "", "link_1.length", "missing", "a value"),
        ("length = 1.2", "length = -1.2", "link_1.length", "-1.2", "a number greater than 0"),
        ("length = 1.2", "length = 0", "link_1.length", "0", "a number greater than 0"),
        ("length = 1.2", 'length = "1.2"', "link_1.length", "'1.2'", "a number"),
        ("length = 1.2", "length = true", "link_1.length", "true", "a number"),
        ("length = 1.2", "length = nan", "link_1.length", "nan", "a finite number"),
        ("length = 1.2", "length = 2026-01-01", "link_1.length", "'2026-01-01'", "a number"),
        ("elements = 2", "elements = 1.5", "link_1.elements", "1.5", "a whole number"),
        ("mass = 400", "mass = -400", "spacecraft.mass", "-400", "not less than 0"),
        ("mass = 400", "mass = [4, 0]", "spacecraft.mass", "[4, 0]", "a number"),
        ('motion = "planar"', 'motion = "plana"', "motion", "'plana'", "did you mean 'planar'?"),
        ('kind = "flexible"', 'kind = "flexibel"', "link_1.kind", "'flexibel'", "did you mean 'flexible'?"),
        ('kind = "flexible"', "", "link_1.kind", "missing", "'rigid', 'cross' or 'flexible'"),
        ('["bending_z"]', '["bending"]', "link_1.deformations[1]", "'bending'", "'bending_y' or 'bending_z'"),
        ('["bending_z"]', "[]", "link_1.deformations", "[]", "at least 1"),
        ("tip = [0.5, 0.0, 0.0]", "tip = [0.5, 0.0]", "link_2.tip", "[0.5, 0.0]", "3 numbers"),
        ("tip = [0.5, 0.0, 0.0]", "tip = [0.5, 0.0, 0.0, 1.0]", "link_2.tip", "[0.5, 0.0, 0.0, 1.0]", "3 numbers"),
        ("tip = [0.5, 0.0, 0.0]", "tip = 0.5", "link_2.tip", "0.5", "a list"),
        ("inertia = { zz = 65.0 }", "inertia = 65.0", "spacecraft.inertia", "65.0", "a table"),
        ('dbc = "bench.dbc"', "dbc = 7", "source 1.dbc", "7", "a text in quotes"),
        ("sine = 1.3", "sine = 'x'", "trajectory.joint_1[1].sine", "'x'", "a number"),
        ('"motor_1.mass" = 3.0', "motor_1.mass = 3.0", "known.motor_1", "a table", '"motor_1.mass" = value'),
        ("duration = 10.0", "", "trajectory.duration", "missing", "a value"),
        ("joint_2 = [{ f", "#", "trajectory.joint_2", "missing", "each of the 2 joints"),
        # numbering
        ("[joint_2]", "[joint_3]", "joint_2", "no such table", "1 to 3 without holes, since there is [joint_3]"),
        ('[link_2]\nkind = "rigid"', "[motor_2]", "link_2", "no such table", "numbered 1 to 2"),
        # physics
        ("[joint_2]", "[joint_2]\naxis = [0, 0, 1.1]", "joint_2.axis", "length 1.1", "a unit vector"),
        ("[joint_2]", "[joint_2]\naxis = [1, 0, 0]", "joint_2.axis", "[1.0, 0.0, 0.0]", "planar"),
        ("[joint_2]", "[joint_2]\nkind = 'prismatic'", "joint_2.axis", "[0.0, 0.0, 1.0]", "x-y plane"),
        ("[joint_2]", "[joint_2]\nmount_rotation = [0.1, 0, 0]", "joint_2.mount_rotation", "[0.1, 0.0, 0.0]", "planar"),
        ('["bending_z"]', '["bending_z", "torsion"]', "link_1.deformations", "'torsion'", "planar"),
        ('motion = "planar"', 'motion = "planar"\ngravity = [0, 0, -9.81]', "gravity", "-9.81", "x-y plane"),
        ("flexural_rigidity_z = 1768.8", "", "link_1.flexural_rigidity_z", "0", "bending_z is active"),
        ("stiffness = 1000.0", "", "joint_1.stiffness", "0", "transmission = 'rigid'"),
        ("rotor_inertia = 0.0075", "", "motor_1.rotor_inertia", "0", "flexible transmission"),
        ("zz = 65.0", "zz = 65.0, xy = 70.0", "spacecraft.inertia", "negative principal moment", "none below 0"),
        # sizes and names
        ("[500.0, 500.0]", "[500.0]", "controller.stiffness", "1 value", "2, one for each joint"),
        ('"q_*"', '"q_3"', "sensor 1.channels", "'q_3' matches no channel", "such as 'q_"),
        ('"q_*"]', '"q_*"]\n[[sensor]]\nchannels = ["q_2"]', "sensor 2.channels", "by sensor 1 too", "one sensor"),
        ('= "q_1"', '= "q1"', "source 1.signals.DRIVE.ANGLE", "unknown channel 'q1'", "'q_1'"),
        ('"DRIVE.ANGLE"', '"ANGLE"', "source 1.signals", "'ANGLE'", "MESSAGE.SIGNAL"),
        ('"bench.dbc"', '"bench"', "source 1.dbc", "'bench'", ".dbc"),
        ('where = "joint_1"', 'where = "joint_9"', "effect 1.where", "'joint_9'", "did you mean 'joint_"),
        ("[known]", f"{VISCOUS_FRICTION}[known]", "effect 2", "viscous_friction@joint_1 again", "each effect once"),
        ('"motor_1.mass"', '"motor_2.mass"', 'known."motor_2.mass"', "'motor_2' is not in", "did you mean 'motor_1'?"),
        ('"motor_1.mass"', '"mass"', "known", "'mass'", "name of a parameter"),
        ('"link_2.mass" =', '"lnik_2.mass" =', 'prior."lnik_2.mass"', "is not in this", "did you mean 'link_2'?"),
        ('"link_2.mass" =', '"motor_1.mass" =', 'prior."motor_1.mass"', "in [known] too", "one of the two"),
    ],
)  # fmt: skip
def test_a_wrong_file_is_refused_in_one_line(old: str, new: str, place: str, found: str, expected: str) -> None:
    assert_refused(changed(old, new), "bench.toml", place, found, expected)


def test_broken_toml_is_located_by_line_and_column() -> None:
    assert message('name = "bench"\nmotion planar\n').startswith("bench.toml, line 2, column 8: ")
    assert "expected valid TOML" in message("name = ")


def test_an_empty_file_lacks_its_first_joint() -> None:
    assert message("").startswith("bench.toml, joint_1: no such table; expected at least one joint")


def test_spatial_links_need_what_their_deformations_need() -> None:
    spatial = changed('motion = "planar"', "", changed("zz = 65.0", "xx = 65.0, yy = 65.0, zz = 65.0"))
    assert parse_system(spatial, "bench.toml").motion == "spatial"
    torsion = changed('["bending_z"]', '["bending_z", "torsion"]\ntorsional_rigidity = 5.0', spatial)
    assert "link_1.polar_inertia_per_length: 0; expected an inertia" in message(torsion)
    parse_system(changed("elements = 2", "elements = 2\npolar_inertia_per_length = 0.1", torsion), "bench.toml")
    traction = changed('["bending_z"]', '["traction", "bending_z"]\naxial_rigidity = 1e6', spatial)
    assert "no traction on an inextensible link" in message(traction)
    parse_system(changed("elements = 2", 'elements = 2\nkinematics = "linear"', traction), "bench.toml")
    twice = changed('["bending_z"]', '["bending_z", "bending_z"]', spatial)
    assert "each deformation once" in message(twice)


def test_flexible_joints_need_a_motor() -> None:
    without = changed("[motor_1]\nmass = 3.0\nrotor_inertia = 0.0075\n", "")
    assert "motor_1.rotor_inertia: no such table; expected a rotor inertia" in message(without)


def test_a_parameter_of_a_declared_effect_may_be_known() -> None:
    text = changed("[known]", '[known]\n"viscous_friction@joint_1.damping" = 1.0')
    assert parse_system(text, "bench.toml").known["viscous_friction@joint_1.damping"] == 1.0
    assert "is not in this system" in message(changed("[known]", '[known]\n"coulomb_friction@joint_1.torque" = 1.0'))


def test_channels_of_a_planar_free_flyer() -> None:
    assert channels(parse_system(PLANAR, "bench.toml")) == (
        *("tau_1", "tau_2", "theta_m_1", "q_1", "q_2"),
        *("r_S_x", "r_S_y", "theta_0", "v_S_x", "v_S_y", "omega_0_z", "gyro_0_z"),
        *(f"link_1.marker_{j}.{field}" for j in (1, 2) for field in ("u_x", "u_y", "theta_z", "x", "y")),
        "link_1.strain_angle",
    )


def test_channels_of_a_linear_link_are_its_coordinates() -> None:
    names = channels(load_system("spatial-two-link"))
    assert {"eps_x", "eps_y", "eps_z", "eta", "omega_0_x", "gyro_0_z"} <= set(names)
    fields = [name.rsplit(".", 1)[1] for name in names if name.startswith("link_2.marker_1.")]
    assert fields == ["u_y", "u_z", "theta_x", "theta_y", "theta_z", "x", "y", "z"]


def test_drives_are_measured_at_the_shaft_or_at_the_axis() -> None:
    assert drive_channel(load_system("paper-planar"), 1) == "tau_1"
    assert drive_channel(load_system("emps"), 1) == "force_1"
    assert drive_channel(load_system("ak80-pendulum"), 1) == "force_1"
    assert channels(load_system("emps")) == ("force_1", "q_1")


def test_a_sensor_fills_only_what_its_patterns_match() -> None:
    system = load_system("paper-planar-exact")
    for sensor in system.sensors:
        expected = [c for c in channels(system) if any(fnmatchcase(c, p) for p in sensor.channels)]
        assert list(sensed_channels(system, sensor)) == expected
        assert expected


def test_the_shipped_systems_are_those_of_the_contract() -> None:
    assert set(shipped_systems()) == {
        "paper-planar",
        "paper-planar-table-v",
        "paper-planar-exact",
        "spatial-two-link",
        "seven-joint",
        "quanser-2dsfl",
        "emps",
        "ak80-pendulum",
    }


@pytest.mark.parametrize("name", shipped_systems())
def test_a_shipped_system_parses_and_carries_its_name(name: str) -> None:
    system = load_system(name)
    assert system.name == name
    assert system.title
    assert system.reference
    assert system.sensors


def test_the_papers_variants_differ_where_the_paper_differs() -> None:
    rigidities, kinematics = {}, {}
    for name in ("paper-planar", "paper-planar-table-v", "paper-planar-exact"):
        links = load_system(name).links
        rigidities[name] = [link.flexural_rigidity_z for link in links if isinstance(link, FlexibleLink)]
        kinematics[name] = {link.kinematics for link in links if isinstance(link, FlexibleLink)}
    assert rigidities == {
        "paper-planar": [1768.8, 597.87],
        "paper-planar-table-v": [1768.8, 1768.8],
        "paper-planar-exact": [1768.8, 597.87],
    }
    assert kinematics == {
        "paper-planar": {"linear"},
        "paper-planar-table-v": {"linear"},
        "paper-planar-exact": {"exact"},
    }


def test_the_papers_spacecraft_gives_table_vs_first_four_values() -> None:
    system = load_system("paper-planar")
    base, motor = system.spacecraft, system.motors[0]
    assert base is not None
    assert motor is not None
    r_0 = -np.array(base.center_of_mass)
    assert base.mass * r_0 == pytest.approx([400.0, 400.0, 0.0])
    assert base.mass + motor.mass == 403.0
    assert base.inertia.zz + motor.stator_inertia.zz + base.mass * r_0 @ r_0 == pytest.approx(865.01, abs=5e-3)


def test_quansers_inertias_are_the_makers() -> None:
    system = load_system("quanser-2dsfl")
    first, second = system.links
    drive_1, drive_2 = system.motors
    assert isinstance(first, RigidLink)
    assert isinstance(second, RigidLink)
    assert drive_1 is not None
    assert drive_2 is not None
    assert drive_1.rotor_inertia * 100**2 == pytest.approx(0.06354)
    assert drive_2.rotor_inertia * 50**2 == pytest.approx(0.00302)
    assert second.inertia.zz + second.mass * second.center_of_mass[0] ** 2 == pytest.approx(0.00644, rel=1e-3)
    stretched = first.tip[0] + second.tip[0]
    about_joint_1 = first.inertia.zz + drive_2.mass * first.tip[0] ** 2 + second.mass * stretched**2
    assert about_joint_1 == pytest.approx(0.17043, rel=1e-3)


def test_references_of_the_spatial_arms_start_at_zero() -> None:
    long_arm = load_system("seven-joint").trajectory
    assert long_arm is not None
    for series in long_arm.joints:
        assert sum(term.sine * term.frequency for term in series) == pytest.approx(0.0, abs=1e-6)


def test_frequencies_of_spatial_references_all_differ() -> None:
    for name in ("spatial-two-link", "seven-joint"):
        trajectory = load_system(name).trajectory
        assert trajectory is not None
        frequencies = [term.frequency for series in trajectory.joints for term in series]
        assert len(set(frequencies)) == len(frequencies) == 3 * len(trajectory.joints)


def test_a_system_file_is_found_by_its_path(tmp_path: Path) -> None:
    path = tmp_path / "bench.toml"
    path.write_text(PLANAR, encoding="utf-8")
    assert load_system(str(path)) == parse_system(PLANAR, "bench.toml")


@pytest.mark.parametrize(
    ("name", "expected"),
    [
        ("paper-plannar", "no shipped system of this name; expected a .toml file or one of "),
        ("nowhere.toml", "nowhere.toml: no such file or directory; expected a readable system file"),
    ],
)
def test_neither_name_nor_path(name: str, expected: str) -> None:
    with pytest.raises(InputError) as caught:
        load_system(name)
    assert expected in str(caught.value)
    assert "\n" not in str(caught.value)


def test_a_misspelt_name_is_answered_with_the_nearest() -> None:
    with pytest.raises(InputError, match="did you mean 'quanser-2dsfl'"):
        load_system("quanser-2dfsl")
    with pytest.raises(InputError, match="one of ak80-pendulum"):
        shipped_text("quanser-2dfsl")


def test_a_file_that_is_not_text_is_refused(tmp_path: Path) -> None:
    path = tmp_path / "binary.toml"
    path.write_bytes(b"name = \xff")
    with pytest.raises(InputError, match="byte 7: not UTF-8 text"):
        load_system(str(path))
