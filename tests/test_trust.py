"""May the numbers be trusted? What speaks against them, in which order, and what is said while it is too early."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from sms_online.description.parse import parse_system
from sms_online.evaluation import ratios_determined
from sms_online.nominal import Apart, NominalComparison
from sms_online.pipeline.estimator import Estimator
from sms_online.row_types import Residual
from sms_online.verdict.evidence import Discrepancy, Dispute, Evidence
from sms_online.verdict.judge import judge, judge_diagnosis
from sms_online.verdict.reasons import CHECK_ROWS, MOVE, place_of
from sms_online.verdict.trust import LONGEST_SENTENCE, Reason
from tests.axis import AXIS, axis_block
from tests.evaluated import judged, results_document
from tests.sessions_of import session_of

QUIET = {"energy": Residual(None, None), "joint_1": Residual(0.01, 1.1), "joint_2": Residual(0.02, 0.9)}
GOOD = Evidence(determined=(15, 16), undetermined=("motor_2.stator_inertia",), residual=QUIET)
SOFT = Apart("joint_1.stiffness", 39.8, 100.0)
LACKING = Discrepancy("joint_2", 2.7, "named", ("coulomb_friction@joint_2",))


def with_row(row: str, **values: float) -> Evidence:
    return replace(GOOD, residual={**QUIET, row: QUIET[row]._replace(**values)})


def test_an_undisputed_result_is_trusted_as_far_as_stated() -> None:
    judgement = judge(GOOD)
    assert (judgement.level, judgement.grave, judgement.marks) == ("trust", False, {})
    assert judgement.sentence == "Trust: 15 of 16 parameters determined, residual at most 1.1 × noise"
    assert judgement.others == ("not determined: motor_2.stator_inertia",)


def test_a_torque_that_is_mostly_noise_is_weak_data() -> None:
    """Nothing is known to be missing where the sensors' noise explains what is left."""
    judgement = judge(with_row("joint_1", relative=0.96))
    assert (judgement.level, judgement.grave) == ("doubt", False)
    assert judgement.grounds[0].text == "weak data: 96 % of the torque or force of joint_1 is noise"
    assert judgement.grounds[0].then == MOVE


@pytest.mark.parametrize(
    ("evidence", "said", "marks"),
    [
        (with_row("joint_2", whitened=62.0), "the residual of joint_2 is 62 × noise", {"joint_2": "62 × noise"}),
        (
            with_row("joint_1", relative=0.96, whitened=2.0),
            "96 % of the torque or force of joint_1",
            {"joint_1": "96 % unexplained"},
        ),
        (replace(GOOD, discrepancies=(LACKING,)), "lacks coulomb_friction@joint_2", {"joint_2": "coulomb friction"}),
        (
            replace(GOOD, discrepancies=(Discrepancy("link_1", 3.0, "noticed"),)),
            "not named yet",
            {"link_1": "exceeds noise"},
        ),
        (
            replace(GOOD, discrepancies=(Discrepancy("base", 3.0, "unexplained"),)),
            "no known effect",
            {"base": "exceeds noise"},
        ),
        (replace(GOOD, alarm="base"), "the residual of base exceeds its predicted noise", {"base": "exceeds noise"}),
        (replace(GOOD, negative=("motor_2.mass",)), "motor_2.mass is negative", {"joint_2": "negative"}),
        (
            replace(GOOD, comparison=NominalComparison(50.0, "tau_i looks like X")),
            "50 × its description: tau_i looks like X",
            {},
        ),
    ],
)
def test_what_error_bars_do_not_know_of_is_a_grave_doubt(evidence: Evidence, said: str, marks: dict[str, str]) -> None:
    judgement = judge(evidence)
    assert (judgement.level, judgement.grave) == ("doubt", True)
    assert said in judgement.sentence
    assert judgement.marks == marks


