"""bound: the least standard deviation that any unbiased estimator can reach with a motion and a set of sensors."""

from __future__ import annotations

import argparse
import math

from sms_online.recorded import Recorded
from sms_sim.bound import bound
from sms_tools.exit_codes import NOTHING_DETERMINED, OK
from sms_tools.report import say, table
from sms_tools.session import described_system
from sms_tools.waiting import waiting, watched


def run(args: argparse.Namespace) -> int:
    """Print the bound of every parameter; 0, 3 where the motion determines none."""
    system, folder = described_system(args)
    if args.capture is None:
        with waiting() as progress:
            bounds = bound(system, grade=args.grade, each_sensor=args.each_sensor, progress=progress)
    else:
        with watched(args.capture, system, folder) as reading:
            recorded = Recorded(reading, str(args.capture))
            bounds = bound(system, recorded, grade=args.grade, each_sensor=args.each_sensor)
    noise = f"noise: grade {bounds.grade}, for {args.system} does not state that of every sensor"
    shown = table(*bounds.rows(), left=("parameter", "unit"))
    say(args, *([noise] if bounds.grade != args.grade else []), shown, document=bounds.to_json())
    determined = any(math.isfinite(parameter.std) for parameter in bounds.parameters.values())
    return OK if determined else NOTHING_DETERMINED
