"""The paper's example again: Figure 6 and Table V, the printed values beside ours.

python -m sms_tools.html_report.paper_example FILE.html
"""

from __future__ import annotations

import argparse
from collections.abc import Sequence
from pathlib import Path

import numpy as np

from sms_adapters.system_file import load_system
from sms_online.session import Session
from sms_sim.simulate import Simulation, exact_states, sampled_blocks, simulate
from sms_tools.html_report.figures import Chart, Series, chart
from sms_tools.html_report.pages import write_page

# Table V says EI_2 = 1768.8 N m², Table III 597.87; the figure's size of motion does not separate them.
SYSTEM = "paper-planar-table-v"
DURATION = 10.0  # s, section VI
# Points of a curve: enough for a smooth line.
POINTS = 1001
# Table V as printed, in its order: actual value, estimated value, relative error in %.
TABLE_V = (
    ("865.01", "865.02", "-0.0014"),
    ("400", "400.01", "-0.0016"),
    ("400", "400.01", "-0.0016"),
    ("403", "403.01", "-0.0017"),
    ("0.0075", "0.0075", "-0.0001"),
    ("0.0075", "0.0075", "0.0004"),
    ("0.0075", "0.0075", "0.11"),
    ("3", "3.00", "0.0050"),
    ("31.42", "31.42", "-0.0004"),
    ("31.42", "31.42", "0.0002"),
    ("1768.8", "1768.80", "0.0000"),
    ("1768.8", "1768.80", "-0.0016"),
    ("1000", "1000.00", "0.0000"),
    ("1000", "1000.00", "0.0004"),
    ("75.85", "75.85", "0.0002"),
    ("75.85", "75.85", "-0.0008"),
)


def main(arguments: Sequence[str] | None = None) -> None:
    """Simulate the example without noise, identify it, and write the page."""
    parser = argparse.ArgumentParser(description="Figure 6 and Table V of the paper beside ours, as a page.")
    parser.add_argument("file", metavar="FILE.html", type=Path, help="the page to write")
    file: Path = parser.parse_args(arguments).file
    simulation = simulate(load_system(SYSTEM), DURATION)
    samples, rows = table_v(simulation)
    write_page(
        file,
        "paper_example.html",
        title="The paper's example",
        figures=figure_6(simulation),
        rows=rows,
        samples=samples,
        duration=simulation.duration,
        rate=simulation.plant.system.sample_rate,
    )


def figure_6(simulation: Simulation) -> list[Chart]:
    """Joint angles, rates and motor torques over time, as in Figure 6."""
    t = np.linspace(0.0, simulation.duration, POINTS)
    exact = exact_states(simulation, t)
    system, layout = simulation.plant.system, simulation.plant.model.layout
    angles, rates, torques = [], [], []
    for i, (q, theta_m) in enumerate(zip(layout.q, layout.theta_m, strict=True)):
        number = "₁₂"[i]
        angles.append(Series(f"q{number}", t, exact.x[:, q + layout.offset]))
        angles.append(Series(f"θ_m{number}", t, exact.x[:, theta_m + layout.offset]))
        rates += [Series(f"q̇{number}", t, exact.v[:, q]), Series(f"θ̇_m{number}", t, exact.v[:, theta_m])]
        torques.append(Series(f"τ{number}", t, exact.torque[:, i] / system.joints[i].gear_ratio))
    return [
        chart("(a) joint angles q and θ_m, rad", angles, "time, s"),
        chart("(b) rates of q and θ_m, rad/s", rates, "time, s"),
        chart("(c) motor torques τ before the gear, N m", torques, "time, s"),
    ]


def table_v(simulation: Simulation) -> tuple[int, list[list[str]]]:
    """Number of samples, and the rows of Table V, printed and ours.

    A row: symbol, unit, then actual value, estimated value and error in %, first as printed.
    """
    system = simulation.plant.system
    blocks = list(sampled_blocks(simulation, "0"))
    session = Session(system, blocks[0].channels)
    for block in blocks:
        session.update(block)
    session.finish()
    result = session.evaluate(truth={"parameters": system.nominal})
    rows = []
    for p, printed in zip(result.parameters.values(), TABLE_V, strict=True):
        assert p.true is not None
        error = 100.0 * (p.value / p.true - 1.0)
        rows.append([p.symbol, p.unit, *printed, f"{p.true:.6g}", f"{p.value:.6g}", f"{error:+.2g}"])
    return result.samples, rows


if __name__ == "__main__":
    main()
