"""simulate: a described system in closed loop, as a capture with its truth beside it."""

from __future__ import annotations

import argparse
from pathlib import Path

from sms_adapters.mcap_capture import capture_writer
from sms_adapters.truth import truth_path, write_truth
from sms_online.effects.build import build_model
from sms_sim.capture import Simulated
from sms_tools.exit_codes import OK
from sms_tools.report import say
from sms_tools.session import described_system
from sms_tools.waiting import waiting


def run(args: argparse.Namespace) -> int:
    """Simulate a session and write FILE.csv and FILE.csv.truth.json."""
    described, _ = described_system(args)
    session = Simulated.of(described, args.effect, args.duration, args.grade, args.seed, args.drift, args.fault)
    capture: Path = args.capture
    # The writer comes first: a name that cannot be written is known before a long simulation.
    with capture_writer(capture, session.channels) as writer:
        with waiting() as progress:
            simulation = session.solve(progress)
        samples = 0
        for block in session.blocks(simulation):
            writer.write(block)
            samples += block.t.size
    drift = simulation.drift
    truth = session.truth(simulation)
    write_truth(capture, truth.pop("parameters"), truth)
    document = {
        "schema": "sms-online/simulation/1",
        "capture": str(capture),
        "truth": str(truth_path(capture)),
        "samples": samples,
        "duration_s": simulation.duration,
        "drift": {
            "energy": drift.energy,
            "linear_momentum": drift.linear_momentum,
            "angular_momentum": drift.angular_momentum,
        },
    }
    lines = [f"capture: {capture}, {samples} samples in {simulation.duration:g} s", f"truth: {truth_path(capture)}"]
    lines.append(f"energy drift: {drift.energy:.1e} of the largest energy")
    for what, value in (("linear", drift.linear_momentum), ("angular", drift.angular_momentum)):
        conserved = "not conserved here (fixed base, gravity, or effects on the base)"
        text = conserved if value is None else f"{value:.1e} of what base and arm exchange"
        lines.append(f"{what} momentum drift: {text}")
    nominal = described.nominal
    # As in what a running session writes: the values of its effects are for the estimator to find.
    effects = build_model(described).effects
    idle = [e for e in effects if e.parameters and not any(nominal[p.name] for p in e.parameters)]
    lines += [f"warning: {e.key} has no effect: {args.system} states no coefficient of it" for e in idle]
    lines += [f"warning: {said}" for said in simulation.beyond]
    if described.trajectory is None:
        lines.append(f"warning: no motor moves: {args.system} has no [trajectory]; `sms-online excite` designs one")
    say(args, *lines, document=document)
    return OK
