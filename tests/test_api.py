"""The one door, `import sms_online as sms`: what a stranger does in a notebook."""

from __future__ import annotations

import dataclasses
import json
import re
import subprocess
import sys
from pathlib import Path
from typing import Any

import numpy as np
import pyarrow as pa
import pytest

import sms_online as sms
from sms_tools.cli import main
from tests.axis import AXIS, axis_block

README = Path(__file__).parents[1] / "README.md"
# What a notebook may rely on, word for word.
TEN_LINES = """
import sms_online as sms
system = sms.load_system("paper-planar")
data = sms.simulate(system, duration=20.0, grade="B", effects=["coulomb_friction@joint_2:torque=8"])
result = sms.estimate(system, data)            # the same bits as replay and live
result.parameters["joint_1.stiffness"]         # value, std, 95 % interval, unit, determined
result.trust.level, result.trust.reasons
found = sms.diagnose(system, data)
better = sms.estimate(found.system, data)

session = sms.Session(system, channels)        # live: any source, one block or one sample at a time
for block in source: session.update(block); session.result.parameters
"""


def without_timing(document: dict[str, Any]) -> dict[str, Any]:
    """What depends on the samples alone."""
    return {key: value for key, value in document.items() if key != "throughput_samples_per_s"}


@pytest.fixture(scope="module")
def ten() -> dict[str, Any]:
    """What the README's Python leaves: these lines, their source being the same data."""
    names: dict[str, Any] = {}
    for block in re.findall(r"^```python\n(.*?)^```", README.read_text(encoding="utf-8"), re.DOTALL | re.MULTILINE):
        exec(block, names)
    return names


def test_the_readme_holds_the_ten_lines() -> None:
    assert set(TEN_LINES.splitlines()) <= set(README.read_text(encoding="utf-8").splitlines())


@pytest.mark.long
def test_the_ten_lines_run(ten: dict[str, Any]) -> None:
    assert ten["result"].trust.grave
    (finding,) = ten["found"].effects
    assert finding.effect == "coulomb_friction@joint_2"
    assert abs(finding.coefficients["torque"].value - 8.0) < 4.0 * finding.coefficients["torque"].std
    better = ten["better"]
    assert better.trust.level == "trust"
    for parameter in better.parameters.values():
        if parameter.determined:
            assert abs(parameter.value - parameter.true) < 5.0 * parameter.std


@pytest.mark.long
def test_an_estimate_is_the_replay_of_the_written_capture(ten: dict[str, Any], tmp_path: Path) -> None:
    path = sms.write_capture(ten["data"], tmp_path / "run.csv")
    assert main(["replay", str(path), "--system", "paper-planar", "--out", str(tmp_path)]) == 0
    replayed = json.loads((tmp_path / "results.json").read_text())
    assert without_timing(json.loads(ten["result"].to_json())) == without_timing(replayed)
    read = sms.read_capture(path)
    assert read.values.tobytes() == ten["data"].values.tobytes()
    assert read.truth["effects"] == ten["data"].truth["effects"]


@pytest.mark.long
def test_a_session_in_blocks_ends_as_the_estimate(ten: dict[str, Any]) -> None:
    session = ten["session"]
    session.finish()
    whole = ten["result"].document()
    live = session.result.document()
    for parameter in whole["parameters"]:
        parameter["true"] = None
    assert without_timing(live) == without_timing(whole)


@pytest.mark.long
def test_results_are_frozen_records(ten: dict[str, Any]) -> None:
    for record in (ten["result"], ten["result"].parameters["joint_1.stiffness"], ten["found"], ten["data"]):
        with pytest.raises(dataclasses.FrozenInstanceError):
            record.source = "another"


# With BLAS as it finds itself, in a process of its own: nothing limits its threads but the package.
ONE_AT_A_TIME = """
import sys
import numpy as np
import sms_online as sms
system = sms.load_system("paper-planar")
data = sms.read_capture(sys.argv[1])
whole = sms.estimate(system, data)
session = sms.Session(system, data.channels, source=data.source)
for t, values in zip(data.t, data.values):
    session.update(t, values)
session.finish()
documents = [result.document() for result in (whole, session.result)]
for document in documents:
    del document["throughput_samples_per_s"]
for parameter in documents[0]["parameters"]:
    parameter["true"] = None
print("same bits" if documents[0] == documents[1] else documents)
"""


@pytest.mark.long
def test_one_sample_at_a_time_gives_the_same_bits(ten: dict[str, Any], tmp_path: Path) -> None:
    data = ten["data"]
    early = data.t <= 4.0
    part = sms.Capture(data.t[early], data.channels, data.values[early], truth=data.truth)
    path = sms.write_capture(part, tmp_path / "run.csv")
    environment = {key: value for key, value in __import__("os").environ.items() if "NUM_THREADS" not in key}
    run = [sys.executable, "-c", ONE_AT_A_TIME, str(path)]
    done = subprocess.run(run, capture_output=True, text=True, env=environment, check=False)
    assert done.stdout.strip() == "same bits", done.stdout[-500:] + done.stderr[-500:]


