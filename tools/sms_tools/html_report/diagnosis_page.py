"""diagnosis.html: what the model lacks, where, how that is known, and what adding it changes."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path
from typing import Any

import numpy as np
from markupsafe import Markup

from sms_online.diagnosis.search import Search
from sms_online.grouping import grouped
from sms_tools.found_effects import cells_of, look_alikes, why
from sms_tools.html_report.arm_drawing import marked_arm
from sms_tools.html_report.diagnosis_charts import AFTER, BEFORE, law_charts, residual_charts
from sms_tools.html_report.pages import write_page
from sms_tools.html_report.parameter_rows import parameter_rows
from sms_tools.report import Document
from sms_tools.view.places import places_of
from sms_tools.view.scene import Scene

NAME = "diagnosis.html"
# Candidates that are listed.
LISTED = 12
# Positions that the tip's way is drawn through.
WAY_POINTS = 300


def write_diagnosis(directory: Path, document: Document, diagnosis: Search, source: str, added: Sequence[str]) -> Path:
    """Write diagnosis.html beside diagnosis.json, whose content `document` is.

    source: the capture. added: lines that the system file gains. Raises InputError where the file cannot be written.
    """
    system = diagnosis.described.system
    before, after = (document[state]["parameters"] for state in ("before", "after"))
    both = bool(document["effects"] or document["drifts"])
    columns = {"before": (before, BEFORE), "after": (after, AFTER)} if both else {"estimate": (after, AFTER)}
    found = bool(document["effects"] or document["unexplained"])
    rows = diagnosis.attempt.rows
    return write_page(
        directory / NAME,
        "diagnosis.html",
        title=f"{system.name}: diagnosis",
        heading=system.title or system.name,
        document=document,
        source=source,
        seconds=sum(segment.index.size for segment in rows.segments) / rows.model.system.sample_rate,
        windows=rows.count,
        blocks=diagnosis.attempt.folds.count,
        arm=_arm(document, diagnosis) if found else None,
        view="from above" if rows.model.layout.planar else "from one side",
        cells=cells_of,
        look_alikes=look_alikes,
        why=why,
        laws=law_charts(diagnosis),
        # Windows of a parameter that drifts are not drawn with one value of it.
        residuals=[] if diagnosis.drifts else residual_charts(diagnosis),
        colors={"before": BEFORE, "after": AFTER},
        changed=diagnosis.after.system != diagnosis.before.system,
        candidates=_candidates(document, diagnosis),
        parameters=parameter_rows(columns, _nominal(diagnosis)),
        added="\n".join(added),
    )


def _nominal(diagnosis: Search) -> dict[str, float]:
    """What the system file states of the parameters after, by name."""
    before, after = (each.base.parameters for each in (diagnosis.estimator_before, diagnosis.estimator_after))
    # What was found is not described.
    described = {p.name for p in before}
    return {p.name: p.nominal for p in after if p.nominal and ("@" not in p.name or p.name in described)}


def _arm(document: Document, diagnosis: Search) -> Markup:
    """The arm in the middle of the session, with the effects' numbers at their places."""
    rows = diagnosis.attempt.rows
    # Windows of each filter's width hold another part of the motion.
    motions = [motion for motion, _ in rows.weak.motions()]
    segment = np.repeat([motion.segment for motion in motions], [len(motion.x) for motion in motions])
    order = np.lexsort((np.concatenate([motion.samples for motion in motions]), segment))
    x = np.concatenate([motion.x for motion in motions])[order][:: max(1, order.size // WAY_POINTS)]
    channels = diagnosis.estimator_before.sensing.channels
    marks: dict[str, list[str]] = {}
    for number, effect in enumerate(document["effects"], start=1):
        for place in places_of(effect["where"], channels):
            marks.setdefault(place, []).append(str(number))
    if document["unexplained"] is not None:
        marks.setdefault(document["unexplained"]["row"], []).append("?")
    return marked_arm(Scene(rows.model), x, len(x) // 2, {place: ", ".join(texts) for place, texts in marks.items()})


def _candidates(document: Document, diagnosis: Search) -> list[dict[str, Any]]:
    """The best by what each alone explains of the whole residual, and those found; none that explains nothing."""
    numbers = {f"{e['name']}@{e['where']}": n for n, e in enumerate(document["effects"], start=1)}
    effects = enumerate(document["effects"], start=1)
    like = grouped((key, str(found)) for found, effect in effects for key in effect["ambiguous_with"])
    rows = []
    for rank, ranked in enumerate(diagnosis.ranking, start=1):
        effect = ranked.candidate.effect
        row = {
            "rank": rank,
            "name": effect.name,
            "where": effect.where,
            "explained": 100.0 * ranked.explained,
            "found": numbers.get(effect.key),
            "like": like.get(ranked.candidate.key, []),
        }
        if ranked.explained and (rank <= LISTED or row["found"]):
            rows.append(row)
    return rows
