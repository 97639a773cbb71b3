"""Read pieces of an MCAP file, and tell whether its closing part is right."""

import os
from collections.abc import Iterator

from bridge.episode.mcap import format as mcap
from bridge.episode.mcap.checksum import crc32

BLOCK_BYTES = 1 << 20


class RecordFile:
    """Reads pieces of an open file."""

    def __init__(self, descriptor: int) -> None:
        """Use a descriptor that stays its owner's."""
        self.descriptor = descriptor
        self.size = os.fstat(descriptor).st_size

    def read(self, offset: int, size: int) -> bytes:
        """Return up to ``size`` bytes, fewer only at the end of the file."""
        size = min(size, self.size - offset)
        data = os.pread(self.descriptor, size, offset) if size > 0 else b""
        while len(data) < size:  # one call returns at most 2 GiB
            more = os.pread(self.descriptor, size - len(data), offset + len(data))
            if not more:
                break
            data += more
        return data

    def read_into(self, offset: int, room: memoryview) -> int:
        """Fill ``room`` and return how many bytes there were, fewer only at the end."""
        done = 0
        while done < len(room):
            count = os.preadv(self.descriptor, [room[done:]], offset + done)
            if not count:
                break
            done += count
        return done

    def blocks(self, offset: int, size: int) -> Iterator[bytes]:
        """Return a range in blocks."""
        end = min(offset + size, self.size)
        while offset < end:
            block = self.read(offset, min(BLOCK_BYTES, end - offset))
            if not block:
                return
            yield block
            offset += len(block)

    def crc(self, offset: int, size: int) -> int:
        """CRC-32 of a range."""
        crc = 0
        for block in self.blocks(offset, size):
            crc = crc32(block, crc)
        return crc


def finished_data_end(file: RecordFile) -> int | None:
    """Return where the data of a finished file ends, None unless its closing CRCs are right."""
    size = mcap.RECORD_HEAD.size + mcap.FOOTER_FIELDS.size + len(mcap.MAGIC)
    if file.size < 2 * size:
        return None
    footer = file.read(file.size - size, size)
    expected = mcap.RECORD_HEAD.pack(mcap.FOOTER, mcap.FOOTER_FIELDS.size)
    if not (footer.startswith(expected) and footer.endswith(mcap.MAGIC)):
        return None
    start, _, summary_crc = mcap.FOOTER_FIELDS.unpack_from(footer, mcap.RECORD_HEAD.size)
    end = start - mcap.RECORD_HEAD.size - 4
    if end < len(mcap.MAGIC) or start > file.size - size:
        return None
    if summary_crc != file.crc(start, file.size - start - len(mcap.MAGIC) - 4):
        return None
    data_end = file.read(end, start - end)
    crc = int.from_bytes(data_end[-4:], "little")
    if not data_end.startswith(mcap.RECORD_HEAD.pack(mcap.DATA_END, 4)):
        return None
    return end if crc in (0, file.crc(0, end)) else None
