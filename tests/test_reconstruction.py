"""Links that cameras see as points: coordinates reconstructed for a diagnosis, and what it finds by them."""

from __future__ import annotations

import numpy as np
import pytest

import sms_online as sms
from sms_adapters.system_file import load_system
from sms_online.description.channels import channels, concerns
from sms_online.description.parse import parse_system
from sms_online.description.schema import Effect, Fitted, System
from sms_online.diagnosis.document import ROUGH_BARS
from sms_online.effects.build import build_model, declaring
from sms_online.pipeline.sensing import Sensing
from sms_online.smoother.reconstruction import Reconstruction
from sms_online.stream import Block
from sms_sim.simulate import sampled_blocks, simulate
from tests.camera_rig import marked_bench, readings_off, seen_by_cameras
from tests.campaigns.sessions import disguised, true_parameters
from tests.one_link import TEXT

RUBBING = Effect(name="coulomb_friction", where="joint_1", coefficients={"torque": 3.0})


def recorded(system: System, *effects: Effect, duration: float | None = None) -> list[Block]:
    """Noisy samples of a system with effects that its description lacks."""
    return list(sampled_blocks(simulate(declaring(system, effects), duration), None, seed=4))


def described(system: System) -> System:
    """The system with nominal values that are up to 40 % off."""
    return disguised(system, np.random.default_rng(4))


@pytest.fixture(scope="module")
def bench() -> System:
    return marked_bench()


@pytest.fixture(scope="module")
def rubbing(bench: System) -> list[Block]:
    return recorded(bench, RUBBING)


def test_what_sensors_follow_is_not_reconstructed() -> None:
    system = load_system("paper-planar")
    same = Reconstruction(system, channels(system), "test")
    assert same.channels == ()
    assert same.system == system
    block = Block(np.zeros(1), ("tau_1",), np.zeros((1, 1)))
    assert same([block]) == [block]


def test_shapes_of_links_seen_as_points_are_reconstructed(bench: System, rubbing: list[Block]) -> None:
    made = Reconstruction(bench, rubbing[0].channels, "test")
    assert made.channels == tuple(f"link_1.marker_{j}.{name}" for j in (1, 2) for name in ("u_y", "theta_z"))
    assert made.restored(made.system) == bench
    assert not Sensing(build_model(made.system), made(rubbing)[0].channels, "test").missing


@pytest.mark.slow
def test_reconstructed_shapes_follow_what_nobody_described(bench: System, rubbing: list[Block]) -> None:
    """Friction of a fifth of the torque, and parameters up to 40 % off; points with 0.1 mm of noise at 125 Hz."""
    made = Reconstruction(described(bench), rubbing[0].channels, "test")
    blocks = made(rubbing)
    assert not made.failures
    t, values = (np.concatenate([getattr(block, part) for block in blocks]) for part in ("t", "values"))
    whole = parse_system(TEXT.replace("KINEMATICS", "linear").replace("marker_*.u_y", "marker_*.*_[yz]"), "one-link")
    exact = list(sampled_blocks(simulate(declaring(whole, [RUBBING])), "0"))
    true_t, true = (np.concatenate([getattr(block, part) for block in exact]) for part in ("t", "values"))
    for name, size in zip(made.channels, (1.5e-4, 1e-3, 3e-4, 2e-3), strict=True):
        own = values[:, blocks[0].channels.index(name)]
        read = np.isfinite(own)
        off = own[read] - np.interp(t[read], true_t, true[:, exact[0].channels.index(name)])
        assert np.sqrt(np.mean(off**2)) < size, name
        assert np.ptp(own[read]) > 30.0 * size, name


def test_a_slow_sensor_is_reconstructed_too() -> None:
    both = 'channels = ["theta_m_1", "q_1"]\nnoise = 2e-5'
    one = 'channels = ["{}"]\nnoise = 2e-5'
    slow = marked_bench(both, one.format("theta_m_1") + "\n\n[[sensor]]\nrate = 10.0\n" + one.format("q_1"))
    made = Reconstruction(slow, channels(slow), "test")
    assert "q_1" in made.channels
    assert "theta_m_1" not in made.channels


