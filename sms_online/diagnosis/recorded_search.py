"""Which effect the last seconds of a session hold whose parameters come from the smoother: they are diagnosed whole."""

from __future__ import annotations

import numpy as np

from sms_online.description.schema import Effect
from sms_online.diagnosis.document import effects_document
from sms_online.diagnosis.reconstructed import diagnose_recorded
from sms_online.diagnosis.searcher import REPORTED, Named, Outcome, RecordedRequest
from sms_online.errors import InputError
from sms_online.pipeline.estimator import Estimator
from sms_online.pipeline.events import prior_behind
from sms_online.priors import known_beforehand
from sms_online.result import Finding
from sms_online.trackers.interface import Prior


def search_recorded(request: RecordedRequest) -> Outcome | None:
    """What a diagnosis of the samples finds; None where they allow for none."""

    def prior(estimator: Estimator) -> Prior | None:
        known = known_beforehand(request.system, estimator.base, request.prior)
        return None if known is None else prior_behind(request.events, known, estimator.base.parameters)

    try:
        found, _ = diagnose_recorded(
            request.system,
            [request.blocks],
            [],
            request.source,
            prior,
            progress=lambda what, share: None,
            stop=lambda: False,
            learned=False,
        )
    except (InputError, np.linalg.LinAlgError):
        return None
    effects = {effect.key: effect for effect in found.adopted.effects}
    named = tuple(_named(Finding.of(entry), effects) for entry in effects_document(found))
    mistakes = tuple(mistake.sentence for mistake in found.mistakes)
    verdict = found.verdict
    if mistakes:
        verdict = "mistake"
    elif verdict == "named" and not named:
        verdict = "unexplained"  # a jump or a drift is no effect
    scores = {ranked.candidate.key: ranked.gain for ranked in found.ranking[:REPORTED]}
    return Outcome(verdict, named, scores, found.left, began=False, beta=np.empty(0), mistakes=mistakes)


def _named(finding: Finding, effects: dict[str, Effect]) -> Named:
    """A finding of a diagnosis, with the effect that it has declared; its parameters are in no model yet."""
    return Named(
        effect=effects[finding.effect],
        parameters=(),
        units=(),
        values=np.empty(0),
        stds=np.empty(0),
        coefficients={name: (c.value, c.std, c.unit) for name, c in finding.coefficients.items()},
        gain=finding.gain,
        limit=finding.limit,
        ambiguous=finding.ambiguous_with,
    )
