"""A diagnosis as one frozen record: verdict, effects, residuals before and after, the system with what was found."""

from __future__ import annotations

from collections.abc import Callable, Iterable, Mapping, Sequence
from dataclasses import dataclass, field
from html import escape
from typing import Any

from sms_online.capture import check_channels
from sms_online.data import Data, recorded_session
from sms_online.description.channels import channels as known_channels
from sms_online.description.given import Given, given_system
from sms_online.description.schema import System
from sms_online.diagnosis.document import diagnosis_document, trust_of
from sms_online.diagnosis.mistakes import Mistake
from sms_online.diagnosis.reconstructed import diagnose_recorded
from sms_online.diagnosis.search import Search
from sms_online.effects.build import build_model
from sms_online.errors import InputError
from sms_online.model.base_parameters import find_base_parameters
from sms_online.pipeline.estimator import Estimator
from sms_online.priors import GivenPrior, given_prior, known_beforehand, with_estimates
from sms_online.recorded import Recorded
from sms_online.result import Finding, Parameter, Parameters
from sms_online.row_types import Residual, Residuals
from sms_online.stream import Block
from sms_online.tables import Documented, html_table, text_table
from sms_online.tracker_results import Drift
from sms_online.trackers.interface import Prior
from sms_online.truth import true_values
from sms_online.verdict.trust import Trust


@dataclass(frozen=True)
class Fit:
    """A description fitted to the capture.

    parameters: by name. residuals: by type of the rows, of the samples that were fitted; held_out: of those that were
    not. limits: what a whitened residual of noise alone stays below.
    """

    parameters: Parameters
    residuals: Residuals
    held_out: Residuals
    limits: Mapping[str, float]

    @staticmethod
    def _of(document: Mapping[str, Any]) -> Fit:
        parameters = Parameters(map(Parameter.of, document["parameters"]))
        fit, held_out = ({row: Residual(**r) for row, r in document[part].items()} for part in ("fit", "holdout"))
        return Fit(parameters, fit, held_out, dict(document["limit"]))


@dataclass(frozen=True)
class Candidate:
    """An effect that was tried. gain: evidence, twice the log likelihood ratio, of the effect alone. explained: share
    of the whole residual, noise included, that it explains alone."""

    name: str
    where: str
    gain: float
    explained: float


@dataclass(frozen=True)
class Diagnosis(Documented):
    """What a capture holds that its system file does not describe.

    verdict: "clean", "named" or "unexplained". summary: the same in a sentence. mistakes: of units, signs and wiring,
    undone in what follows. effects: what was found. drifts: parameters that drift, which a tracker of `system` follows;
    no effects are searched then. before, after:
    fits of the system as described and with what was found. candidates: effects that were tried, the best first.
    system: with what was found and the parameters after as its fitted values, to estimate with, predict and simulate.
    trust: may the parameters after, and the system file, be trusted.
    warnings: a sentence each.
    """

    verdict: str
    summary: str
    mistakes: tuple[Mistake, ...]
    effects: tuple[Finding, ...]
    before: Fit
    after: Fit
    candidates: tuple[Candidate, ...]
    system: System
    trust: Trust
    warnings: tuple[str, ...]
    search: Search = field(repr=False, compare=False)
    _document: Mapping[str, Any] = field(repr=False, compare=False)
    drifts: tuple[Drift, ...] = ()

    def document(self) -> dict[str, Any]:
        """diagnosis.json as plain lists, dictionaries and numbers."""
        return dict(self._document)

    def _rows(self) -> tuple[list[str], list[list[str]]]:
        rows = []
        for finding in self.effects:
            named = [
                [name, f"{c.value:.5g}", "" if c.std is None else f"{c.std:.2g}", c.unit]
                for name, c in finding.coefficients.items()
            ]
            for k, cells in enumerate(named or [["", "", "", ""]]):
                rows.append([finding.effect if k == 0 else "", *cells])
        return ["effect", "coefficient", "estimate", "± std", "unit"], rows

    def __str__(self) -> str:
        table = f"{text_table(*self._rows(), left=2)}\n\n" if self.effects else ""
        return f"{self.summary}\n\n{table}{self.trust}"

    __repr__ = __str__

    def _repr_html_(self) -> str:
        table = html_table(*self._rows()) if self.effects else ""
        return f"<p><b>{escape(self.summary)}</b></p>{table}<p>{escape(self.trust.sentence)}</p>"


