"""Sessions of an arm that cameras see as points: coverage, errors and error bars against the bound.

python -m tests.campaigns.points RESULTS.jsonl --seeds 50 [--system NAME] [--faults]
"""

from __future__ import annotations

import argparse
import json
from pathlib import Path

import numpy as np

from sms_adapters.system_file import load_system
from sms_online.evaluation import NORMAL_95
from sms_sim.camera_faults import CameraFaults, parsed_faults
from sms_sim.plant import Plant
from sms_sim.simulate import Simulation, sampled_blocks
from tests.camera_rig import FAULTS, bound_of, seen_by_cameras
from tests.sessions_of import normalised, session_of
from tests.simulations import simulated


def run(results: Path, name: str, seeds: range, faulty: bool) -> None:
    """One line a session: z of each parameter, and its standard deviation as a multiple of the bound."""
    system = seen_by_cameras(name)
    # Cameras play no part in the motion.
    simulation = Simulation(Plant(system), simulated(load_system(name)).solution)
    bound = bound_of(simulation)
    for seed in seeds:
        blocks = list(sampled_blocks(simulation, None, seed))
        faults = CameraFaults(parsed_faults(FAULTS if faulty else ()), blocks[0].channels, seed)
        estimator = session_of(system, [faults(block) for block in blocks])
        record = {
            "seed": seed,
            "method": estimator.method,
            "z": normalised(estimator).tolist(),
            "std": (estimator.estimate().std / bound).tolist(),
            "swaps": len(estimator.swaps),
        }
        with results.open("a", encoding="utf-8") as file:
            file.write(json.dumps(record) + "\n")


def show(results: Path) -> None:
    """Coverage of 95 % intervals, rms of z, and of errors over the bound, the worst parameter's too."""
    records = [json.loads(line) for line in results.read_text(encoding="utf-8").splitlines()]
    z, std = (np.array([record[name] for record in records]) for name in ("z", "std"))
    rms = np.sqrt(np.mean((z * std) ** 2, axis=0))
    print(f"{len(records)} sessions, {sum(record['method'] == 'smoother' for record in records)} by the smoother")
    print(f"coverage {np.mean(np.abs(z) < NORMAL_95):.3f}, rms z {np.sqrt(np.mean(z**2)):.2f}")
    print(f"errors over the bound: rms {np.sqrt(np.mean(rms**2)):.2f}, of the worst parameter {rms.max():.2f}")
    print(f"error bars over the bound: {std.min():.2f} to {std.max():.2f}")


def main() -> None:
    """Run what is asked for, and show what there is."""
    assert __doc__ is not None
    parser = argparse.ArgumentParser(prog="python -m tests.campaigns.points", description=__doc__.splitlines()[0])
    parser.add_argument("results", type=Path)
    parser.add_argument("--seeds", type=int, default=50)
    parser.add_argument("--first", type=int, default=0, help="number of the first seed")
    parser.add_argument("--system", default="paper-planar", help="a shipped system")
    parser.add_argument("--faults", action="store_true", help="markers missing, hidden and swapped")
    args = parser.parse_args()
    run(args.results, args.system, range(args.first, args.first + args.seeds), args.faults)
    show(args.results)


if __name__ == "__main__":
    main()
