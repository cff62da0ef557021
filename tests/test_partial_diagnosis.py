"""A diagnosis that is interrupted says what it has found by then."""

from __future__ import annotations

import tomllib
from pathlib import Path

import pytest

import sms_online as sms
from sms_online.diagnosis.document import diagnosis_document
from sms_online.result import result_of
from sms_online.verdict.judged import evaluated
from sms_tools.cli import main
from sms_tools.exit_codes import INTERRUPTED
from sms_tools.interruption import Interruption
from tests.axis import AXIS, axis_block

FRICTION = 0.05


def axis_capture() -> sms.Capture:
    block = axis_block(coulomb=FRICTION)
    return sms.Capture.from_arrays(block.t, dict(zip(block.channels, block.values.T, strict=True)))


@pytest.mark.slow
def test_an_interrupted_search_reports_what_it_found() -> None:
    capture = axis_capture()
    said: list[str] = []

    def stop() -> bool:
        return any(text.startswith("found so far") for text in said)

    found = sms.diagnose(
        sms.load_system(tomllib.loads(AXIS)),
        capture,
        progress=lambda what, share: said.append(what),
        stop=stop,
    )
    assert found.summary.startswith("Partial, the search was interrupted.")
    assert found.document()["partial"]
    (effect,) = found.effects
    assert effect.effect == "coulomb_friction@joint_1"
    # As a person reads it, from the model with it although no session of that model was run.
    assert effect.coefficients["torque"].value == pytest.approx(FRICTION, rel=0.05)
    assert effect.coefficients["torque"].unit == "N m"
    assert "coulomb_friction" in [each.name for each in found.system.effects]
    assert not any(text.startswith("fitting the model with") for text in said)
    # Parameters of its own rows are reported as those of a session, and compared with the truth.
    truth = {p.name: p.nominal for p in found.search.model.parameters} | {f"{effect.effect}.torque": FRICTION}
    entries = diagnosis_document(found.search, truth=truth)["after"]["parameters"]
    whole = result_of(evaluated(found.search.estimator_before)).document()["parameters"]
    assert all(entry.keys() == whole[0].keys() for entry in entries)
    assert entries[-1]["true"] == FRICTION
    assert all(entry["true"] is not None for entry in entries)


@pytest.mark.slow
def test_an_interrupted_search_rules_nothing_out(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    monkeypatch.chdir(tmp_path)
    Path("axis.toml").write_text(AXIS)
    sms.write_capture(axis_capture(), Path("run.csv"))

    class Pressed(Interruption):
        """Ctrl-C at once."""

        def __enter__(self) -> Interruption:
            super().__enter__()
            self.requested = True
            return self

    monkeypatch.setattr("sms_tools.verbs.diagnose.Interruption", Pressed)
    assert main(["diagnose", "run.csv", "--system", "axis.toml", "--out", "found"]) == INTERRUPTED
    said = capsys.readouterr().out
    assert "no other effect is ruled out" in said
    assert "no known effect explains" not in said
    assert "Do not trust: the search was interrupted" in said
