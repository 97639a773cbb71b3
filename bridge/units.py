"""The unit written beside a number."""

from enum import StrEnum


class Unit(StrEnum):
    """SI units and the few dimensionless ones that measurements carry."""

    METRE = "m"
    RADIAN = "rad"
    SECOND = "s"
    NANOSECOND = "ns"
    DECIBEL = "dB"
    FRACTION = "1"
    COUNT = "count"
    PERCENTAGE_POINT = "pp"
