"""Systems without tolerances: what a test of exactness describes is the truth, and no error bar counts what is not."""

from __future__ import annotations

from sms_online.description.schema import System, Tolerances

EXACTLY = Tolerances.model_validate("none")


def exactly_known(system: System) -> System:
    """The same system with geometry, clocks and calibration known exactly."""
    return system.model_copy(update={"tolerances": EXACTLY})
