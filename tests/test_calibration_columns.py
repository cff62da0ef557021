"""Columns of calibration are what rows change by when samples or geometry are off by a little."""

from __future__ import annotations

from collections.abc import Callable

import numpy as np
import pytest

from sms_adapters.system_file import load_system
from sms_online.calibration.channels import Families, Motion
from sms_online.calibration.columns import CalibrationColumns, nuisances
from sms_online.calibration.geometry import Geometry, geometries
from sms_online.description.schema import System, Tolerances
from sms_online.effects.build import build_model
from sms_online.model.base_parameters import find_base_parameters
from sms_online.model.model import Model
from sms_online.pipeline.momentum_balance import MomentumBalance
from sms_online.pipeline.momentum_windows import COPIES, INSTANTS, Instants, Window
from sms_online.pipeline.sensing import Sensing
from sms_online.pipeline.sensitivity import Sensitivities
from sms_online.stream import Array
from sms_sim.plant import Plant
from tests.model_systems import paper, spatial
from tests.prescribed_motion import prescribed

SPAN = 0.4  # s
# m, rad, s and so on: rows are linear in it, and it is large against rounding.
STEP = 1e-5
# Share of the largest entry of a column: derivatives by positions are computed at every other instant and interpolated.
AGREEMENT = 1e-3
ROUNDING = 1e-6  # N s and so on for a unit of a nuisance
SYSTEMS: dict[str, Callable[[], System]] = {
    "planar": paper,
    "planar, exact links": lambda: paper("exact"),
    "planar, sloping table": lambda: paper().model_copy(update={"gravity": (0.003, -0.002, 0.0)}),
    "spatial": lambda: load_system("spatial-two-link"),
    "flexible joints with gauges": lambda: load_system("quanser-2dsfl"),
    "spatial, prismatic joint, gravity, effects": lambda: spatial(free=False),
}


class Rows:
    """Residuals Y β - b of windows of one stretch of motion, exact parameters, for samples and geometries at will."""

    def __init__(self, system: System) -> None:
        # More elements than described change no sample, see `test_truncation`.
        system = system.model_copy(update={"tolerances": Tolerances(truncation=0.0)})
        self.model = model = build_model(system)
        self.base = find_base_parameters(model)
        self.beta = self.base.values(model.nominal)
        plant = Plant(system)
        self.sensing = sensing = Sensing(model, plant.channels, "test")
        order = [plant.channels.index(name) for name in sensing.channels]
        balance = MomentumBalance(model, self.base, system.sample_rate, SPAN)
        self.motion = prescribed(model, balance.width + balance.lead + balance.margin + balance.hop + 1, seed=1)
        torque = self.motion.Q[:, list(model.layout.theta_m)]
        self.exact = plant.channel_values(torque, self.motion.x)[:, order]
        self.columns = self._columns(balance)

    def _columns(self, balance: MomentumBalance) -> Array:
        pi = balance.rough.without(self.base.physical_values(self.beta))
        found, instants = self._windows(balance, self.sensing, self.exact)
        calibration = CalibrationColumns(self.model, self.sensing, balance.span)
        sensitivities = Sensitivities(
            self.model, self.sensing.displacements, balance.span / INSTANTS, calibration.geometries
        )
        for piece in instants:
            by_geometry = sensitivities.extend(pi, piece.x, piece.v, piece.signals)
            rates = sensitivities.rates(len(piece.x))
            calibration.extend(pi, piece.x, piece.v, piece.signals, rates, by_geometry)
        starts = np.array([window.start for window in found])
        sensitivity = sensitivities.windows(starts)
        responses = np.array([window.rough[1] for window in found])
        rough = balance.rough.kernels(responses, self.base.physical_values(self.beta), sensitivity.displacements)
        return np.concatenate(calibration.windows(starts, sensitivity, rough))

    def _windows(
        self, balance: MomentumBalance, sensing: Sensing, values: Array
    ) -> tuple[list[Window], list[Instants]]:
        sigma = np.full(self.model.layout.n_x, 1e-9)
        return balance.push(np.arange(len(values)), [sensing.motion(values)] * COPIES, sigma)

    def residual(self, values: Array, model: Model | None = None) -> Array:
        """Y β - b, all windows' rows one below the other."""
        model = self.model if model is None else model
        sensing = Sensing(model, self.sensing.channels, "test")
        balance = MomentumBalance(model, self.base, self.model.system.sample_rate, SPAN)
        dense = balance.dense(self._windows(balance, sensing, values)[0])[:, 0]
        return np.concatenate([rows[:, :-1] @ self.beta - rows[:, -1] for rows in dense])

    def moved(self, geometry: Geometry, by: float) -> Array:
        """The same of another geometry."""
        return self.residual(self.exact, self.model.of_geometry(geometry.moved(self.model.system, by)))

    def added(self) -> Array:
        """What a unit of each channel's nuisance adds to the samples, (nuisances, samples, channels)."""
        sensing, model = self.sensing, self.model
        x, v = self.motion.x, self.motion.v
        readings = sensing.readings(x)
        displacements = sensing.displacements(x)
        rates = (np.linalg.pinv(displacements) @ v[:, :, None])[..., 0]
        np.testing.assert_allclose(readings, self.exact[:, sensing.position_columns], atol=1e-9)
        torque = sensing.joint_torque(self.exact)
        motion = Motion(readings, rates, torque, model.layout.base_pose(x)[1])
        gear = sensing.joint_torque(np.ones_like(self.exact[:1]))[0]
        out, families = [], Families.of(sensing)
        for family in families.positions:
            for column in np.moveaxis(family.adds(motion), 2, 0):
                out.append(np.zeros_like(self.exact))
                out[-1][:, sensing.position_columns] = column
        for low_pass in families.low_passes:
            slopes = np.gradient(low_pass.adds(motion), 1.0 / model.system.sample_rate, axis=0)
            for column in np.moveaxis(slopes, 2, 0):
                out.append(np.zeros_like(self.exact))
                out[-1][:, sensing.position_columns] = column
        for torques in families.torques:
            for column in np.moveaxis(torques.adds(motion), 2, 0):
                out.append(np.zeros_like(self.exact))
                out[-1][:, sensing.torque_columns] = column / gear
        return np.array(out)


