"""Clouds of points: sensor_msgs/PointCloud2 with x, y and z as float32, and nothing else."""

from dataclasses import dataclass

import numpy as np
from jaxtyping import Float

from bridge.clock import split_ns
from bridge.episode import cdr, schema
from bridge.episode.records import stamp_of

FLOAT32 = 7
"""PointField's number for this type."""
POINT_STEP = 12


@dataclass(frozen=True, kw_only=True)
class PointCloudSample:
    """Points of one body at one instant."""

    stamp_ns: int
    frame_id: str
    points_m: Float[np.ndarray, "num_points 3"]

    def to_cdr(self) -> bytes:
        """Serialise as sensor_msgs/PointCloud2."""
        sec, nanosec = split_ns(self.stamp_ns)
        count = len(self.points_m)
        message = {
            "header": {"stamp": {"sec": sec, "nanosec": nanosec}, "frame_id": self.frame_id},
            "height": 1,
            "width": count,
            "fields": [
                {"name": name, "offset": 4 * index, "datatype": FLOAT32, "count": 1}
                for index, name in enumerate("xyz")
            ],
            "point_step": POINT_STEP,
            "row_step": POINT_STEP * count,
            "data": self.points_m.astype("<f4").tobytes(),
            "is_dense": True,
        }
        return cdr.encode(schema.POINT_CLOUD, message)

    @staticmethod
    def from_cdr(data: bytes) -> "PointCloudSample":
        """Read a cloud as ``to_cdr`` writes it.

        Raises:
            MalformedMessageError: Another layout of fields, or bytes that are no cloud.
        """
        message = cdr.decode(schema.POINT_CLOUD, data)
        layout = [(item["name"], item["offset"], item["datatype"]) for item in message["fields"]]
        raw, count = bytes(message["data"]), int(message["width"]) * int(message["height"])
        if (
            layout != [(name, 4 * index, FLOAT32) for index, name in enumerate("xyz")]
            or message["is_bigendian"]
            or int(message["point_step"]) != POINT_STEP
            or len(raw) != POINT_STEP * count
        ):
            raise cdr.MalformedMessageError(
                type_name=schema.POINT_CLOUD, found=f"fields {layout} over {len(raw)} bytes"
            )
        return PointCloudSample(
            stamp_ns=stamp_of(message),
            frame_id=message["header"]["frame_id"],
            points_m=np.frombuffer(raw, dtype="<f4").reshape(-1, 3).astype(np.float64),
        )
