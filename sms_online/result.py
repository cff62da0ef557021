"""The result of a session as one frozen record: parameters, residuals, events, findings, trust. results.json is it."""

from __future__ import annotations

import difflib
import math
from collections.abc import Iterable, Iterator, Mapping, Sequence
from dataclasses import dataclass, field
from html import escape
from typing import TYPE_CHECKING, Any

import numpy as np

from sms_online.calibration.found import Calibration
from sms_online.description.parse import describe
from sms_online.description.schema import System
from sms_online.evaluation import NORMAL_95
from sms_online.history import History, HistoryRecorder, reported_covariance
from sms_online.model.base_parameters import BaseParameters
from sms_online.pipeline.events import Event
from sms_online.pipeline.statistics import Method
from sms_online.row_types import Residual, Residuals
from sms_online.stream import Array
from sms_online.tables import Documented, Table, finite, formatter
from sms_online.tracker_results import Drift, TrackerResult
from sms_online.triangle import upper
from sms_online.verdict.judged import JudgedEvaluation
from sms_online.verdict.trust import Trust

if TYPE_CHECKING:
    import pandas

SCHEMA = "sms-online/results/1"


@dataclass(frozen=True)
class Parameter:
    """An identified parameter: a physical one, or a combination that the motion determines only as such.

    name: as in the system file, such as "joint_1.stiffness"; a combination has that of its first member. symbol: the
    paper's. unit: SI. value: the estimate. std: its standard deviation as it is reported, inf where the data determine
    nothing. determined: whether the value is three of it from zero. nominal: of the system file, None where it states
    none. true: of a simulated capture. bound: Cramér–Rao bound of std, where it was asked for. projected: value in the
    nearest physically consistent parameters, where the estimate violates consistency.
    """

    name: str
    symbol: str
    unit: str
    value: float
    std: float
    determined: bool
    nominal: float | None = None
    true: float | None = None
    bound: float | None = None
    projected: float | None = None

    @staticmethod
    def of(document: Mapping[str, Any]) -> Parameter:
        """The parameter of an entry `parameters` of results.json or diagnosis.json."""
        return Parameter(
            name=document["name"],
            symbol=document["symbol"],
            unit=document["unit"],
            value=document["estimate"],
            std=math.inf if document["std"] is None else document["std"],
            determined=document["identifiable"],
            nominal=document["nominal"],
            true=document["true"],
            bound=document.get("bound"),
            projected=document.get("projected"),
        )

    @property
    def interval(self) -> tuple[float, float]:
        """Lower and upper end of the 95 % interval, infinite where the data determine nothing."""
        return self.value - NORMAL_95 * self.std, self.value + NORMAL_95 * self.std

    def __str__(self) -> str:
        if not self.determined:
            return f"{self.name}: not determined"
        shown = formatter(self.value, self.std)
        return f"{self.name}: {shown(self.value)} ± {self.std:.2g} {self.unit}".rstrip()

    def document(self) -> dict[str, Any]:
        """The entry of results.json."""
        lower, upper = self.interval
        return {
            "name": self.name,
            "symbol": self.symbol,
            "unit": self.unit,
            "estimate": self.value,
            "std": finite(self.std),
            "lower95": finite(lower),
            "upper95": finite(upper),
            "nominal": self.nominal,
            "true": self.true,
            "identifiable": self.determined,
            "projected": self.projected,
            "bound": self.bound,
        }


class Parameters(Mapping[str, Parameter], Table):
    """Parameters by name, in the order of the arm from its base outwards.

    KeyError for an unknown name says which one was probably meant.
    """

    def __init__(self, parameters: Iterable[Parameter]) -> None:
        self._by_name = {parameter.name: parameter for parameter in parameters}

    def __getitem__(self, name: str) -> Parameter:
        try:
            return self._by_name[name]
        except KeyError:
            near = difflib.get_close_matches(str(name), self._by_name, n=1)
            meant = f"; did you mean {near[0]!r}?" if near else ""
            raise KeyError(f"no parameter {name!r} of this result{meant}") from None

    def __contains__(self, name: object) -> bool:
        return name in self._by_name

    def __iter__(self) -> Iterator[str]:
        return iter(self._by_name)

    def __len__(self) -> int:
        return len(self._by_name)

    def rows(self) -> tuple[list[str], list[list[str]]]:
        """Headings, and a row of cells for each parameter; no column without an entry."""
        compared = "true" if any(p.true is not None for p in self.values()) else "nominal"
        headings = ["parameter", "unit", "estimate", "± std", "95 % interval", compared]
        rows = []
        for p in self.values():
            other = getattr(p, compared)
            last = "" if other is None else f"{other:.6g}"
            if not p.determined:
                rows.append([p.name, p.unit, "not determined", "", "", last])
                continue
            shown = formatter(p.value, p.std)
            lower, upper = map(shown, p.interval)
            rows.append([p.name, p.unit, shown(p.value), f"{p.std:.2g}", f"{lower} … {upper}", last])
        return headings, rows


