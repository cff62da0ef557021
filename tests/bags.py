"""One simulated motion in every format of a log, each written by the format's own library."""

from __future__ import annotations

import json
from collections.abc import Callable, Iterable, Iterator
from pathlib import Path
from typing import Any

import numpy as np
from mcap.writer import Writer as McapWriter
from rosbags.rosbag1 import Writer as Writer1
from rosbags.rosbag2 import StoragePlugin
from rosbags.rosbag2 import Writer as Writer2
from rosbags.typesys import Stores, get_types_from_msg, get_typestore

import sms_online as sms

# Instant of the first sample, ns since 1970.
EPOCH = 1_700_000_000_123_456_789
MARKERS = "rig_msgs/msg/Markers"
MARKERS_TEXT = "std_msgs/Header header\nfloat64 attitude\nfloat64[] displacement\n"
# Topic and path of each channel of the planar example, in the words of the system file.
PATHS = {
    "tau_1": "/torque_1.wrench.torque.z",
    "tau_2": "/torque_2.wrench.torque.z",
    "theta_m_1": "/joint_states.position[shoulder]",
    "theta_m_2": "/joint_states.position[elbow]",
    "r_S_x": "/base.pose.position.x",
    "r_S_y": "/base.pose.position.y",
    "theta_0": "/markers.attitude",
    "wrench_1.f_x": "/contact.wrench.force.x",
    "wrench_1.f_y": "/contact.wrench.force.y",
    "wrench_1.m_z": "/contact.wrench.torque.z",
}


def path_of(channel: str, channels: tuple[str, ...]) -> str:
    """Where a channel's samples are in a bag: markers in one list."""
    markers = [each for each in channels if each not in PATHS]
    return PATHS.get(channel) or f"/markers.displacement[{markers.index(channel)}]"


def nanoseconds(capture: sms.Capture) -> list[int]:
    """Instants of the samples, ns after the first."""
    whole = np.rint((capture.t - capture.t[0]) * 1e9).astype(int)
    assert np.array_equal(whole / 1e9, capture.t)  # so that nothing is lost on the way
    out: list[int] = whole.tolist()
    return out


def typestore(ros: int) -> Any:
    store = get_typestore(Stores.ROS2_HUMBLE if ros == 2 else Stores.ROS1_NOETIC)
    store.register(get_types_from_msg(MARKERS_TEXT, MARKERS))
    return store


def messages(capture: sms.Capture, ros: int) -> Iterator[tuple[str, str, int, Any]]:
    """Topic, type, instant (ns) and message, in order of time; joints in another order than in the capture."""
    types = typestore(ros).types
    point, quaternion, pose = (types[f"geometry_msgs/msg/{name}"] for name in ("Point", "Quaternion", "Pose"))
    vector, wrench = types["geometry_msgs/msg/Vector3"], types["geometry_msgs/msg/Wrench"]
    column = {name: k for k, name in enumerate(capture.channels)}
    markers = [k for name, k in column.items() if name not in PATHS]
    for number, (at, row) in enumerate(zip(nanoseconds(capture), capture.values, strict=True)):
        seconds, rest = divmod(EPOCH + at, 1_000_000_000)
        stamp = types["builtin_interfaces/msg/Time"](seconds, rest)
        head = (stamp, "rig") if ros == 2 else (number, stamp, "rig")
        header = types["std_msgs/msg/Header"](*head)

        def value(name: str, row: Any = row) -> float:
            return float(row[column[name]])

        nothing = np.empty(0)
        angles = np.array([value("theta_m_2"), value("theta_m_1")])
        joints = types["sensor_msgs/msg/JointState"](header, ["elbow", "shoulder"], angles, nothing, nothing)
        yield "/joint_states", "sensor_msgs/msg/JointState", EPOCH + at, joints
        for k in (1, 2):
            torque = wrench(vector(0.0, 0.0, 0.0), vector(0.0, 0.0, value(f"tau_{k}")))
            stamped = types["geometry_msgs/msg/WrenchStamped"](header, torque)
            yield f"/torque_{k}", "geometry_msgs/msg/WrenchStamped", EPOCH + at, stamped
        if "wrench_1.f_x" in column:
            push = vector(value("wrench_1.f_x"), value("wrench_1.f_y"), 0.0)
            pushed = types["geometry_msgs/msg/WrenchStamped"](
                header, wrench(push, vector(0.0, 0.0, value("wrench_1.m_z")))
            )
            yield "/contact", "geometry_msgs/msg/WrenchStamped", EPOCH + at, pushed
        place = point(value("r_S_x"), value("r_S_y"), 0.0)
        base = pose(place, quaternion(0.0, 0.0, 0.0, 1.0))
        yield "/base", "geometry_msgs/msg/PoseStamped", EPOCH + at, types["geometry_msgs/msg/PoseStamped"](header, base)
        yield "/markers", MARKERS, EPOCH + at, types[MARKERS](header, value("theta_0"), row[markers].copy())


