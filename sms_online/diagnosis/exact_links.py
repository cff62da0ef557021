"""Links whose shortening the samples ask for: exact kinematics in place of straight links."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

from sms_online.description.schema import Effect
from sms_online.diagnosis.attempt import Attempt, Case
from sms_online.diagnosis.trace import DECISIVE
from sms_online.effects.build import declaring
from sms_online.effects.catalogue import kinematic_candidates
from sms_online.pipeline.momentum_windows import HOPS

# Exact links have to take this share of what straight ones leave beyond noise.
STIFFENING_TAKES = 0.1


def with_exact_links(case: Case, attempt: Attempt, chosen: Sequence[int]) -> Attempt | None:
    """An attempt with those links exact that the samples ask for, and nothing else; None where these take too little.

    All links together first, for one may hide what another lacks; then without those that take no more than chance.
    """
    links, beta = kinematic_candidates(attempt.system), attempt.rows.beta
    # What was found may be there beside it, or may only have mimicked it.
    effects = [attempt.tracing.candidates[k].effect for k in chosen]

    def excess(links: Sequence[Effect]) -> float:
        try:
            some = attempt.trial(declaring(attempt.system, links), attempt.constants, beta, effects)
        except np.linalg.LinAlgError:
            return np.inf  # the readings are those of links that are straight
        return some.excess(range(len(some.tracing.candidates)))

    # Squares of rows that overlap count the same evidence once for each.
    chance = DECISIVE * HOPS
    least = excess(links)
    while len(links) > 1:
        fewer = [[*links[:k], *links[k + 1 :]] for k in range(len(links))]
        left = [excess(some) for some in fewer]
        if min(left) > least + chance:
            break
        links, least = fewer[left.index(min(left))], min(left)
    straight = excess([])
    if straight - least <= max(chance, STIFFENING_TAKES * straight):
        return None
    try:
        return Attempt(case, declaring(attempt.system, links), (), beta)
    except np.linalg.LinAlgError:
        return None