@dataclass(frozen=True)
class Coefficient:
    """A coefficient of an effect: value in its unit, and standard deviation, None where it has none."""

    value: float
    std: float | None
    unit: str


@dataclass(frozen=True)
class Finding:
    """An effect that the samples show and the system file does not describe.

    name, where: as a system file declares it. coefficients: by name, in SI units. ambiguous_with: other effects,
    `name@where`, that explain as much. gain: evidence, twice the log likelihood ratio; limit: what the best of all
    absent effects reaches by chance. held_out_improvement: share of the residual that it takes on samples that were
    not fitted; None where nothing was held out.
    """

    name: str
    where: str
    coefficients: Mapping[str, Coefficient]
    ambiguous_with: tuple[str, ...]
    gain: float
    limit: float
    held_out_improvement: float | None = None

    @property
    def effect(self) -> str:
        """name@where."""
        return f"{self.name}@{self.where}"

    @staticmethod
    def of(document: Mapping[str, Any]) -> Finding:
        """The finding of an entry `effects` of results.json or diagnosis.json."""
        evidence = document["evidence"]
        return Finding(
            document["name"],
            document["where"],
            {k: Coefficient(c["estimate"], c["std"], c["unit"]) for k, c in document["coefficients"].items()},
            tuple(document["ambiguous_with"]),
            evidence["gain"],
            evidence["limit"],
            evidence.get("held_out_improvement"),
        )


@dataclass(frozen=True)
class PhysicalConsistency:
    """Physical consistency: distance from the estimate to the nearest consistent parameters, in standard deviations.

    active: the conditions that bind, as names of parameters and bodies; empty at distance 0.
    """

    distance: float
    active: tuple[str, ...]


@dataclass(frozen=True)
class Result(Documented):
    """The result of a session: parameters with their accuracy, residuals, events, findings and the verdict.

    system: as described. parameters: by name; after an event they, and residuals, are those since then. residuals: by
    type of the rows, "energy", "joint_i", "link_i" or "base". events: changes while the session ran. findings: effects
    that the running diagnosis has named. trust: the verdict, and its reasons. warnings: a sentence each. method:
    source of the estimate, "smoother", "momentum" or "energy" balance. samples, lost_samples: counts. outliers:
    how many samples were left out, by channel. duration: s. condition_number: of the scaled information, inf without
    full rank. throughput: samples/s of computing time. calibration: what the description is off by, estimated better
    than its tolerances. trackers: what each says, the judged one, whose estimate `parameters` holds, first; empty where
    the energy balance gives the estimate, or the smoother by its own least squares alone.
    physical: None of a session that still runs. diagnosis: episodes of the running diagnosis, as in results.json.
    history: of the estimates of each tracker, the judged one first. covariance (n, n): of the parameters, in their
    order, with the deviations that are reported; NaN of what is not determined.
    """

    system: System
    parameters: Parameters
    residuals: Residuals
    events: tuple[Event, ...]
    findings: tuple[Finding, ...]
    trust: Trust
    warnings: tuple[str, ...]
    method: Method
    samples: int
    duration: float
    condition_number: float
    lost_samples: int
    outliers: dict[str, int]
    throughput: float = 0.0
    calibration: tuple[Calibration, ...] = ()
    trackers: tuple[TrackerResult, ...] = field(default=(), repr=False)
    physical: PhysicalConsistency | None = field(default=None, repr=False)
    diagnosis: tuple[Mapping[str, Any], ...] = field(default=(), repr=False)
    history: tuple[History, ...] = field(default=(), repr=False)
    covariance: Array = field(default_factory=lambda: np.empty((0, 0)), repr=False, compare=False)

    @property
    def drifts(self) -> tuple[Drift, ...]:
        """Parameters that the judged tracker has found to drift."""
        return tuple(drift for tracker in self.trackers if tracker.judged for drift in tracker.drifts)

    def document(self) -> dict[str, Any]:
        """results.json as plain lists, dictionaries and numbers."""
        return {
            "schema": SCHEMA,
            "system": describe(self.system),
            "samples": self.samples,
            "duration_s": self.duration,
            "method": self.method,
            "verdict": self.trust.document(),
            "parameters": [parameter.document() for parameter in self.parameters.values()],
            "covariance": [finite(each) for each in upper(self.covariance).tolist()],
            "scale_tolerance": self.system.scale_tolerance,
            "calibration": [each.document() for each in self.calibration],
            "trackers": [each.document() for each in self.trackers],
            "events": [event_document(event) for event in self.events],
            "residual": residual_document(self.residuals),
            "physical": None
            if self.physical is None
            else {"distance_std": self.physical.distance, "active": list(self.physical.active)},
            "condition_number": finite(self.condition_number),
            "throughput_samples_per_s": self.throughput,
            "lost_samples": self.lost_samples,
            "outliers": self.outliers,
            "warnings": list(self.warnings),
            "diagnosis": [dict(episode) for episode in self.diagnosis],
            "history": [each.document() for each in self.history],
        }

    def to_frame(self) -> pandas.DataFrame:
        """The parameters as a table of pandas, indexed by name; ImportError where pandas is not installed."""
        try:
            import pandas
        except ImportError:
            raise ImportError("Result.to_frame needs pandas, which is not installed: pip install pandas") from None
        columns = ("symbol", "unit", "value", "std", "lower", "upper", "determined", "nominal", "true", "bound")
        rows = [
            [p.symbol, p.unit, p.value, p.std, *p.interval, p.determined, p.nominal, p.true, p.bound]
            for p in self.parameters.values()
        ]
        frame = pandas.DataFrame(rows, index=pandas.Index(list(self.parameters), name="name"), columns=columns)
        return frame.astype(dict.fromkeys(("nominal", "true", "bound"), float))

    def __str__(self) -> str:
        calibration = [f"calibration: {each}\n" for each in self.calibration if each.certain]
        return f"{self.parameters}\n\n{''.join(calibration)}{self.trust}"

    __repr__ = __str__

    def _repr_html_(self) -> str:
        others = "".join(f"<li>{escape(other)}</li>" for other in self.trust.others)
        return f"<p><b>{escape(self.trust.sentence)}</b></p><ul>{others}</ul>{self.parameters._repr_html_()}"


