"""Sensors that are far behind the others, found by how well readings can be explained without their lag."""

from __future__ import annotations

import numpy as np

from sms_adapters.system_file import load_system
from sms_online.description.schema import Sensor
from sms_online.diagnosis.late_sensors import Lags
from sms_online.diagnosis.record import Segment
from sms_online.pipeline.estimator import Estimator
from sms_sim.simulate import sampled_blocks
from tests.simulations import planar


def test_a_stated_latency_is_taken_off_once() -> None:
    """A lag of microseconds leaves what no lag leaves: 6 s of the planar example, grade B (seed 4).

    The links' encoders are stated to be 20 ms late, which is off the samples already. Logarithms move by less than
    1e-3 over such a lag, and by 0.2 at least over 20 ms.
    """
    system = load_system("paper-planar").model_copy(update={"sensors": (Sensor(channels=("q_*",), latency=0.02),)})
    blocks = list(sampled_blocks(planar(6.0), "B", seed=4))
    estimator = Estimator(system, blocks[0].channels, "test")
    order = [blocks[0].channels.index(channel) for channel in estimator.sensing.channels]
    values = np.concatenate([block.values for block in blocks])[:, order]
    lags = Lags(estimator, [Segment(np.arange(len(values)), values)])
    np.testing.assert_allclose(lags.left("theta_m_1", 1e5), lags.left(), atol=0.01)
