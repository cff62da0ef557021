"""From a results document back to the full dynamics: H, C and K_f of (40), with no other knowledge of the testbed."""

from __future__ import annotations

from typing import Any

import numpy as np

from sms_online.description.schema import System
from sms_online.effects.build import build_model
from sms_online.errors import InputError
from sms_online.model.base_parameters import find_base_parameters
from sms_online.model.model import Model
from sms_online.results import SCHEMA
from sms_online.stream import Array


def reconstruct(document: dict[str, Any], source: str) -> tuple[Model, Array]:
    """Model and physical parameter values π (n_pi,) with the identified dynamics, from a parsed results.json.

    The description's nominal values play no part. Parameters that only act in combinations are zero but for the one
    that carries the combination, so `Model.dynamics(π)` is the identified system though single masses are not. Raises
    InputError, naming `source`, where the document is of another kind or its parameters do not fit its system.
    """
    if document.get("schema") != SCHEMA:
        raise InputError(source, "schema", repr(document.get("schema")), SCHEMA)
    model = build_model(System.model_validate(document["system"]))
    base = find_base_parameters(model)
    estimates = {entry["name"]: entry["estimate"] for entry in document["parameters"]}
    missing = [p.name for p in base.parameters if p.name not in estimates]
    if missing:
        raise InputError(source, "parameters", f"no {missing[0]!r}", "every base parameter of the document's system")
    return model, base.physical_values(np.array([estimates[p.name] for p in base.parameters]))
