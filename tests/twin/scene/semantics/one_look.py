"""The default segmenter with voxels of one size: what the looks of a rebuild are made of."""

from twin.scene.semantics.cluster import SurfacePoints
from twin.scene.semantics.segment import Segmentation, SegmentConfig, ground_of


def segment_points(
    points: SurfacePoints,
    config: SegmentConfig,
) -> Segmentation:
    """Find the things that stand on the plane."""
    ground = ground_of(points, config)
    look = ground.look(1.0)
    numbers = range(1, int(look.labels.max(initial=0)) + 1)
    things = tuple(ground.thing(look.labels == number, look.voxel_m) for number in numbers)
    remark = "" if things else ground.nothing
    return Segmentation(labels=look.labels, things=things, plane=ground.plane, remark=remark)