@pytest.mark.parametrize(
    ("evidence", "step"),
    [
        (with_row("joint_1", relative=0.4, whitened=2.1), "a diagnosis has described this system already"),
        (with_row("joint_1", relative=0.1, whitened=20.0), "check geometry, clocks and stated noise"),
    ],
)
def test_nobody_is_sent_to_a_diagnosis_twice(evidence: Evidence, step: str) -> None:
    assert "run `sms-online diagnose`" in judge(evidence).next_step
    assert judge(replace(evidence, diagnosed=True)).next_step.startswith(step)
    assert "run `sms-online diagnose`" not in judge(replace(evidence, diagnosed=True)).next_step


@pytest.mark.parametrize(
    ("evidence", "said"),
    [
        (replace(GOOD, attenuated=("motor_2.mass",)), "noise biases motor_2.mass beyond the error bar"),
        (replace(GOOD, undecided=(19.2,)), "a change at 19.2 s"),
        (replace(GOOD, repeated=("joint_1.damping",)), "joint_1.damping has jumped the same way several times"),
        (replace(GOOD, discrepancies=(Discrepancy("base", 3.0, "passed"),)), "exceeded its predicted noise for a time"),
        (replace(GOOD, distance=39.0), "the estimate violates physical consistency by 39 standard deviations"),
        (replace(GOOD, lost=0.2), "20 % of the samples are lost"),
        (replace(GOOD, jitters={"encoders": 5e-4}), "stamps of encoders jitter by 0.5 ms"),
        (
            replace(GOOD, coloured={"q_1": 4e-2, "q_2": 2e-2}),
            "noise of q_1 and of 1 more channels is correlated over 40",
        ),
        (replace(GOOD, troubles=("drive: silent",)), "drive: silent"),
        (with_row("joint_1", relative=0.4, whitened=2.1), "the residual of joint_1 is 2.1 × noise"),
        (with_row("joint_1", relative=0.4, whitened=None), "40 % of the torque or force of joint_1"),
        (replace(GOOD, undetermined=("joint_1.stiffness",)), "not determined: joint_1.stiffness"),
        (replace(GOOD, comparison=NominalComparison(apart=(SOFT,))), "joint_1.stiffness is 39.8, described as 100"),
    ],
)
def test_what_harms_some_numbers_is_a_doubt_that_is_not_grave(evidence: Evidence, said: str) -> None:
    judgement = judge(evidence)
    assert (judgement.level, judgement.grave) == ("doubt", False)
    assert said in judgement.sentence


@pytest.mark.parametrize(
    "evidence",
    [
        replace(GOOD, discrepancies=(replace(LACKING, adopted=True), Discrepancy("base", 9.0, "change"))),
        replace(GOOD, lost=1e-4, distance=1.0),
        replace(GOOD, jitters={"encoders": 3e-5}, coloured={"q_1": 5e-3}),
        with_row("joint_1", relative=0.4, whitened=1.4),
    ],
)
def test_what_is_explained_or_harmless_leaves_trust(evidence: Evidence) -> None:
    assert judge(evidence).level == "trust"


def test_nothing_is_missing_beside_torques_that_are_noise() -> None:
    """Of a torque that is noise for the most part a fit may leave twice the noise, along what no motion shows."""
    weak = replace(GOOD, residual={"joint_1": Residual(1.7, 1.8)}, discrepancies=(LACKING,), alarm="joint_1")
    judgement = judge(weak)
    assert (judgement.level, judgement.grave) == ("doubt", False)
    assert judgement.sentence == "Doubt: weak data: 100 % of the torque or force of joint_1 is noise"
    assert judgement.next_step == MOVE
    undetermined = judge(replace(weak, determined=(0, 16), unconverged="no parameter is determined"))
    assert undetermined.sentence == "Not yet: weak data: 100 % of the torque or force of joint_1 is noise"
    wrong = judge(replace(weak, residual={"joint_1": Residual(1.7, 9.0)}))
    assert wrong.grave


