import json
import sys
from pathlib import Path

import pytest

from drocap_ros.errors import InputError
from drocap_ros.recording.mcap.metadata import own_definitions, schema_text, standard_types, type_hash


def test_schema_is_the_file_followed_by_its_dependencies(root):
    text = schema_text("drocap_ros/msg/Pose3DWindow")
    first, *rest = text.split("=" * 80 + "\n")
    assert first == (root / "msg" / "Pose3DWindow.msg").read_text()
    names = [part.split("\n", 1)[0] for part in rest]
    assert set(names) == {
        "MSG: drocap_ros/Pose3D",
        "MSG: std_msgs/Header",
        "MSG: builtin_interfaces/Time",
        "MSG: geometry_msgs/Quaternion",
    }
    assert len(names) == len(set(names))
    pose3d = next(part for part in rest if part.startswith("MSG: drocap_ros/Pose3D\n"))
    assert pose3d.split("\n", 1)[1] == (root / "msg" / "Pose3D.msg").read_text()


@pytest.mark.parametrize("name", [*sorted(own_definitions()), "sensor_msgs/msg/CameraInfo", "tf2_msgs/msg/TFMessage"])
def test_schema_defines_the_whole_type(name):
    from rosbags.typesys import Stores, get_types_from_msg, get_typestore

    store = get_typestore(Stores.EMPTY)
    store.register(get_types_from_msg(schema_text(name), name))
    assert store.fielddefs[name] == standard_types().fielddefs[name]
    assert type_hash(name, schema_text(name)).startswith("RIHS01_")


def test_hash_equals_the_one_of_ros():
    share = Path(sys.prefix) / "share" / "std_msgs" / "msg" / "Header.json"
    if not share.exists():
        pytest.skip("no ROS message packages in this environment to compare with")
    table = json.loads(share.read_text())["type_hashes"]
    theirs = {row["type_name"]: row["hash_string"] for row in table}
    assert type_hash("std_msgs/msg/Header", schema_text("std_msgs/msg/Header")) == theirs["std_msgs/msg/Header"]


def test_unknown_type_is_refused():
    with pytest.raises(InputError, match="expected one of drocap_ros"):
        schema_text("nobody/msg/Knows")
