"""Room that one chunk after another is read and unpacked into.

A megabyte asked of the system for every chunk costs 256 page faults, a third of the time a
recovery takes; room that is used again costs none.
"""

import zstandard

from bridge.episode.mcap.record_file import RecordFile


class Scratch:
    """Two buffers that grow as needed; what they hold is lost with the next chunk."""

    def __init__(self) -> None:
        """Begin without any room."""
        self._record = bytearray()
        self._unpacked = bytearray()

    def read(self, file: RecordFile, offset: int, size: int) -> memoryview:
        """Read up to ``size`` bytes, fewer only at the end of the file."""
        if len(self._record) < size:
            self._record = bytearray(size)
        room = memoryview(self._record)[:size]
        return room[: file.read_into(offset, room)]

    def unpack(self, frame: memoryview, size: int) -> memoryview | None:
        """Unpack a zstd frame of exactly ``size`` bytes; None when it is something else."""
        if len(self._unpacked) < size:
            self._unpacked = bytearray(size)
        room = memoryview(self._unpacked)[:size]
        reader = zstandard.ZstdDecompressor().stream_reader(frame)
        done = 0
        while done < size:
            count = reader.readinto(room[done:])
            if not count:
                return None
            done += count
        return None if reader.read(1) else room
