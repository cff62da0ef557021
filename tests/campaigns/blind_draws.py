"""Effects for blind cases: place, size and shape constants drawn by a seed, and sessions that have them."""

from __future__ import annotations

import zlib
from functools import cache
from pathlib import Path

import numpy as np

from sms_adapters.system_file import load_system
from sms_online.description.channels import has_motor_side
from sms_online.description.schema import Effect, System
from sms_online.diagnosis.candidates import CandidateColumns
from sms_online.diagnosis.record import SampleRecord
from sms_online.diagnosis.rows import SessionRows
from sms_online.effects.catalogue import ENTRIES, candidates
from sms_online.effects.delay import delay_of
from sms_online.pipeline.estimator import Estimator
from sms_online.stream import Array, Block
from tests.campaigns.sessions import exact_session, noisy_session, true_parameters

SYSTEM = "paper-planar"
GRADE = "B"
# Worth of an effect, share of the rms of the rows it acts on.
WORTH = (0.02, 0.2)
# Share of what the catalogue takes for possible that a coefficient is drawn up to.
LARGEST = 0.9
# Noise of grade B is 1e-4 m and rad: motions are simulated to a ten-thousandth of it.
TOLERANCE = 1e-8
# Exact samples of the arm without an effect.
CLEAN = "clean.npz"


class Draw:
    """Draws effects for the planar example from its own clean motion."""

    def __init__(self, system: System, cache: Path) -> None:
        self.system = system
        self.cache = cache
        block = noisy_session(system, exact_session(system, cache / CLEAN), GRADE, 0)
        estimator = Estimator(system, block.channels, "clean")
        record = SampleRecord(system.sample_rate)
        estimator.observers.append(record)
        estimator.push(block)
        estimator.finish()
        assert estimator.momentum is not None
        assert estimator.momentum.sensor_noise is not None
        beta = true_parameters(system)
        parts = (estimator.model, estimator.base, estimator.sensing, estimator.momentum.sensor_noise)
        self.rows = SessionRows(*parts, record.segments(), beta)
        self.make = CandidateColumns(self.rows, system)
        # Size of each speed's rows: of the torque where there is one, else of all its terms together.
        torque = np.sqrt(np.mean(self.rows.b**2, axis=0))
        terms = np.sqrt(np.mean(np.sum((self.rows.Y * beta) ** 2, axis=2), axis=0))
        self._size = np.where(torque > 0.0, torque, terms)
        peaks = np.abs(self.rows.b).max(axis=0)
        self._peak = np.where(peaks > 0.0, peaks, np.abs(self.rows.Y * beta).sum(axis=2).max(axis=0))

    def effect(self, name: str, seed: int) -> Effect:
        """An effect of a name at a place and of a size that the seed chooses, coefficients as `simulate` takes them."""
        rng = np.random.default_rng([seed, zlib.crc32(name.encode())])
        places = [effect for effect in candidates(self.system) if effect.name == name]
        drawn = places[rng.integers(len(places))]
        if ENTRIES[name].kind == "kinematics":
            return drawn
        wanted = float(np.exp(rng.uniform(*np.log(WORTH))))
        shapes = {}
        for shape, constant in ENTRIES[name].shapes.items():
            grid = constant.grid(self.make.ranges(drawn.where))
            if shape in drawn.coefficients and name != "sensor_lag":
                counted = shape == "order" or min(grid) <= 0.0
                between = np.log([grid[0], grid[-1]]) if not counted else (0.0, 0.0)
                shapes[shape] = float(rng.choice(grid) if counted else np.exp(rng.uniform(*between)))
        plain = drawn.model_copy(update={"coefficients": {} if ENTRIES[name].kind == "channel" else shapes})
        candidate = self.make.of(plain)
        direction = rng.uniform(0.5, 1.0, candidate.columns.shape[2])
        if candidate.columns.shape[2] > 1 and name != "direction_friction":
            direction = rng.standard_normal(candidate.columns.shape[2])
        added = candidate.columns @ direction
        # By the rms, and by the peaks: an effect of a few moments must not hold the arm.
        shares = np.sqrt(np.mean(added**2, axis=0)) / self._size, np.abs(added).max(axis=0) / self._peak
        worth = float(np.max(shares))
        stated = self._stated(name, drawn.where, direction * wanted / worth, shapes)
        # What the catalogue takes for impossible is named nowhere.
        most = {key: LARGEST * limit for key, (_, limit) in ENTRIES[name].traits.limits.items()}
        stated = {key: min(value, most.get(key, np.inf)) for key, value in stated.items()}
        # So that the last digits of the estimator do not draw other cases.
        return plain.model_copy(update={"coefficients": {key: float(f"{value:.6g}") for key, value in stated.items()}})

    def session(self, effects: tuple[Effect, ...], seed: int) -> Block:
        """Samples of a session with these effects, with noise of the seed."""
        system = self.system.model_copy(update={"effects": effects})
        name = "+".join(effect.name for effect in effects)
        return noisy_session(system, exact_session(system, self.cache / f"{name}-{seed}.npz", TOLERANCE), GRADE, seed)

    def _stated(self, name: str, where: str, linear: Array, shapes: dict[str, float]) -> dict[str, float]:
        """The coefficients that give these linear ones."""
        number = where.removeprefix("joint_")
        joint = self.system.joints[int(number) - 1] if number.isdigit() else None
        link = self.system.links[int(where.removeprefix("link_")) - 1] if where in ("link_1", "link_2") else None
        value = float(linear[0])
        size, phase = float(np.hypot(*linear[:2])) if linear.size > 1 else 0.0, 0.0
        if linear.size > 1:
            phase = float(np.arctan2(linear[1], linear[0]))
        match name:
            case "kinematic_error":
                assert joint is not None
                return {"amplitude": size / joint.stiffness, "phase": phase, **shapes}
            case "cogging" | "torque_ripple" | "encoder_eccentricity":
                return {"amplitude": size, "phase": phase, **shapes}
            case "load_friction":
                assert joint is not None
                return {"ratio": value / joint.stiffness if has_motor_side(joint) else value}
            case "link_damping":
                return {"time": value / link.flexural_rigidity_z}  # type: ignore[union-attr]
            case "link_mass_damping":
                return {"rate": value / link.mass_per_length}  # type: ignore[union-attr]
            case "backlash":
                # The gap is what is drawn: the stiffness inside is the joint's own.
                assert joint is not None
                return {"gap": shapes["gap"] * min(1.0, value / joint.stiffness)}
            case "slosh":
                return {"stiffness": value, "mass": value / shapes["frequency"] ** 2}
            case "sensor_lag":
                return {"corner": delay_of(value)}
        names = [n for n in ENTRIES[name].coefficients if n not in shapes]
        return dict(zip(names, linear.tolist(), strict=False)) | shapes


@cache
def drawn(folder: Path) -> Draw:
    """What draws effects, once a process."""
    return Draw(load_system(SYSTEM), folder)
