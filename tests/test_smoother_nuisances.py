"""Readings of the smoother may be off within their tolerances: what they are off by is estimated beside π."""

from __future__ import annotations

import numpy as np
import pytest
from numpy.testing import assert_allclose

import sms_online as sms
from sms_online.description.schema import System, Tolerances
from sms_online.effects.build import build_model
from sms_online.model.readings import Readings
from sms_online.smoother.nuisances import ReadingNuisances
from tests.camera_rig import marked_bench, seen_by_cameras
from tests.model_systems import random_states

NONE = dict.fromkeys(Tolerances.model_fields, 0.0)
LATE = 3e-4


def tolerant(system: System, **tolerances: float) -> System:
    return system.model_copy(update={"tolerances": Tolerances(**(NONE | tolerances))})


@pytest.fixture(scope="module")
def late() -> tuple[System, sms.Capture]:
    """A bench whose cameras are late and whose second marker is 0.4 mm further along the link than described."""
    system = marked_bench()
    first, second = system.links[0].markers
    moved = second.model_copy(update={"position": (second.position[0] + 4e-4, *second.position[1:])})
    link = system.links[0].model_copy(update={"markers": (first, moved)})
    data = sms.simulate(system.model_copy(update={"links": (link,)}), seed=3)
    points = np.array([".marker_" in name for name in data.channels])
    seen = np.isfinite(data.values[:, points]).any(axis=1)
    values = np.full((data.t.size + np.count_nonzero(seen), points.size), np.nan)
    values[: data.t.size, ~points] = data.values[:, ~points]
    values[data.t.size :, points] = data.values[np.ix_(seen, points)]
    t = np.concatenate((data.t, data.t[seen] + LATE))
    order = np.argsort(t, kind="stable")
    return system, sms.Capture(t[order], data.channels, values[order], truth=data.truth)


@pytest.mark.slow
def test_late_cameras_and_a_misplaced_marker_are_found(late: tuple[System, sms.Capture]) -> None:
    system, data = late
    result = sms.estimate(tolerant(system, clock=1e-3, marker_station=1e-3), data)
    found = {(each.name, each.where, each.part): each for each in result.calibration}
    cameras = found["clock", "markers", ""]
    assert abs(cameras.estimate - LATE) < 4.0 * cameras.std < 2e-4
    place = found["marker_station", "link_1.marker_2", "x"]
    assert abs(place.estimate - 4e-4) < 4.0 * place.std < 4e-4
    stiffness = result.parameters["joint_1.stiffness"]
    assert abs(stiffness.value - 400.0) < 4.0 * stiffness.std


@pytest.mark.long
def test_exact_readings_do_not_hold_what_they_are_off_by(late: tuple[System, sms.Capture]) -> None:
    system, data = late
    result = sms.estimate(tolerant(system), data)
    assert result.calibration == ()
    assert result.trust.level != "trust"


@pytest.mark.parametrize("name", ["paper-planar", "spatial-two-link"])
def test_columns_are_derivatives_of_the_readings(name: str) -> None:
    system = seen_by_cameras(name).model_copy(update={"tolerances": Tolerances()})
    model = build_model(system)
    x, v = random_states(model.layout, 4, seed=2)
    names = [each for each in Readings(model, ["q_1"])._model.layout.position_names if not each.startswith("link_")]
    channels = [*names, "link_2.marker_2.x", "link_2.marker_2.y"]
    readings = Readings(model, channels)
    nuisances = ReadingNuisances(model, channels)
    columns = nuisances.columns(x, v, readings.derivatives(x, v)[0], readings(x, v), range(len(channels)))
    at = {(each.name, each.where, each.part): k for k, each in enumerate(nuisances.all)}
    # A marker that sits further along each axis; these links are curved by several 1/m.
    step = 1e-6
    for axis, letter in enumerate("xy"):
        marker = system.links[1].markers[1]
        place = np.array(marker.position)
        place[axis] += step
        link = system.links[1].model_copy(
            update={"markers": (system.links[1].markers[0], marker.model_copy(update={"position": tuple(place)}))}
        )
        other = build_model(system.model_copy(update={"links": (system.links[0], link)}))
        moved = (Readings(other, channels)(x, v) - readings(x, v)) / step
        assert_allclose(
            columns[..., at["marker_station", "link_2.marker_2", letter]], moved, atol=1e-3
        )  # curved by 4 / m
    # What cameras see later is where it was.
    late = at["clock", "markers", ""]
    ahead = (readings(model.layout.displaced(x, step * v), v) - readings(x, v)) / step
    assert_allclose(columns[:, -2:, late], -ahead[:, -2:], rtol=1e-4, atol=1e-4)
    assert not columns[:, :-2, late].any()
    assert_allclose(columns[:, channels.index("q_1"), at["encoder_zero", "q_1", ""]], 1.0)
