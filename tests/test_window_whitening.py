"""Sequential whitening uses all windows before: a filter that begins anew has to receive enough of them first."""

from __future__ import annotations

import numpy as np

from sms_online.effects.build import build_model
from sms_online.model.base_parameters import find_base_parameters
from sms_online.pipeline.momentum_balance import MomentumBalance
from sms_online.pipeline.momentum_fit import WARM_UP
from sms_online.pipeline.momentum_windows import COPIES, HOPS
from sms_online.pipeline.sensing import Sensing
from sms_online.pipeline.sensor_noise import SensorNoise
from sms_online.pipeline.window_noise import WindowNoise
from sms_online.pipeline.window_whitening import WindowWhitening
from sms_online.stream import Array
from sms_sim.plant import Plant
from tests.model_systems import paper
from tests.prescribed_motion import prescribed

SPAN = 0.4  # s
POSITION_NOISE, TORQUE_NOISE = 1e-4, 0.5  # rad and m, N m
COMPARED = HOPS  # windows


def _information(rows: Array) -> Array:
    """Squares (n,) of the columns of whitened rows."""
    return np.asarray(np.sum(rows**2, axis=0))


def test_a_warmed_up_filter_whitens_like_one_that_saw_all() -> None:
    system = paper()
    model = build_model(system)
    base = find_base_parameters(model)
    plant = Plant(system)
    sensing = Sensing(model, plant.channels, "test")
    balance = MomentumBalance(model, base, system.sample_rate, SPAN)
    warm = round(WARM_UP * HOPS / balance.span)
    late = HOPS + warm  # the window from which on the chains are compared
    count = balance.width + balance.lead + balance.margin + (late + COMPARED) * balance.hop
    motion = prescribed(model, count, seed=1)
    exact = plant.channel_values(motion.Q[:, list(model.layout.theta_m)], motion.x)
    values = exact[:, [plant.channels.index(name) for name in sensing.channels]]
    n_x, joints = model.layout.n_x, len(model.layout.q)
    coordinates = sensing.coordinate_noise(np.full(n_x, POSITION_NOISE))
    windows, instants = balance.push(np.arange(count), [sensing.motion(values)] * COPIES, coordinates)
    x, v, signals = (np.concatenate([getattr(piece, name) for piece in instants]) for name in ("x", "v", "signals"))
    density = POSITION_NOISE**2 / system.sample_rate, TORQUE_NOISE**2 / system.sample_rate
    grid = np.full(n_x + joints, POSITION_NOISE)
    noise = SensorNoise(
        np.full(n_x, density[0]), np.full(joints, density[1]), coordinates, grid, False, np.zeros(n_x, bool)
    )

    def information_from(first: int) -> Array:
        """Information about each parameter in the windows compared, by a filter that begins with window `first`."""
        chain = WindowWhitening(WindowNoise(model, base, balance, sensing.displacements), COPIES * (base.n + 1))
        chain.begin(base.values(model.nominal), noise, np.zeros(model.layout.n_v), windows[first].start)
        chain.noise.extend(0, x, v, signals)
        chosen = windows[first : late + COMPARED]
        rows = np.zeros((len(chosen), model.layout.n_v, COPIES * (base.n + 1)))
        rows[:, balance.rows, balance.columns] = [window.Y[0] for window in chosen]
        white = chain.push(chosen, rows, np.zeros((len(chosen), model.layout.n_v)))
        return _information(np.concatenate([each.rows[:, : base.n] for each in white[late - first :]]))

    whole, warmed, cold = information_from(0), information_from(late - warm), information_from(late)
    assert np.all(np.abs(warmed / whole - 1.0) < 0.25)
    # Parameters of the whole arm's momentum, which noise of a single window hides.
    assert np.median(cold / whole) < 1.0
    assert np.min(cold / whole) < 0.05
