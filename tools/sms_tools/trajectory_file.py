"""A trajectory as people take it to a testbed: in the system file, and as a reference for its controller."""

from __future__ import annotations

import re
from collections.abc import Iterator

import numpy as np

from sms_adapters.system_file import system_text
from sms_online.description.schema import Trajectory
from sms_sim.references import fourier_reference

REFERENCE = "reference.csv"


def with_trajectory(described: str, trajectory: Trajectory) -> str:
    """TOML of the text of `described`, file or name of a system, with another trajectory."""
    lines = system_text(described).rstrip().splitlines()
    kept: list[str] = []
    inside, place = False, None
    for line in lines:
        if re.match(r"\s*\[", line):
            inside = bool(re.match(r"\s*\[\s*trajectory\s*\]", line))
            place = len(kept) if inside else place
        # Comments between this table and the next belong to the next.
        if not inside or re.match(r"\s*(#|$)", line):
            kept.append(line)
    table = ["[trajectory]", f"duration = {trajectory.duration!r}"]
    for i, series in enumerate(trajectory.joints, start=1):
        values = [(term.frequency, term.sine, term.cosine) for term in series]
        terms = [f"  {{ frequency = {w!r}, sine = {sine!r}, cosine = {cosine!r} }}," for w, sine, cosine in values]
        table += [f"joint_{i} = [", *terms, "]"]
    if place is None:
        place, table = len(kept), ["", *table]
    return "\n".join([*kept[:place], *table, *kept[place:]]) + "\n"


def reference_lines(trajectory: Trajectory, rate: float) -> Iterator[str]:
    """Lines of the reference as CSV at a rate, Hz.

    Columns: t, s; of each joint q_d, rad (m); of each its rate, rad/s (m/s).
    """
    joints = range(1, len(trajectory.joints) + 1)
    yield ",".join(["t", *(f"q_d_{i}" for i in joints), *(f"q_d_dot_{i}" for i in joints)])
    t = np.arange(round(trajectory.duration * rate) + 1) / rate
    for row in np.column_stack((t, *fourier_reference(trajectory)(t))).tolist():
        yield ",".join(map(repr, row))
