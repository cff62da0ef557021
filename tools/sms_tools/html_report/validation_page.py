"""validation.html: measured torques beside those that fixed parameters predict, and what is left over the run."""

from __future__ import annotations

from pathlib import Path

import numpy as np

from sms_online.diagnosis.residuals import rms
from sms_online.stream import Array
from sms_online.torque_prediction import TorqueCourse
from sms_online.validation import Validation
from sms_tools.html_report.diagnosis_charts import TIME
from sms_tools.html_report.figures import Chart, Series, chart
from sms_tools.html_report.pages import write_page

NAME = "validation.html"
# Length of the part of a run that is drawn, s: the one with the largest error.
PART = 10.0
# Stretches of the whole run of which one rms each is drawn.
STRETCHES = 40
MEASURED, PREDICTED, LEFT = "grey", "blue", "orange"


def write_validation(directory: Path, found: Validation) -> Path:
    """Write validation.html; InputError where it cannot be written."""
    return write_page(
        directory / NAME,
        "validation.html",
        title=f"{found.system}: {found.duration:.0f} s predicted with fixed parameters",
        found=found,
        tables=[table for table in (found.rows(), found.deflection_rows()) if table[1]],
        part=PART,
        charts=[part for course in found.courses.values() for part in (_part(course), _run(course))],
    )


def _part(course: TorqueCourse) -> Chart:
    """Measured and predicted torque and the error, in the part of the run where this is largest."""
    # Of each window, the error from there on for the length of a part.
    error = np.concatenate(([0.0], np.cumsum((course.predicted - course.measured) ** 2)))
    last = np.searchsorted(course.t, course.t + PART)
    whole = course.t <= max(course.t[0], course.t[-1] - PART)
    first = int(np.argmax(np.where(whole, error[last] - error[:-1], -1.0)))
    some = slice(first, int(last[first]))
    t = course.t[some]
    lines = (
        ("measured", course.measured[some], MEASURED),
        ("predicted", course.predicted[some], PREDICTED),
        ("left", (course.measured - course.predicted)[some], LEFT),
    )
    series = [Series(label, *_broken(t, values), color=color) for label, values, color in lines]
    return chart(f"{course.channel}, {course.unit}", series, TIME)


def _broken(t: Array, values: Array) -> tuple[Array, Array]:
    """A line with a gap wherever samples have one."""
    step = np.diff(t)
    gaps = np.flatnonzero(step > 1.5 * np.median(step)) + 1 if step.size else np.zeros(0, int)
    return np.insert(t, gaps, t[gaps]), np.insert(values, gaps, np.nan)


def _run(course: TorqueCourse) -> Chart:
    """rms of the torque and of the error over the whole run."""
    parts = np.array_split(np.arange(course.t.size), min(STRETCHES, course.t.size))
    t = np.array([course.t[part].mean() for part in parts])
    error = course.measured - course.predicted
    series = [
        Series(label, t, np.array([rms(values[part]) for part in parts]), color=color)
        for label, values, color in (("measured", course.measured, MEASURED), ("left", error, LEFT))
    ]
    return chart(f"{course.channel}, rms over the run, {course.unit}", series, TIME)