def result_of(
    evaluation: JudgedEvaluation,
    truth: Mapping[str, float] | None = None,
    bound: Array | None = None,
    warnings: Sequence[str] = (),
    episodes: Sequence[Mapping[str, Any]] = (),
    throughput: float = 0.0,
    history: HistoryRecorder | None = None,
) -> Result:
    """An evaluation as one record.

    truth: true values of physical parameters by name, of a simulated capture, which enter this record alone. bound (n,)
    or fewer: Cramér–Rao bound of each parameter's std. warnings: of the source. episodes: of the diagnosis that ran
    beside the session, as results.json holds them. throughput: samples/s. history: the
    recorder of the estimates on the way.
    """
    now, base = evaluation.statistics, evaluation.base
    notices = evaluation.notices
    missing = [] if truth is None else [p.name for p in base.physical if p.name not in truth]
    if missing:
        notices = [*notices, f"no comparison with the truth: it does not hold {missing[0]}"]
    bounds = np.full(base.n, np.inf)
    if bound is not None:
        bounds[: bound.size] = bound
    estimate, projection = evaluation.estimate, evaluation.projection
    projected = np.full(base.n, np.nan) if projection is None or not projection.active else projection.beta
    numbers = (estimate.pi, evaluation.std, evaluation.determined, true_parameters(base, truth), bounds, projected)
    parameters = Parameters(
        Parameter(
            p.name,
            p.symbol,
            p.unit,
            value,
            std,
            determined,
            # A combination that is nominally zero is not described.
            nominal=p.nominal or None,
            true=finite(true_value),
            bound=finite(least),
            projected=finite(nearest),
        )
        for p, value, std, determined, true_value, least, nearest in zip(
            base.parameters, *(column.tolist() for column in numbers), strict=True
        )
    )
    return Result(
        system=now.setup.system,
        parameters=parameters,
        residuals=evaluation.residuals,
        events=now.events,
        findings=tuple(Finding.of(effect) for episode in episodes for effect in episode["effects"]),
        trust=evaluation.trust,
        warnings=(*warnings, *notices, *evaluation.warnings),
        method=now.method,
        samples=now.samples,
        duration=now.duration,
        condition_number=estimate.condition_number,
        lost_samples=now.counters.lost_samples,
        outliers={channel: left.number for channel, left in now.outliers.items()},
        throughput=throughput,
        calibration=tuple(evaluation.calibration),
        trackers=evaluation.trackers,
        physical=None if projection is None else PhysicalConsistency(projection.distance, projection.active),
        diagnosis=tuple(episodes),
        history=() if history is None else history.histories,
        covariance=reported_covariance(estimate, evaluation.std),
    )


def true_parameters(base: BaseParameters, truth: Mapping[str, float] | None) -> Array:
    """True values (n,) of base parameters, NaN unless `truth` holds that of each physical parameter by its name."""
    if truth is None or not all(p.name in truth for p in base.physical):
        return np.full(base.n, np.nan)
    return base.values(np.array([truth[p.name] for p in base.physical]))


def event_document(event: Event) -> dict[str, Any]:
    """An event as results.json holds it."""
    jumps = zip(event.parameters, event.units, event.sizes, event.stds, strict=True)
    return {
        "time": event.time,
        "kind": event.kind,
        "parameters": [{"name": name, "unit": unit, "size": size, "std": std} for name, unit, size, std in jumps],
        "dropped_windows": event.dropped_windows,
    }


def residual_document(residuals: Mapping[str, Residual]) -> dict[str, dict[str, float | None]]:
    """Residuals as the documents hold them."""
    return {rows: residual._asdict() for rows, residual in residuals.items()}
