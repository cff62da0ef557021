"""Error bars on measured rigs: what two halves of one run determine agrees within them."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest

from sms_adapters.importers import import_emps, import_quanser
from sms_adapters.sources import open_source
from sms_adapters.system_file import load_system, shipped_text
from sms_online.description.parse import parse_system
from sms_online.description.schema import System
from sms_online.evaluation import beside_prior
from sms_online.session import Session
from sms_online.verdict.judged import JudgedEvaluation

DATA = Path(__file__).resolve().parents[1].parent / "shared" / "data"
EMPS = DATA / "emps" / "DATA_EMPS.mat"
QUANSER = DATA / "quanser_2dsfl" / "lqr_full_10deg.mat"
FACTORY = DATA / "quanser_factory" / "fsf.csv"
KUKA = DATA / "kuka_kr300"


def measured(path: Path) -> Path:
    if not path.exists():
        pytest.skip(f"measured data {path.name} is not beside the checkout")
    return path


def replayed(
    system: System, capture: Path, prior: bool, start: float | None = None, stop: float | None = None
) -> JudgedEvaluation:
    source = open_source(capture, system, start, stop)
    # Constant parameters: what friction with memory leaves may look like a drift.
    session = Session(system, source.channels, prior=prior, tracker="rls")
    for block in source:
        session.update(block)
    session.finish()
    return session.evaluation()


def apart(system: System, capture: Path, prior: bool, middle: float) -> dict[str, float]:
    """How many of their joint bars the halves of a run differ by, of what both determine."""
    halves = replayed(system, capture, prior, stop=middle), replayed(system, capture, prior, start=middle)
    found = [
        {
            p.name: (value, std)
            for p, value, std, known in zip(
                half.parameters, half.estimate.pi.tolist(), half.std.tolist(), half.determined.tolist(), strict=True
            )
            if known
        }
        for half in halves
    ]
    both = found[0].keys() & found[1].keys()
    return {
        name: abs(found[0][name][0] - found[1][name][0]) / float(np.hypot(found[0][name][1], found[1][name][1]))
        for name in both
    }


def with_friction() -> System:
    """The Quanser rig with the friction at its hubs."""
    laws = "".join(
        f'\n[[effect]]\nname = "{law}_friction"\nwhere = "joint_{joint}"\n'
        for joint in (1, 2)
        for law in ("viscous", "coulomb")
    )
    return parse_system(shipped_text("quanser-2dsfl") + laws, "quanser-2dsfl")


@pytest.mark.long
def test_halves_of_emps_agree_within_their_bars(tmp_path: Path) -> None:
    import_emps(measured(EMPS), tmp_path / "emps.csv")
    z = apart(load_system("emps"), tmp_path / "emps.csv", False, 12.4)
    assert {"link_1.mass", "viscous_friction@joint_1.damping", "coulomb_friction@joint_1.torque"} <= z.keys()
    assert max(z.values()) < 3.0, z


@pytest.mark.long
@pytest.mark.parametrize("unit", ["CTU", "maker"])
def test_halves_of_quanser_runs_agree_within_bars(tmp_path: Path, unit: str) -> None:
    capture, middle = measured(FACTORY), 9.7
    if unit == "CTU":
        capture, middle = tmp_path / "quanser.csv", 10.0
        import_quanser(measured(QUANSER), capture)
    z = apart(with_friction(), capture, True, middle)
    # Half of the maker's run does not determine hub 2's spring beside its prior.
    assert {"joint_1.stiffness", *(["joint_2.stiffness"] if unit == "CTU" else [])} <= z.keys()
    assert max(z.values()) < 3.0, z


@pytest.mark.long
def test_two_axes_of_a_robot_are_not_determined() -> None:
    """Their friction has memory, and the torque of axis 1 alone gives any stiffness; axis 3 has 5.5 to 5.7e6 N m/rad
    by least squares of three runs."""
    system = load_system(str(measured(KUKA / "system.toml")))
    evaluation = replayed(system, KUKA / "run_a.csv", False)
    names = [p.name for p in evaluation.parameters]
    first, second, third = (names.index(f"joint_{i}.stiffness") for i in (1, 2, 3))
    assert not evaluation.determined[[first, second]].any()
    assert evaluation.determined[third]
    stiffness, std = evaluation.estimate.pi[third], evaluation.std[third]
    assert abs(stiffness - 5.55e6) < 1.96 * std
    # By windows that overlap, and by blocks.
    assert std > 1.5 * evaluation.estimate.std[third]


@pytest.mark.long
def test_a_prior_determines_no_axis_of_a_robot() -> None:
    """Beside priors of ± 10 % the torque of axes 1 and 2 says nothing that is certain, that of axis 3 does."""
    system = load_system(str(measured(KUKA / "system.toml")))
    evaluation = replayed(system, KUKA / "run_a.csv", True)
    names = [p.name for p in evaluation.parameters]
    first, second, third = (names.index(f"joint_{i}.stiffness") for i in (1, 2, 3))
    assert evaluation.determined[[first, second, third]].tolist() == [False, False, True]
    # Least squares of its torque alone says 5.5 to 5.7e6 N m/rad, the prior 4.1 ± 0.4e6.
    prior = evaluation.statistics.setup.current_prior
    assert prior is not None
    value, std = beside_prior(evaluation.estimate, evaluation.std, prior)
    assert abs(value[third] - 5.55e6) < 1.96 * std[third]
    assert evaluation.trust.level == "doubt"


@pytest.mark.long
def test_halves_of_a_robot_run_agree_within_their_bars() -> None:
    """Without a prior, from the rows alone: few parameters are determined in five seconds, friction of two axes."""
    system = load_system(str(measured(KUKA / "system.toml")))
    z = apart(system, KUKA / "run_a.csv", False, 5.0)
    assert z
    assert max(z.values()) < 3.0, z
