"""How a topic travels when the network is behind. Imports nothing heavy.

``docs/qos.md`` says which preset belongs to which topic, with the measurements.
"""

from dataclasses import dataclass
from typing import ClassVar

from bridge.episode.topics import service_of_topic


@dataclass(frozen=True, kw_only=True)
class Qos:
    """One choice for one topic; use the presets."""

    block: bool
    """Wait for space when the network is behind; otherwise the message is lost and the receiver
    sees a gap in the numbers."""
    priority: str
    """Which of zenoh's queues carries it, by its name there; a full queue delays no other one."""
    shared_memory: bool = False
    """Large messages go through shared memory when the session has some."""
    is_remote: bool = False
    """Subscribers of the same session get none, and do not count as somebody who looks."""

    @classmethod
    def of(cls, topic: str) -> "Qos":
        """Choose the preset of one of our topics; what is not known is reliable."""
        presets = {"camera": cls.CAMERA, "control": cls.CONTROL, "reliable": cls.RELIABLE}
        return presets[service_of_topic(topic)]

    CAMERA: ClassVar["Qos"]
    """Images: many bytes, each worth little; the newest frame is never worth a stall."""
    CONTROL: ClassVar["Qos"]
    """Joints and whatever else a control loop sends: small, frequent, never waits."""
    RELIABLE: ClassVar["Qos"]
    """Plans, events, labels, files: nothing may be lost and the sender can wait."""
    PREVIEW: ClassVar["Qos"]
    """Pictures for a person; the first to go."""


Qos.CAMERA = Qos(block=False, priority="data_low", shared_memory=True)
Qos.CONTROL = Qos(block=False, priority="real_time")
Qos.RELIABLE = Qos(block=True, priority="data")
Qos.PREVIEW = Qos(block=False, priority="background", is_remote=True)