def test_known_values_that_noise_hides_are_said() -> None:
    evidence = replace(GOOD, determined=(0, 16), unconverged="no parameter is determined", unscaled=("payload.mass",))
    judgement = judge(evidence)
    assert judgement.level == "not yet"
    assert judgement.reasons[0].startswith("ratios of parameters are determined, not their scale")
    assert judgement.next_step.startswith("leave `[known]` out")


def test_ratios_are_determined_where_one_held_parameter_determines_the_others() -> None:
    """A scale that is five times uncertain, and one per cent of each parameter beside it; without, and as noise."""
    beta = np.array([1.0, 20.0, 300.0, -4.0])
    own = np.diag((0.01 * beta) ** 2)
    assert ratios_determined(beta, own + 25.0 * np.outer(beta, beta))
    assert not ratios_determined(beta, np.diag((5.0 * beta) ** 2))


def test_the_named_effect_comes_before_its_residual() -> None:
    evidence = replace(with_row("joint_2", whitened=19.0), discrepancies=(LACKING,), attenuated=("motor_2.mass",))
    judgement = judge(evidence)
    assert "coulomb_friction" in judgement.sentence
    assert judgement.others[0] == "the residual of joint_2 is 19 × noise"
    assert "motor_2.mass" in judgement.others[-1]
    assert judgement.marks == {"joint_2": "coulomb friction"}


def test_what_the_model_lacks_is_said_in_place_of_calibration_errors() -> None:
    off = Reason("link_1.marker_2: place -74 ± 5 mm off", True)
    judgement = judge(replace(GOOD, discrepancies=(LACKING,), miscalibrated=(off,)))
    assert off.text not in (judgement.sentence, *judgement.reasons)
    assert off in judge(replace(GOOD, miscalibrated=(off,))).grounds


@pytest.mark.parametrize(("short", "left", "advised"), [(True, 0.01, True), (False, 0.01, False), (True, 0.5, False)])
def test_a_short_session_is_advised_to_record_for_longer(short: bool, left: float, advised: bool) -> None:
    # So few windows do not show whether it is a force; where half of a torque is left, it is no noise.
    judgement = judge(replace(with_row("joint_2", relative=left, whitened=9.0), short=short))
    assert judgement.grave
    assert any("record for longer" in reason.then for reason in judgement.grounds) == advised


def test_lost_samples_come_before_their_residual() -> None:
    judgement = judge(replace(with_row("joint_2", whitened=19.0), lost=0.02))
    assert judgement.sentence == "Do not trust: 2 % of the samples are lost"
    assert judgement.others == ("the residual of joint_2 is 19 × noise",)


@pytest.mark.parametrize(("share", "first"), [(0.002, "the residual"), (0.05, "5 % of the samples of q_1")])
def test_few_outliers_come_behind_what_they_do_not_cause(share: float, first: str) -> None:
    judgement = judge(replace(with_row("joint_2", whitened=19.0), outliers={"q_1": share}))
    assert judgement.grave
    assert judgement.reasons[0].startswith(first)
    assert len(judgement.reasons) == 2


def test_slow_noise_comes_before_its_residual() -> None:
    judgement = judge(replace(with_row("joint_2", whitened=4.0), coloured={"q_1": 4e-2}, jitters={"markers": 1e-3}))
    assert judgement.grave
    stamps, noise, residual = judgement.reasons
    assert stamps == "stamps of markers jitter by 1 ms"
    assert noise == "noise of q_1 is correlated over 40 ms"
    assert residual == "the residual of joint_2 is 4 × noise"


def test_residuals_of_an_unconverged_estimate_show_nothing() -> None:
    loud = replace(with_row("joint_1", relative=3.0, whitened=80.0), unconverged="too few rows")
    assert judge(loud).level == "not yet"
    assert judge(loud).sentence == "Not yet: too few rows"
    # Unless a test says so.
    assert judge(replace(loud, alarm="joint_1")).grave


