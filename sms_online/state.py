"""What stages keep while they run, as typed records that are copied, encoded and put back by one piece of code.

A stage is an object that samples or rows pass through. What changes in it while it runs lies in attributes that are a
`State`, a record of arrays, numbers, and lists and records of these; whatever else it holds its constructor makes anew
from the same arguments. Stages may hold stages. A new stage declares its record, and is saved with the session.

An array of a state is replaced, never written: so copies share it, and take microseconds however large it is.
Source: msgspec, which decodes into declared types and refuses what does not fit them.
"""

from __future__ import annotations

from copy import copy, deepcopy
from typing import Any, TypeVar, get_origin

import msgspec
import numpy as np
from pydantic import BaseModel


class State(msgspec.Struct):
    """A record of what changes while a session runs. Its annotations are evaluated: import them at run time."""


class Stage:
    """Something that keeps a `State`, in as many attributes as it likes, or holds other stages."""

    def renew(self) -> None:
        """Make anew what follows from the states, which were put back just now; the stages within follow later."""


StageT = TypeVar("StageT", bound=Stage)
# Copies of states, and of those of the stages within, by the names of the attributes.
Saved = dict[str, Any]


def snapshot(stage: StageT) -> StageT:
    """The stage as it is now, which does not change when the stage goes on; stages within included."""
    out = copy(stage)
    for name, value in vars(stage).items():
        if isinstance(value, State):
            setattr(out, name, state_copy(value))
        elif isinstance(value, Stage):
            setattr(out, name, snapshot(value))
    return out


def collect(stage: Stage) -> Saved:
    """The states of a stage and of the stages within as they are now; a stage that several hold comes once."""
    return _collect(stage, set())


def _collect(stage: Stage, seen: set[int]) -> Saved:
    seen.add(id(stage))
    out: Saved = {}
    for name, value in vars(stage).items():
        if isinstance(value, State):
            out[name] = state_copy(value)
        elif isinstance(value, Stage) and id(value) not in seen:
            out[name] = _collect(value, seen)
    return out


ValueT = TypeVar("ValueT")


def state_copy(value: ValueT) -> ValueT:
    """A state, or what one holds, as it is now, with arrays shared."""
    if isinstance(value, list):
        return type(value)(map(state_copy, value))
    if isinstance(value, dict):
        return type(value)((key, state_copy(each)) for key, each in value.items())
    if isinstance(value, np.random.Generator):
        return deepcopy(value)  # it is written
    if not isinstance(value, State):
        return value
    out = copy(value)
    for name in out.__struct_fields__:
        setattr(out, name, state_copy(getattr(out, name)))
    return out


def encode(saved: Any) -> bytes:
    """Collected states, or what holds some, as msgpack."""
    return msgspec.msgpack.encode(saved, enc_hook=_to_plain)


def put_back(stage: Stage, encoded: bytes | msgspec.Raw) -> None:
    """Have a stage made with the same arguments go on from encoded states.

    Raises msgspec.DecodeError or ValueError where they are not those of such a stage.
    """
    saved = msgspec.msgpack.decode(encoded, type=dict[str, msgspec.Raw])
    missing = [name for name, value in vars(stage).items() if isinstance(value, State) and name not in saved]
    if missing:
        raise msgspec.ValidationError(f"no state `{missing[0]}` of {type(stage).__name__}")
    within = []
    for name, raw in saved.items():
        value = getattr(stage, name, None)
        if isinstance(value, State):
            setattr(stage, name, msgspec.msgpack.decode(raw, type=type(value), dec_hook=_from_plain))
        else:
            within.append(name)
    stage.renew()
    for name in within:
        # One that came before may have made the later ones anew.
        value = getattr(stage, name, None)
        if not isinstance(value, Stage):
            raise msgspec.ValidationError(f"states of `{name}`, which {type(stage).__name__} does not have")
        put_back(value, saved[name])


def _to_plain(value: Any) -> Any:
    """What msgspec does not know, in what it knows."""
    if isinstance(value, np.ndarray):
        # The order of axes in memory decides in which order sums are taken, and so their last bits.
        axes = range(value.ndim)
        order = axes if value.flags.c_contiguous else sorted(axes, key=lambda axis: -abs(value.strides[axis]))
        packed = np.ascontiguousarray(value.transpose(order))
        return value.dtype.str, value.shape, tuple(order), packed.data
    if isinstance(value, np.generic):
        return value.item()
    if isinstance(value, np.random.Generator):
        # Its numbers have 128 bits.
        return {name: str(number) for name, number in value.bit_generator.state["state"].items()}
    if isinstance(value, BaseModel):
        return value.model_dump()
    raise TypeError(f"{type(value).__name__} in a state; expected arrays, numbers, text and records of them")


def _from_plain(kind: Any, plain: Any) -> Any:
    """A value of the declared type, of what `_to_plain` made of it."""
    kind = get_origin(kind) or kind
    if kind is np.ndarray:
        dtype, shape, order, data = plain
        packed = np.ndarray([shape[axis] for axis in order], np.dtype(dtype), bytearray(data))
        return packed.transpose(sorted(range(len(order)), key=order.__getitem__))
    if kind is np.random.Generator:
        generator = np.random.default_rng(0)
        now = dict(generator.bit_generator.state)
        now["state"] = {name: int(number) for name, number in plain.items()}
        generator.bit_generator.state = now
        return generator
    if issubclass(kind, BaseModel):
        return kind.model_validate(plain)
    raise TypeError(f"{kind} in a state; expected arrays, numbers, text and records of them")
