"""Which effect the last seconds of a session hold whose parameters come from the smoother: they are diagnosed whole."""

from __future__ import annotations

import numpy as np

from sms_online.diagnosis.document import effects_document
from sms_online.diagnosis.reconstructed import diagnose_recorded
from sms_online.diagnosis.searcher import Named, Outcome, RecordedRequest
from sms_online.errors import InputError
from sms_online.pipeline.estimator import Estimator
from sms_online.priors import known_beforehand
from sms_online.trackers.interface import Prior


def search_recorded(request: RecordedRequest) -> Outcome | None:
    """What a diagnosis of the samples finds; None where they allow for none."""

    def prior(estimator: Estimator) -> Prior | None:
        return known_beforehand(request.system, estimator.base, request.prior)

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
    named = tuple(
        Named(
            effect=effects[f"{entry['name']}@{entry['where']}"],
            parameters=(),
            units=(),
            values=np.empty(0),
            stds=np.empty(0),
            coefficients={name: (c["estimate"], c["std"], c["unit"]) for name, c in entry["coefficients"].items()},
            gain=entry["evidence"]["gain"],
            limit=entry["evidence"]["limit"],
            ambiguous=tuple(entry["ambiguous_with"]),
        )
        for entry in effects_document(found)
    )
    # A mistake of units or wiring is no effect.
    verdict = "unexplained" if found.verdict == "named" and not named else found.verdict
    scores = {ranked.candidate.key: ranked.gain for ranked in found.ranking}
    return Outcome(verdict, named, scores, found.left, began=False, beta=np.empty(0))