def test_an_alarm_under_diagnosis_is_no_doubt_of_its_own() -> None:
    looked_into = judge(replace(GOOD, alarm="joint_2", discrepancies=(Discrepancy("joint_2", 3.0, "noticed"),)))
    assert len(looked_into.reasons) == 1
    # What was adopted is in the model, and the test began anew with it.
    assert judge(replace(GOOD, alarm="joint_1", discrepancies=(replace(LACKING, adopted=True),))).grave


def test_what_explains_some_of_it_is_said_where_nothing_explains_all() -> None:
    noticed = Discrepancy("joint_2", 3.0, "noticed", ("sensor_lag@q_*",))
    said = "the residual of joint_2 exceeds its predicted noise since 3.0 s, not named yet, nearest sensor_lag@q_*"
    assert judge(replace(GOOD, discrepancies=(noticed,))).reasons[0] == said


def test_a_prior_that_data_pull_from_is_a_grave_doubt() -> None:
    off = Dispute("joint_2.stiffness", -6.2, "link_2")
    judgement = judge(replace(GOOD, disputed=(Dispute("link_1.mass", 3.4, None), off)))
    assert judgement.sentence == "Do not trust: joint_2.stiffness is 6 σ off its prior, driven by the rows of link_2"
    assert judgement.marks == {"joint_2": "off its prior", "link_1": "off its prior"}
    assert not judge(replace(GOOD, unconverged="too few rows", disputed=(off,))).grave


def test_the_energy_balance_alone_is_never_trusted() -> None:
    """Its residual is scaled by itself: nothing distinguishes a lacking effect from noise."""
    block = axis_block(0.1)
    session = session_of(parse_system('balance = "energy"\n' + AXIS, "axis.toml"), [block])
    assert judged(session).level == "doubt"
    assert "energy balance alone" in judged(session).sentence


def test_a_sentence_is_read_at_a_glance() -> None:
    many = tuple(f"torsional_hysteresis@joint_{i}" for i in range(9))
    sentence = judge(replace(GOOD, discrepancies=(replace(LACKING, effects=many),))).sentence
    assert "and 7 more" in sentence
    assert len(judge(replace(GOOD, troubles=("much ado " * 50,))).sentence) <= LONGEST_SENTENCE


@pytest.mark.parametrize(
    ("parameter", "place"),
    [
        ("spacecraft.first_moment_x", "base"),
        ("motor_2.rotor_inertia", "joint_2"),
        ("link_1.flexural_rigidity", "link_1"),
        ("payload.mass", "tip"),
        ("viscous_friction@joint_1.damping", "joint_1"),
    ],
)
def test_a_parameter_sits_at_its_body(parameter: str, place: str) -> None:
    assert place_of(parameter) == (place,)


TRUSTED, DOUBTED = judge(GOOD), judge(with_row("joint_2", whitened=5.0))


def test_a_clean_capture_is_judged_by_its_session() -> None:
    assert judge_diagnosis("clean", [], None, TRUSTED) == TRUSTED
    assert judge_diagnosis("clean", [], None, DOUBTED) == DOUBTED


def test_a_named_effect_puts_the_system_file_in_doubt() -> None:
    judgement = judge_diagnosis("named", ["sensor_lag@link_1.*"], None, TRUSTED)
    assert (judgement.level, judgement.grave) == ("doubt", False)
    assert "the parameters are trusted with it" in judgement.sentence
    assert judgement.marks == {"link_1.*": "sensor lag"}
    caution = judge(replace(GOOD, attenuated=("motor_2.mass",)))
    assert (
        "the parameters are trusted with it, except as listed below"
        in judge_diagnosis("named", ["slosh@base"], None, caution).sentence
    )
    early = judge(replace(GOOD, unconverged="few rows"))
    assert "the parameters are trusted" not in judge_diagnosis("named", ["slosh@base"], None, early).sentence
    still = judge_diagnosis("named", ["backlash@joint_1", "cogging@joint_2"], None, DOUBTED)
    assert still.grave
    assert "the parameters are trusted" not in still.sentence
    assert still.marks == {"joint_1": "backlash", "joint_2": "cogging"}