def diagnose(
    system: Given,
    data: Data | Sequence[Data],
    *,
    holdout: Data | None = None,
    prior: GivenPrior = False,
    progress: Callable[[str, float], None] = lambda what, share: None,
    stop: Callable[[], bool] = lambda: False,
    learned: bool = False,
) -> Diagnosis:
    """Find what recorded data hold that a system file does not describe, and describe it.

    system, data: as for `estimate`; a list of data, several captures of the same rig, is searched at once: parameters
    and effects are common, initial states are each capture's own, and an effect is selected where it improves captures
    that are predicted from the others. holdout: another capture of the same rig, to check on, of which nothing found
    depends; without it blocks of the data, each predicted from the others. prior: as for `Session`. progress: is called
    with what is being done, a few words, and the share of all that is done, roughly. stop: is asked between steps
    whether to end with a partial verdict. learned: whether a curve may be named where no law of the catalogue is.
    Where parameters jump within the capture, one part of it is searched.
    Raises InputError where the data cannot be read or do not fit the system, a sensor that it needs is missing, or
    there is too little motion.
    """
    system, folder = given_system(system)
    recorded, *others = [recorded_session(system, each, folder) for each in _several(data)]
    check_channels(tuple(recorded.source.channels), known_channels(system), recorded.name)
    blocks = _samples(recorded.source, recorded.name)
    warnings = [*recorded.source.warnings]

    def like_the_first(other: Recorded) -> list[Block]:
        samples = _samples(other.source, other.name)
        warnings.extend(other.source.warnings)
        if samples[0].channels != blocks[0].channels:
            raise InputError(other.name, "header", ", ".join(samples[0].channels), ", ".join(blocks[0].channels))
        return samples

    further = [like_the_first(other) for other in others]
    held = [] if holdout is None else like_the_first(recorded_session(system, holdout, folder))

    beforehand = given_prior(prior)

    def known(estimator: Estimator) -> Prior | None:
        return known_beforehand(system, estimator.base, beforehand)

    name = ", ".join(each.name for each in (recorded, *others))
    found, said = diagnose_recorded(system, [blocks, *further], held, name, known, progress, stop, learned)
    warnings += said
    described = found.adopted
    true = None if recorded.truth is None else true_values(recorded.truth, system, described)
    document = diagnosis_document(found, warnings, true)
    after = Fit._of(document["after"])
    base = find_base_parameters(build_model(described))
    return Diagnosis(
        verdict=found.verdict,
        summary=document["summary"],
        mistakes=found.mistakes,
        effects=tuple(map(Finding.of, document["effects"])),
        before=Fit._of(document["before"]),
        after=after,
        candidates=tuple(Candidate(**candidate) for candidate in document["candidates"]),
        system=with_estimates(described, base, after.parameters),
        trust=trust_of(found),
        warnings=tuple(document["warnings"]),
        search=found,
        _document=document,
        drifts=found.drifts,
    )


def _several(data: Data | Sequence[Data]) -> list[Data]:
    """The captures of data: one, unless it is a list of them."""
    several = isinstance(data, list | tuple) and len(data) > 0 and not isinstance(data[0], Block)
    return list(data) if several else [data]  # type: ignore[list-item, arg-type]


def _samples(source: Iterable[Block], name: str) -> list[Block]:
    blocks = [block for block in source if block.t.size]
    if not blocks:
        raise InputError(name, "", "no samples", "a capture with samples in the time asked for")
    return blocks
