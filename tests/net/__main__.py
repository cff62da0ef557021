"""Records the net's numbers, or compares those of now with the recorded ones.

python -m tests.net record
python -m tests.net compare [--tolerance 1e-10] [SESSION …]
"""

from __future__ import annotations

import argparse
import sys
from time import process_time

from tests.net.numbers import differences, environment, numbers
from tests.net.recorded import Recorded
from tests.net.sessions import SESSIONS


def main() -> int:
    """0 where nothing differs, 1 where something does."""
    assert __doc__ is not None
    parser = argparse.ArgumentParser(prog="python -m tests.net", description=__doc__.splitlines()[0])
    parser.add_argument("verb", choices=("record", "compare"))
    parser.add_argument("session", nargs="*", help="all by default")
    parser.add_argument("--tolerance", type=float, default=0.0, help="relative; 0 by default: not a bit may differ")
    args = parser.parse_args()
    names = args.session or list(SESSIONS)
    recorded = Recorded.read()
    if args.verb == "compare" and recorded.environment != environment():
        print(f"recorded elsewhere: {recorded.environment}; here: {environment()}")
    differing = 0
    for name in names:
        begun = process_time()
        session = SESSIONS[name]()
        made = process_time()
        found = numbers(session)
        took = f"made in {made - begun:.1f} s of processor time, run in {process_time() - made:.1f} s"
        if args.verb == "record":
            recorded = Recorded(environment(), recorded.sessions | {name: found})
            recorded.write()
            print(f"{name}: {len(found)} recorded, {took}", flush=True)
            continue
        lines = sorted(differences(recorded.sessions[name], found, args.tolerance))
        differing += bool(lines)
        print(f"{name}: {len(lines)} of {len(found)} differ, {took}", flush=True)
        print("".join(f"  {line}\n" for line in lines), end="", flush=True)
    return 1 if differing else 0


if __name__ == "__main__":
    sys.exit(main())
