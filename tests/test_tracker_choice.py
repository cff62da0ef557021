"""A tracker chosen in the system file, on the command line or in Python, and several on the same rows."""

from __future__ import annotations

import json
from pathlib import Path
from typing import Any

import pytest

import sms_online as sms
from sms_online.description.parse import parse_system, shipped_text
from sms_online.description.schema import TrackerChoice
from sms_online.tracker_results import TrackerResult
from sms_online.trackers.build import KINDS
from sms_online.trackers.parse import parse_tracker
from sms_tools.cli import main
from tests.axis import AXIS, capture_lines
from tests.exactly_known import exactly_known
from tests.guide import fading
from tests.simulations import planar_capture

SYSTEM = exactly_known(sms.load_system("paper-planar"))
FORGETTING = "rls:forgetting=exponential,memory=3"
CHOICES = [
    "rls",
    FORGETTING,
    "rls:forgetting=window,memory=3",
    "rls:forgetting=directional,memory=3",
    "kalman",
    "kalman:drift=random_walk,share=1e-6",
    "kalman:joint_1.stiffness=random_walk/0.5",
]


@pytest.fixture(scope="module")
def data() -> sms.Capture:
    return planar_capture(6.0)


@pytest.fixture(scope="module")
def several(data: sms.Capture) -> sms.Result:
    """All choices on the same rows, the first judged."""
    return sms.estimate(SYSTEM, data, tracker=CHOICES)


def of(several: sms.Result, choice: str) -> TrackerResult:
    return several.trackers[CHOICES.index(choice)]


def test_the_first_tracker_gives_the_estimate(several: sms.Result) -> None:
    assert [each.name for each in several.trackers] == [parse_tracker(choice).label for choice in CHOICES]
    assert [each.judged for each in several.trackers] == [True, *[False] * (len(CHOICES) - 1)]


@pytest.mark.parametrize("choice", [FORGETTING, pytest.param("kalman", marks=pytest.mark.slow)])
def test_a_tracker_alone_estimates_as_beside_others(choice: str, data: sms.Capture, several: sms.Result) -> None:
    alone = sms.estimate(SYSTEM, data, tracker=choice)
    # Alone it is judged, and what noise in the columns does is estimated about its own path.
    for here, there in zip(of(several, choice).parameters.values(), alone.parameters.values(), strict=True):
        assert here.value == pytest.approx(there.value, abs=0.1 * there.std)
        assert here.std == pytest.approx(there.std, rel=0.02)


@pytest.mark.slow
def test_no_choice_learns_drifts_and_begins_as_rls(data: sms.Capture, several: sms.Result) -> None:
    plain, learned = sms.estimate(SYSTEM, data), sms.estimate(SYSTEM, data, tracker="kalman:drift=learned")
    assert list(plain.parameters.values()) == list(learned.parameters.values())
    for here, there in zip(plain.parameters.values(), several.parameters.values(), strict=True):
        assert (here.value, here.std) == pytest.approx((there.value, there.std), rel=1e-9)
    (tracker,) = plain.trackers
    assert tracker.name == "kalman learned"
    assert tracker.consistency.consistent
    assert not tracker.drifts


@pytest.mark.long
def test_what_no_ramps_explain_is_a_lack_from_the_first_row() -> None:
    """Patience with a drift yet to be learned ends, and rows are made again with weights that allow for friction."""
    data = sms.simulate(SYSTEM, duration=8.0, grade="B", effects=["coulomb_friction@joint_2:torque=8"])
    sessions = [sms.Session(SYSTEM, data.channels, tracker=tracker) for tracker in ("kalman:drift=learned", "rls")]
    for session in sessions:
        for block in data:
            session.update(block)
        session.finish()
    learned, rls = (session.result.parameters for session in sessions)
    momentum = sessions[0].estimator.momentum
    assert momentum is not None
    assert not momentum.state.patient
    assert momentum.misfit
    for name, here in learned.items():
        assert here.value == pytest.approx(rls[name].value, abs=rls[name].std), name
        assert here.std == pytest.approx(rls[name].std, rel=0.2), name


def test_estimates_agree_with_the_truth_within_bars(several: sms.Result) -> None:
    for tracker in several.trackers:
        truth = {p.name: p.true for p in several.parameters.values()}
        known = [(p, true) for name, p in tracker.parameters.items() if (true := truth[name]) is not None]
        errors = [(p.value - true) / p.std for p, true in known]
        assert max(map(abs, errors)) < 4.5, tracker.name
        assert tracker.consistency.consistent, tracker.name


def test_kalman_without_drift_is_least_squares(several: sms.Result) -> None:
    pairs = zip(several.parameters.values(), of(several, "kalman").parameters.values(), strict=True)
    for squares, kalman in pairs:
        assert kalman.value == pytest.approx(squares.value, abs=0.05 * squares.std)
        assert kalman.std == pytest.approx(squares.std, rel=1e-3)


def test_forgetting_widens_error_bars_and_says_its_memory(several: sms.Result) -> None:
    for choice in CHOICES[1:4]:
        forgetting = of(several, choice)
        assert forgetting.parameters["joint_1.stiffness"].std > several.parameters["joint_1.stiffness"].std
        assert forgetting.memory == pytest.approx(3.0, rel=0.25)


