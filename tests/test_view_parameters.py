"""Which parameters share a plot, what a table of them says, and the colours of residuals."""

from __future__ import annotations

from collections.abc import Sequence
from copy import copy
from pathlib import Path

import numpy as np
import pytest
import rerun as rr

from sms_adapters.system_file import load_system
from sms_online.effects.build import build_model
from sms_online.evaluation import identifiable
from sms_online.model.base_parameters import find_base_parameters
from sms_online.model.parameters import Parameter
from sms_online.pipeline.events import Event
from sms_online.pipeline.joint_balance import SquaredResidual
from sms_online.stream import Array
from sms_tools.view.frames import Reference
from sms_tools.view.known import Known
from sms_tools.view.number_log import NumberLog, markdown_table
from sms_tools.view.own_scale import LEAST_REST, OwnScale
from sms_tools.view.parameter_groups import MOST_LINES, Basis, parameter_groups, shortened
from sms_tools.view.residuals import RecentResidual
from sms_tools.view.style import BAD, GOOD, residual_colors
from tests.recordings import columns


def known(t: float, estimate: Array, std: Array) -> Known:
    """What is known at t, s, without a prior."""
    return Known(t, estimate, std, identifiable(estimate, std))


def about(parameters: Sequence[Parameter]) -> Basis:
    """The nominal values, where they are something."""
    return Basis(np.array([p.nominal or np.nan for p in parameters]), "nominal value", 100.0)


@pytest.mark.parametrize("truth", [False, True])
@pytest.mark.parametrize("name", ["paper-planar", "seven-joint", "quanser-2dsfl", "emps"])
def test_every_parameter_is_in_one_plot_of_one_unit(name: str, truth: bool) -> None:
    parameters = find_base_parameters(build_model(load_system(name))).parameters
    groups = parameter_groups(parameters, [Reference(p.nominal, truth) for p in parameters], about(parameters))
    members = np.concatenate([group.indices for group in groups])
    assert sorted(members.tolist()) == list(range(len(parameters)))
    assert len({group.path for group in groups}) == len(groups)
    for group in groups:
        assert len(group.indices) <= MOST_LINES
        # A true value of zero is no measure of anything.
        units = {"%" if parameters[k].nominal or not truth else parameters[k].unit for k in group.indices}
        assert units == {group.unit}
        assert group.unit in group.title


def test_what_only_some_have_a_true_value_of_is_drawn_apart() -> None:
    parameters = [Parameter(f"link_{i}.mass", f"m_{i}", "kg", 1.0) for i in (1, 2)]
    first, second = parameter_groups(parameters, [Reference(1.0, True), None], about(parameters))
    assert (first.path, second.path) == ("links", "links_own")
    assert "true value" in first.title
    assert "nominal value" in second.title


def test_a_deviation_is_in_percent_of_its_reference() -> None:
    parameter = Parameter("link_1.first_moment_x", "m_1 c_1x", "kg m", 1.0)
    (group,) = parameter_groups([parameter], [Reference(-2.0, True)], about([parameter]))
    assert (-2.1 - group.zero[0]) / group.scale[0] == pytest.approx(-5.0)


def test_without_a_reference_nothing_is_drawn() -> None:
    parameter = Parameter("coulomb_friction@joint_1.torque", "c_1", "N m", 0.0)
    (group,) = parameter_groups([parameter], [None], about([parameter]))
    assert np.isnan((3.0 - group.zero[0]) / group.scale[0])
    assert (group.kind, group.unit, group.half_range) == ("effects", "%", 100.0)


def followed(scale: OwnScale, t: float, estimate: list[float], percent: float, converged: bool = True) -> bool:
    """An instant at which every error bar (1σ) is so many percent long."""
    values = np.array(estimate)
    return scale.follow(known(t, values, np.abs(values) * percent / 100.0), converged)


def test_an_axis_is_about_the_estimate_once_converged() -> None:
    scale = OwnScale([Reference(10.0, False)] * 4)
    assert not followed(scale, 1.0, [12.0] * 4, 1.0, converged=False)
    assert (scale.basis.half_range, scale.basis.about[0]) == (100.0, 10.0)
    assert followed(scale, 2.0, [12.0] * 4, 1.0)
    assert scale.basis.about.tolist() == [12.0] * 4
    # Twice ± 2 %, on the next axis there is.
    assert scale.basis.half_range == 10.0
    assert "2.0 s" in scale.basis.name


