"""From a description to a model with the effects that it declares."""

from __future__ import annotations

import re
from collections.abc import Callable, Iterable, Mapping
from functools import lru_cache

import numpy as np

from sms_online.description.bodies import FlexibleLink
from sms_online.description.schema import Effect, System
from sms_online.description.tree import index_of
from sms_online.effects.base import Site
from sms_online.effects.catalogue import (
    CONSTANTS,
    FORCE_CLASSES,
    GEOMETRIC_STIFFENING,
    INERTIA_CLASSES,
    check_effect,
    with_shapes,
)
from sms_online.errors import InputError
from sms_online.model.base_parameters import fixes_scale
from sms_online.model.chain import Chain
from sms_online.model.effect import ForceEffect, InertiaEffect
from sms_online.model.model import Model
from sms_online.stream import Array

# The last joint of a pair.
NUMBERED = re.compile(r"(?:joint_\d+\+)?(?:joint|link)_(\d+)")


def build_model(system: System, reference: Array | None = None) -> Model:
    """Model of a system with the effects that it declares.

    reference (n_pi,): π whose masses effects of gravity use, the nominal ones unless given. InputError on an unknown
    name, place or coefficient of an effect.
    """
    return Model(with_kinematics(system), build_effects, reference)


def scale_is_fixed(system: System) -> bool:
    """Whether values that a system states as known or as priors fix the scale common to all parameters."""
    return _scale_is_fixed(system.model_dump_json())


@lru_cache(maxsize=16)
def _scale_is_fixed(described: str) -> bool:
    return fixes_scale(build_model(System.model_validate_json(described)))


def refuse_unknown_masses(model: Model) -> None:
    """InputError on a declared effect whose columns hold masses that are yet to be found."""
    for effect in model.effects:
        if effect.needs_masses:
            place, found = f"effect {effect.key}", "a product with masses, which are unknown"
            expected = "the system's gravity, or a tilt that is found from a whole capture"
            raise InputError(model.system.name, place, found, expected)


def changed_model(model: Model, system: System, masses: Mapping[str, float] | None = None) -> Model:
    """Model of a changed system, with the reference of `model` by the parameters' names; what is new has mass 0.

    masses: reference of these parameters in its place.
    """
    reference = dict(zip((p.name for p in model.parameters), model.reference, strict=True)) | dict(masses or {})
    other = build_model(system)
    other.reference = np.array([reference.get(p.name, 0.0) for p in other.parameters])
    return other


def declaring(system: System, effects: Iterable[Effect]) -> System:
    """The system with further effects declared."""
    return system.model_copy(update={"effects": (*system.effects, *effects)})


def with_effects(system: System, effects: Iterable[Effect]) -> System:
    """The system with further effects: declared, or as constants of its description where they become such."""
    effects = tuple(effects)
    system = declaring(system, [effect for effect in effects if effect.name not in CONSTANTS])
    for effect in effects:
        if effect.name in CONSTANTS:
            system = CONSTANTS[effect.name].declared(system, effect)
    return system


def with_kinematics(system: System) -> System:
    """The system with `exact` kinematics of the links that declare geometric_stiffening; InputError as `check_effect`.

    What is exact already stays, so that the system that comes out may go in again.
    """
    links = list(system.links)
    flexible = [(f"link_{i}", link) for i, link in enumerate(links, start=1) if isinstance(link, FlexibleLink)]
    exact = {name for name, link in flexible if link.kinematics == "exact"}
    for k, effect in enumerate(system.effects, start=1):
        if effect.name == GEOMETRIC_STIFFENING.name and effect.where not in exact:
            check_effect(system, effect, f"effect {k}", system.name)
            i = index_of(effect.where)
            links[i] = links[i].model_copy(update={"kinematics": "exact"})
    return system.model_copy(update={"links": tuple(links)}) if links != list(system.links) else system


def build_effects(
    system: System, chain: Chain, weight: Callable[[Array], Array]
) -> tuple[tuple[ForceEffect, ...], tuple[InertiaEffect, ...]]:
    """Effects of kind force, and of kind inertia, that a system declares, in its order; weight: see `Site`.

    InputError on an unknown name, place or coefficient.
    """
    forces: list[ForceEffect] = []
    inertias: list[InertiaEffect] = []
    for k, effect in enumerate(system.effects, start=1):
        if effect.name == GEOMETRIC_STIFFENING.name:
            continue  # the links are exact already
        check_effect(system, effect, f"effect {k}", system.name)
        numbered = NUMBERED.fullmatch(effect.where)
        site = Site(system, chain, effect, int(numbered[1]) if numbered else 0, weight)
        given = with_shapes(effect, system).coefficients
        if effect.name in FORCE_CLASSES:
            forces.append(FORCE_CLASSES[effect.name](site, given))
        elif effect.name in INERTIA_CLASSES:
            inertias.append(INERTIA_CLASSES[effect.name](site, given))
    return tuple(forces), tuple(inertias)