@pytest.mark.slow
def test_a_session_cut_by_a_checkpoint_gives_the_same_bits(data: sms.Capture, several: sms.Result) -> None:
    session = sms.Session(SYSTEM, data.channels, tracker=CHOICES)
    blocks = list(data)
    for k, block in enumerate(blocks):
        if k == len(blocks) // 2:
            session = sms.Session.restore(session.save())
        session.update(block)
    session.finish()
    found = session.result
    assert [(p.value, p.std) for p in found.parameters.values()] == [
        (p.value, p.std) for p in several.parameters.values()
    ]
    assert found.trackers == several.trackers


@pytest.mark.slow
def test_the_system_file_and_the_command_line_choose_alike(tmp_path: Path) -> None:
    (tmp_path / "run.csv").write_text("\n".join(capture_lines()) + "\n")
    (tmp_path / "plain.toml").write_text(AXIS)
    (tmp_path / "chosen.toml").write_text(
        AXIS + '\n[tracker]\nkind = "rls"\nforgetting = "exponential"\nmemory = 3.0\n'
    )
    values = []
    for name, options in (("chosen", []), ("plain", ["--tracker", FORGETTING]), ("plain", [])):
        arguments = ["replay", str(tmp_path / "run.csv"), "--system", str(tmp_path / f"{name}.toml")]
        assert main([*arguments, "--out", str(tmp_path / "out"), *options]) == 0
        document = json.loads((tmp_path / "out" / "results.json").read_text(encoding="utf-8"))
        values.append(([tracker["name"] for tracker in document["trackers"]], document["parameters"]))
    assert values[0] == values[1] != values[2]
    assert values[0][0] == ["rls exponential 3 s"]


@pytest.mark.parametrize(
    ("text", "place"),
    [
        ("lms", "lms"),
        ("rls:memory=-1", "rls:memory=-1"),
        ("rls:forgetting=slow", "rls:forgetting=slow"),
        ("rls:drift=learned", "rls:drift=learned"),
        ("kalman:drift=fast", "kalman:drift=fast"),
    ],
)
def test_a_text_that_is_no_tracker_is_refused(text: str, place: str) -> None:
    with pytest.raises(sms.InputError) as refused:
        parse_tracker(text)
    assert place in str(refused.value)


def test_an_unknown_kind_is_refused_with_all_that_are_known(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setitem(KINDS, "fading", lambda choice, tracked: fading(tracked.n, 10.0, tracked.prior))
    with pytest.raises(sms.InputError, match=r"one of rls, kalman, fading \(did you mean 'fading'\?\)"):
        parse_tracker("fadin:memory=5")


@pytest.mark.parametrize(
    "choice",
    [
        TrackerChoice(forgetting="exponential"),
        TrackerChoice(memory=3.0),
        TrackerChoice(drift="learned"),
        TrackerChoice(kind="kalman", forgetting="window", memory=3.0),
        TrackerChoice(kind="kalman", drift="random_walk"),
        TrackerChoice(kind="kalman", drift={"joint_7.stiffness": "random_walk"}, share=1e-3),
        TrackerChoice(kind="kalman", drift="learned", share=1e-3),
        TrackerChoice(kind="kalman", std={"joint_1.stiffness": 20.0}),
    ],
)
def test_a_choice_that_does_not_fit_the_system_is_refused(choice: TrackerChoice, data: sms.Capture) -> None:
    with pytest.raises(sms.InputError, match=f"tracker {choice.label}[:,]"):
        sms.Session(SYSTEM, data.channels, tracker=choice)


@pytest.mark.parametrize(
    ("given", "message"),
    [
        (["rls", 3], "tracker: 3; expected rls"),
        (["rls", "rls"], "tracker: rls, twice; expected trackers that differ"),
    ],
)
def test_what_is_no_list_of_trackers_is_refused(given: list[Any], message: str) -> None:
    with pytest.raises(sms.InputError, match=message):
        sms.Session(sms.load_system("paper-planar"), (), tracker=given)


@pytest.mark.parametrize(
    ("tables", "message"),
    [
        ('[tracker]\nkind = "kalmann"\n', r"'kalmann'; expected one of rls, kalman \(did you mean 'kalman'\?\)"),
        ('[[tracker]]\nkind = "rls"\n' * 2, "rls, twice; expected trackers that differ"),
    ],
)
def test_a_file_with_trackers_that_cannot_be_is_refused(tables: str, message: str, tmp_path: Path) -> None:
    file = tmp_path / "bad.toml"
    file.write_text(f"{shipped_text('paper-planar')}\n{tables}", encoding="utf-8")
    with pytest.raises(sms.InputError, match=f"bad.toml, tracker.*: {message}"):
        sms.load_system(file)


def test_a_system_described_elsewhere_with_a_kind_that_is_none_is_refused(data: sms.Capture) -> None:
    system = SYSTEM.model_copy(update={"trackers": (TrackerChoice(kind="lms"),)})
    with pytest.raises(sms.InputError, match="'lms'; expected one of rls, kalman"):
        sms.Session(system, data.channels)


def test_a_system_without_momentum_rows_refuses_a_tracker(data: sms.Capture) -> None:
    text = shipped_text("paper-planar").replace("sample_rate", 'balance = "energy"\nsample_rate', 1)
    system = parse_system(text, "system.toml")
    assert system.balance == "energy"
    with pytest.raises(sms.InputError, match="no momentum balance"):
        sms.Session(system, data.channels, tracker=FORGETTING)


def test_two_tables_are_two_trackers_in_their_order() -> None:
    text = shipped_text("paper-planar") + '\n[[tracker]]\nkind = "kalman"\n\n[[tracker]]\nkind = "rls"\n'
    assert [choice.kind for choice in parse_system(text, "system.toml").trackers] == ["kalman", "rls"]
