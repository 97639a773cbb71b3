"""Clouds of points: back as they went, and as an independent implementation writes them."""

import numpy as np
import pytest

from bridge.episode import schema
from bridge.episode.cdr import codec
from bridge.episode.cdr.messages import PointCloudSample
from bridge.episode.topics import type_of_topic

POINTS = np.random.default_rng(0).normal(size=(7, 3)).astype(np.float32).astype(np.float64)


@pytest.mark.parametrize("count", [0, 1, 7])
def test_a_cloud_comes_back_as_it_went(count: int) -> None:
    sample = PointCloudSample(stamp_ns=1_700_000_000_123, frame_id="base", points_m=POINTS[:count])
    again = PointCloudSample.from_cdr(sample.to_cdr())
    assert (again.stamp_ns, again.frame_id) == (sample.stamp_ns, sample.frame_id)
    np.testing.assert_array_equal(again.points_m, sample.points_m)


def test_rosbags_reads_the_same_cloud() -> None:
    rosbags = pytest.importorskip("rosbags.typesys")
    store = rosbags.get_typestore(rosbags.Stores.ROS2_HUMBLE)
    sample = PointCloudSample(stamp_ns=5_000_000_007, frame_id="base", points_m=POINTS)
    theirs = store.deserialize_cdr(sample.to_cdr(), schema.POINT_CLOUD)
    assert (theirs.header.stamp.sec, theirs.header.stamp.nanosec) == (5, 7)
    assert [field.name for field in theirs.fields] == ["x", "y", "z"]
    assert theirs.width * theirs.height == len(POINTS)
    assert theirs.row_step == len(theirs.data)
    read = np.frombuffer(bytes(theirs.data), dtype="<f4").reshape(-1, 3)
    np.testing.assert_array_equal(read, POINTS.astype(np.float32))
    assert bytes(store.serialize_cdr(theirs, schema.POINT_CLOUD)) == sample.to_cdr()


def test_a_cloud_of_another_layout_is_refused() -> None:
    message = codec.decode(
        schema.POINT_CLOUD, PointCloudSample(stamp_ns=0, frame_id="", points_m=POINTS).to_cdr()
    )
    message["fields"][0]["name"] = "intensity"
    with pytest.raises(codec.MalformedMessageError, match="intensity"):
        PointCloudSample.from_cdr(codec.encode(schema.POINT_CLOUD, message))
    message["fields"][0]["name"] = "x"
    message["width"] = 99
    with pytest.raises(codec.MalformedMessageError, match="bytes"):
        PointCloudSample.from_cdr(codec.encode(schema.POINT_CLOUD, message))


def test_the_topic_of_a_soft_object_carries_clouds() -> None:
    assert type_of_topic("/standin/truth/object/sloth/nodes") == schema.POINT_CLOUD
