"""From the statistics of a session to the evidence for or against its estimate."""

from __future__ import annotations

from collections.abc import Sequence
from typing import TYPE_CHECKING

import numpy as np

from sms_online.description.sources import source_channels
from sms_online.evaluation import Evaluation
from sms_online.pipeline.event_hypotheses import PAYLOAD
from sms_online.pipeline.events import TRANSIENT, Event
from sms_online.pipeline.periods import LONGEST_HOLE
from sms_online.pipeline.sensing import is_slow
from sms_online.pipeline.statistics import Statistics
from sms_online.pipeline.synchronise import SIDE
from sms_online.verdict.contradictions import ambiguous_effects, disputes, miscalibrated
from sms_online.verdict.evidence import Discrepancy, Evidence
from sms_online.verdict.reasons import DIAGNOSE, MEASURE_SLOPES, STATE_HELD, unexplained_torques
from sms_online.verdict.torque_noise import noisy_torques
from sms_online.verdict.trust import Reason

if TYPE_CHECKING:
    from sms_online.smoother.statistics import SmootherStatistics

# Rows of the energy balance, for each parameter, from which on its first transient is forgotten.
ROWS_A_PARAMETER = 10
# Changes in a row of the same parameters that are a series.
SERIES = 3
# Tolerances that are none of the smoother's readings.
NOT_SMOOTHED = ("length", "axis", "gravity", "gauge_low_pass", "base_angle", "truncation", "drive_gain", "drive_offset")


def evidence_of(evaluation: Evaluation, discrepancies: Sequence[Discrepancy], troubles: Sequence[str]) -> Evidence:
    """All evidence of an evaluated session for or against its estimate."""
    now, flags, momentum = evaluation.statistics, evaluation.determined, evaluation.statistics.momentum
    projection, trackers = evaluation.projection, evaluation.trackers
    return Evidence(
        determined=(int(np.count_nonzero(flags)), flags.size),
        undetermined=tuple(p.name for p, known in zip(evaluation.parameters, flags, strict=True) if not known),
        unconverged=_unconverged(evaluation),
        unscaled=tuple(now.setup.system.known) if evaluation.scale_alone else (),
        silent=_silent(now),
        residual=evaluation.residuals,
        negative=tuple(evaluation.negative),
        attenuated=tuple(evaluation.attenuated),
        alarm=None if momentum is None else momentum.alarm,
        disputed=tuple(disputes(evaluation)),
        undecided=tuple(event.time for event in now.events if event.kind == "undecided"),
        repeated=repeated(now.events) if now.method == "smoother" else (),
        distance=0.0 if projection is None else projection.distance,
        comparison=evaluation.comparison,
        lost=_lost(now),
        slow=_slow(now),
        outliers={channel: left.number / left.of for channel, left in now.outliers.items()},
        discrepancies=tuple(discrepancies),
        jitters={} if momentum is None else momentum.jitters,
        coloured={} if momentum is None else momentum.coloured,
        noisy={} if momentum is None else noisy_torques(evaluation.residuals, momentum.passing),
        short=momentum is not None and momentum.short,
        miscalibrated=(*miscalibrated(evaluation), *ambiguous_effects(evaluation)),
        troubles=tuple(troubles),
        weaknesses=tuple(_weaknesses(now)),
        suspected=None if momentum is None or now.method != "momentum" else momentum.suspected,
        still=any(each.still for each in now.setup.system.trackers[:1]),
        unwatched=now.duration if now.method == "momentum" and momentum is not None and momentum.unwatched else 0.0,
        consistency=trackers[0].consistency if trackers else None,
        scale=now.setup.system.scale_tolerance,
        diagnosed=bool(now.setup.system.fitted),
    )


def repeated(events: Sequence[Event]) -> tuple[str, ...]:
    """Names of the parameters that have jumped the same way in each of the last changes; not payloads, which add up."""
    series = [event for event in events[-SERIES:] if event.kind not in (PAYLOAD, TRANSIENT)]
    if len(series) < SERIES:
        return ()
    ways = {(event.parameters, tuple(size > 0.0 for size in event.sizes)) for event in series}
    return series[0].parameters if len(ways) == 1 else ()