def test_an_axis_stays_until_bars_shrink_or_estimates_leave_it() -> None:
    scale = OwnScale([None] * 4)
    assert followed(scale, 0.0, [12.0] * 4, 1.0)
    assert not followed(scale, 10.0, [12.1] * 4, 0.5)
    assert followed(scale, 20.0, [12.1] * 4, 0.1)
    assert scale.basis.half_range == 1.0
    assert not followed(scale, 40.0, [20.0, 12.1, 12.1, 12.1], 0.1)  # one of four may
    assert followed(scale, 60.0, [20.0, 20.0, 12.1, 12.1], 0.1)


def test_an_axis_of_a_restless_estimate_changes_ever_rarer() -> None:
    """What was drawn is drawn again each time, so an hour must not hold thousands of them."""
    scale = OwnScale([None] * 4)
    changes = [t for t in range(3600) if followed(scale, float(t), [1.0 + t % 2] * 4, 0.1)]
    assert len(changes) < 40
    assert changes[-1] > 2000


def test_what_is_determined_later_joins_the_axis_of_the_others() -> None:
    scale = OwnScale([None] * 2)
    values, std = np.array([5.0, 7.0]), np.array([0.01, 0.01])
    assert scale.follow(known(1.0, values, np.array([0.01, np.inf])), converged=True)
    assert np.isnan(scale.basis.about[1])
    # Everything is drawn anew then, so not at every moment.
    assert not scale.follow(known(1.0, values, std), converged=True)
    assert scale.follow(known(1.0 + LEAST_REST, values, std), converged=True)
    assert scale.basis.about.tolist() == [5.0, 7.0]


def test_where_all_true_values_are_known_the_axis_never_changes() -> None:
    scale = OwnScale([Reference(1.0, True)] * 4)
    assert not followed(scale, 5.0, [12.0] * 4, 1.0)
    assert not scale.follow(known(9.0, np.full(4, 12.0), np.full(4, 0.1)), converged=True, last=True)


def test_long_combinations_are_cut_to_a_label() -> None:
    assert shortened("k_1") == "k_1"
    assert len(shortened("m_0+m_1+m_2+m_m1+m_m2+m_m3")) == 18
    assert shortened("m_0+m_1+m_2+m_m1+m_m2+m_m3").startswith("m_0+m_1")


def test_a_table_has_no_number_of_what_is_not_determined() -> None:
    parameters = [Parameter("joint_1.stiffness", "k_1", "N m/rad", 1000.0)] * 2
    now = known(1.0, np.array([1010.0, 7.0]), np.array([5.0, np.inf]))
    lines = markdown_table(parameters, [Reference(1000.0, True), None], now).splitlines()
    assert lines[2] == "| k_1 | N m/rad | 1010 | 5 | 1000 | +1 % |"
    assert lines[3] == "| k_1 | N m/rad | – | – | – | – |"


def test_a_plot_may_gain_a_line_between_two_sendings(tmp_path: Path) -> None:
    stream = rr.RecordingStream("sms_online_test", make_default=False)
    stream.save(tmp_path / "plot.rrd")
    numbers = NumberLog(stream)
    for t, count in enumerate((2, 2, 3)):
        numbers.add("plot", float(t), np.full(count, float(t)))
    numbers.send()
    stream.flush()
    stream.disconnect()
    drawn = [row["Scalars:scalars"] for row in columns(tmp_path / "plot.rrd", "/plot")]
    assert drawn == [[0.0, 0.0], [1.0, 1.0], [2.0, 2.0, 2.0]]


def test_colours_go_from_good_to_bad() -> None:
    colors = residual_colors(np.array([np.nan, 0.0, 0.5, 7.0]))
    np.testing.assert_array_equal(colors, np.array([GOOD, GOOD, BAD, BAD]).astype(np.uint8))


class Watched:
    """As much of a session's statistics as a residual needs."""

    def __init__(self) -> None:
        self.joints = [SquaredResidual(np.zeros((2, 2)))]
        self.events: list[Event] = []


def test_the_recent_residual_forgets_what_is_over() -> None:
    estimator, recent = Watched(), RecentResidual()
    beta = np.array([2.0])
    for t in np.arange(0.0, 3.0, 0.25):
        # Nothing of the torque of 4 is explained by β Y = 2 at first, all of 2 later.
        measured = 4.0 if t < 1.0 else 2.0
        estimator.joints = [copy(estimator.joints[0])]
        estimator.joints[0].add(np.array([1.0, measured]), measured)
        share = recent.push(float(t), estimator, beta)  # type: ignore[arg-type]
        if t < 1.0:
            assert share[0] == pytest.approx(0.5)
    assert share[0] == pytest.approx(0.0, abs=1e-7)
