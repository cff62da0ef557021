"""Evidence for or against a session's estimate: what is known, before anything is concluded from it."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, field

from sms_online.nominal import AS_STATED, NominalComparison
from sms_online.pipeline.tracker_bank import Suspected
from sms_online.row_types import Residuals
from sms_online.tracker_results import Consistency
from sms_online.verdict.trust import Reason


@dataclass(frozen=True)
class Discrepancy:
    """Rows of a running session that leave more than noise, as diagnosed so far: see `diagnosis.episodes.Episode`.

    row: type of the rows that leave most, "" where the smoother has none. noticed: s. effects: what was named,
    `name@where`, or what is nearest where nothing is. adopted: whether the model has been updated with them; refused:
    whether it cannot be. mistakes: of units, signs and wiring, a sentence each.
    """

    row: str
    noticed: float
    verdict: str
    effects: tuple[str, ...] = ()
    adopted: bool = False
    refused: bool = False
    mistakes: tuple[str, ...] = ()

    @property
    def unexplained(self) -> bool:
        """Whether an alarm of the sequential test is this one's. After a model update it is of something else."""
        return not self.adopted and self.verdict not in ("change", "drift")


@dataclass(frozen=True)
class Dispute:
    """A parameter that the data pull further from its prior than that allows.

    deviations: of the prior, by which it is off. row: type of the rows that pull most; None where that is not known.
    """

    parameter: str
    deviations: float
    row: str | None


@dataclass(frozen=True)
class Evidence:
    """What is known of a session for or against its estimate.

    determined: number of parameters that the data determine, and of all.
    undetermined: names of the others.
    unconverged: why the estimate will still move by more than its error bars; empty where it will not.
    unscaled: names of known values that leave the scale of all parameters to noise, where nothing else is lacking.
    silent: since when, s, nothing has come of sources or channels; -inf where it never has.
    residual: of each type of rows.
    negative: names of parameters that are negative and must not be.
    attenuated: names of parameters that noise in the columns biases beyond their error bars.
    alarm: type of the rows in which the sequential test finds more than noise, of a session without diagnosis.
    disputed: parameters that the data pull away from their prior.
    undecided: times, s, of changes that the session ended too early to decide on.
    repeated: parameters that have jumped the same way in each of the last changes.
    distance: from the nearest physically consistent parameters, in standard deviations.
    comparison: with the values that the system file states.
    lost: share of the samples.
    slow: rates, Hz, of sensors that are too slow for the balance.
    outliers: share of the samples that was left out, by channel.
    discrepancies: of the running diagnosis.
    jitters: 1σ, s, by which stamps of devices are off at random.
    coloured: correlation time of the noise, s, by channel.
    noisy: by type of rows that leave more than noise, the torque's channel and the 1σ that they leave, see `noisier`.
    short: whether rows leave more than noise in too few windows to show whether that lasts.
    miscalibrated: what is off by more than the description's tolerances allow.
    troubles: of the devices, the recording and the machine of a live session, a short sentence each.
    weaknesses: of an estimate by the way it is made.
    suspected: parameters that seem to move, which the judged tracker does not follow.
    still: whether the tracker that was asked for lets no parameter move.
    unwatched: s of a session in which no drift is watched for and none is followed; 0 elsewhere.
    consistency: of the judged tracker's rows with its error bars.
    scale: 1σ of the factor that all parameters have in common, where nothing else fixes it.
    diagnosed: whether the system is what a diagnosis has found.
    """

    determined: tuple[int, int]
    undetermined: tuple[str, ...] = ()
    unconverged: str = ""
    unscaled: tuple[str, ...] = ()
    silent: Mapping[str, float] = field(default_factory=dict)
    residual: Residuals = field(default_factory=dict)
    negative: tuple[str, ...] = ()
    attenuated: tuple[str, ...] = ()
    alarm: str | None = None
    disputed: tuple[Dispute, ...] = ()
    undecided: tuple[float, ...] = ()
    repeated: tuple[str, ...] = ()
    distance: float = 0.0
    comparison: NominalComparison = AS_STATED
    lost: float = 0.0
    slow: Mapping[str, float] = field(default_factory=dict)
    outliers: Mapping[str, float] = field(default_factory=dict)
    discrepancies: tuple[Discrepancy, ...] = ()
    jitters: Mapping[str, float] = field(default_factory=dict)
    coloured: Mapping[str, float] = field(default_factory=dict)
    noisy: Mapping[str, tuple[str, float]] = field(default_factory=dict)
    short: bool = False
    miscalibrated: tuple[Reason, ...] = ()
    troubles: tuple[str, ...] = ()
    weaknesses: tuple[Reason, ...] = ()
    suspected: Suspected | None = None
    still: bool = False
    unwatched: float = 0.0
    consistency: Consistency | None = None
    scale: float | None = None
    diagnosed: bool = False
