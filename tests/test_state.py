"""What stages keep comes back bit for bit, is complete, and is refused where it belongs to another session."""

from __future__ import annotations

import hashlib
from dataclasses import dataclass
from functools import cache
from typing import Any, NamedTuple

import msgspec
import numpy as np
import pytest
from numpy.typing import NDArray

from sms_online.checkpoint import Checkpoint
from sms_online.description.parse import parse_system
from sms_online.description.schema import Effect
from sms_online.errors import InputError
from sms_online.pipeline.estimator import Estimator
from sms_online.state import Saved, Stage, State, collect, encode, snapshot
from sms_online.stream import Array
from tests.axis import AXIS, axis_block
from tests.net.sessions import SESSIONS
from tests.saved import resumed


@dataclass(frozen=True)
class Piece:
    values: Array
    flags: NDArray[np.bool_]


class Sums(NamedTuple):
    factor: Array
    rss: float


class Kept(State):
    array: Array
    maybe: Array | None
    ragged: list[Piece]
    by_width: dict[int, Array]
    number: float
    random: np.random.Generator
    effects: tuple[Effect, ...]
    sums: Sums


class Keeper(Stage):
    def __init__(self) -> None:
        nothing = np.empty(0)
        self.state = Kept(nothing, None, [], {}, 0.0, np.random.default_rng(0), (), Sums(nothing, 0.0))


ARRAYS = {
    "of rows": np.arange(6.0).reshape(2, 3),
    "of columns": np.arange(6.0).reshape(2, 3, order="F"),
    "every second row of columns": np.arange(12.0).reshape(4, 3, order="F")[::2],
    "of swapped axes": np.arange(24.0).reshape(2, 3, 4).swapaxes(0, 1),
    "none": np.empty((0, 3)),
    "one number": np.array(-0.0),
    "no numbers": np.array([np.nan, np.inf, -np.inf, 5e-324]),
}


@pytest.mark.parametrize("array", ARRAYS.values(), ids=ARRAYS)
def test_arrays_come_back_bit_for_bit_in_their_order(array: Array) -> None:
    keeper = Keeper()
    keeper.state.array = array
    back = resumed(Keeper(), keeper).state.array
    assert (back.tobytes(), back.shape, back.dtype) == (array.tobytes(), array.shape, array.dtype)
    assert back.strides == array.copy(order="K").strides or not array.size
    assert back.flags.writeable


def test_records_and_numbers_come_back_as_declared() -> None:
    keeper, now = Keeper(), np.array([0.1, 0.2])
    pieces = [Piece(np.ones(2), np.array([True, False])), Piece(np.empty((3, 0)), np.zeros(0, dtype=np.bool_))]
    effect = Effect(name="coulomb_friction", where="joint_1", coefficients={"torque": 2.0})
    random = np.random.default_rng(6)
    random.standard_normal(5)
    keeper.state = Kept(now, now, pieces, {6: now}, np.float64(0.3), random, (effect,), Sums(now, np.nan))
    back = resumed(Keeper(), keeper).state
    assert [piece.flags.dtype for piece in back.ragged] == [np.bool_, np.bool_]
    assert [piece.values.shape for piece in back.ragged] == [(2,), (3, 0)]
    assert list(back.by_width) == [6]
    assert back.number == 0.3
    assert back.effects == (effect,)
    assert isinstance(back.sums, Sums)
    assert np.array_equal(back.random.standard_normal(9), random.standard_normal(9))
    assert back.maybe is not None


def test_what_is_no_state_is_refused_when_saving() -> None:
    keeper = Keeper()
    keeper.state.number = lambda: 0.0  # type: ignore[assignment]
    with pytest.raises(TypeError, match="function in a state"):
        encode(collect(keeper))


def test_a_snapshot_shares_arrays_and_no_lists() -> None:
    keeper = Keeper()
    then = snapshot(keeper)
    assert then.state.array is keeper.state.array
    keeper.state.by_width[6] = keeper.state.array
    assert then.state.by_width == {}


@pytest.mark.slow
@pytest.mark.parametrize(
    "name", [pytest.param("gap", marks=pytest.mark.long), "effects", "smoother", "recording", "axis-event"]
)
def test_a_session_resumed_repeatedly_ends_in_the_same_state(name: str) -> None:
    """At eight places by seed 1, in every bit of every stage's state: so no state lacks what the stage goes on with.

    And states that were collected there have not changed by the end: so no stage has written into an array of its own.
    """
    session = SESSIONS[name]()
    pieces = list(session.block.pieces(1 + session.block.t.size // 60))
    cuts = np.random.default_rng(1).choice(len(pieces), 8, replace=False)

    def estimator() -> Estimator:
        return Estimator(session.system, session.block.channels, name)

    whole, parted = estimator(), estimator()
    then: list[tuple[Saved, str]] = []
    for k, piece in enumerate(pieces):
        whole.push(piece)
        parted.push(piece)
        if k in cuts:
            then.append((collect(whole), digest(collect(whole))))
            parted = resumed(estimator(), parted)
    for each in (whole, parted):
        each.finish()
    assert digest(collect(parted)) == digest(collect(whole))
    assert parted.estimate().pi.tobytes() == whole.estimate().pi.tobytes()
    assert [digest(saved) for saved, _ in then] == [digested for _, digested in then]


def digest(saved: Saved) -> str:
    return hashlib.sha256(encode(saved)).hexdigest()


def test_a_checkpoint_of_another_version_is_refused() -> None:
    saved = axis_checkpoint(AXIS)
    other = Checkpoint(msgspec.structs.replace(saved.head, version="0.0.9"), saved.states)
    expected = r"run: a checkpoint of version 0\.0\.9; expected one of version \d"
    with pytest.raises(InputError, match=expected):
        Checkpoint.from_bytes(other.to_bytes(), "run")


def test_a_checkpoint_of_another_system_is_refused() -> None:
    other = axis_checkpoint(AXIS.replace('name = "axis"', 'name = "other"').replace("200.0", "100.0"))
    with pytest.raises(InputError, match=r"a checkpoint of system other; .* system axis, .* name, sample_rate"):
        Checkpoint.from_bytes(other.to_bytes(), "run").put_into(axis_estimator(AXIS))


@pytest.mark.parametrize("broken", [b"", b"nothing", b"PK\x03\x04", msgspec.msgpack.encode({"head": {}})])
def test_a_file_that_is_no_checkpoint_is_refused(broken: bytes) -> None:
    with pytest.raises(InputError, match=r"run: no usable checkpoint \(.*\); expected a checkpoint that"):
        Checkpoint.from_bytes(broken, "run")


@pytest.mark.parametrize("states", [{}, {"state": {"samples": "many"}}, {"_other": {}}])
def test_states_that_do_not_fit_are_refused(states: dict[str, Any]) -> None:
    saved = axis_checkpoint(AXIS)
    broken = Checkpoint(saved.head, {"estimator": states})
    with pytest.raises(InputError, match="no usable checkpoint"):
        broken.put_into(axis_estimator(AXIS))


def axis_estimator(text: str) -> Estimator:
    return Estimator(parse_system(text, "axis.toml"), ("force_1", "q_1"), "axis")


@cache
def axis_checkpoint(text: str) -> Checkpoint:
    """After three seconds."""
    estimator = axis_estimator(text)
    estimator.push(next(iter(axis_block(coulomb=0.0).pieces(600))))
    return Checkpoint.of(estimator)
