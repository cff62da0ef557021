"""What a search of a whole capture has found, as one record."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from functools import cached_property

from sms_online.calibration.found import Calibration
from sms_online.description.schema import System
from sms_online.diagnosis.attempt import Attempt, ModelFit, Step
from sms_online.diagnosis.candidate import Finding, Ranked
from sms_online.diagnosis.capture_changes import CaptureChange
from sms_online.diagnosis.hypothesis import share_left
from sms_online.diagnosis.late_sensors import LateSensor
from sms_online.diagnosis.mistakes import Mistake
from sms_online.diagnosis.torque_zeros import TorqueZero
from sms_online.diagnosis.unexplained import Unexplained
from sms_online.effects.build import build_model
from sms_online.model.model import Model
from sms_online.pipeline.estimator import Estimator
from sms_online.tracker_results import Drift


@dataclass(frozen=True)
class Search:
    """What was found.

    verdict: "clean", "named" or "unexplained". partial: the search was ended before it was done, and parameters after
    are those of its rows. mistakes: of wiring, units and signs, undone in all that follows.
    zeros: of torques that differed from capture to capture, taken off.
    calibration: what the description is off by, beyond its tolerances, that no effect of the catalogue says.
    findings: constants first, then the effects that are unknowns of π.
    late: sensors far behind the others, whose lag the description of the last attempt states. steps: of the last
    search, its effects one after the other.
    described, attempt: first and last description against the samples; chosen: of the last one's candidates.
    estimator_before, estimator_after: sessions of the two systems over the whole capture; the first one again where the
    search is partial or parameters come from its own rows. drifts: parameters that drift, which the second follows;
    nothing else is searched then. changes: jumps of parameters in the capture; all else is of one part of it.
    restored: the system with what was found as captures of it are recorded, where coordinates were reconstructed.
    """

    verdict: str
    partial: bool
    mistakes: tuple[Mistake, ...]
    zeros: Sequence[TorqueZero]
    calibration: tuple[Calibration, ...]
    findings: list[Finding]
    late: list[LateSensor]
    ranking: list[Ranked]
    described: Attempt
    attempt: Attempt
    steps: list[Step]
    chosen: list[int]
    before: ModelFit
    after: ModelFit
    estimator_before: Estimator
    estimator_after: Estimator
    unexplained: Unexplained | None
    drifts: tuple[Drift, ...] = ()
    changes: tuple[CaptureChange, ...] = ()
    restored: System | None = None

    @property
    def adopted(self) -> System:
        """The described system with what was found."""
        return self.after.system if self.restored is None else self.restored

    @property
    def left(self) -> float:
        """Share of what was beyond noise that is left with what was found."""
        return share_left(self.before.excess, self.after.excess)

    @property
    def of_reconstructed(self) -> bool:
        """Whether parameters after are of coordinates that are reconstructed, and not of the samples themselves."""
        return self.restored is not None and self.estimator_after.system != self.restored

    @cached_property
    def by_rows(self) -> bool:
        """Whether parameters after are those of the diagnosis's rows, and not of a session; see `Attempt.by_rows`.

        Where nothing was found those of the session as described are, which knows more of its sensors' noise.
        """
        if self.restored is not None and not self.of_reconstructed:
            return False
        return (self.partial or self.attempt.by_rows(self.chosen)) and self.after.system != self.estimator_before.system

    @cached_property
    def model(self) -> Model:
        """Of the system with what was found, whether or not there was a session of it."""
        same = self.estimator_after.system == self.after.system
        return self.estimator_after.model if same else build_model(self.after.system)
