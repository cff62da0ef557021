"""Memory of reading a bag of 1 GB, of each format: joint states of seven axes at 1 kHz beside a camera's pictures.

pytest tests/bench/test_bench_bags.py --override-ini addopts= -s

Some six minutes of a core, and 1 GB of the disk at a time.
"""

from __future__ import annotations

import shutil
import subprocess
import sys
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from rosbags.rosbag1 import Writer as Writer1
from rosbags.rosbag2 import StoragePlugin
from rosbags.rosbag2 import Writer as Writer2
from rosbags.typesys import Stores, get_typestore

FORMATS = ("ros1", "ros2", "mcap")
# Messages of joint states: with a picture after every 20, of 20 kB, they take 1 GB.
MESSAGES, EVERY, PICTURE = 710_000, 20, 20_000
AXES = [f"joint_{k}" for k in range(7)]
STATES, PICTURES = "sensor_msgs/msg/JointState", "sensor_msgs/msg/CompressedImage"
MOST = 400.0  # MB

# What a user's program does: every row of the bag, a block at a time.
READ = """
import resource, sys
from pathlib import Path
import sms_online as sms
from sms_adapters.sources import open_source
from sms_online.description.sources import BagSource

signals = {f"/joint_states.effort[joint_{k}]": f"tau_{k + 1}" for k in range(7)}
signals |= {f"/joint_states.position[joint_{k}]": f"q_{k + 1}" for k in range(7)}
source = BagSource(kind="bag", name="rig", signals=signals)
system = sms.load_system("seven-joint").model_copy(update={"sources": (source,)})
rows = sum(block.t.size for block in open_source(Path(sys.argv[1]), system))
print(rows, resource.getrusage(resource.RUSAGE_SELF).ru_maxrss / 1024)
"""


@pytest.fixture(params=FORMATS)
def bag(request: pytest.FixtureRequest, tmp_path: Path) -> Iterator[Path]:
    """A bag of a format, removed afterwards."""
    first = request.param == "ros1"
    path = tmp_path / ("rig.bag" if first else "rig")
    store = get_typestore(Stores.ROS1_NOETIC if first else Stores.ROS2_HUMBLE)
    plugin = StoragePlugin.MCAP if request.param == "mcap" else StoragePlugin.SQLITE3
    with Writer1(path) if first else Writer2(path, version=9, storage_plugin=plugin) as writer:
        topics = {STATES: "/joint_states", PICTURES: "/camera"}
        to = {kind: writer.add_connection(name, kind, typestore=store) for kind, name in topics.items()}
        serialize = store.serialize_ros1 if first else store.serialize_cdr
        for kind, at, message in messages(store.types, first):
            writer.write(to[kind], at, serialize(message, kind))
    yield path
    shutil.rmtree(tmp_path)


def messages(types: Any, numbered: bool) -> Iterator[tuple[str, int, Any]]:
    """Type, instant (ns) and message of what the rig sends."""
    picture = np.random.default_rng(0).integers(0, 256, PICTURE, dtype=np.uint8)
    for k in range(MESSAGES):
        at = 1_700_000_000_000_000_000 + 1_000_000 * k
        stamp = types["builtin_interfaces/msg/Time"](*divmod(at, 1_000_000_000))
        header = types["std_msgs/msg/Header"](*((k, stamp, "rig") if numbered else (stamp, "rig")))
        values = np.sin(1e-3 * k + np.arange(7.0))
        yield STATES, at, types[STATES](header, AXES, values, values, values)
        if k % EVERY == 0:
            yield PICTURES, at, types[PICTURES](header, "jpeg", picture)


def test_memory_of_a_bag_of_1_gb(bag: Path) -> None:
    size = sum(file.stat().st_size for file in ([bag] if bag.is_file() else bag.iterdir()))
    done = subprocess.run([sys.executable, "-c", READ, str(bag)], capture_output=True, text=True, check=True)
    rows, peak = map(float, done.stdout.split())
    print(f"\n{bag.name}: {size / 1e9:.2f} GB, {rows:.0f} rows, peak {peak:.0f} MB")
    assert rows == MESSAGES
    assert peak < MOST