def write_ros2(capture: sms.Capture, path: Path, plugin: StoragePlugin = StoragePlugin.SQLITE3) -> Path:
    """A ROS 2 bag, in SQLite or MCAP."""
    store = typestore(2)
    with Writer2(path, version=9, storage_plugin=plugin) as writer:
        _write(writer, store, store.serialize_cdr, messages(capture, 2))
    return path


def write_ros1(capture: sms.Capture, path: Path) -> Path:
    """A ROS 1 bag."""
    store = typestore(1)
    with Writer1(path) as writer:
        _write(writer, store, store.serialize_ros1, messages(capture, 1))
    return path


def _write(
    writer: Writer1 | Writer2,
    store: Any,
    serialised: Callable[[Any, str], Any],
    sent: Iterable[tuple[Any, ...]],
) -> None:
    connections: dict[str, Any] = {}
    for topic, kind, at, message in sent:
        if topic not in connections:
            connections[topic] = writer.add_connection(topic, kind, typestore=store)
        writer.write(connections[topic], at, serialised(message, kind))


def json_message(capture: sms.Capture, topic: str, row: Any) -> dict[str, Any]:
    """What a topic says of a row, nested by its paths."""
    column = {name: k for k, name in enumerate(capture.channels)}
    value = {name: float(row[k]) for name, k in column.items()}
    if topic == "/joint_states":
        return {"name": ["elbow", "shoulder"], "position": [value["theta_m_2"], value["theta_m_1"]]}
    if topic.startswith("/torque"):
        return {"wrench": {"torque": {"z": value[f"tau_{topic[-1]}"]}}}
    if topic == "/base":
        return {"pose": {"position": {"x": value["r_S_x"], "y": value["r_S_y"]}}}
    markers = [value[name] for name in column if name not in PATHS]
    return {"attitude": value["theta_0"], "displacement": markers}


def write_json_mcap(
    capture: sms.Capture,
    path: Path,
    *,
    delayed: tuple[str, float] = ("", 0.0),
    stamped: bool = True,
    stamp: int | None = None,
) -> Path:
    """An MCAP file of JSON messages, with stamps as Foxglove writes them.

    delayed: a topic whose messages are recorded so much later, s. stamped: whether messages have stamps. stamp: the
    same one in all.
    """
    topics = ("/joint_states", "/torque_1", "/torque_2", "/base", "/markers")
    recorded = [
        (EPOCH + at + (round(1e9 * delayed[1]) if topic == delayed[0] else 0), k, topic)
        for k, at in enumerate(nanoseconds(capture))
        for topic in topics
    ]
    with path.open("wb") as file:
        writer = McapWriter(file, chunk_size=1 << 16)
        writer.start()
        schema = writer.register_schema("rig", "jsonschema", b'{"type": "object"}')
        channels = {topic: writer.register_channel(topic, "json", schema) for topic in topics}
        instants = nanoseconds(capture)
        for at, k, topic in sorted(recorded, key=lambda each: each[0]):
            sec, nsec = divmod(EPOCH + instants[k] if stamp is None else stamp, 1_000_000_000)
            head = {"header": {"stamp": {"sec": sec, "nsec": nsec}}} if stamped else {}
            message = {**head, **json_message(capture, topic, capture.values[k])}
            writer.add_message(channels[topic], at, json.dumps(message).encode(), at)
        writer.finish()
    return path