@pytest.mark.parametrize("command", ["import sms_online", "from sms_tools.cli import main; main(['--help'])"])
def test_importing_loads_no_library(command: str) -> None:
    program = f"{command}\nimport sys\nprint([name for name in ('numpy', 'scipy', 'pydantic') if name in sys.modules])"
    done = subprocess.run([sys.executable, "-c", program], capture_output=True, text=True, check=True)
    assert done.stdout.splitlines()[-1] == "[]"


def test_every_public_name_is_there_and_documented() -> None:
    assert dir(sms) == sms.__all__
    for name in sms.__all__:
        assert name == "__version__" or getattr(sms, name).__doc__, name
    with pytest.raises(AttributeError, match="no attribute 'estimates'"):
        _ = sms.estimates  # type: ignore[attr-defined]


SYSTEM_TABLES = {
    "name": "axis",
    "joint_1": {"transmission": "rigid"},
    "link_1": {"kind": "rigid", "mass": 1.0},
}


def test_systems_come_by_name_path_and_mapping(tmp_path: Path) -> None:
    (tmp_path / "axis.toml").write_text(AXIS)
    axis = sms.load_system(tmp_path / "axis.toml")
    assert axis == sms.load_system(str(tmp_path / "axis.toml"))
    assert sms.load_system(SYSTEM_TABLES).joints[0].transmission == "rigid"
    assert "paper-planar" in sms.shipped_systems()
    assert sms.load_system("paper-planar").nominal["joint_1.stiffness"] == 1000.0
    with pytest.raises(sms.InputError, match=r"axis, link_1.mas: unknown key 'mas'; .*did you mean 'mass'"):
        sms.load_system({**SYSTEM_TABLES, "link_1": {"kind": "rigid", "mas": 1.0}})


@pytest.fixture(scope="module")
def axis() -> sms.System:
    """One axis, of a force and a position."""
    from sms_online.description.parse import parse_system

    return parse_system(AXIS, "axis.toml")


@pytest.fixture(scope="module")
def capture() -> sms.Capture:
    """The axis, 12 s."""
    block = axis_block(coulomb=0.0)
    return sms.Capture(block.t, block.channels, block.values)


@pytest.fixture(scope="module")
def result(axis: sms.System, capture: sms.Capture) -> sms.Result:
    return sms.estimate(axis, capture)


@pytest.mark.slow
def test_tables_are_captures(axis: sms.System, capture: sms.Capture, result: sms.Result) -> None:
    pandas = pytest.importorskip("pandas")
    columns = {"t": capture.t, **dict(zip(capture.channels, capture.values.T, strict=True))}
    for table in (pa.table(columns), pandas.DataFrame(columns)):
        assert sms.estimate(axis, sms.Capture.from_table(table)).parameters == result.parameters


def test_missing_cells_of_tables_are_nan() -> None:
    table = pa.table({"t": [0.0, 1.0], "q_1": [None, 2.0]})
    np.testing.assert_array_equal(sms.Capture.from_table(table).values, [[np.nan], [2.0]])
    pandas = pytest.importorskip("pandas")
    frame = pandas.DataFrame({"t": [0.0, 1.0], "q_1": pandas.array([None, 2.0], dtype="Float64")})
    np.testing.assert_array_equal(sms.Capture.from_table(frame).values, [[np.nan], [2.0]])


def test_a_result_is_a_frame_of_pandas(result: sms.Result) -> None:
    pytest.importorskip("pandas")
    frame = result.to_frame()
    assert list(frame.index) == list(result.parameters)
    assert frame["std"].tolist() == [p.std for p in result.parameters.values()]


T = np.arange(5) / 100.0


@pytest.mark.parametrize(
    ("arguments", "message"),
    [
        ((T, {"q_1": np.zeros(4)}), r"arrays, channel q_1: samples of shape \(4,\); expected as many as times, \(5,\)"),
        ((T[::-1], {"q_1": np.zeros(5)}), "arrays, sample 2: time 0.03 s; expected finite times, each after the one"),
        ((np.zeros(5), {"q_1": np.zeros(5)}), "sample 2: time 0 s; expected finite times, each after the one before"),
        ((T, {"q_1": ["a"] * 5}), "arrays, channel q_1: could not convert string to float: .*; expected numbers"),
        ((T, {"q_1": np.full(5, np.inf)}), "sample 1, channel q_1: an infinite value; expected a finite number"),
        (([], {"q_1": []}), "arrays: no samples; expected at least one"),
        ((np.zeros((2, 2)), {}), r"arrays, t: times of shape \(2, 2\); expected \(N,\)"),
    ],
)
def test_arrays_that_are_no_capture_are_named(arguments: tuple[Any, Any], message: str) -> None:
    with pytest.raises(sms.InputError, match=message):
        sms.Capture.from_arrays(*arguments)


def test_a_table_without_times_is_named() -> None:
    with pytest.raises(sms.InputError, match="table, columns: time, q_1; expected a column t with times in seconds"):
        sms.Capture.from_table(pa.table({"time": T, "q_1": T}))