def test_laws_with_internal_states_do_not_keep_coordinates_from_being_reconstructed(
    bench: System, rubbing: list[Block]
) -> None:
    """A smoother's session refuses them, in one line."""
    rough = Effect(name="presliding_friction", where="joint_1", coefficients={"width": 0.002})
    fitted = {"presliding_friction@joint_1.torque": Fitted(value=3.0, std=0.1)}
    system = declaring(bench, [rough]).model_copy(update={"fitted": fitted})
    made = Reconstruction(system, rubbing[0].channels, "test")
    assert [effect.key for effect in made.system.effects] == [rough.key]
    assert made(rubbing)
    with pytest.raises(sms.InputError, match="presliding_friction@joint_1, whose internal states"):
        sms.estimate(system, rubbing)


def test_a_place_concerns_channels_by_name_and_pattern() -> None:
    assert concerns("q_1, link_1.*", ["link_1.marker_2.u_y"])
    assert not concerns("q_1, link_2.*", ["link_1.marker_2.u_y"])


@pytest.mark.slow
def test_friction_is_found_on_a_link_seen_as_points(bench: System, rubbing: list[Block]) -> None:
    found = sms.diagnose(described(bench), rubbing)
    assert found.verdict == "named"
    (effect,) = found.effects
    assert effect.effect == "coulomb_friction@joint_1"
    torque = effect.coefficients["torque"]
    assert torque.std is not None
    assert abs(torque.value - RUBBING.coefficients["torque"]) < 4.0 * torque.std
    assert not found.trust.grave
    # The system that is written is of the capture as it was recorded.
    assert found.system.links[0].points == bench.links[0].points
    assert found.system.sensors == bench.sensors


@pytest.mark.long
def test_a_law_with_internal_states_is_found_by_reconstructed_coordinates(bench: System) -> None:
    """No smoother follows it, so parameters are of these coordinates, and the verdict says so."""
    law = Effect(name="presliding_friction", where="joint_1", coefficients={"torque": 3.0, "width": 0.004})
    found = sms.diagnose(described(bench), recorded(bench, law))
    assert [effect.effect for effect in found.effects] == [law.key]
    for name, each in found.effects[0].coefficients.items():
        assert each.std is not None
        assert abs(each.value - law.coefficients[name]) < 5.0 * each.std, name
        assert each.std < 0.05 * each.value, name
    assert ROUGH_BARS in found.trust.reasons
    assert found.trust.level == "doubt"


@pytest.mark.slow
def test_stamps_in_milliseconds_are_found_on_a_link_seen_as_points(bench: System) -> None:
    late = [Block(1000.0 * block.t, block.channels, block.values) for block in recorded(bench)]
    found = sms.diagnose(described(bench), late)
    assert [mistake.name for mistake in found.mistakes] == ["clock_unit"]
    assert not found.effects


@pytest.mark.slow
def test_nothing_is_found_on_a_link_seen_as_points_that_is_described(bench: System) -> None:
    found = sms.diagnose(described(bench), recorded(bench))
    assert found.verdict == "clean"
    truth = dict(zip((p.name for p in found.after.parameters.values()), true_parameters(bench), strict=True))
    z = [(p.value - truth[name]) / p.std for name, p in found.after.parameters.items() if p.determined]
    assert np.abs(z).max() < 4.0


@pytest.mark.long
def test_friction_is_found_beside_markers_and_cameras_that_are_off() -> None:
    """All that readings may be off by within the default tolerances; 70 s."""
    system = seen_by_cameras("paper-planar")
    rubbing = Effect(name="coulomb_friction", where="joint_2", coefficients={"torque": 8.0})
    blocks = recorded(system, rubbing, duration=20.0)
    t, values = (np.concatenate([getattr(block, part) for block in blocks]) for part in ("t", "values"))
    off, block = readings_off(described(system), Block(t, blocks[0].channels, values), seed=4)
    found = sms.diagnose(off, block)
    assert [effect.effect for effect in found.effects] == ["coulomb_friction@joint_2"]
    assert found.effects[0].coefficients["torque"].value == pytest.approx(8.0, rel=0.005)
    assert found.verdict == "named"
    assert not found.trust.grave
