"""excite: the trajectory from which a system's parameters are best estimated, for its file and its controller."""

from __future__ import annotations

import argparse

from sms_adapters.files import write_text
from sms_adapters.session_log import SYSTEM
from sms_sim.excitation import Excitation, excite
from sms_sim.motion_limits import Limits
from sms_tools.exit_codes import OK
from sms_tools.report import say, table
from sms_tools.results_file import results_directory, write_document
from sms_tools.session import described_system
from sms_tools.trajectory_file import REFERENCE, reference_lines, with_trajectory
from sms_tools.waiting import waiting

DOCUMENT = "excitation.json"
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
