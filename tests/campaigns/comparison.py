"""This program beside others on the same noisy sessions of the planar example, as a Markdown table.

    python -m tests.campaigns.comparison --seeds 3

Every method gets the same samples of positions and torques. Those that fit energy rows get the rows of this program,
with their columns scaled by all of them beforehand, which favours them.
"""

from __future__ import annotations

import argparse
from collections.abc import Callable
from pathlib import Path
from tempfile import gettempdir
from time import process_time

import numpy as np
import padasip
from filterpy.kalman import KalmanFilter

from sms_adapters.system_file import load_system
from sms_online.description.schema import System
from sms_online.effects.build import build_model
from sms_online.model.base_parameters import find_base_parameters
from sms_online.pipeline.estimator import Estimator
from sms_online.pipeline.sensing import Sensing
from sms_online.pipeline.smoothing import smooth
from sms_online.stream import Array, Block
from sms_sim.sensors import GRADES
from tests.batch_solution import batch_least_squares
from tests.campaigns.output_error import OutputError
from tests.campaigns.sessions import disguised, exact_session, noisy_session, true_parameters
from tests.exactly_known import exactly_known
from tests.keeping_tracker import KeepingTracker
from tests.sessions_of import session_of

SYSTEM, GRADE = "paper-planar", "B"
# As many measurements as the paper takes.
PAPER_ROWS = 100
# Variance of the unknowns before the first row, for columns and b of unit length: none is known.
DIFFUSE = 1e12
# The output-error fit costs seconds for every second of data.
SHORT = 4.0  # s
# Its parameters start so far from the truth: springs, dampers and rigidities above, masses and inertias below, so that
# the bodies are ones that can be.
START_ERROR = 0.1
ABOVE = ("stiffness", "damping", "rigidity")
# Half width of the filter that gives its first initial states, samples.
HALF_WIDTH = 40


def momentum(system: System, block: Block) -> Array:
    """This program as it comes."""
    return _session(system, block).estimate().pi


def _session(system: System, block: Block) -> Estimator:
    return session_of(system, [block])


def paper(system: System, block: Block) -> Array:
    """(42)-(45) with central differences, the trapezoidal rule at sensor rate, and 100 measurements."""
    model = build_model(system)
    sensing = Sensing(model, block.channels, "comparison")
    values = block.values[:, [block.channels.index(name) for name in sensing.channels]]
    x, torque = sensing.coordinates(values), sensing.joint_torque(values)
    step = 1.0 / system.sample_rate
    v = model.layout.speeds(x, np.gradient(x, step, axis=0))
    work = np.einsum("bj,bj->b", torque, v[:, list(model.layout.theta_m)])
    power = np.column_stack((model.power_columns(x, v), work))
    integral = np.concatenate((np.zeros((1, power.shape[1])), np.cumsum(0.5 * step * (power[1:] + power[:-1]), axis=0)))
    chosen = np.linspace(0, len(x) - 1, PAPER_ROWS + 1).round().astype(int)
    energy = model.energy_columns(x[chosen], v[chosen])
    Y = energy[1:] - energy[0] + integral[chosen[1:], :-1]
    return batch_least_squares(find_base_parameters(model).columns(Y), integral[chosen[1:], -1]).pi


def _energy_rows(system: System, block: Block) -> tuple[Array, Array]:
    estimator = Estimator(system.model_copy(update={"balance": "energy"}), block.channels, "comparison")
    recorder = estimator.energy.tracker = KeepingTracker(estimator.base.n)
    estimator.push(block)
    estimator.finish()
    return np.concatenate([rows.Y for rows in recorder.kept]), np.concatenate([rows.b for rows in recorder.kept])


def energy(system: System, block: Block) -> Array:
    """Energy rows of this program, all at once by (45)."""
    return batch_least_squares(*_energy_rows(system, block)).pi


def _scaled(Y: Array, b: Array) -> tuple[Array, Array, Array]:
    """Columns and b of unit root mean square, and what turns their solution into β."""
    columns, size = np.sqrt(np.mean(Y**2, axis=0)), float(np.sqrt(np.mean(b**2)))
    return Y / columns, b / size, size / columns