def test_an_unknown_channel_is_named_with_the_one_meant(axis: sms.System) -> None:
    data = sms.Capture.from_arrays(T, {"force_1": T, "q_l": T})
    with pytest.raises(sms.InputError, match=r"unknown channel 'q_l'; expected .* such as 'q_1'"):
        sms.estimate(axis, data)
    with pytest.raises(sms.InputError, match=r"unknown channel 'q_l'"):
        sms.diagnose(axis, data)


@pytest.mark.parametrize(
    ("samples", "message"),
    [
        ((0.01, [1.0]), r"values of shape \(1, 1\); expected \(1, 2\)"),
        (([0.01, 0.02], [1.0, 2.0]), r"values of shape \(2,\); expected \(2, 2\)"),
        ((-1.0, [1.0, 1.0]), "time -1 s; expected times that do not go back"),
        ((np.nan, [1.0, 1.0]), "time nan s; expected times that do not go back"),
        ((0.01, [1.0, np.inf]), "an infinite value of q_1; expected finite numbers"),
    ],
)
def test_samples_that_do_not_fit_are_named(axis: sms.System, samples: tuple[Any, Any], message: str) -> None:
    session = sms.Session(axis, ["force_1", "q_1"])
    session.update(0.0, [0.0, 0.0])
    with pytest.raises(sms.InputError, match=message):
        session.update(*samples)
    session.finish()
    with pytest.raises(sms.InputError, match=r"samples after finish\(\)"):
        session.update(1.0, [0.0, 0.0])


@pytest.mark.slow
def test_a_saved_session_goes_on_to_the_same_bits(axis: sms.System, capture: sms.Capture) -> None:
    whole = sms.Session(axis, capture.channels)
    blocks = list(capture)
    for block in blocks[: len(blocks) // 2]:
        whole.update(block)
    continued = sms.Session.restore(whole.save())
    for session in (whole, continued):
        for block in blocks[len(blocks) // 2 :]:
            session.update(block)
        session.finish()
    assert continued.result.parameters == whole.result.parameters
    assert continued.result.residuals == whole.result.residuals
    with pytest.raises(sms.InputError, match="saved session: no usable checkpoint"):
        sms.Session.restore(b"nothing")


def test_an_unknown_parameter_is_named_with_the_one_meant(result: sms.Result) -> None:
    with pytest.raises(KeyError, match=r"did you mean 'viscous_friction@joint_1\.damping'"):
        result.parameters["viscous_friction@joint_1.dampin"]


def test_results_read_as_tables(result: sms.Result) -> None:
    for text in (str(result), result._repr_html_()):
        assert result.trust.sentence in text
        assert all(name in text for name in result.parameters)


@pytest.mark.long
def test_a_recorded_motion_has_bounds() -> None:
    system = sms.load_system("paper-planar")
    bounds = sms.bound(system, sms.simulate(system, 4.0, "B"))
    assert all(bound.std > 0.0 for bound in bounds.parameters.values())
    assert "joint_1.stiffness" in str(bounds)


@pytest.mark.slow
def test_a_system_may_be_given_by_the_path_of_its_file(
    tmp_path: Path, capture: sms.Capture, result: sms.Result
) -> None:
    path = tmp_path / "axis.toml"
    path.write_text(AXIS)
    system = sms.load_system(path)
    assert without_timing(sms.estimate(str(path), capture).document()) == without_timing(result.document())
    for given in (path, str(path)):
        assert sms.Session(given, capture.channels).system == system
    assert sms.check(path, capture).system == system.name
    assert sms.bound(path, capture).parameters == sms.bound(system, capture).parameters


@pytest.mark.parametrize(
    ("system", "said"),
    [("paper-plana", "no shipped system of this name"), ("none.toml", "no such file"), (3, "an object of type int")],
)
def test_a_system_that_is_none_is_one_clear_line(system: Any, said: str) -> None:
    block = axis_block(coulomb=0.0)
    capture = sms.Capture(block.t, block.channels, block.values)
    for verb in (sms.estimate, sms.diagnose, sms.check, sms.bound):
        with pytest.raises(sms.InputError, match=said):
            verb(system, capture)
    with pytest.raises(sms.InputError, match=said):
        sms.simulate(system)
    with pytest.raises(sms.InputError, match=said):
        sms.Session(system, block.channels)


def test_a_capture_read_with_its_arguments_swapped_is_refused() -> None:
    with pytest.raises(sms.InputError, match="an object of type System; expected the path of a recording first"):
        sms.read_capture(sms.load_system("paper-planar"), "run.csv")  # type: ignore[arg-type]


@pytest.mark.parametrize(
    ("given", "message"),
    [
        (
            {"effects": ["coulomb_friction@joint_2"]},
            "coulomb_friction@joint_2: nothing of it; expected its size, such as",
        ),
        ({"effects": ["coulomb_friction@joint_2:torque=0"]}, "nothing of it"),
        ({"duration": -1.0}, "duration: -1 s; expected more than 0"),
        ({"duration": 1e300}, r"duration: 1e\+300 s; expected .* at most"),
    ],
)
def test_a_simulation_of_nothing_is_refused(given: dict[str, Any], message: str) -> None:
    with pytest.raises(sms.InputError, match=message):
        sms.simulate("paper-planar", **given)
