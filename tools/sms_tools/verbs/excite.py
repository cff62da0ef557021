"""excite: the trajectory from which a system's parameters are best estimated, for its file and its controller."""

from __future__ import annotations

import argparse
import re
from collections.abc import Iterator

import numpy as np

from sms_adapters.files import write_text
from sms_adapters.session_log import SYSTEM
from sms_adapters.system_file import system_text
from sms_online.description.schema import Trajectory
from sms_sim.excitation import Excitation, excite
from sms_sim.motion_limits import Limits
from sms_sim.references import fourier_reference
from sms_tools.exit_codes import OK
from sms_tools.report import say, table
from sms_tools.results_file import results_directory, write_document
from sms_tools.session import described_system
from sms_tools.waiting import waiting

DOCUMENT, REFERENCE = "excitation.json", "reference.csv"
# Of what the motion may reach, so much counts as reached.
CLOSE = 0.98


def run(args: argparse.Namespace) -> int:
    """Design the motion; write system file, reference and document, and say what each parameter gains."""
    system, _ = described_system(args)
    directory = results_directory(args.out)
    limits = Limits(args.angle, args.rate, args.torque, args.base_rotation, args.deflection)
    with waiting() as progress:
        found = excite(
            system,
            limits=limits,
            duration=args.duration,
            separate=args.separate or (),
            grade=args.grade,
            seed=args.seed,
            iterations=args.iterations,
            progress=progress,
        )
    trajectory = found.system.trajectory
    assert trajectory is not None
    file = write_text(directory / SYSTEM, with_trajectory(args.system, trajectory))
    reference = write_document(directory / REFERENCE, "\n".join(reference_lines(trajectory, system.sample_rate)))
    document = write_document(directory / DOCUMENT, found.to_json())
    notes = []
    if found.after.grade != args.grade:
        notes.append(f"noise: grade {found.after.grade}, for {args.system} does not state that of every sensor")
    if trajectory == system.trajectory:
        notes.append("no better motion was found: the described one is kept; try more --iterations or another --seed")
    files = [f"system file with the motion: {file}", f"reference: {reference}", f"document: {document}"]
    shown = table(*found.rows(), left=("parameter", "unit"))
    say(args, *notes, shown, "", _reached(found), "", *files, document=found.to_json())
    return OK


def _reached(found: Excitation) -> str:
    """Which limits hold the motion back."""
    close = [each.name for each in found.reached if each.limit is not None and each.largest > CLOSE * each.limit]
    return f"at its limit: {', '.join(close)}" if close else "no limit is reached"


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