@pytest.mark.long
@pytest.mark.parametrize("system", SYSTEMS.values(), ids=SYSTEMS.keys())
def test_columns_are_what_rows_change_by(system: Callable[[], System]) -> None:
    """Samples or description changed, rows rebuilt, central differences: Y β - b changes by -N ν."""
    rows = Rows(system())
    model, found = rows.model, nuisances(rows.sensing)
    numeric = []
    for added in rows.added():
        numeric.append(
            (rows.residual(rows.exact + STEP * added) - rows.residual(rows.exact - STEP * added)) / -(2 * STEP)
        )
    for geometry in geometries(model.system):
        there, back = (rows.moved(geometry, by) for by in (STEP, -STEP))
        numeric.append((there - back) / (2 * STEP))
    assert len(numeric) == len(found) == rows.columns.shape[1]
    size = np.abs(np.array(numeric)).max(axis=1)
    off = np.abs(np.array(numeric) - rows.columns.T).max(axis=1)
    bad = {
        (nuisance.name, nuisance.where, nuisance.part): (float(error), float(largest))
        for nuisance, error, largest in zip(found, off, size, strict=True)
        if error > AGREEMENT * largest + ROUNDING
    }
    assert bad == {}


def test_a_mount_turned_about_its_joint_offsets_its_encoder() -> None:
    rows = Rows(paper())
    k = [(n.name, n.where) for n in nuisances(rows.sensing)].index(("axis", "joint_2"))
    joint = rows.model.system.joints[1]
    turned = []
    for by in (STEP, -STEP):
        moved = joint.model_copy(update={"mount_rotation": (0.0, 0.0, by)})
        system = rows.model.system.model_copy(update={"joints": (rows.model.system.joints[0], moved)})
        turned.append(rows.residual(rows.exact, rows.model.of_geometry(system)))
    expected = (turned[0] - turned[1]) / (2 * STEP)
    np.testing.assert_allclose(rows.columns[:, k], expected, atol=AGREEMENT * np.abs(expected).max())


def test_a_sloping_table_may_slope_otherwise() -> None:
    """Gravity in the plane is what a slope leaves of 9.8 m/s²; an upright plane holds all of it."""
    planar = load_system("paper-planar")

    def parts(*gravity: float) -> dict[str, Geometry]:
        every = geometries(planar.model_copy(update={"gravity": gravity}))
        return {each.nuisance.part: each for each in every if each.nuisance.name == "gravity"}

    assert parts(0.0, 0.0, 0.0) == {}
    assert list(parts(0.0, -9.81, 0.0)) == ["z"]
    sloping = parts(0.003, -0.002, 0.0)
    assert list(sloping) == ["z", "x", "y"]
    tilted = planar.model_copy(update={"gravity": (0.003, -0.002, 0.0)})
    np.testing.assert_allclose(sloping["x"].moved(tilted, 1e-3).gravity, [0.003, -0.002 + 9.76e-3, 0.0], atol=1e-7)
    np.testing.assert_allclose(sloping["y"].moved(tilted, 1e-3).gravity, [0.003 - 9.76e-3, -0.002, 0.0], atol=1e-7)
