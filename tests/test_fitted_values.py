"""What a diagnosis writes describes the rig by itself: it is validated on another run, simulated, and used as a prior.

The elastic axis with dry friction that its description lacks, and a stiffness that is 10 % off there; grade A.
"""

from __future__ import annotations

import json
from pathlib import Path

import numpy as np
import pytest

import sms_online as sms
from sms_online.description.parse import parse_system
from sms_online.effects.build import build_model
from sms_online.model.base_parameters import find_base_parameters
from sms_online.priors import base_prior, with_estimates
from sms_tools.cli import main
from tests.simulations import planar_capture
from tests.test_compare import ELASTIC_AXIS, STIFFNESS

FRICTION = 1.2  # N m
KEY = "coulomb_friction@joint_1.torque"


@pytest.fixture(scope="module")
def rig(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A folder with rig.toml, runs of two days, and found/, the diagnosis of the first."""
    folder = tmp_path_factory.mktemp("rig")
    (folder / "rig.toml").write_text("# kept\n" + ELASTIC_AXIS.format(stiffness=1.1 * STIFFNESS))
    (folder / "true.toml").write_text(ELASTIC_AXIS.format(stiffness=STIFFNESS))
    for seed, day in enumerate(("monday", "tuesday")):
        effects = [f"coulomb_friction@joint_1:torque={FRICTION}"]
        capture = sms.simulate(folder / "true.toml", grade="A", seed=seed, effects=effects)
        sms.write_capture(capture, folder / f"{day}.csv")
    arguments = [str(folder / "monday.csv"), "--system", str(folder / "rig.toml"), "--out", str(folder / "found")]
    assert main(["diagnose", *arguments]) == 0
    return folder


@pytest.mark.slow
def test_the_file_states_what_was_fitted(rig: Path) -> None:
    text = (rig / "found" / "system.toml").read_text()
    assert text.startswith("# kept\n")
    system = sms.load_system(rig / "found" / "system.toml")
    document = json.loads((rig / "found" / "diagnosis.json").read_text())
    fitted = {p["name"]: p for p in document["after"]["parameters"]}
    assert set(system.fitted) == set(fitted)
    for name, found in system.fitted.items():
        assert system.nominal[name] == found.value == pytest.approx(fitted[name]["estimate"], rel=1e-8)
        assert found.std == pytest.approx(fitted[name]["std"], rel=1e-2)
    assert abs(system.nominal["joint_1.stiffness"] - STIFFNESS) < 4.0 * system.fitted["joint_1.stiffness"].std
    assert system.nominal[KEY] == pytest.approx(FRICTION, rel=0.02)


@pytest.mark.slow
def test_it_holds_on_another_run_without_results(rig: Path) -> None:
    found = sms.validate(sms.load_system(rig / "found" / "system.toml"), rig / "tuesday.csv")
    assert found.holds
    assert not sms.validate(sms.load_system(rig / "rig.toml"), rig / "tuesday.csv").holds


@pytest.mark.slow
def test_it_is_simulated_as_found(rig: Path, capsys: pytest.CaptureFixture[str]) -> None:
    path, capture = str(rig / "found" / "system.toml"), rig / "simulated.csv"
    assert main(["simulate", "--system", path, "--capture", str(capture), "--grade", "0"]) == 0
    assert "does nothing" not in "".join(capsys.readouterr())
    made = sms.read_capture(capture)
    true = sms.simulate(rig / "true.toml", grade="0", effects=[f"coulomb_friction@joint_1:torque={FRICTION}"])
    described = sms.simulate(rig / "rig.toml", grade="0")

    def away(capture: sms.Capture) -> float:
        torques = [each.values[:, each.channels.index("tau_1")] for each in (capture, true)]
        return float(np.sqrt(np.mean((torques[0] - torques[1]) ** 2)))

    assert away(made) < 0.1 * away(described)


@pytest.mark.slow
def test_its_deviations_are_priors_where_priors_are_asked_for(rig: Path) -> None:
    system = sms.load_system(rig / "found" / "system.toml")
    base = find_base_parameters(build_model(system))
    assert not base_prior(system, base, prior=False).known.any()
    prior = base_prior(system, base, prior=True)
    for parameter, value, std in zip(base.parameters, prior.value, prior.std, strict=True):
        assert (value, std) == (system.fitted[parameter.name].value, system.fitted[parameter.name].std)


@pytest.mark.slow
def test_a_second_diagnosis_replaces_the_fitted_values(rig: Path) -> None:
    path, out = rig / "found" / "system.toml", rig / "again"
    assert main(["diagnose", str(rig / "tuesday.csv"), "--system", str(path), "--out", str(out)]) == 0
    first, second = (sms.load_system(each) for each in (path, out / "system.toml"))
    assert (out / "system.toml").read_text().count("[fitted]") == 1
    assert second.effects == first.effects
    assert set(second.fitted) == set(first.fitted)
    assert second.fitted != first.fitted


@pytest.mark.slow
def test_a_combination_is_fitted_as_its_leading_parameter() -> None:
    system = sms.load_system("paper-planar")
    found = sms.estimate(system, planar_capture(1.0, "A"))
    base = find_base_parameters(build_model(system))
    carried = with_estimates(system, base, found.parameters)
    again = find_base_parameters(build_model(carried))
    values = [found.parameters[parameter.name].value for parameter in again.parameters]
    assert [parameter.nominal for parameter in again.parameters] == pytest.approx(values, rel=1e-9)
    assert carried.nominal["motor_1.mass"] == system.nominal["motor_1.mass"]


def test_an_unknown_fitted_name_is_refused() -> None:
    text = ELASTIC_AXIS.format(stiffness=STIFFNESS) + '[fitted]\n"joint_1.stifness" = { value = 1.0 }\n'
    with pytest.raises(sms.InputError, match=r"did you mean 'joint_1\.stiffness'"):
        build_model(parse_system(text, "rig.toml"))
