"""The demo on a host whose cores are busy with other work: false events and drifts, verdicts, errors, losses.

    python -m tests.campaigns.busy run RESULTS.jsonl --demos 20
    python -m tests.campaigns.busy summary RESULTS.jsonl

Each demo is a process of its own, and beside it `--beside` processes, one for each core by default, compute all the
time at the same priority. Nothing changes in the demo's arm, so every event or drift is false. True values are read
from results.json, where the verb has put them after the estimate. Recordings lie beside RESULTS, in a folder for each
demo whose result is bad; `sms-online replay FOLDER --system FOLDER/system.toml` repeats it.
"""

from __future__ import annotations

import argparse
import json
import shutil
import subprocess
import sys
from collections import Counter
from collections.abc import Iterator, Mapping
from contextlib import contextmanager
from pathlib import Path
from time import monotonic
from typing import Any

from sms_tools.archive.runner import cores
from sms_tools.option_values import whole
from tests.campaigns.results import Record, campaign, complete, summed

# An interval that misses the true value by more bars than this is wrong, not unlucky.
FAR = 5.0
# Computes until its parent ends, however that ends.
BUSY = "import os; parent = os.getppid()\nwhile os.getppid() == parent: pass"


@contextmanager
def busy(processes: int) -> Iterator[None]:
    """So many processes compute beside what is done meanwhile."""
    running = [subprocess.Popen([sys.executable, "-c", BUSY]) for _ in range(processes)]
    try:
        yield
    finally:
        for process in running:
            process.kill()
            process.wait()


def demo(out: Path, seed: int) -> Record:
    """One demo: what it says of itself, and by how many bars it errs; a good one leaves no files."""
    shutil.rmtree(out, ignore_errors=True)  # what a stopped campaign left
    command = [sys.executable, "-m", "sms_tools", "demo", "--rerun", "off", "--seed", str(seed), "--out", str(out)]
    began = monotonic()
    done = subprocess.run(command, check=False, capture_output=True, text=True)
    if not (out / "results.json").is_file():
        return {"code": done.returncode, "failed": done.stderr.strip().splitlines()[-1:]}
    results = json.loads((out / "results.json").read_text(encoding="utf-8"))
    verdict = results["verdict"]
    record = {
        "code": done.returncode,
        "level": verdict["level"],
        "sentence": verdict["sentence"],
        "events": [event["kind"] for event in results["events"]],
        "drifts": [drift["parameter"] for tracker in results["trackers"] for drift in tracker["drifts"]],
        "worst": worst(results),
        "lost": results["lost_samples"],
        "samples": results["samples"],
        "warnings": results["warnings"],
        "seconds": monotonic() - began,
    }
    if not bad(record):
        shutil.rmtree(out)
    return record


def worst(results: Mapping[str, Any]) -> float | None:
    """The largest error of a determined parameter over its bar; None where nothing is determined."""
    errors = [abs(p["estimate"] - p["true"]) / p["std"] for p in results["parameters"] if p["identifiable"]]
    return max(errors, default=None)


def bad(record: Mapping[str, Any]) -> list[str]:
    """What a demo must never do, a word for each."""
    if "failed" in record:
        return ["failed"]
    found = [f"event: {kind}" for kind in record["events"]] + [f"drift: {name}" for name in record["drifts"]]
    if record["level"] == "trust" and (record["worst"] is None or record["worst"] > FAR):
        found.append(f"trusted, {record['worst']} bars off")
    return found


def run(args: argparse.Namespace) -> None:
    """Append the demos that the results lack."""
    names = {"cores": cores(), "beside": args.beside}
    outs = {seed: args.results.with_suffix("") / str(seed) for seed in range(args.demos)}
    with busy(args.beside):
        complete(args, demo, [({"seed": seed, **names}, (out, seed)) for seed, out in outs.items()])


def summary(records: list[Record]) -> str:
    """A line for each demo, and the counts."""
    lines = []
    for record in records:
        found = bad(record)
        if "failed" in record:
            lines.append(f"BAD {record['seed']}: {record['failed']}")
            continue
        lines.append(
            f"{'BAD' if found else 'ok '} {record['seed']}: {record['sentence']}; "
            f"worst {record['worst'] or 0.0:.1f} bars; {record['lost']} of {record['samples']} samples lost"
            + (f"; {', '.join(found)}" if found else "")
        )
    ended = [record for record in records if "failed" not in record]
    levels = Counter(record["level"] for record in ended)
    lines.append(
        f"{len(records)} demos: {sum(len(record['events']) for record in ended)} false events, "
        f"{sum(len(record['drifts']) for record in ended)} false drifts; "
        f"{', '.join(f'{count} {level}' for level, count in sorted(levels.items()))}; "
        f"worst {max((record['worst'] or 0.0 for record in ended), default=0.0):.1f} bars, "
        f"{sum(any('trusted' in what for what in bad(record)) for record in records)} of them trusted beyond {FAR:g}; "
        f"{sum(bool(record['lost']) for record in ended)} with lost samples, "
        f"{sum(record['lost'] for record in ended)} in all"
    )
    return "\n".join(lines)


if __name__ == "__main__":
    campaign(
        __doc__,
        {"run": run, "summary": summed(summary)},
        alone=True,
        demos={"type": int, "default": 20},
        beside={"type": whole(0), "default": cores(), "help": "busy processes; 0 on a host that is busy already"},
    )
