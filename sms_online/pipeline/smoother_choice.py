"""Whether states are to be estimated with the parameters, and the smoother that does so."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from typing import TYPE_CHECKING

from sms_online.description.schema import LEAST_SQUARES
from sms_online.effects.catalogue import channel_effects
from sms_online.errors import InputError
from sms_online.model.base_parameters import BaseParameters
from sms_online.pipeline.sensing import Sensing, is_slow, not_smoothed, stated_period

if TYPE_CHECKING:
    from sms_online.smoother.session import Smoother


def too_slow(sensing: Sensing) -> bool:
    """Whether a position sensor is described as too slow for the windows of the momentum balance."""
    system = sensing.model.system
    positions = tuple(sensing.channels[k] for k in sensing.position_columns)
    return is_slow(stated_period(system, positions), system.windows.momentum)


def _wanted(sensing: Sensing) -> bool:
    """Whether states are to be estimated: it is asked for, or sensors or samples are missing."""
    balance = sensing.model.system.balance
    if balance != "both":
        return balance == "smoother" or (balance == "momentum" and bool(sensing.missing))
    return bool(sensing.missing) or too_slow(sensing)


def smoother_of(
    base: BaseParameters, sensing: Sensing, channels: Sequence[str], source: str, changed: Callable[[], None]
) -> Smoother | None:
    """The smoother of a session, None where it needs none or can have none.

    changed: see `Smoother`. InputError where it needs one and can have none.
    """
    model = sensing.model
    # It reads the channels as they come.
    distorted = channel_effects(model.system)
    if distorted and sensing.missing and model.system.balance != "energy":
        found = f"{distorted[0].name}@{distorted[0].where}, and no {sensing.missing[0]}"
        raise InputError(source, "", found, 'balance = "energy", or all coordinates measured')
    wanted = _wanted(sensing)
    if wanted and (refused := not_smoothed(model)):
        raise InputError(source, "", refused, 'balance = "energy", or all coordinates measured fast enough')
    if distorted or not wanted:
        return None
    from sms_online.smoother.session import Smoother  # which few sessions need

    # Beside a momentum balance, which finds changes sooner, it looks for none.
    alone = bool(sensing.missing) or too_slow(sensing)
    trackers = model.system.trackers or (LEAST_SQUARES,)
    return Smoother(model, base, sensing, channels, trackers, changed if alone else None)
