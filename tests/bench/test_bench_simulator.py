"""How long the simulator takes: the planar example on one core, at what loss of energy.

Timed by the processor's clock, which other programs on the machine disturb least.
"""

from __future__ import annotations

from time import process_time
from typing import Any

import pytest

from sms_online.description.parse import parse_system, shipped_text
from sms_sim.plant import Plant
from sms_sim.realtime import STEP, RealTimeStepper
from sms_sim.simulate import simulate

PAPER = parse_system(shipped_text("paper-planar"), "paper-planar")


@pytest.mark.benchmark(timer=process_time)
def test_ten_seconds_of_the_planar_example(benchmark: Any) -> None:
    simulation = benchmark.pedantic(simulate, args=(PAPER, 10.0), rounds=2, iterations=1)
    assert simulation.drift.energy < 1e-8
    assert benchmark.stats.stats.max < 40.0  # s


@pytest.mark.benchmark(timer=process_time)
def test_a_second_of_real_time_steps(benchmark: Any) -> None:
    steps = round(1.0 / STEP)

    def stepper() -> tuple[tuple[RealTimeStepper], dict[str, Any]]:
        return (RealTimeStepper(Plant(PAPER)),), {}

    def run(stepper: RealTimeStepper) -> None:
        for _ in range(steps):
            stepper.step()

    benchmark.pedantic(run, setup=stepper, rounds=5)
    assert benchmark.stats.stats.mean < 1.0  # s