def kalman(system: System, block: Block) -> Array:
    """filterpy's Kalman filter of constant parameters on energy rows, given the variance that batch leaves."""
    Y, b, unit = _scaled(*_energy_rows(system, block))
    batch = batch_least_squares(Y, b)
    tracker = KalmanFilter(dim_x=Y.shape[1], dim_z=1)
    tracker.P *= DIFFUSE
    tracker.Q[:] = 0.0
    for y, z in zip(Y, b, strict=True):
        tracker.predict()
        tracker.update(z, R=batch.rss / batch.dof, H=y[None])
    return np.asarray(tracker.x[:, 0] * unit)


def rls(system: System, block: Block) -> Array:
    """padasip's recursive least squares on energy rows, without forgetting."""
    Y, b, unit = _scaled(*_energy_rows(system, block))
    tracker = padasip.filters.FilterRLS(n=Y.shape[1], mu=1.0, eps=1.0 / DIFFUSE, w="zeros")
    for y, z in zip(Y, b, strict=True):
        tracker.adapt(z, y)
    return np.asarray(tracker.w * unit)


def output_error(system: System, block: Block) -> Array:
    """SciPy's least squares on simulated output, given the sensors' noise, parameters to 10 %, also as a prior."""
    block = _first(block, SHORT)
    model = build_model(system)
    base = find_base_parameters(model)
    sensing = Sensing(model, block.channels, "comparison")
    values = block.values[:, [block.channels.index(name) for name in sensing.channels]]
    x, grade = sensing.coordinates(values), GRADES[GRADE]
    problem = OutputError(model, base, x, sensing.joint_torque(values), np.full(x.shape[1], grade.marker))
    truth = true_parameters(load_system(SYSTEM))
    start = truth * [1.0 + START_ERROR * (1 if p.name.endswith(ABOVE) else -1) for p in base.parameters]
    later = problem.samples * np.arange(1, problem.segments)
    values_there, rates = smooth(x, later, HALF_WIDTH, system.sample_rate)
    # The arm starts at rest.
    x_0, v_0 = np.concatenate((x[:1], values_there)), np.concatenate((np.zeros((1, x.shape[1])), rates))
    return problem.fit(problem.first_guess(start, x_0, v_0))


def momentum_short(system: System, block: Block) -> Array:
    """This program on what the output-error fit gets."""
    return momentum(system, _first(block, SHORT))


def _first(block: Block, seconds: float) -> Block:
    kept = block.t <= seconds
    return Block(block.t[kept], block.channels, block.values[kept])


METHODS: dict[str, Callable[[System, Block], Array]] = {
    "the paper's batch fit, 100 energy rows (45)": paper,
    "energy rows of this program, batch (45)": energy,
    "the same rows, filterpy `KalmanFilter`": kalman,
    "the same rows, padasip `FilterRLS`": rls,
    f"SciPy output-error fit, first {SHORT:g} s": output_error,
    f"**this program**, first {SHORT:g} s": momentum_short,
    "**this program**": momentum,
}


def table(seeds: int, cache: Path) -> str:
    """Markdown: errors over all parameters and sessions, and processor time of a session."""
    true_system = exactly_known(load_system(SYSTEM))
    truth, exact = true_parameters(true_system), exact_session(true_system, cache)
    names = [p.name for p in find_base_parameters(build_model(true_system)).parameters]
    blocks = [noisy_session(true_system, exact, GRADE, seed) for seed in range(seeds)]
    lines = [
        f"| grade {GRADE}, {exact.t[-1]:g} s, {seeds} sessions | median error % | worst error % | of | time s |",
        "|---|---|---|---|---|",
    ]
    for title, method in METHODS.items():
        errors, times = np.empty((seeds, truth.size)), []
        for seed, block in enumerate(blocks):
            start = process_time()
            errors[seed] = 100.0 * np.abs(method(disguised(true_system), block) / truth - 1.0)
            times.append(process_time() - start)
        worst = int(errors.max(axis=0).argmax())
        lines.append(
            f"| {title} | {np.median(errors):.2g} | {errors.max():.2g} | {names[worst]} | {np.median(times):.1f} |"
        )
    return "\n".join(lines)


def main() -> None:
    """Parse the command line and print the table."""
    parser = argparse.ArgumentParser(prog="python -m tests.campaigns.comparison", description="See the module.")
    parser.add_argument("--seeds", type=int, default=3, help="sessions, 3 by default")
    default = Path(gettempdir()) / f"{SYSTEM}.exact.npz"
    parser.add_argument("--exact", metavar="FILE.npz", type=Path, default=default, help="cache of the exact samples")
    args = parser.parse_args()
    print(table(args.seeds, args.exact))


if __name__ == "__main__":
    main()
