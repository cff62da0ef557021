"""What happened to the samples and to the smoother in a session, in sentences for a person."""

from __future__ import annotations

from typing import TYPE_CHECKING

import numpy as np

from sms_online.physical import Projection
from sms_online.pipeline.statistics import Statistics

if TYPE_CHECKING:
    from sms_online.smoother.statistics import SmootherStatistics

# Effects of one cause that a warning names.
NAMED = 4


def smoother_warnings(now: Statistics) -> list[str]:
    """What the smoother replaced, and where it failed."""
    setup, smoother = now.setup, now.smoother
    if smoother is None:
        asked = setup.system.balance == "smoother"
        return ["no smoother: it cannot correct the declared effects on channels"] if asked else []
    out = [f"the smoother left out {failure}" for failure in smoother.failures]
    if smoother.noisier:
        names, most = [name for name, _ in smoother.noisier], max(times for _, times in smoother.noisier)
        more = f" and {len(names) - NAMED} more" if len(names) > NAMED else ""
        out.append(f"{', '.join(names[:NAMED])}{more}: up to {most:.2g} × their stated noise, which is what counts")
    missing = ", ".join(setup.sensing.missing)
    if now.method != "smoother":
        bent = "links are taken to bend quasi-statically: estimates are off by several percent"
        text = f"{missing} are not measured, so {bent}"
        return [*out, text] if missing else out
    if missing:
        out.append(f"not measured, but estimated by the equations of motion: {missing}")
    if allowed := _allowed(smoother):
        out.append(f"samples do not agree with the equations of motion: {allowed}")
    return out


def _allowed(smoother: SmootherStatistics) -> str:
    """What a smoother had to allow for where samples do not agree with the equations of motion; empty where they do."""
    if smoother.level > 0.0:
        return f"unknown forces of {100.0 * smoother.level:.2g} % of the usual ones are added"
    if smoother.torque_noise > 1.0:
        return f"noise of the torques is taken as {smoother.torque_noise:.0f} × what they show"
    if smoother.beyond > 1.0:
        return f"innovations are {smoother.beyond:.2g} × their noise"
    return ""


def projection_warning(projection: Projection | None) -> list[str]:
    """How far the estimate of a finished session is from physical consistency."""
    if projection is None:
        return ["physical consistency is not known: the search for consistent parameters did not converge"]
    if projection.distance == 0.0:
        return []
    distance, names = f"{projection.distance:.2g} standard deviations", ", ".join(projection.active)
    return [f"the estimate violates physical consistency, because of {names}, by {distance}"]


def notices(now: Statistics) -> list[str]:
    """What happened to the samples, a sentence each."""
    system, out = now.setup.system, []
    if now.dropped_rows:
        out.append(f"{now.dropped_rows} rows of the balance dropped: a value in them is infinite or not a number")
    period = 1.0 / system.sample_rate
    fastest = float(np.nanmin(now.periods, initial=np.inf))
    if np.isfinite(fastest) and not 0.8 < fastest / period < 1.25:
        rate = f"{1.0 / fastest:.4g}"
        said = f"the capture has {rate} samples/s, the system file says {system.sample_rate:g}"
        out.append(f"{said}: state sample_rate = {rate}, for interpolated samples add no information and take time")
    late = [name for sensor in system.sensors if sensor.delay(system.sample_rate) for name in sensor.channels]
    if late and now.method == "smoother":
        out.append(f"latency of {', '.join(late)} is described but not corrected by the smoother")
    if now.counters.gaps:
        out.append(f"{now.counters.gaps} gaps too long to bridge; each begins a new window of the balance")
    if now.counters.duplicates:
        out.append(f"{now.counters.duplicates} samples dropped: their channel had one at that instant already")
    if now.counters.interpolated_cells:
        out.append(f"{now.counters.interpolated_cells} cells interpolated")
    coloured = {} if now.momentum is None else now.momentum.coloured
    out += [f"{channel}: noise is correlated over {1e3 * time:.2g} ms" for channel, time in coloured.items()]
    out += [f"{channel}: {left.number} outliers left out" for channel, left in now.outliers.items()]
    out += [
        f"{s.first} and {s.second} swapped from {s.begin:.3f} to {s.end:.3f} s: {s.samples} samples relabelled"
        for s in now.swaps
    ]
    out += unstated_latency(now)
    for shift in () if now.momentum is None else now.momentum.shifts:
        size = f"{1e6 * shift.size:+.0f} ± {1e6 * shift.std:.0f} µs"
        out.append(f"{shift.device}: its clock shifted by {size} against the others' at {shift.time:.1f} s")
    if system.scale_tolerance is not None and (system.known or system.priors):
        out.append("what is known does not fix the scale: it acts as parameters do that are unknown")
    if now.setup.unused:
        out.append(f"unused channels: {', '.join(now.setup.unused)}")
    return out


def unstated_latency(now: Statistics) -> list[str]:
    """A notice where a source is later against the others than the system file states."""
    found = None if now.momentum is None else now.momentum.latency
    if found is None:
        return []
    late = f"{1e3 * abs(found.size):.3g} ± {1e3 * found.std:.2g} ms"
    if found.size < 0.0:
        return [f"all sources but {found.source}: {late} later than their stated latencies"]
    more = [f"{len(found.effects) - NAMED} more"] if len(found.effects) > NAMED else []
    effects = ", ".join([*found.effects[:NAMED], *more])
    return [f"{found.source}: {late} later than its stated latency ({effects})"]