def test_what_nothing_explains_is_marked_where_it_acts() -> None:
    judgement = judge_diagnosis("unexplained", [], "link_1", TRUSTED)
    assert judgement.grave
    assert judgement.marks == {"link_1": "unexplained"}
    assert "diagnose --learn" in judgement.next_step
    assert "diagnose --learn" not in judge_diagnosis("unexplained", [], "link_1", TRUSTED, learned=True).next_step


def test_an_effect_that_does_not_explain_all_is_called_near() -> None:
    judgement = judge_diagnosis("unexplained", ["cogging@joint_1"], "joint_1", TRUSTED)
    assert judgement.reasons[1] == "some of it looks like cogging@joint_1"
    judgement = judge_diagnosis("unexplained", ["cogging@joint_1"], "joint_1", TRUSTED, near=True)
    assert judgement.grave
    assert "cogging@joint_1 explains most of what acts" in judgement.sentence
    assert "lacks" not in judgement.sentence


def session(coulomb: float, seconds: float) -> Estimator:
    block = axis_block(coulomb)
    estimator = Estimator(parse_system(AXIS, "axis.toml"), block.channels, "test")
    kept = block.t < seconds
    estimator.push(type(block)(block.t[kept], block.channels, block.values[kept]))
    return estimator


def test_a_session_goes_from_too_early_to_trust() -> None:
    levels = [judged(session(0.0, seconds)).level for seconds in (0.5, 1.5, 12.0)]
    assert levels == ["not yet", "not yet", "trust"]


@pytest.mark.slow
def test_a_model_without_friction_is_doubted_where_it_acts() -> None:
    judgement = judged(session(0.2, 12.0))
    assert judgement.grave
    assert [*judgement.marks] == ["joint_1"]


@pytest.mark.slow
def test_results_hold_the_judgement_and_warn_of_the_reasons() -> None:
    estimator = session(0.2, 12.0)
    estimator.finish()
    document = results_document(estimator, 0.0, [])
    assert document["verdict"] == judged(estimator).document()
    assert any(warning.startswith("the residual of joint_1 is") for warning in document["warnings"])


def test_a_judgement_is_plain_data_in_results() -> None:
    document = judge(with_row("joint_2", whitened=5.0)).document()
    assert document == {
        "level": "doubt",
        "grave": True,
        "sentence": "Do not trust: the residual of joint_2 is 5 × noise",
        "reasons": ["the residual of joint_2 is 5 × noise"],
        "next_step": CHECK_ROWS,
    }


def test_a_tracker_that_lets_nothing_move_may_be_what_is_wrong() -> None:
    found = judge(replace(with_row("joint_2", whitened=5.0), still=True)).document()["next_step"]
    assert found.startswith("replay it with `--tracker kalman:drift=learned`")
    assert found.endswith(CHECK_ROWS)


def test_every_grave_doubt_states_what_to_do_next() -> None:
    for evidence in (
        with_row("joint_2", whitened=62.0),
        with_row("joint_1", relative=0.96, whitened=2.0),
        replace(GOOD, discrepancies=(LACKING,)),
        replace(GOOD, discrepancies=(Discrepancy("base", 3.0, "unexplained"),)),
        replace(GOOD, alarm="base"),
        replace(GOOD, disputed=(Dispute("link_1.mass", 3.4, None),)),
        replace(GOOD, negative=("motor_2.mass",)),
        replace(GOOD, comparison=NominalComparison(50.0)),
    ):
        assert judge(evidence).grave
        assert judge(evidence).next_step