def _unconverged(evaluation: Evaluation) -> str:
    """Why the estimate will still move by more than its error bars."""
    now, estimate = evaluation.statistics, evaluation.estimate
    smoother, momentum = now.smoother, now.momentum
    # Of a torque that is noise for the most part no motion determines anything; where it is not, the model is at fault.
    lacking = momentum is not None and momentum.tested and bool(unexplained_torques(evaluation.residuals))
    if not evaluation.determined.any() and not lacking:
        return f"no parameter is determined by the motion of {now.duration:.3g} s"
    if smoother is not None and smoother.spans == 0 and not smoother.failures:
        return "the smoother has not processed its first span"
    if now.method == "smoother":
        return ""
    if momentum is None:
        few = estimate.dof < ROWS_A_PARAMETER * estimate.pi.size
        return "the energy balance has few rows yet" if few else ""
    if not momentum.started:
        return f"the motion of {now.duration:.3g} s is too little for the first weights"
    if momentum.tested or (now.events and now.events[-1].kind == "undecided"):
        return ""
    after = f" since the change at {now.events[-1].time:.1f} s" if now.events else ""
    return f"the test of the residual has too few rows{after}"


def _silent(now: Statistics) -> dict[str, float]:
    """Since when, s, sources have been silent; channels where not all of a source is, or none is described."""
    channels, last = now.setup.sensing.channels, now.last_time
    silent = {
        name: time
        for name, time in zip(channels, last.tolist(), strict=True)
        if np.isneginf(time) or last.max() - time > LONGEST_HOLE
    }
    sources: dict[str, float] = {}
    for source in now.setup.system.sources:
        used = [name for name in source_channels(source) if name in channels]
        if used and all(name in silent for name in used):
            sources[source.name] = max(silent.pop(name) for name in used)
    return sources | silent


def _lost(now: Statistics) -> float:
    """Share of the grid's points that were lost; not what interpolation between slow samples needs at the ends."""
    if now.method == "smoother" and now.smoother is not None:
        # Of its samples those are lost that have no torque.
        return now.smoother.lost / max(1, now.smoother.lost + now.samples)
    ends = 2.0 * SIDE * float(np.nanmax(now.periods, initial=0.0)) * now.setup.system.sample_rate
    lost = max(0.0, now.counters.lost_samples - ends)
    return lost / max(1.0, lost + now.samples)


def _slow(now: Statistics) -> dict[str, float]:
    """Sample rates, Hz, of position channels that are too slow for the momentum balance's windows."""
    if now.method == "smoother" or now.setup.system.balance == "energy":
        return {}
    sensing, window = now.setup.sensing, now.setup.system.windows.momentum
    periods = {sensing.channels[k]: float(now.periods[k]) for k in sensing.position_columns}
    return {name: 1.0 / period for name, period in periods.items() if is_slow(period, window)}


def _weaknesses(now: Statistics) -> list[Reason]:
    """What weakens an estimate by the way it is made."""
    out: list[Reason] = []
    by_smoother = now.method == "smoother"
    if now.smoother is not None and by_smoother:
        out += _inexact(now.smoother)
    tolerances = now.setup.system.tolerances.model_dump()
    if by_smoother and any(tolerances[name] != 0.0 for name in NOT_SMOOTHED):
        text = "the smoother's error bars do not include the tolerances of lengths, axes, gravity and drives"
        out.append(Reason(text, False, then=MEASURE_SLOPES))
    if now.momentum is None and not by_smoother:
        out.append(Reason("by the energy balance alone, nothing tests whether the model lacks something", False))
    if now.smoother is not None and not by_smoother and now.setup.sensing.missing:
        text = "links are taken to bend quasi-statically: estimates are off by several percent"
        out.append(Reason(text, False, then=DIAGNOSE))
    late = None if now.momentum is None else now.momentum.latency
    if late is not None:
        whose = late.source if late.size > 0.0 else f"all sources but {late.source}"
        out.append(Reason(f"{whose}: {1e3 * abs(late.size):.2g} ms later than stated", False))
    return out


def _inexact(smoother: SmootherStatistics) -> list[Reason]:
    """What the smoother had to allow for. Nothing that acts there is white: it shifts parameters by more than that."""
    if smoother.level > 0.0:
        return [Reason("samples do not agree with the equations of motion", True, then=STATE_HELD)]
    said = []
    if smoother.torque_noise > 1.0:
        said.append(f"what acts beside the torques is {smoother.torque_noise:.0f} × their noise")
    if smoother.beyond > 1.0:
        beyond = f"innovations are {smoother.beyond:.2g} × their noise"
        said.append(f"{beyond}: forces on the joints do not quite follow their laws")
    return [Reason(text, smoother.contradicted, then=STATE_HELD) for text in said]
